"""The RealSense driver against the SDK's own software device: pairing, units, refusals."""

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from realsim.errors import InputError, MissingLibraryError
from realsim.interop import import_pyrealsense2
from realsim_capture_plans.devices.interfaces import DeviceError
from realsim_capture_plans.devices.realsense import RealSenseCamera, intrinsics_of

WIDTH, HEIGHT, FOCAL = 640, 360, 320.0


@pytest.fixture(scope="module")
def rs() -> Any:
    try:
        return import_pyrealsense2()
    except MissingLibraryError as error:
        pytest.skip(str(error))


def raw_intrinsics(rs: Any, model: Any, coefficients: list[float]) -> Any:
    raw = rs.intrinsics()
    raw.width, raw.height = WIDTH, HEIGHT
    raw.fx, raw.fy, raw.ppx, raw.ppy = FOCAL, FOCAL + 1, 319.5, 179.5
    raw.model, raw.coeffs = model, coefficients
    return raw


@dataclass
class SoftwareD405:
    """One sensor with depth and colour, as the D405 has; frame n is 3000 + n counts deep."""

    rs: Any
    colour_lag: int = 0
    _stop: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        rs = self.rs
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.name, "Software D405")
        self.device.register_info(rs.camera_info.serial_number, "SW0001")
        self.sensor = self.device.add_sensor("Stereo Module")
        self.depth = self._stream(rs.stream.depth, 1, rs.format.z16, 2)
        self.color = self._stream(rs.stream.color, 2, rs.format.rgb8, 3)
        self.sensor.add_read_only_option(rs.option.depth_units, 1e-4)
        self.depth.register_extrinsics_to(self.color, self.depth.get_extrinsics_to(self.depth))
        self._thread = threading.Thread(target=self._feed)

    def _stream(self, kind: Any, uid: int, pixel: Any, size: int) -> Any:
        stream = self.rs.video_stream()
        stream.type, stream.index, stream.uid = kind, 0, uid
        stream.width, stream.height, stream.fps = WIDTH, HEIGHT, 30
        stream.bpp, stream.fmt = size, pixel
        stream.intrinsics = raw_intrinsics(self.rs, self.rs.distortion.brown_conrady, [0.0] * 5)
        return self.sensor.add_video_stream(stream).as_video_stream_profile()

    def _send(self, profile: Any, pixels: Any, number: int, size: int) -> None:
        frame = self.rs.software_video_frame()
        frame.pixels, frame.bpp, frame.stride = pixels, size, WIDTH * size
        frame.timestamp, frame.frame_number = 33.0 * number, number
        frame.domain, frame.profile = self.rs.timestamp_domain.hardware_clock, profile
        self.sensor.on_video_frame(frame)

    def _feed(self) -> None:
        number = 0
        while not self._stop.is_set():
            number += 1
            colour = number - self.colour_lag
            self._send(self.depth, np.full((HEIGHT, WIDTH), 3000 + number, np.uint16), number, 2)
            if colour > 0:
                grey = np.full((HEIGHT, WIDTH, 3), colour % 200, np.uint8)
                self._send(self.color, grey, colour, 3)
            time.sleep(0.01)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()


@pytest.fixture
def software(rs: Any) -> Iterator[SoftwareD405]:
    device = SoftwareD405(rs)
    yield device
    device.stop()


def test_frames_are_pairs_of_one_number_in_metres(software: SoftwareD405) -> None:
    camera = RealSenseCamera(width=WIDTH, height=HEIGHT, device=software.device)
    software.start()
    try:
        assert camera.name == "Software D405 SW0001"
        assert camera.depth_unit_m == 1e-4
        assert (camera.intrinsics.fx, camera.intrinsics.cy) == (FOCAL, 179.5)
        times: list[float] = []
        for _ in range(4):
            frame = camera.grab()
            number = round(frame.time_s / 0.033)
            assert np.all(frame.rgb == number % 200)
            assert frame.depth_m == pytest.approx(np.float32(1e-4 * (3000 + number)), abs=1e-7)
            times.append(frame.time_s)
        assert np.all(np.diff(times) > 0)
    finally:
        camera.close()


def test_no_frame_is_a_device_error(
    software: SoftwareD405, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("realsim_capture_plans.devices.realsense.TIMEOUT_MS", 200)
    camera = RealSenseCamera(width=WIDTH, height=HEIGHT, device=software.device)
    try:
        with pytest.raises(DeviceError, match="no frame within 200 ms"):
            camera.grab()
    finally:
        camera.close()


def test_a_stream_that_the_device_lacks_is_named(software: SoftwareD405) -> None:
    with pytest.raises(DeviceError, match=r"no stream .*1280, 720"):
        RealSenseCamera(device=software.device)
    with pytest.raises(InputError, match="16:9"):
        RealSenseCamera(width=640, height=480, device=software.device)


def test_distortion_models(rs: Any) -> None:
    brown = intrinsics_of(
        raw_intrinsics(rs, rs.distortion.brown_conrady, [0.1, -0.2, 1e-3, 2e-3, 0.05])
    )
    assert brown.distortion == pytest.approx([0.1, -0.2, 1e-3, 2e-3, 0.05, 0, 0, 0], abs=1e-7)
    inverse = rs.distortion.inverse_brown_conrady
    assert not intrinsics_of(raw_intrinsics(rs, inverse, [0.0] * 5)).is_distorted
    with pytest.raises(InputError, match="inverse_brown_conrady"):
        intrinsics_of(raw_intrinsics(rs, inverse, [0.1, 0.0, 0.0, 0.0, 0.0]))


def test_without_a_camera_the_error_says_what_to_do(rs: Any) -> None:
    if len(list(rs.context().query_devices())) > 0:
        pytest.skip("a RealSense camera is connected")
    with pytest.raises(DeviceError, match="no RealSense camera is connected"):
        RealSenseCamera()
