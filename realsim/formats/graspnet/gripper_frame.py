"""GraspNet's gripper frame and the 300 x 12 orientations of its labels.

x = approach, y = closing axis, z = height, the gripper's thin side. The origin (`translation`, the
labels' `points`) is a point on the object's surface through which the gripper approaches; the
fingertips are at x = depth, the palm's face at x = -0.02 m (graspnetAPI: plot_gripper_pro_max,
collision_detection). A gripper closes where Dex-Net's contacts are looked for, between its
fingertips, so that

    T_a_grasp = T_a_graspnet @ translation(x = depth) @ axes

where `grasp` has z = approach, y = closing axis, so x = -height. The Panda's fingers reach 8.8 mm
beyond that point: its pads meet the object where the label says that the contacts are.

An orientation is a view, one of 300 points of a Fibonacci lattice from which the object is looked
at along x = -view, and a turn about x by k pi / 12 (generate_views, viewpoint_params_to_matrix).
graspnetAPI has them in single precision: they differ from these by up to 1e-4.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array
from realsim.geometry import se3

VIEWS, ANGLES, DEPTHS = 300, 12, 4
"""Orientations and depths of GraspNet's labels."""
DEPTHS_M = (0.01, 0.02, 0.03, 0.04)
"""How far the fingertips are beyond a label's point [m]."""
BASE_M = 0.02
"""How far the palm's face is behind a label's point [m]."""
FINGER_M = 0.01
"""Thickness of GraspNet's fingers and palm [m] (collision_detection; drawn with 4 mm)."""
HEIGHT_M = 0.02
"""Extent of the gripper along its z axis [m] (GRASP_HEIGHT)."""

R_GRASP_GRASPNET = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
"""Axes of GraspNet's frame in `grasp`: a signed permutation, so that nothing is rounded."""


def grasp_poses(Ts_a_graspnet: ArrayLike, depths_m: ArrayLike) -> Array:
    """Return T_a_grasp (N, 4, 4) [m] of GraspNet's poses T_a_graspnet (N, 4, 4) and depths (N,)."""
    Ts = np.array(Ts_a_graspnet, dtype=np.float64)
    Ts[..., :3, 3] += np.asarray(depths_m, dtype=np.float64)[..., None] * Ts[..., :3, 0]
    Ts[..., :3, :3] = Ts[..., :3, :3] @ R_GRASP_GRASPNET.T
    return Ts


def graspnet_poses(Ts_a_grasp: ArrayLike, depths_m: ArrayLike) -> Array:
    """Return T_a_graspnet (N, 4, 4) [m] whose fingertips are `depths_m` (N,) beyond their origin.

    Undoes `grasp_poses`.
    """
    Ts = np.array(Ts_a_grasp, dtype=np.float64)
    Ts[..., :3, :3] = Ts[..., :3, :3] @ R_GRASP_GRASPNET
    Ts[..., :3, 3] -= np.asarray(depths_m, dtype=np.float64)[..., None] * Ts[..., :3, 0]
    return Ts


def views() -> Array:
    """Return the 300 unit vectors (300, 3) from an object to where it is looked at from."""
    i = np.arange(VIEWS, dtype=np.float64)
    golden = (np.sqrt(5.0) - 1.0) / 2.0
    z = (2.0 * i + 1.0) / VIEWS - 1.0
    r = np.sqrt(1.0 - z**2)
    turn = 2.0 * np.pi * golden * i
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)


def rotations(approach: ArrayLike, angles_rad: ArrayLike) -> Array:
    """Return R_a_graspnet (..., 3, 3) of approach directions (..., 3), turned about them by (...).

    At angle 0 the closing axis is level in the object's frame (y where the approach is upright).
    """
    x = np.asarray(approach, dtype=np.float64)
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    angle = np.asarray(angles_rad, dtype=np.float64)[..., None]
    level = np.stack([-x[..., 1], x[..., 0], np.zeros_like(x[..., 0])], axis=-1)
    length = np.linalg.norm(level, axis=-1, keepdims=True)
    y = np.where(length > 0, level / np.where(length > 0, length, 1.0), [0.0, 1.0, 0.0])
    z = np.cross(x, y)
    cos, sin = np.cos(angle), np.sin(angle)
    turned = cos * y + sin * z
    return np.stack([np.broadcast_to(x, turned.shape), turned, -sin * y + cos * z], axis=-1)


def angles_rad() -> Array:
    """Return the 12 turns about the approach axis (12,) [rad]; half a turn more is the same."""
    return np.arange(ANGLES) * np.pi / ANGLES


def label_poses(
    points: ArrayLike, view: NDArray[np.integer], angle_rad: ArrayLike, depth_m: ArrayLike
) -> Array:
    """Return T_obj_grasp (N, 4, 4) of labels.

    Args:
        points: (N, 3) on the object's surface [m].
        view: (N,) number of the view.
        angle_rad: (N,) turn about the approach axis.
        depth_m: (N,) how far the fingertips are beyond the point.
    """
    R = rotations(-views()[view], angle_rad)
    return grasp_poses(se3.from_rt(R, points), depth_m)
