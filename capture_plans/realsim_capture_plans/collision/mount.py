"""Camera mounts: the cameras' bodies as boxes in their colour frame, and the usual bracket."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.robots.shapes import Kind, Mount, Shape

FLANGE = 6
"""What `Shape.frame` is of camera and bracket, on whatever arm: the model puts in its flange."""


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


USUAL_CAMERA_M = (0.0, -0.065, 0.035)
"""The camera beside the flange: near enough to stay inside the wrist's shadow, far enough for the
cable."""
PLATE_M = (0.0315, 0.008)
"""Radius and thickness of a plate on the flange (ISO 9409-1-50-4-M6: 63 mm across)."""
ARM_RADIUS_M = 0.012
"""Half the width of the bracket's arm."""
LEAST_ARM_M = 0.001
"""Shorter arms are left out."""


def d405_mount(T_ee_cam: ArrayLike | None = None) -> Mount:
    """Return a D405 on a plain bracket; by default beside the flange, optical axis along tool z.

    The bracket is a plate on the flange, an arm along the plate to where the camera is, and an arm
    out (or back) to the camera's body.

    Args:
        T_ee_cam: (4, 4) another place of the camera [m].
    """
    T = (
        se3.from_translation(list(USUAL_CAMERA_M))
        if T_ee_cam is None
        else se3.check_rigid(T_ee_cam, "T_ee_cam")
    )
    return Mount(
        name="D405 on a plain bracket", camera="D405", T_ee_cam=T, bracket=plain_bracket(T, "D405")
    )


def plain_bracket(T_ee_cam: ArrayLike, camera: str) -> tuple[Shape, ...]:
    """Return a plate and two arms from the flange to a camera's body.

    Raises:
        InputError: the camera is not known.
    """
    T = np.asarray(T_ee_cam, dtype=np.float64)
    center = se3.transform(T, np.array(camera_body(camera).center_m)[None])[0]
    root = np.array([0.0, 0.0, ARM_RADIUS_M])
    corner = np.array([center[0], center[1], ARM_RADIUS_M])
    plate = _piece("cylinder", PLATE_M, [0.0, 0.0, PLATE_M[1] / 2], [0.0, 0.0, 1.0])
    pieces = [plate]
    for start, end in ((root, corner), (corner, center)):
        along = end - start
        length = float(np.linalg.norm(along))
        if length >= LEAST_ARM_M:
            pieces.append(_piece("capsule", (ARM_RADIUS_M, length), (start + end) / 2, along))
    return tuple(pieces)


def _piece(kind: Kind, size_m: tuple[float, ...], center: ArrayLike, axis: ArrayLike) -> Shape:
    """Return a round piece of the bracket about an axis."""
    z = np.asarray(axis, dtype=np.float64)
    z = z / np.linalg.norm(z)
    x = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
    x = x / np.linalg.norm(x)
    return Shape(
        part="bracket",
        frame=FLANGE,
        kind=kind,
        size_m=size_m,
        T_frame_shape=se3.from_rt(np.stack([x, np.cross(z, x), z], axis=-1), center),
    )
