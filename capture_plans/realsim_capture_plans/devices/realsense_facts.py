"""What a RealSense says of itself, as records and plain JSON: lenses, options, frames."""

from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics

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
