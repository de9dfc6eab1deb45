"""Camera mounts: the usual bracket, and a small file for any other."""

import numpy as np
from numpy.typing import ArrayLike

from realsim.geometry import se3
from realsim_capture_plans.collision.camera_bodies import CAMERA_BODIES, FLANGE, camera_body
from realsim_capture_plans.collision.mount_file import read_mount, write_mount
from realsim_capture_plans.collision.shapes import Kind, Mount, Shape

__all__ = ["CAMERA_BODIES", "d405_mount", "plain_bracket", "read_mount", "write_mount"]
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
