"""A RealSense without hardware: the SDK's own software device, fed from a thread."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from realsim.arrays import Array, UInt8, UInt16

WIDTH, HEIGHT, FOCAL = 640, 360, 320.0
FRAME_MS = 1000 / 30


def raw_intrinsics(rs: Any, model: Any, coefficients: list[float], focal: float = FOCAL) -> Any:
    raw = rs.intrinsics()
    raw.width, raw.height = WIDTH, HEIGHT
    raw.fx, raw.fy, raw.ppx, raw.ppy = focal, focal + 1, 319.5, 179.5
    raw.model, raw.coeffs = model, coefficients
    return raw


def depth_of(number: int) -> UInt16:
    return np.random.default_rng(number).integers(3000, 3900, (HEIGHT, WIDTH)).astype(np.uint16)


def color_of(number: int) -> UInt8:
    return np.full((HEIGHT, WIDTH, 3), number % 200, np.uint8)


@dataclass
class Software:
    """A camera of the SDK without hardware: one sensor as a D405 has, or two as a D435 has."""

    rs: Any
    model: str = "Software D405"
    serial: str = "SW0001"
    two_sensors: bool = False
    color_focal: float = FOCAL
    T_color_depth: Array = field(default_factory=lambda: np.eye(4))
    color_lag: int = 0
    """Frames by which colour comes later than its depth."""
    color_count: int = 0
    """What colour's frame counter is ahead of depth's."""
    color_delay_ms: float = 0.0
    """What colour's time stamp is later than that of its depth."""
    depth: Callable[[int], UInt16] = depth_of
    exposure_us: int = 8123

    def __post_init__(self) -> None:
        rs = self.rs
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self.plugged = True
        self.device = rs.software_device()
        infos = {
            "name": self.model, "serial_number": self.serial, "firmware_version": "5.16.0.1",
            "usb_type_descriptor": "3.2", "product_line": "D400",
        }  # fmt: skip
        for name, value in infos.items():
            self.device.register_info(getattr(rs.camera_info, name), value)
        add = self.device.add_sensor
        self.stereo = add("Stereo Module")
        self.color_sensor = add("RGB Camera") if self.two_sensors else self.stereo
        self.depth_profile = self._stream(self.stereo, rs.stream.depth, 1, rs.format.z16, 2)
        self.color_profile = self._stream(self.color_sensor, rs.stream.color, 2, rs.format.rgb8, 3)
        self.stereo.add_read_only_option(rs.option.depth_units, 1e-4)
        for sensor, longest in {self.stereo: 165_000, self.color_sensor: 10_000}.items():
            if sensor is self.stereo or self.two_sensors:
                sensor.add_option(rs.option.enable_auto_exposure, self._range(0, 1, 1), True)
                sensor.add_option(rs.option.exposure, self._range(1, longest, 156), True)
        between = rs.extrinsics()
        between.rotation = self.T_color_depth[:3, :3].T.ravel().tolist()  # column-major
        between.translation = self.T_color_depth[:3, 3].tolist()
        self.depth_profile.register_extrinsics_to(self.color_profile, between)

    def _range(self, least: float, most: float, default: float) -> Any:
        span = self.rs.option_range()
        span.min, span.max, span.step, span.default = least, most, 1.0, default
        return span

    def _stream(self, sensor: Any, kind: Any, uid: int, pixel: Any, size: int) -> Any:
        stream = self.rs.video_stream()
        stream.type, stream.index, stream.uid = kind, 0, uid
        stream.width, stream.height, stream.fps = WIDTH, HEIGHT, 30
        stream.bpp, stream.fmt = size, pixel
        focal = self.color_focal if kind == self.rs.stream.color else FOCAL
        brown = self.rs.distortion.brown_conrady
        stream.intrinsics = raw_intrinsics(self.rs, brown, [0.0] * 5, focal)
        return sensor.add_video_stream(stream).as_video_stream_profile()

    def _send(self, sensor: Any, profile: Any, pixels: Any, number: int, time_ms: float) -> None:
        size = 3 if pixels.ndim == 3 else 2
        frame = self.rs.software_video_frame()
        frame.pixels, frame.bpp, frame.stride = pixels, size, WIDTH * size
        frame.timestamp, frame.frame_number = time_ms, number
        frame.domain, frame.profile = self.rs.timestamp_domain.hardware_clock, profile
        sensor.set_metadata(self.rs.frame_metadata_value.actual_exposure, self.exposure_us)
        sensor.on_video_frame(frame)

    def send_depth(self, number: int) -> None:
        self._send(self.stereo, self.depth_profile, self.depth(number), number, FRAME_MS * number)

    def send_color(self, number: int) -> None:
        self._send(
            self.color_sensor, self.color_profile, color_of(number), number + self.color_count,
            FRAME_MS * number + self.color_delay_ms,
        )  # fmt: skip

    def send(self, number: int) -> None:
        self.send_depth(number)
        if number > self.color_lag:
            self.send_color(number - self.color_lag)

    def _feed(self) -> None:
        number = 0
        while not self._stop.is_set():
            number += 1
            self.send(number)
            time.sleep(0.005)

    def run(self) -> None:
        self._stop.clear()
        self._thread = threading.Thread(target=self._feed)
        self._thread.start()

    def halt(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()

    def devices(self) -> list[Any]:
        return [self.device] if self.plugged else []
