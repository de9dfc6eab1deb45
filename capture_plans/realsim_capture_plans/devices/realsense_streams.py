"""Frames of two streams: those that belong together, and depth on the colour camera's pixels.

The SDK's own framesets may join depth with the colour of another frame, so pairs are made here:
streams of one sensor count their frames together and pair by frame number; sensors of their own
count on their own and pair by time stamp, within half a frame.

What a RealSense says of itself, as records and plain JSON: lenses, options, frames.
"""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array, Array32
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from realsim.records import CameraIntrinsics

DEPTH, COLOR = 0, 1
LIVE_PAIRS = 4
"""Pairs kept while nobody grabs; older ones give way, a live frame is worth nothing later."""
RECORDED_PAIRS = 8
"""Pairs kept of a recording before its reader has to wait: 37 MB at 1280x720."""
UNPAIRED = 32
"""Frames kept per stream that wait for their partner: about a second."""
CLOCKS_TOLD = 2
"""Domains named in the message when depth and colour are stamped by different clocks."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Pair:
    """A depth frame and the colour frame of the same exposure (pyrealsense2 frames)."""

    depth: Any
    color: Any


class PairBuffer:
    """Collects frames of two streams, hands out pairs in the order in which they came."""

    def __init__(
        self, by: Literal["number", "time"], *, half_frame_ms: float, lossless: bool
    ) -> None:
        """Prepare an empty buffer.

        Args:
            by: what pairs are made by.
            half_frame_ms: greatest difference of time stamps of a pair [ms]; used by "time".
            lossless: True makes the SDK wait when the buffer is full (recordings), False lets
                the oldest pair go (live cameras).
        """
        self._by = by
        self._half_frame_ms = half_frame_ms
        self._lossless = lossless
        self._pairs: deque[Pair] = deque(maxlen=None if lossless else LIVE_PAIRS)
        self._waiting: tuple[deque[Any], deque[Any]] = (deque(), deque())
        self._last_number: list[int | None] = [None, None]
        self._changed = threading.Condition()
        self._closed = False
        self.ended = False
        """Whether the recording is over."""
        self.received = [0, 0]
        """Frames that came, depth and colour."""

    def taker(self, kind: int) -> Callable[[Any], None]:
        """Return the function that takes the frames of one stream, DEPTH or COLOR."""

        def take(frame: Any) -> None:
            frame.keep()  # the SDK's pool is small; kept frames do not count
            self._put(kind, frame)

        return take

    def _put(self, kind: int, frame: Any) -> None:
        with self._changed:
            number = int(frame.get_frame_number())
            if self._closed or number == self._last_number[kind]:
                return  # recordings may hold a frame twice
            self._last_number[kind] = number
            self.received[kind] += 1
            partner = self._partner(kind, frame)
            if partner is None:
                own = self._waiting[kind]
                own.append(frame)
                if len(own) > UNPAIRED:
                    own.popleft()
                return
            depth, color = (frame, partner) if kind == DEPTH else (partner, frame)
            self._pairs.append(Pair(depth=depth, color=color))
            self._changed.notify_all()
            while self._lossless and len(self._pairs) > RECORDED_PAIRS and not self._closed:
                self._changed.wait()

    def _partner(self, kind: int, frame: Any) -> Any:
        """Take the partner of a frame out of the other stream's; None where it is not there."""
        others = self._waiting[1 - kind]
        if self._by == "number":
            found = [f for f in others if f.get_frame_number() == frame.get_frame_number()]
        else:
            domain = frame.get_frame_timestamp_domain()
            near = sorted(
                (abs(f.get_timestamp() - frame.get_timestamp()), k)
                for k, f in enumerate(others)
                if f.get_frame_timestamp_domain() == domain
            )
            found = [others[k] for dt, k in near[:1] if dt <= self._half_frame_ms]
        if not found:
            return None
        while others:  # what is older than the partner of a newer frame stays alone
            other = others.popleft()
            if other is found[0]:
                break
        return found[0]

    def next(self, timeout_s: float) -> Pair | None:
        """Return the next pair; None if none came in time [s] or the recording has ended."""
        with self._changed:
            self._changed.wait_for(
                lambda: bool(self._pairs) or self.ended or self._closed, timeout_s
            )
            pair = self._pairs.popleft() if self._pairs else None
            self._changed.notify_all()
            return pair

    def clear(self) -> None:
        """Forget the pairs that are there; frames that wait for a partner stay."""
        with self._changed:
            self._pairs.clear()
            self.received = [0, 0]
            self._changed.notify_all()

    def end(self) -> None:
        """Note that no more frames will come: the recording is over."""
        with self._changed:
            self.ended = True
            self._changed.notify_all()

    def close(self) -> None:
        """Let go of every frame and of everybody who waits."""
        with self._changed:
            self._closed = True
            self._pairs.clear()
            for waiting in self._waiting:
                waiting.clear()
            self._changed.notify_all()

    def why_none(self) -> str:
        """Return what came instead of a pair, for a message."""
        with self._changed:
            depth, color = self.received
            if depth == color == 0:
                return "neither depth nor colour came"
            if depth == 0 or color == 0:
                return f"only {'colour' if depth == 0 else 'depth'} came"
            lasts = [w[-1] for w in self._waiting if w]
            clocks = {str(f.get_frame_timestamp_domain()).rsplit(".", 1)[-1] for f in lasts}
            if len(clocks) == CLOCKS_TOLD and self._by == "time":
                return f"depth and colour are stamped by different clocks ({', '.join(clocks)})"
            said = " and ".join(
                f"{name} frame {w[-1].get_frame_number()} at {w[-1].get_timestamp():.1f} ms"
                for name, w in zip(("depth", "colour"), self._waiting, strict=True)
                if w
            )
            by = "frame number" if self._by == "number" else "time stamp"
            return f"depth and colour never had the same {by}" + (
                f" (last: {said})" if said else ""
            )


ALIGN_MS = 1000
"""Waited for the SDK's alignment of one frame [ms], which takes about 20."""


class Alignment:
    """Brings depth to the colour camera: its pixels by the SDK, its z axis by us."""

    def __init__(self, rs: Any, color: CameraIntrinsics, T_color_depth: NDArray[Any]) -> None:
        """Prepare the alignment.

        Args:
            rs: the module pyrealsense2.
            color: the colour camera.
            T_color_depth: (4, 4) depth camera in the colour camera [m].
        """
        self._align = rs.align(rs.stream.color)
        self._queue = rs.frame_queue(2)
        self._color: list[Any] = []
        color_frame = self._color  # the SDK keeps the function, which must not keep this object

        def join(depth: Any, source: Any) -> None:
            source.frame_ready(source.allocate_composite_frame([depth, color_frame[0]]))

        self._join = rs.processing_block(join)
        self._join.start(self._queue)
        # The SDK moves a pixel's depth to the colour's pixel but leaves it along the depth
        # camera's axis. With z_d = a . (z r - t), a = R's third column, r the colour pixel's ray:
        axis, t = T_color_depth[:3, 2], T_color_depth[:3, 3]
        along = ray_table(color) @ axis
        self._scale = np.nan_to_num(1.0 / along, nan=0.0).astype(np.float32)
        self._offset = float(axis @ t)

    def depth_m(self, pair: Pair, unit_m: float) -> Array32:
        """Return the depth (H, W) [m] on the colour image's pixels, along its z axis."""
        self._color[:] = [pair.color]
        self._join.invoke(pair.depth)
        frames = self._queue.wait_for_frame(ALIGN_MS).as_frameset()
        self._color.clear()
        aligned = self._align.process(frames).get_depth_frame()
        depth = np.asanyarray(aligned.get_data()) * np.float64(unit_m)
        return np.where(depth > 0, (depth + self._offset) * self._scale, 0).astype(np.float32)


INFOS = {
    "model": "name",
    "serial": "serial_number",
    "firmware": "firmware_version",
    "recommended_firmware": "recommended_firmware_version",
    "usb_type": "usb_type_descriptor",
    "product_line": "product_line",
}
"""Our key -> the SDK's name of what a device may tell."""
OPTIONS = (
    "depth_units", "exposure", "gain", "enable_auto_exposure", "white_balance",
    "enable_auto_white_balance", "laser_power", "emitter_enabled", "visual_preset",
    "global_time_enabled",
)  # fmt: skip
"""Options of a sensor that change what its images look like."""
COLOR_EXPOSURE_US = 100.0
"""The exposure option of a colour sensor of its own counts 100 us, that of a depth sensor 1 us;
the frames' metadata are in us for both."""


def intrinsics_of(raw: Any) -> CameraIntrinsics:
    """Return the record of a pyrealsense2 `intrinsics`.

    Brown-Conrady and its "modified" kin with zero coefficients are OpenCV's k1 k2 p1 p2 k3.

    Raises:
        InputError: a distortion model that OpenCV's coefficients cannot express.
    """
    coefficients = np.array(raw.coeffs, dtype=np.float64)
    model = _plain(raw.model)
    if np.any(coefficients != 0) and model != "brown_conrady":
        raise InputError(
            f"the camera's distortion model is {model} with coefficients {coefficients.tolist()}; "
            "only brown_conrady (OpenCV's k1 k2 p1 p2 k3) or zero coefficients can be used. "
            "inverse_brown_conrady undistorts where OpenCV distorts: calibrate the camera instead."
        )
    return CameraIntrinsics(
        width=raw.width, height=raw.height, fx=raw.fx, fy=raw.fy, cx=raw.ppx, cy=raw.ppy,
        distortion=coefficients,
    )  # fmt: skip


def raw_intrinsics_json(raw: Any) -> dict[str, Any]:
    """Return a pyrealsense2 `intrinsics` as it is; integer pixels are pixel centres."""
    return {
        "width": int(raw.width), "height": int(raw.height),
        "fx": float(raw.fx), "fy": float(raw.fy), "cx": float(raw.ppx), "cy": float(raw.ppy),
        "model": _plain(raw.model), "coefficients": [float(c) for c in raw.coeffs],
    }  # fmt: skip


def T_of(extrinsics: Any) -> Array:
    """Return T_to_from (4, 4) [m] of the SDK's `from.get_extrinsics_to(to)`.

    The SDK's rotation is column-major; it is float32, so that the nearest rotation is taken.
    """
    R = np.array(extrinsics.rotation, dtype=np.float64).reshape(3, 3).T
    U, _, Vt = np.linalg.svd(R)
    return se3.from_rt(U @ Vt, np.array(extrinsics.translation, dtype=np.float64))


def device_json(rs: Any, device: Any) -> dict[str, Any]:
    """Return model, serial number, firmware and USB type, as far as the device tells them."""
    known: dict[str, Any] = {}
    for key, name in INFOS.items():
        info = getattr(rs.camera_info, name)
        if device.supports(info):
            known[key] = str(device.get_info(info))
    return known


def options_json(rs: Any, sensor: Any) -> dict[str, float]:
    """Return the options of a sensor that change its images, as far as it has them."""
    known: dict[str, float] = {}
    for name in OPTIONS:
        option = getattr(rs.option, name)
        if sensor.supports(option):
            # Options are float32: the shortest decimal is what was meant (0.0001).
            known[name] = float(str(np.float32(sensor.get_option(option))))
    return known


def frame_json(rs: Any, frame: Any) -> dict[str, Any]:
    """Return number, clock, exposure [us] and gain of a frame, as far as it carries them."""
    known: dict[str, Any] = {
        "frame_number": int(frame.get_frame_number()),
        "time_s": float(frame.get_timestamp()) * 1e-3,
        "clock": _plain(frame.get_frame_timestamp_domain()),
    }
    metadata = rs.frame_metadata_value
    for key, value in (("exposure_us", metadata.actual_exposure), ("gain", metadata.gain_level)):
        if frame.supports_frame_metadata(value):
            known[key] = float(frame.get_frame_metadata(value))
    return known


def _plain(value: Any) -> str:
    """Return the name of one of the SDK's enumerations without its type."""
    return str(value).rsplit(".", maxsplit=1)[-1]
