"""Where demonstrations are seen from: from a view of the session, from the hand.

The camera beside the table is placed in `front_view`. Pictures have square pixels and no
distortion. The hand's camera is on Franka's usual mount unless another pose is given.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics
from realsim_sim_bridge.arm import panda
from realsim_sim_bridge.demonstrations.records import DemonstrationCamera

Array = NDArray[np.float64]
SIZE_PX = (320, 240)
"""Width and height of the pictures: what policies are fed with, or a little more."""
FRONT, WRIST = "front", "wrist"
WRIST_VIEW_DEG = 69.0
"""Horizontal angle of view of the hand's camera: a RealSense D435's colour camera."""
WRIST_AT_M = (0.075, 0.0, -0.055)
"""Where the hand's camera is in the grasp frame [m]: before the palm, over the fingers' plane."""
WRIST_LOOKS_M = (0.0, 0.0, 0.03)
"""What it looks at, grasp frame [m]: just beyond the fingertips."""


def view_intrinsics(view_deg: float, size_px: tuple[int, int] = SIZE_PX) -> CameraIntrinsics:
    """Return a camera without distortion, by its horizontal angle of view."""
    width, height = size_px
    f = width / 2.0 / np.tan(np.radians(view_deg) / 2.0)
    return CameraIntrinsics(
        width=width, height=height, fx=f, fy=f, cx=(width - 1) / 2.0, cy=(height - 1) / 2.0
    )


def wrist_camera(
    T_ee_cam: Array | None = None, size_px: tuple[int, int] = SIZE_PX
) -> DemonstrationCamera:
    """Return a camera in the hand.

    Args:
        T_ee_cam: (4, 4) camera in the arm's flange, as a hand-eye calibration gives it [m];
            None = the usual mount.
        size_px: width and height of its pictures.
    """
    if T_ee_cam is None:
        z = np.array(WRIST_LOOKS_M) - WRIST_AT_M
        z = z / np.linalg.norm(z)
        x = np.array([0.0, 1.0, 0.0])
        T = se3.from_rt(np.stack([x, np.cross(z, x), z], axis=-1), np.array(WRIST_AT_M))
    else:
        T = flange_in_grasp() @ T_ee_cam
    return DemonstrationCamera(
        name=WRIST, intrinsics=view_intrinsics(WRIST_VIEW_DEG, size_px), T_frame_cam=T, on_hand=True
    )


def flange_in_grasp() -> Array:
    """Return T_grasp_flange (4, 4) of a Panda [m]."""
    turn = se3.from_rt(se3.exp_so3([0.0, 0.0, panda.HAND_TURN]), np.zeros(3))
    return se3.invert(turn @ se3.from_translation([0.0, 0.0, panda.TCP_M]))


def sees_fingertips(camera: DemonstrationCamera) -> bool:
    """Return whether a camera in the hand has what is between the fingertips in its picture."""
    x, y, z = se3.invert(camera.T_frame_cam)[:3, 3].tolist()
    i = camera.intrinsics
    if z <= 0.0:
        return False
    u, v = i.fx * x / z + i.cx, i.fy * y / z + i.cy
    return 0.0 <= u <= i.width - 1 and 0.0 <= v <= i.height - 1


def view_camera(
    name: str, intrinsics: CameraIntrinsics, T_table_cam: Array, width_px: int = SIZE_PX[0]
) -> DemonstrationCamera:
    """Return a camera where one of a session stood, with smaller pictures without distortion.

    Args:
        name: of the camera.
        intrinsics: of the session's camera.
        T_table_cam: (4, 4) [m].
        width_px: of the pictures; their height follows, made even for the video.

    Raises:
        InputError: the width is less than 16 pixels.
    """
    if width_px < 16:
        raise InputError(f"pictures {width_px} px wide show nothing; 16 or more is accepted.")
    height = max(2, 2 * round(width_px * intrinsics.height / intrinsics.width / 2))
    sx, sy = width_px / intrinsics.width, height / intrinsics.height
    scaled = replace(
        intrinsics,
        width=width_px,
        height=height,
        fx=intrinsics.fx * sx,
        fy=intrinsics.fy * sy,
        # Pixel centres are whole numbers.
        cx=(intrinsics.cx + 0.5) * sx - 0.5,
        cy=(intrinsics.cy + 0.5) * sy - 0.5,
        distortion=np.zeros(8),
    )
    return DemonstrationCamera(name=name, intrinsics=scaled, T_frame_cam=T_table_cam)
