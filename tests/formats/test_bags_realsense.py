"""librealsense's own recordings: a real .bag of a D435, and a .db3 by the SDK's software device."""

import os
import sqlite3
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from realsim.formats.bags import BagChoice, open_bag
from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from refusals import refused

BAGS = Path(os.environ.get("REALSIM_DATA", "../shared/data")) / "bags"
WIDTH, HEIGHT = 320, 240
T_COLOUR_DEPTH = se3.from_rt(se3.exp_so3(np.array([0.01, -0.02, 0.03])), [0.015, 0.001, 0.002])
FRAMES = 5


def real(name: str) -> Path:
    path = BAGS / name
    if not path.exists():
        pytest.skip(f"{path} is not here: set REALSIM_DATA")
    return path


# --- a real recording -----------------------------------------------------------------------------


@pytest.mark.real
def test_a_real_d435s_depth_lies_on_its_colour_image() -> None:
    path = real("single_depth_color_640x480.bag")
    source = open_bag(path, BagChoice(max_pair_gap_s=0.11))
    assert len(source) == 1
    assert source.depth_unit_m == 0.001
    assert source.intrinsics.fx == pytest.approx(613.20367)
    assert source.extra["camera"]["Name"] == "Intel RealSense D435"
    assert source.reprojection is not None
    T = source.reprojection.T_colour_depth
    assert T[:3, 3] == pytest.approx([0.0143113, 0.0006023, 0.0006108], abs=1e-6)

    def distance_px(T_tried: Any) -> float:
        """Median-free mean distance of depth edges from colour edges, at most 8 px."""
        assert source.reprojection is not None
        tried = replace(source, reprojection=replace(source.reprojection, T_colour_depth=T_tried))
        frame = next(iter(tried.frames()))
        assert frame.depth_counts is not None
        depth = frame.depth_counts.astype(np.float32)
        edges = cv2.Canny(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), 60, 150)
        far = cv2.distanceTransform((edges == 0).astype(np.uint8), cv2.DIST_L2, 5)
        steps = cv2.morphologyEx(depth, cv2.MORPH_GRADIENT, np.ones((3, 3))) > 80
        whole = cv2.erode((depth > 0).astype(np.uint8), np.ones((5, 5))) > 0
        assert np.sum(steps & whole) > 50
        return float(np.minimum(far[steps & whole], 8).mean())

    turned, shifted = se3.from_rt(T[:3, :3].T, T[:3, 3]), se3.from_rt(T[:3, :3], -T[:3, 3])
    right = distance_px(T)
    assert right < 4
    for wrong in (se3.invert(T), np.eye(4), turned, shifted):
        assert distance_px(wrong) > 1.5 * right


# --- the SDK's recorder ---------------------------------------------------------------------------


def wall(k: int) -> Any:
    """Return depth counts (H, W) of a slope that no two frames share."""
    u = np.arange(WIDTH)[None] + np.zeros((HEIGHT, 1))
    return (4000 + 2 * u + k).astype(np.uint16)


def picture(k: int) -> Any:
    return np.random.default_rng(k).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def record(rs: Any, path: Path, model: Any = None, coefficients: Any = (0.0,) * 5) -> Path:
    """Record frames of a device with two sensors; colour comes 20 ms after its depth."""
    device = rs.software_device()
    device.register_info(rs.camera_info.name, "Software D435")
    device.register_info(rs.camera_info.serial_number, "SW0002")

    def stream(name: str, kind: Any, uid: int, pixel: Any, size: int, focal: float) -> Any:
        sensor = device.add_sensor(name)
        s, raw = rs.video_stream(), rs.intrinsics()
        raw.width, raw.height = WIDTH, HEIGHT
        raw.fx, raw.fy, raw.ppx, raw.ppy = focal, focal + 1, 159.5, 119.5
        raw.model, raw.coeffs = model or rs.distortion.brown_conrady, list(coefficients)
        s.type, s.index, s.uid, s.width, s.height, s.fps = kind, 0, uid, WIDTH, HEIGHT, 30
        s.bpp, s.fmt, s.intrinsics = size, pixel, raw
        return sensor, sensor.add_video_stream(s).as_video_stream_profile()

    stereo, depth = stream("Stereo Module", rs.stream.depth, 1, rs.format.z16, 2, 250.0)
    rgb, colour = stream("RGB Camera", rs.stream.color, 2, rs.format.rgb8, 3, 260.0)
    stereo.add_read_only_option(rs.option.depth_units, 1e-4)
    extrinsics = rs.extrinsics()
    extrinsics.rotation = list(T_COLOUR_DEPTH[:3, :3].T.ravel())  # by columns
    extrinsics.translation = list(T_COLOUR_DEPTH[:3, 3])
    depth.register_extrinsics_to(colour, extrinsics)
    recorder = rs.recorder(str(path), device)
    sensors, queue = recorder.query_sensors(), rs.frame_queue(100)
    for sensor, profile in zip(sensors, (depth, colour), strict=True):
        sensor.open(profile)
        sensor.start(queue)
    for k in range(FRAMES):
        shots = (stereo, depth, wall(k), 2), (rgb, colour, picture(k), 3)
        for sensor, profile, image, size in shots:
            frame = rs.software_video_frame()
            frame.pixels, frame.bpp, frame.stride = image, size, WIDTH * size
            frame.timestamp, frame.frame_number = 1000.0 + 33.0 * k, k + 1
            frame.domain, frame.profile = rs.timestamp_domain.hardware_clock, profile
            sensor.on_video_frame(frame)
            time.sleep(0.02)  # later than half a frame: the time of recording would not join them
    time.sleep(0.2)
    for sensor in sensors:
        sensor.stop()
        sensor.close()
    del recorder
    return path


@pytest.fixture(scope="module")
def recorded(rs: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(rs, tmp_path_factory.mktemp("realsense") / "software.db3")


def test_frames_carry_the_devices_own_time_unit_and_extrinsics(recorded: Path) -> None:
    source = open_bag(recorded)
    assert len(source) == FRAMES
    assert source.depth_unit_m == 1e-4
    assert (source.intrinsics.fx, source.intrinsics.fy) == (260.0, 261.0)
    assert source.extra["camera"]["Serial Number"] == "SW0002"
    assert source.reprojection is not None
    assert np.allclose(source.reprojection.T_colour_depth, T_COLOUR_DEPTH, atol=2e-6)
    unprojected = replace(source, reprojection=None)
    for k, (frame, raw) in enumerate(zip(source.frames(), unprojected.frames(), strict=True)):
        assert frame.time_s == pytest.approx(1.0 + 0.033 * k, abs=1e-9)
        assert np.array_equal(frame.rgb, picture(k))
        assert raw.depth_counts is not None and frame.depth_counts is not None
        assert np.array_equal(raw.depth_counts, wall(k))


def test_projection_agrees_with_the_sdks_own_alignment(rs: Any, recorded: Path) -> None:
    config, pipeline = rs.config(), rs.pipeline()
    config.enable_device_from_file(str(recorded), repeat_playback=False)
    profile = pipeline.start(config)
    profile.get_device().as_playback().set_real_time(False)
    align = rs.align(rs.stream.color)
    theirs: dict[int, Any] = {}
    try:
        while True:
            frames = pipeline.wait_for_frames(1000)
            depth, colour = frames.get_depth_frame(), frames.get_color_frame()
            if depth and colour and depth.get_frame_number() == colour.get_frame_number():
                aligned = align.process(frames).get_depth_frame()
                theirs[depth.get_frame_number()] = np.asanyarray(aligned.get_data()).copy()
    except RuntimeError:
        pass  # the end of the file
    finally:
        pipeline.stop()
    assert theirs
    source = open_bag(recorded)
    ours = list(source.frames())
    for number, image in theirs.items():
        mine = ours[number - 1].depth_counts
        assert mine is not None
        both = (mine > 0) & (image > 0)
        assert both.mean() > 0.85
        # The SDK writes the depth camera's z into the colour image; ours is the colour camera's.
        points = ray_table(source.intrinsics).astype(float) * (mine * 1e-4)[..., None]
        z = se3.transform(se3.invert(T_COLOUR_DEPTH), points.reshape(-1, 3))[:, 2] * 1e4
        difference = (z.reshape(mine.shape) - image)[both]
        assert np.abs(difference).max() < 6  # counts: 2 a pixel
        assert np.percentile(np.abs(difference), 90) < 3
        assert abs(difference.mean()) < 1.5
        assert np.mean((mine > 0) != (image > 0)) < 0.03


def test_another_lens_model_is_refused_though_camera_info_says_plumb_bob(
    rs: Any, tmp_path: Path
) -> None:
    model = rs.distortion.inverse_brown_conrady
    path = record(rs, tmp_path / "inverse.db3", model, (0.1, 0.0, 0.0, 0.0, 0.0))
    refused("Inverse Brown Conrady", open_bag, path)


def test_streams_of_two_clocks_are_refused(recorded: Path, tmp_path: Path) -> None:
    path = tmp_path / "two.db3"
    path.write_bytes(recorded.read_bytes())
    with sqlite3.connect(path) as database:
        topic = "SELECT id FROM topics WHERE name='/device_0/sensor_1/Color_0/image/metadata'"
        rows = database.execute(f"SELECT id, data FROM messages WHERE topic_id=({topic})")
        for row, data in rows.fetchall():
            other = data.replace(b"Hardware Clock", b"System Time   ")
            database.execute("UPDATE messages SET data=? WHERE id=?", (other, row))
    database.close()
    refused("clock=receive", open_bag, path)
