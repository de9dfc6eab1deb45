"""GraspNet's grasps as rectangles of the image: rect/NNNN.npy.

    (N, 7) float32: centre x, centre y, open x, open y, height, score, object id

Pixels. The open point is the middle of the rectangle's side at one finger, so that the gripper's
opening is twice the distance from the centre to it; height is the rectangle's extent across. The
score is 1.1 - friction, objects count from 0. Only grasps along the camera's axis have a rectangle:
where their palm's face is seen (graspnetAPI: to_rect_grasp_group, get_batch_key_points).
"""

import io
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Int64
from realsim.formats.graspnet.grasp_group import GraspGroup
from realsim.formats.graspnet.gripper_frame import BASE_M, HEIGHT_M, graspnet_poses
from realsim.geometry import se3
from realsim.records import CameraIntrinsics
from realsim.records.checked_arrays import frozen

ALONG_AXIS = 0.99
"""Least cosine of approach and camera axis of a grasp that has a rectangle (8 deg)."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class RectGrasps:
    """Rectangles in one image."""

    centers_px: Array
    """(N, 2) x, y."""
    open_px: Array
    """(N, 2) x, y of the middle of one finger's side."""
    heights_px: Array
    """(N,) extent across the closing axis."""
    scores: Array
    """(N,) higher is better."""
    obj_ids: Int64
    """(N,) realsim's ids: GraspNet's number + 1; 0 = not known."""

    def __post_init__(self) -> None:
        """Check that all arrays speak of the same rectangles and freeze them."""
        n = len(self.scores)
        for name in ("centers_px", "open_px"):
            object.__setattr__(self, name, frozen(getattr(self, name), np.float64, (n, 2), name))
        for name in ("heights_px", "scores"):
            object.__setattr__(self, name, frozen(getattr(self, name), np.float64, (n,), name))
        object.__setattr__(self, "obj_ids", frozen(self.obj_ids, np.int64, (n,), "obj_ids"))

    def __len__(self) -> int:
        """Return the number of rectangles."""
        return len(self.scores)

    def corners_px(self) -> Array:
        """Return the corners (N, 4, 2) in order; the fingers are sides 1 to 2 and 3 to 0."""
        axis = self.open_px - self.centers_px
        length = np.linalg.norm(axis, axis=1, keepdims=True)
        across = np.stack([-axis[:, 1], axis[:, 0]], axis=1) / np.where(length > 0, length, 1.0)
        across *= 0.5 * self.heights_px[:, None]
        sides = ((1, 1), (1, -1), (-1, -1), (-1, 1))
        return np.stack([self.centers_px + a * across + b * axis for a, b in sides], axis=1)


def rect_grasps(group: GraspGroup, intrinsics: CameraIntrinsics) -> RectGrasps:
    """Return the rectangles of the grasps that approach along the camera's axis.

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
    return RectGrasps(
        centers_px=uv[:, 0],
        open_px=uv[:, 1],
        heights_px=np.linalg.norm(uv[:, 2] - uv[:, 3], axis=-1),
        scores=group.scores[rows],
        obj_ids=group.obj_ids[rows],
    )


def rect_bytes(grasps: RectGrasps) -> bytes:
    """Return rectangles as an npy file in single precision."""
    columns = (
        grasps.centers_px,
        grasps.open_px,
        grasps.heights_px[:, None],
        grasps.scores[:, None],
        grasps.obj_ids[:, None] - 1.0,
    )
    buffer = io.BytesIO()
    np.save(buffer, np.concatenate(columns, axis=1).astype(np.float32), allow_pickle=False)
    return buffer.getvalue()
