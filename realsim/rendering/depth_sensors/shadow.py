"""Which surfaces only one eye of a depth camera sees: they have no match, so no depth.

Exactly, by rays from the surface to either eye; and from a depth image alone, by a scan along its
rows, which knows nothing of what the image does not show.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array, Array32, Mask
from realsim.errors import InputError
from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics
from realsim.rendering.rays import RayScene, rotated

LIFT = 3e-4
"""Share of the way to the eye by which rays start above the surface: more than float32 and the
rendered depth are off (1e-6), less than a sheet of paper at half a metre (0.15 mm)."""


def shadow_mask(
    scene: RayScene,
    depth_m: ArrayLike,
    intrinsics: CameraIntrinsics,
    T_world_cam: ArrayLike,
    *,
    baseline_m: float,
    eye_offset_m: float = 0.0,
    border: bool = True,
    border_margin_px: float = 0.0,
) -> Mask:
    """Return where (H, W) a surface is hidden from an eye, or outside the second eye's picture.

    The eyes (or eye and projector) stand on the x axis of the picture's camera, at `eye_offset_m`
    and at `eye_offset_m + baseline_m`.

    Args:
        scene: everything that can hide something.
        depth_m: (H, W) exact depth along z of the picture [m], 0 = nothing.
        intrinsics: the picture's camera, distorted or not.
        T_world_cam: (4, 4) the picture's camera in world [m].
        baseline_m: distance of the eyes [m].
        eye_offset_m: where the first eye stands [m]; 0 = the picture is its own.
        border: whether what lies outside the second eye's picture (its axes are parallel and it has
            the same lens) counts, too.
        border_margin_px: how near to its left border a match is lost [px].

    Raises:
        InputError: sizes differ, or the pose is not rigid.
    """
    depth = np.asarray(depth_m, dtype=np.float32)
    require_same_size(depth, intrinsics)
    T = se3.check_rigid(T_world_cam, "T_world_cam")
    table = camera.ray_table(intrinsics)
    seen = (depth > 0) & np.isfinite(table[..., 0])
    points = table[seen] * depth[seen][:, None]
    hidden = np.zeros(len(points), dtype=bool)
    for x in (eye_offset_m, eye_offset_m + baseline_m):
        if x != 0:  # what the camera sees is not hidden from its own place
            hidden |= _hidden_from(scene, points, np.array([x, 0.0, 0.0]), T)
    if border:
        u = np.nonzero(seen)[1] - intrinsics.fx * baseline_m / points[:, 2]
        hidden |= u < border_margin_px - 0.5
    mask = np.zeros(depth.shape, dtype=bool)
    mask[seen] = hidden
    return mask


def require_same_size(
    image: NDArray[np.generic], intrinsics: CameraIntrinsics, name: str = "the depth picture"
) -> None:
    """Refuse a depth picture that is not of the camera's size.

    Raises:
        InputError: the sizes differ, or the array is no picture.
    """
    if image.ndim != 2:
        raise InputError(
            f"{name}: a depth picture has rows and columns; found an array of shape {image.shape}."
        )
    if image.shape != (intrinsics.height, intrinsics.width):
        raise InputError(
            f"{name} is {image.shape[1]}x{image.shape[0]}, the camera "
            f"{intrinsics.width}x{intrinsics.height}. Give the intrinsics of the depth pictures, "
            "at their size."
        )


def _hidden_from(scene: RayScene, points: Array32, eye: Array, T_world_cam: Array) -> Mask:
    """Return which points (N, 3) of the camera's axes something hides from an eye (3,)."""
    if len(points) == 0:
        return np.zeros(0, dtype=bool)
    towards = eye.astype(np.float32) - points
    starts = se3.transform(T_world_cam, (points + np.float32(LIFT) * towards).astype(np.float64))
    directions = rotated(towards, T_world_cam[:3, :3])
    # The ray ends at the eye: a wall behind it hides nothing.
    return scene.occluded(starts, directions, until=1 - LIFT)


def half_occluded(
    disparity: Array32,
    *,
    second_eye: float = 1.0,
    first_eye: float = 0.0,
    border: bool = True,
    border_margin_px: float = 0.0,
) -> Mask:
    """Return where (H, W) an eye cannot see what the picture shows, from the picture alone.

    A point at column u appears at u - s d in an eye that stands s baselines to the right. Along a
    row that order is kept unless something nearer jumps in front: for s > 0 something at u' > u
    with u' - s d' < u - s d hides u, which one running minimum from the right finds for all pixels;
    for s < 0 the mirror image. What leaves the second eye's picture has no match either.

    Args:
        disparity: (H, W) for the whole baseline [px], 0 = unknown.
        second_eye: where the second eye stands [baselines].
        first_eye: where the first eye stands [baselines]; 0 = the picture is its own.
        border: whether what leaves the picture (u < d) counts.
        border_margin_px: what comes so near to leaving it counts, too [px].
    """
    known = disparity > 0
    lost = np.zeros(disparity.shape, dtype=bool)
    for s in (second_eye, first_eye):
        if s > 0:
            lost |= _overtaken(disparity * np.float32(s), known)
        elif s < 0:
            lost |= _overtaken(disparity[:, ::-1] * np.float32(-s), known[:, ::-1])[:, ::-1]
    if border:
        u = np.arange(disparity.shape[1], dtype=np.float32)
        lost |= u - disparity < border_margin_px - 0.5
    return known & lost


def _overtaken(shift: Array32, known: Mask) -> Mask:
    """Return which pixels (H, W) one further to the right overtakes when all move left."""
    u = np.arange(shift.shape[1], dtype=np.float32)
    moved = np.where(known, u - shift, np.float32(1e9))
    least = np.minimum.accumulate(moved[:, ::-1], axis=1)[:, ::-1]
    hidden = np.zeros(shift.shape, dtype=bool)
    hidden[:, :-1] = least[:, 1:] < moved[:, :-1]
    return hidden
