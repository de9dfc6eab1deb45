"""GraspNet's grasps as rectangles of the image: rect/NNNN.npy.

    (N, 7) float32: centre x, centre y, open x, open y, height, score, object id

Pixels. The open point is the middle of the rectangle's side at one finger, so that the gripper's
opening is twice the distance from the centre to it; height is the rectangle's extent across. The
score is 1.1 - friction, objects count from 0. Only grasps along the camera's axis have a rectangle:
where their palm's face is seen (graspnetAPI: to_rect_grasp_group, get_batch_key_points).
"""

import numpy as np

from realsim.arrays import Array
from realsim.formats.graspnet.grasp_group import GraspGroup
from realsim.formats.graspnet.gripper_frame import BASE_M, HEIGHT_M, graspnet_poses
from realsim.geometry import se3
from realsim.records import CameraIntrinsics

ALONG_AXIS = 0.99
"""Least cosine of approach and camera axis of a grasp that has a rectangle (8 deg)."""


def rect_rows(group: GraspGroup, intrinsics: CameraIntrinsics) -> Array:
    """Return the rectangles (N, 7) of the grasps that approach along the camera's axis.

    Args:
        group: in the camera's frame.
        intrinsics: of the camera; GraspNet's are used without distortion.
    """
    Ts = graspnet_poses(group.Ts_a_grasp, group.depths_m)
    rows = np.flatnonzero((Ts[:, 2, 0] > ALONG_AXIS) & (Ts[:, 2, 3] > BASE_M))
    half = 0.5 * group.openings_m[rows]
    corners = np.zeros((len(rows), 4, 3))
    corners[:, :, 0] = -BASE_M
    corners[:, 1:, 1] = -half[:, None]
    corners[:, 2, 2], corners[:, 3, 2] = 0.5 * HEIGHT_M, -0.5 * HEIGHT_M
    p = se3.transform(Ts[rows], corners)
    fx, fy, cx, cy = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    uv = np.stack([fx * p[..., 0] / p[..., 2] + cx, fy * p[..., 1] / p[..., 2] + cy], axis=-1)
    heights_px = np.linalg.norm(uv[:, 2] - uv[:, 3], axis=-1)
    numbers = group.obj_ids[rows].astype(np.float64) - 1.0
    return np.column_stack([uv[:, 0], uv[:, 1], heights_px, group.scores[rows], numbers])
