"""The cameras' bodies as boxes in the frame of their colour image."""

from dataclasses import dataclass

import numpy as np

from realsim.errors import InputError
from realsim.geometry import se3
from realsim_capture_plans.collision.shapes import Mount, Shape

FLANGE = 6
"""DH frame that camera and bracket are fixed in."""


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraBody:
    """A housing without plug and cable; those go into the mount's cover or bracket."""

    size_m: tuple[float, float, float]
    """Across the image, along the image's height, along the optical axis [m]."""
    center_m: tuple[float, float, float]
    """Centre of the housing in the colour camera's frame [m]."""


CAMERA_BODIES = {
    # 42 x 42 x 23 mm; colour is the left imager, 9 mm from the middle, 3.7 mm behind the glass.
    "D405": CameraBody(size_m=(0.042, 0.042, 0.023), center_m=(0.009, 0.0, -0.0078)),
    # 99 x 23 x 20 mm; left imager 20 mm from the middle, colour 15 mm beyond, 1.1 mm behind the
    # glass.
    "D415": CameraBody(size_m=(0.099, 0.023, 0.02005), center_m=(0.035, 0.0, -0.0088)),
    # 90 x 25 x 25 mm; left imager 17.5 mm from the middle, colour 15 mm beyond, 4.2 mm behind the
    # glass.
    "D435": CameraBody(size_m=(0.090, 0.025, 0.02505), center_m=(0.0325, 0.0, -0.0082)),
    "D435i": CameraBody(size_m=(0.090, 0.025, 0.02505), center_m=(0.0325, 0.0, -0.0082)),
}
"""Sizes and depth start points: D400 series datasheet (337029-017); imagers' places: the cameras'
published ROS descriptions. The glass is 0.1 mm behind the front plate."""


def camera_body(camera: str) -> CameraBody:
    """Return a camera's body.

    Raises:
        InputError: the camera is not known.
    """
    if camera not in CAMERA_BODIES:
        raise InputError(
            f"the camera '{camera}' is not known; there are {', '.join(CAMERA_BODIES)}. Take the "
            "one with the next larger housing, or add boxes to the bracket."
        )
    return CAMERA_BODIES[camera]


def camera_shape(mount: Mount) -> Shape:
    """Return the camera's body on its mount, in the flange."""
    body = camera_body(mount.camera)
    return Shape(
        part="camera",
        frame=FLANGE,
        kind="box",
        size_m=body.size_m,
        T_frame_shape=mount.T_ee_cam @ se3.from_translation(np.array(body.center_m)),
    )
