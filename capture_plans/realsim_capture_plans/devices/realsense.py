"""A RealSense camera (D405, D415, D435 and kin) as a `DepthCamera`, on pyrealsense2.

What is handled here so that nobody else has to: a D405's colour comes from its depth sensor, that
of the others from a sensor of its own; framesets may pair depth with the colour of another frame;
the depth unit is the device's; depth is brought to the colour's pixels, and to its z axis, too. A
recording (.db3, or an older .bag) is played back through the same code.
"""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.interop import import_pyrealsense2
from realsim_capture_plans.devices import realsense_streams as facts
from realsim_capture_plans.devices.interfaces import DeviceError, Frame
from realsim_capture_plans.devices.realsense_streams import (
    COLOR,
    DEPTH,
    Alignment,
    Pair,
    PairBuffer,
    intrinsics_of,
)

__all__ = ["EndOfRecordingError", "RealSenseCamera", "RealSenseConfig", "intrinsics_of"]

STALE_PAIRS = 2
"""Pairs dropped once the buffer is empty: exposed, perhaps, before `grab` was called."""
MS = 1e-3


class EndOfRecordingError(DeviceError):
    """Every pair of a recording has been given out."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RealSenseConfig:
    """How the camera streams."""

    width: int = 1280
    """Width of both streams [px]; the D405's full resolution, where its depth is best."""
    height: int = 720
    """Height of both streams [px]."""
    fps: int = 30
    """Frames per second."""
    exposure: Literal["auto", "locked"] | float = "auto"
    """Auto exposure; locked: found by auto exposure in the first frames, then kept, so that all
    views are equally bright; a number: fixed, in microseconds."""
    settle_pairs: int = 15
    """Pairs dropped after the start of a live camera: auto exposure takes about half a second."""
    timeout_s: float = 5.0
    """Waited for a pair [s]; a camera that starts up takes about 1 s."""


class RealSenseCamera:
    """One connected RealSense, streaming until `close`; or a recording, see `from_recording`."""

    def __init__(
        self,
        serial: str | None = None,
        config: RealSenseConfig | None = None,
        *,
        devices: Callable[[], Sequence[Any]] | None = None,
    ) -> None:
        """Find the camera and start its depth and colour streams.

        Args:
            serial: serial number; may be left out where one camera is connected.
            config: size, rate and exposure; None is `RealSenseConfig()`.
            devices: returns the pyrealsense2 devices that are connected now; by default those of
                the SDK's context. `recover` asks again.

        Raises:
            InputError: a D405 is asked for 4:3 images, or its distortion model cannot be used.
            DeviceError: no such camera, several without a serial, or it does not start.
        """
        self._rs = import_pyrealsense2()
        self._config = RealSenseConfig() if config is None else config
        self._devices = self._connected if devices is None else devices
        self._serial = serial
        self._recording: Path | None = None
        self._sensors: list[Any] = []
        self._start(_chosen(self._rs, list(self._devices()), serial))

    @classmethod
    def from_recording(cls, path: Path | str) -> "RealSenseCamera":
        """Play a recording: every `grab` gives its next pair, `EndOfRecordingError` ends it.

        Args:
            path: a .db3 written by the SDK's recorder (2.59 or later), or a .bag of an older one.

        Raises:
            InputError: no such file, or not a recording with depth and colour.
        """
        path = Path(path).resolve()
        if not path.is_file():
            raise InputError(f"{path} does not exist; a RealSense recording is expected.")
        camera = cls.__new__(cls)
        camera._rs, camera._config = import_pyrealsense2(), RealSenseConfig()
        camera._devices, camera._serial = (lambda: ()), None
        camera._recording, camera._sensors = path, []
        camera._start(camera._loaded())
        return camera

    def _connected(self) -> Sequence[Any]:
        return list(self._rs.context().query_devices())

    def _loaded(self) -> Any:
        try:
            playback = self._rs.context().load_device(str(self._recording))
        except RuntimeError as error:
            raise InputError(
                f"{self._recording} is not a recording that the RealSense SDK can play ({error})."
            ) from error
        playback.set_real_time(False)
        return playback

    # --- starting -----------------------------------------------------------------------------

    def _start(self, device: Any) -> None:
        rs = self._rs
        self._device: Any = device
        self._facts = facts.device_json(rs, device)
        self.name = f"{self._facts.get('model', 'RealSense')} {self._facts.get('serial', '')}"
        """Model and serial number."""
        self._serial = self._facts.get("serial", self._serial)
        self._check_size()
        depth_sensor, depth = self._stream(rs.stream.depth, rs.format.z16)
        color_sensor, color = self._stream(rs.stream.color, rs.format.rgb8)
        self._lenses = (depth.get_intrinsics(), color.get_intrinsics())
        self.intrinsics = intrinsics_of(self._lenses[COLOR])
        """The factory's model of the colour image, which the depth is aligned to."""
        units = facts.options_json(rs, depth_sensor).get("depth_units")
        if not units:
            raise DeviceError(f"{self.name} does not report its depth unit.")
        self.depth_unit_m = units
        """Metres per count, as the device says (0.0001 on a D405)."""
        self._T_color_depth = facts.T_of(depth.get_extrinsics_to(color))
        self._alignment = None
        if not _same_pixels(*self._lenses, self._T_color_depth):
            self._alignment = Alignment(rs, self.intrinsics, self._T_color_depth)
        # A D405 has both streams in one sensor, which opens them together; others have two.
        self._together = _name_of(rs, depth_sensor) == _name_of(rs, color_sensor)
        self._pairs = PairBuffer(
            "number" if self._together else "time",
            half_frame_ms=500.0 / max(1, color.fps()),
            lossless=self._recording is not None,
        )
        self.last_metadata: dict[str, Any] = {}
        """Frame number, clock, exposure [us] and gain of the last pair, "depth" and "color"."""
        self._unsettled = self._recording is None
        self._open(
            [(depth_sensor, [depth, color])]
            if self._together
            else [(depth_sensor, [depth]), (color_sensor, [color])]
        )

    def _check_size(self) -> None:
        width, height = self._config.width, self._config.height
        four_to_three = width * 9 != height * 16 and (width, height) != (848, 480)
        if self._recording is None and four_to_three and "D405" in self.name:
            raise InputError(
                f"{width}x{height} is not 16:9; the SDK aligns depth wrongly to a D405's 4:3 "
                "colour crops. Use 1280x720, 848x480 or 640x360."
            )

    def _stream(self, kind: Any, pixels: Any) -> tuple[Any, Any]:
        """Return the sensor and the video profile of a stream.

        Raises:
            DeviceError: a camera without it.
            InputError: a recording without it.
        """
        c = self._config
        there: list[str] = []
        for sensor in self._device.query_sensors():
            for profile in sensor.get_stream_profiles():
                if not profile.is_video_stream_profile():
                    continue
                video = profile.as_video_stream_profile()
                size = (video.width(), video.height(), video.fps())
                is_wanted = video.stream_type() == kind and video.format() == pixels
                if is_wanted and (self._recording or size == (c.width, c.height, c.fps)):
                    return sensor, video
                if video.stream_type() == kind:
                    there.append(f"{video.format()} {size[0]}x{size[1]} at {size[2]}")
        wanted = f"{kind}, {pixels}"
        if self._recording:
            raise InputError(
                f"{self._recording} has no stream {wanted}; it has "
                f"{', '.join(sorted(set(there))) or 'none of that kind'}."
            )
        raise DeviceError(
            f"{self.name} has no stream {wanted}, {c.width}, {c.height}, {c.fps}; there is "
            f"{', '.join(sorted(set(there))[:12]) or 'none of that kind'}. On a USB 2 port or "
            "cable the larger sizes are missing."
        )

    def _open(self, groups: list[tuple[Any, list[Any]]]) -> None:
        rs = self._rs
        take = {
            rs.stream.depth: self._pairs.taker(DEPTH),
            rs.stream.color: self._pairs.taker(COLOR),
        }

        def sort(frame: Any) -> None:
            take[frame.get_profile().stream_type()](frame)

        # The SDK keeps these functions: they must not keep the camera, or nothing is ever freed.
        pairs, over = self._pairs, rs.playback_status.stopped

        def on_status(status: Any) -> None:
            if status == over:
                pairs.end()

        if self._recording is not None:
            self._device.set_status_changed_callback(on_status)
        try:
            for sensor, profiles in groups:
                self._set_exposure(sensor, self._config.exposure)
                sensor.open(profiles)
                self._sensors.append(sensor)
            for sensor, _ in groups:
                sensor.start(sort)
        except RuntimeError as error:
            self.close()
            c = self._config
            raise DeviceError(
                f"{self.name} does not start {c.width}x{c.height} at {c.fps} per second ({error})."
                " Is it on a USB 3 port, and is no other program using it?"
            ) from error

    def _set_exposure(self, sensor: Any, exposure: Literal["auto", "locked"] | float) -> None:
        rs = self._rs
        if self._recording is not None or not sensor.supports(rs.option.exposure):
            return
        automatic = isinstance(exposure, str)
        if sensor.supports(rs.option.enable_auto_exposure):
            sensor.set_option(rs.option.enable_auto_exposure, float(automatic))
        if automatic:
            return
        unit = 1.0 if sensor.supports(rs.option.depth_units) else facts.COLOR_EXPOSURE_US
        span = sensor.get_option_range(rs.option.exposure)
        steps = np.round((exposure / unit - span.min) / span.step)
        value = float(span.min + steps * span.step)
        if not span.min <= value <= span.max:
            raise InputError(
                f"an exposure of {exposure:g} us was asked for; the {_name_of(rs, sensor)} of "
                f"{self.name} takes {span.min * unit:g} to {span.max * unit:g} us."
            )
        sensor.set_option(rs.option.exposure, value)

    # --- what it is ---------------------------------------------------------------------------

    @property
    def description(self) -> dict[str, Any]:
        """Plain JSON values: who the camera is, its factory lenses, its options as they are now.

        `T_color_depth` (4, 4) [m] maps depth camera coordinates into the colour camera.
        """
        options: dict[str, Any] = {}
        with contextlib.suppress(RuntimeError):  # an unplugged camera has no options to tell
            options = {
                _name_of(self._rs, s): facts.options_json(self._rs, s) for s in self._sensors
            }
        return {
            "name": self.name,
            **self._facts,
            "depth_unit_m": self.depth_unit_m,
            "factory": {
                "color": facts.raw_intrinsics_json(self._lenses[COLOR]),
                "depth": facts.raw_intrinsics_json(self._lenses[DEPTH]),
                "T_color_depth": self._T_color_depth.tolist(),
            },
            "pairs_by": "frame number" if self._together else "time stamp",
            "depth_aligned_to_color": self._alignment is not None,
            "exposure": self._config.exposure,
            "options": options,
            "recording": None if self._recording is None else self._recording.name,
        }

    # --- frames -------------------------------------------------------------------------------

    def grab(self) -> Frame:
        """Return a frame exposed after this call; of a recording, the next one.

        Raises:
            DeviceError: no pair of depth and colour came; the message says what did.
            EndOfRecordingError: the recording has no more pairs.
        """
        if self._recording is not None:
            return self._frame(self._next())
        if self._unsettled:
            self._settle()
        self._pairs.clear()
        for _ in range(STALE_PAIRS):
            self._next()
        return self._frame(self._next())

    def _settle(self) -> None:
        """Let auto exposure find its value, and keep that if it is to be locked."""
        pair = self._next()
        for _ in range(self._config.settle_pairs):
            pair = self._next()
        if self._config.exposure == "locked":
            # A single sensor exposes both streams at once: the depth frame tells.
            for sensor, frame in zip(self._sensors, (pair.depth, pair.color), strict=False):
                found = facts.frame_json(self._rs, frame).get("exposure_us")
                if found is not None:
                    self._set_exposure(sensor, float(found))
                elif sensor.supports(self._rs.option.enable_auto_exposure):
                    sensor.set_option(self._rs.option.enable_auto_exposure, 0.0)
        self._unsettled = False

    def _next(self) -> Pair:
        pair = self._pairs.next(self._config.timeout_s)
        if pair is not None:
            return pair
        if self._pairs.ended:
            if not self.last_metadata:
                raise EndOfRecordingError(
                    f"{self._recording} holds no pair of depth and colour: {self._pairs.why_none()}"
                )
            raise EndOfRecordingError(f"{self._recording} has no more pairs of depth and colour.")
        raise DeviceError(self._trouble())

    def _trouble(self) -> str:
        """Return what is wrong with a camera that gives no pairs, and what to do."""
        why = f"{self.name} gave no frame within {self._config.timeout_s:g} s: "
        if self._recording is not None:
            return why + f"{self._pairs.why_none()} from {self._recording}."
        if self._serial not in _serials(self._rs, list(self._devices())):
            return (
                f"{why}it is not connected any more. Plug it in again (a screwed or clamped "
                "USB 3 cable), then go on."
            )
        return (
            f"{why}{self._pairs.why_none()}. Check cable and port (USB 3), close other "
            "programs that use it, or unplug it and plug it in again."
        )

    def _frame(self, pair: Pair) -> Frame:
        self.last_metadata = {
            "depth": facts.frame_json(self._rs, pair.depth),
            "color": facts.frame_json(self._rs, pair.color),
        }
        if self._alignment is None:
            counts = np.asanyarray(pair.depth.get_data())
            depth_m = (counts * np.float64(self.depth_unit_m)).astype(np.float32)
        else:
            depth_m = self._alignment.depth_m(pair, self.depth_unit_m)
        return Frame(
            rgb=np.asanyarray(pair.color.get_data()),
            depth_m=depth_m,
            time_s=float(pair.color.get_timestamp()) * MS,
        )

    # --- stopping and going on ----------------------------------------------------------------

    def close(self) -> None:
        """Stop the streams; a camera that is gone is no error."""
        self._pairs.close()
        for sensor in self._sensors:
            for stop in (sensor.stop, sensor.close):
                with contextlib.suppress(RuntimeError):
                    stop()
        self._sensors = []
        self._device, self._alignment = None, None

    def reopen(self) -> None:
        """Start the same camera (by serial number) again; a recording starts from its beginning.

        Raises:
            DeviceError: it is not connected, or it does not start.
        """
        self.close()
        if self._recording is not None:
            self._start(self._loaded())
            return
        devices = list(self._devices())
        if self._serial not in _serials(self._rs, devices):
            there = ", ".join(_serials(self._rs, devices)) or "no other"
            raise DeviceError(
                f"{self.name} is not connected (connected: {there}). Plug it in again; another "
                "camera cannot replace it, because its lens and mount differ."
            )
        self._start(_chosen(self._rs, devices, self._serial))

    def recover(self) -> None:
        """Make ready to deliver frames again after one did not come.

        Raises:
            DeviceError: the camera is not connected, or it does not start.
        """
        if self._recording is None:
            self.reopen()


def _serials(rs: Any, devices: Sequence[Any]) -> list[str]:
    return [str(d.get_info(rs.camera_info.serial_number)) for d in devices]


def _chosen(rs: Any, devices: list[Any], serial: str | None) -> Any:
    """Return the device with this serial number, or the only one."""
    numbers = _serials(rs, devices)
    if not devices:
        raise DeviceError(
            "no RealSense camera is connected. Plug it into a USB 3 port; on Linux the SDK's udev "
            "rules must be installed."
        )
    if serial is None and len(devices) > 1:
        raise DeviceError(
            f"{len(devices)} RealSense cameras are connected ({', '.join(numbers)}); name one "
            "serial number."
        )
    if serial is not None and serial not in numbers:
        raise DeviceError(
            f"no RealSense camera {serial} is connected; there is {', '.join(numbers)}."
        )
    return devices[0 if serial is None else numbers.index(serial)]


def _name_of(rs: Any, sensor: Any) -> str:
    return str(sensor.get_info(rs.camera_info.name))


def _same_pixels(depth: Any, color: Any, T_color_depth: NDArray[Any]) -> bool:
    """Return whether two cameras share their pinhole and their place: resampling costs a border."""
    a, b = facts.raw_intrinsics_json(depth), facts.raw_intrinsics_json(color)
    lens = ("width", "height", "fx", "fy", "cx", "cy", "coefficients")
    return all(a[key] == b[key] for key in lens) and np.allclose(T_color_depth, np.eye(4))
