"""The RealSense driver against the SDK's own software device, recorder and player."""

import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from realsim.records import CameraIntrinsics
from realsim_capture_plans.devices.interfaces import DepthCamera, DeviceError
from realsim_capture_plans.devices.realsense import (
    EndOfRecordingError,
    RealSenseCamera,
    RealSenseConfig,
    intrinsics_of,
)
from refusals import refused
from software_realsense import FOCAL, FRAME_MS, HEIGHT, WIDTH, Software, depth_of, raw_intrinsics

DATA = Path(os.environ.get("REALSIM_DATA", "../shared/data"))
FAST = RealSenseConfig(width=WIDTH, height=HEIGHT, settle_pairs=2, timeout_s=1.0)


Make = Callable[..., Software]


@pytest.fixture
def make(rs: Any) -> Iterator[Make]:
    made: list[Software] = []

    def new(**options: Any) -> Software:
        made.append(Software(rs, **options))
        return made[-1]

    yield new
    for software in made:
        software.halt()


@pytest.fixture
def opened() -> Iterator[Callable[..., RealSenseCamera]]:
    cameras: list[RealSenseCamera] = []

    def new(software: Software, config: RealSenseConfig = FAST, **options: Any) -> RealSenseCamera:
        cameras.append(RealSenseCamera(config=config, devices=software.devices, **options))
        return cameras[-1]

    yield new
    for camera in cameras:
        camera.close()


Open = Callable[..., RealSenseCamera]
TWO = {
    "model": "Software D435", "two_sensors": True, "color_count": 41, "color_delay_ms": 7.0,
}  # fmt: skip


# --- live ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("sensors", "lag"), [(1, 5), (2, 0)])
def test_depth_and_colour_of_a_frame_are_of_one_exposure(
    make: Make, opened: Open, sensors: int, lag: int
) -> None:
    software = make(color_lag=lag, **(TWO if sensors == 2 else {}))
    camera: DepthCamera = opened(software)
    software.run()
    times: list[float] = []
    for _ in range(4):
        frame = camera.grab()
        number = round((1e3 * frame.time_s - software.color_delay_ms) / FRAME_MS)
        assert np.all(frame.rgb == number % 200)
        assert np.array_equal(frame.depth_m, (depth_of(number) * 1e-4).astype(np.float32))
        times.append(frame.time_s)
    assert np.all(np.diff(times) > 0)


def test_one_sensor_whose_counters_differ_is_refused(make: Make, opened: Open) -> None:
    software = make(color_count=1000)
    camera = opened(software)
    software.run()
    refused(r"never had the same frame number .*depth frame \d+ at", camera.grab, error=DeviceError)


def test_what_it_says_of_itself(make: Make, opened: Open) -> None:
    T = se3.from_rt(se3.exp_so3([0.001, -0.02, 0.003]), [0.015, 1e-4, -2e-4])
    camera = opened(make(**TWO, color_focal=300.0, T_color_depth=T))
    assert (camera.name, camera.depth_unit_m) == ("Software D435 SW0001", 1e-4)
    assert (camera.intrinsics.fx, camera.intrinsics.cy) == (300.0, 179.5)
    told = json.loads(json.dumps(camera.description, allow_nan=False))
    assert (told["serial"], told["firmware"], told["usb_type"]) == ("SW0001", "5.16.0.1", "3.2")
    assert told["depth_unit_m"] == 1e-4 and told["pairs_by"] == "time stamp"
    assert (told["factory"]["color"]["fx"], told["factory"]["depth"]["fx"]) == (300.0, FOCAL)
    np.testing.assert_allclose(told["factory"]["T_color_depth"], T, atol=1e-7)
    se3.check_rigid(np.array(told["factory"]["T_color_depth"]), "extrinsics")
    assert told["options"]["Stereo Module"]["enable_auto_exposure"] == 1.0
    assert told["depth_aligned_to_color"]


def test_depth_of_a_turned_sensor_is_along_the_colour_cameras_axis(
    make: Make, opened: Open
) -> None:
    # Turned by 1.5 degrees: depth left along its own axis would be 13 mm off at the border.
    T = se3.from_rt(se3.exp_so3([0.004, 0.026, 0.002]), [0.015, 0.001, -0.002])
    normal, distance = np.array([0.1, -0.05, 1.0]), 0.5  # n . p = d in depth coordinates
    depth_lens = CameraIntrinsics(
        width=WIDTH, height=HEIGHT, fx=FOCAL, fy=FOCAL + 1, cx=319.5, cy=179.5
    )
    counts = np.round(distance / (ray_table(depth_lens) @ normal) / 1e-4).astype(np.uint16)
    software = make(**TWO, color_focal=310.0, T_color_depth=T, depth=lambda _: counts)
    camera = opened(software)
    software.run()
    depth_m = camera.grab().depth_m
    n = T[:3, :3] @ normal
    expected = (distance + n @ T[:3, 3]) / (ray_table(camera.intrinsics) @ n)
    seen = depth_m > 0
    assert seen.mean() > 0.85
    slope = np.abs(np.gradient(expected)).max()  # the SDK rounds to whole pixels
    assert np.abs(depth_m - expected)[seen].max() < slope + 2e-4
    assert abs(np.mean((depth_m - expected)[seen])) < 1e-4


# --- exposure ------------------------------------------------------------------------------------


def exposure_of(rs: Any, sensor: Any) -> tuple[float, float]:
    options = rs.option
    return sensor.get_option(options.enable_auto_exposure), sensor.get_option(options.exposure)


def test_exposure_is_automatic_fixed_or_locked(rs: Any, make: Make, opened: Open) -> None:
    software = make(**TWO)
    opened(software, replace(FAST, exposure=5000.0)).close()
    # A colour sensor of its own counts 100 us.
    assert exposure_of(rs, software.stereo) == (0.0, 5000.0)
    assert exposure_of(rs, software.color_sensor) == (0.0, 50.0)
    opened(software, replace(FAST, exposure="auto")).close()
    assert exposure_of(rs, software.stereo)[0] == 1.0
    camera = opened(software, replace(FAST, exposure="locked"))
    assert exposure_of(rs, software.stereo)[0] == 1.0
    software.run()
    camera.grab()
    assert exposure_of(rs, software.stereo) == (0.0, 8123.0)
    assert exposure_of(rs, software.color_sensor) == (0.0, 81.0)
    assert camera.last_metadata["depth"]["exposure_us"] == 8123.0
    assert camera.description["options"]["Stereo Module"]["exposure"] == 8123.0
    software.halt()
    refused(r"takes 1 to 165000 us", opened, software, replace(FAST, exposure=1e9))


# --- trouble -------------------------------------------------------------------------------------


def test_a_dead_colour_stream_is_named(make: Make, opened: Open) -> None:
    software = make()
    camera = opened(software)
    software.send_depth(1)
    refused("only depth came", camera.grab, error=DeviceError)


def test_an_unplugged_camera_is_named_and_goes_on_when_it_is_back(rs: Any, make: Make) -> None:
    first, other = make(), make(serial="SW0002")
    connected = [first, other]
    camera = RealSenseCamera(
        "SW0001", FAST, devices=lambda: [d for s in connected for d in s.devices()]
    )
    try:
        first.run()
        before = camera.grab()
        first.halt()
        first.plugged = False
        refused(r"SW0001 .* not connected any more", camera.grab, error=DeviceError)
        assert camera.description["serial"] == "SW0001"
        # The other camera on the bus is not taken in its place.
        refused(r"SW0001 is not connected \(connected: SW0002\)", camera.recover, error=DeviceError)
        connected[0] = back = make()
        camera.recover()
        back.run()
        assert camera.grab().rgb.shape == before.rgb.shape
        camera.recover()  # no error while it is well
        camera.grab()
    finally:
        camera.close()


def test_a_stream_that_the_device_lacks_is_named(make: Make, opened: Open) -> None:
    with pytest.raises(DeviceError, match=r"no stream .*1280, 720, 30; there is .*640x360 at 30"):
        opened(make(), RealSenseConfig())
    refused("16:9", opened, make(), RealSenseConfig(width=640, height=480))


def test_distortion_models(rs: Any) -> None:
    terms = [0.1, -0.2, 1e-3, 2e-3, 0.05]
    brown = intrinsics_of(raw_intrinsics(rs, rs.distortion.brown_conrady, terms))
    assert brown.distortion == pytest.approx([*terms, 0, 0, 0], abs=1e-7)
    inverse = rs.distortion.inverse_brown_conrady
    assert not intrinsics_of(raw_intrinsics(rs, inverse, [0.0] * 5)).is_distorted
    with pytest.raises(InputError, match="inverse_brown_conrady"):
        intrinsics_of(raw_intrinsics(rs, inverse, [0.1, 0.0, 0.0, 0.0, 0.0]))


# --- recordings ----------------------------------------------------------------------------------

SENT = 26


def record(rs: Any, software: Software, path: Path, numbers: list[int]) -> None:
    """Record frames with the SDK's own recorder."""
    sensors = rs.recorder(str(path), software.device).query_sensors()
    came: list[int] = []
    for sensor in sensors:
        sensor.open(sensor.get_stream_profiles())
        sensor.start(lambda frame: came.append(frame.get_frame_number()))
    expected = 0
    for number in numbers:
        software.send(number)
        expected += 1 + (number > software.color_lag)
        end = time.monotonic() + 10
        while len(came) < expected and time.monotonic() < end:
            time.sleep(0.001)
    for sensor in sensors:
        sensor.stop()
        sensor.close()


def test_a_recording_gives_every_pair_once_and_bit_exact(
    rs: Any, make: Make, tmp_path: Path
) -> None:
    lag = 3
    software = make(color_lag=lag, **TWO)
    lost = {9, 10, 19}
    record(rs, software, tmp_path / "r.db3", [n for n in range(1, SENT + 1) if n not in lost])
    # Frame 9's depth was lost, and the colour that would have been sent then.
    depths = set(range(1, SENT + 1)) - lost
    colors = {n - lag for n in depths if n > lag}
    camera = RealSenseCamera.from_recording(tmp_path / "r.db3")
    try:
        assert (camera.name, camera.depth_unit_m) == (f"{software.model} SW0001", 1e-4)
        assert camera.description["recording"] == "r.db3"
        for turn in range(2):
            found: list[int] = []
            with pytest.raises(EndOfRecordingError, match="no more pairs"):
                while True:
                    frame = camera.grab()
                    number = round((1e3 * frame.time_s - software.color_delay_ms) / FRAME_MS)
                    assert np.all(frame.rgb == number % 200)
                    counts = np.round(frame.depth_m / 1e-4).astype(np.uint16)
                    assert np.array_equal(counts, depth_of(number))
                    assert camera.last_metadata["depth"]["exposure_us"] == 8123.0
                    found.append(number)
                    if turn == 1:  # a slow reader loses nothing either
                        time.sleep(0.01)
            assert found == sorted(depths & colors)
            camera.reopen()
    finally:
        camera.close()


def test_a_recording_that_is_none_is_named(tmp_path: Path) -> None:
    refused("does not exist", RealSenseCamera.from_recording, tmp_path / "none.db3")
    (tmp_path / "text.db3").write_text("not a recording")
    with pytest.raises(InputError, match="not a recording that the RealSense SDK can play"):
        RealSenseCamera.from_recording(tmp_path / "text.db3")


@pytest.mark.real
def test_a_real_d435_recording_without_a_pair_says_so() -> None:
    path = DATA / "bags/single_depth_color_640x480.bag"
    if not path.is_file():
        pytest.skip(f"{path} is not there; set REALSIM_DATA")
    camera = RealSenseCamera.from_recording(path)
    try:
        told = camera.description
        assert told["model"] == "Intel RealSense D435" and told["depth_unit_m"] == 1e-3
        assert told["factory"]["color"]["fx"] == pytest.approx(613.2037, abs=1e-3)
        assert told["factory"]["depth"]["fx"] == pytest.approx(390.4315, abs=1e-3)
        # Its two depth frames are 102 and 268 ms from its colour frame, at 6 frames per second.
        refused("no pair of depth and colour", camera.grab, error=EndOfRecordingError)
    finally:
        camera.close()
