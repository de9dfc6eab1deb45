"""Roll, pitch and yaw as URDF means them: fixed axes, R = Rz(yaw) Ry(pitch) Rx(roll)."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.geometry import se3

Array = NDArray[np.float64]


def rpy_from_R(R: ArrayLike) -> Array:
    """Return roll, pitch, yaw (3,) [rad] of a rotation (3, 3).

    Straight up and down (pitch of a right angle) roll and yaw are one turn: yaw takes what it can
    read, roll the rest, so that the rotation comes back in any case.
    """
    R = np.asarray(R, dtype=np.float64)
    yaw = np.arctan2(R[1, 0], R[0, 0])
    s, c = np.sin(yaw), np.cos(yaw)
    pitch = np.arctan2(-R[2, 0], c * R[0, 0] + s * R[1, 0])
    roll = np.arctan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    return np.array([roll, pitch, yaw])


def R_from_rpy(rpy: ArrayLike) -> Array:
    """Return the rotation (3, 3) of roll, pitch, yaw (3,) [rad]."""
    roll, pitch, yaw = np.asarray(rpy, dtype=np.float64)
    x, y, z = (
        se3.exp_so3(angle * axis) for angle, axis in zip((roll, pitch, yaw), np.eye(3), strict=True)
    )
    product: Array = z @ y @ x
    return product
