"""A RealSense camera (D405 and kin) as a `DepthCamera`, on pyrealsense2.

What is handled here so that nobody else has to: the D405's colour comes from its depth sensor;
a frameset may pair depth with the colour of another frame, so pairs are accepted by frame number
alone; the depth unit is read from the device; depth is aligned to colour.
"""

from typing import Any

import numpy as np

from realsim.errors import InputError
from realsim.interop import import_pyrealsense2
from realsim.records import CameraIntrinsics
from realsim_capture_plans.devices.interfaces import DeviceError, Frame

TIMEOUT_MS = 5000
"""Waited for one frame [ms]; a camera that starts up takes about 1 s."""
PAIR_ATTEMPTS = 30
"""Framesets looked at for one whose depth and colour belong together."""
STALE_FRAMES = 2
"""Pairs dropped after the queue is empty: their exposure may have begun before `grab`."""
MS = 1e-3


def intrinsics_of(raw: Any) -> CameraIntrinsics:
    """Return the record of a pyrealsense2 `intrinsics`.

    Brown-Conrady and its "modified" kin with zero coefficients are OpenCV's k1 k2 p1 p2 k3.

    Raises:
        InputError: a distortion model that OpenCV's coefficients cannot express.
    """
    coefficients = np.array(raw.coeffs, dtype=np.float64)
    model = str(raw.model).rsplit(".", maxsplit=1)[-1]
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


class RealSenseCamera:
    """One connected RealSense, streaming until `close`."""

    def __init__(
        self,
        serial: str | None = None,
        *,
        width: int = 1280,
        height: int = 720,
        fps: int = 30,
        device: Any = None,
    ) -> None:
        """Find the camera and start its depth and colour streams.

        Args:
            serial: serial number; may be left out where one camera is connected.
            width: of both streams [px]. 16:9 only: the SDK misaligns the D405's 4:3 crop.
            height: of both streams [px].
            fps: frames per second.
            device: a pyrealsense2 device, such as a recording; by default the connected one.

        Raises:
            InputError: the image is not 16:9, or its distortion model cannot be used.
            DeviceError: no such camera, several without a serial, or it does not start.
        """
        if width * 9 != height * 16 and (width, height) != (848, 480):
            raise InputError(
                f"{width}x{height} is not 16:9; the SDK aligns depth wrongly to 4:3 colour crops. "
                "Use 1280x720, 848x480 or 640x360."
            )
        rs = import_pyrealsense2()
        if device is None:
            device = _chosen(rs, list(rs.context().query_devices()), serial)
        self._name = (
            f"{device.get_info(rs.camera_info.name)} "
            f"{device.get_info(rs.camera_info.serial_number)}"
        )
        wanted = [
            (rs.stream.depth, rs.format.z16, width, height, fps),
            (rs.stream.color, rs.format.rgb8, width, height, fps),
        ]
        streams = [self._stream(device, *stream) for stream in wanted]
        color = streams[1][1].as_video_stream_profile()
        self._intrinsics = intrinsics_of(color.get_intrinsics())
        # The option is a float32: its shortest decimal is the unit that was meant (0.0001).
        self._depth_unit_m = float(str(np.float32(streams[0][0].get_option(rs.option.depth_units))))
        # Resampling costs the border: not done where depth is on the colour's pixels already.
        depth = streams[0][1].as_video_stream_profile()
        self._align = None if _same_pixels(depth, color) else rs.align(rs.stream.color)
        self._pairs = rs.syncer()
        # A D405 has both streams in one sensor, which opens them together; others have two.
        together = streams[0][0].get_info(rs.camera_info.name) == streams[1][0].get_info(
            rs.camera_info.name
        )
        groups = (
            [(streams[0][0], [p for _, p in streams])]
            if together
            else [(sensor, [p]) for sensor, p in streams]
        )
        self._sensors: list[Any] = []
        for sensor, profiles in groups:
            try:
                sensor.open(profiles)
                sensor.start(self._pairs)
            except RuntimeError as error:
                self.close()
                raise DeviceError(
                    f"{self._name} does not start {width}x{height} at {fps} per second ({error}). "
                    "Is it on a USB 3 port, and is no other program using it?"
                ) from error
            self._sensors.append(sensor)

    def _stream(self, device: Any, *wanted: Any) -> tuple[Any, Any]:
        """Return the sensor and the profile of a stream (type, format, width, height, fps)."""
        for sensor in device.query_sensors():
            for profile in sensor.get_stream_profiles():
                if not profile.is_video_stream_profile():
                    continue
                video = profile.as_video_stream_profile()
                size = (video.width(), video.height(), video.fps())
                if (video.stream_type(), video.format(), *size) == wanted:
                    return sensor, profile
        raise DeviceError(f"{self._name} has no stream {', '.join(map(str, wanted))}.")

    @property
    def name(self) -> str:
        """Model and serial number."""
        return self._name

    @property
    def intrinsics(self) -> CameraIntrinsics:
        """The factory's model of the colour image, which the depth is aligned to."""
        return self._intrinsics

    @property
    def depth_unit_m(self) -> float:
        """Metres per count, as the device says (0.0001 on a D405)."""
        return self._depth_unit_m

    def grab(self) -> Frame:
        """Return a frame exposed after this call.

        Raises:
            DeviceError: no frame came, or depth and colour never belonged together.
        """
        while self._pairs.poll_for_frames():
            pass
        seen: set[int] = set()
        for _ in range(PAIR_ATTEMPTS):
            try:
                frames = self._pairs.wait_for_frames(TIMEOUT_MS)
            except RuntimeError as error:
                raise DeviceError(
                    f"{self._name} gave no frame within {TIMEOUT_MS} ms ({error}). Check the cable."
                ) from error
            depth, color = frames.get_depth_frame(), frames.get_color_frame()
            if not depth or not color or depth.get_frame_number() != color.get_frame_number():
                continue
            seen.add(int(depth.get_frame_number()))
            if len(seen) > STALE_FRAMES:
                return self._frame(frames)
        raise DeviceError(
            f"{self._name}: depth and colour had different frame numbers in {PAIR_ATTEMPTS} "
            "framesets. Lower the frame rate or restart the camera."
        )

    def close(self) -> None:
        """Stop the streams."""
        for sensor in self._sensors:
            sensor.stop()
            sensor.close()
        self._sensors = []

    def _frame(self, frames: Any) -> Frame:
        aligned = frames if self._align is None else self._align.process(frames)
        color = aligned.get_color_frame()
        counts = np.asanyarray(aligned.get_depth_frame().get_data())
        return Frame(
            rgb=np.asanyarray(color.get_data()),
            depth_m=(counts * np.float64(self._depth_unit_m)).astype(np.float32),
            time_s=float(color.get_timestamp()) * MS,
        )


def _chosen(rs: Any, devices: list[Any], serial: str | None) -> Any:
    """Return the device with this serial number, or the only one."""
    numbers = [d.get_info(rs.camera_info.serial_number) for d in devices]
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


def _same_pixels(depth: Any, color: Any) -> bool:
    """Return whether two video stream profiles share their pinhole and their place."""
    a, b = depth.get_intrinsics(), color.get_intrinsics()
    between = depth.get_extrinsics_to(color)
    return (
        (a.fx, a.fy, a.ppx, a.ppy, list(a.coeffs)) == (b.fx, b.fy, b.ppx, b.ppy, list(b.coeffs))
        and np.allclose(between.rotation, np.eye(3).ravel())
        and np.allclose(between.translation, 0.0)
    )
