"""Grasps seen from one view: where they are in the camera, and which contacts it can see.

A grasp's two contacts lie at +-width/2 along its closing axis y. A contact is seen if it is in the
image and the straight line from the camera to it is free. The line is drawn to a point a clearance
outside the contact, where the finger's pad would stand: the two sides of a convex object are never
both in sight of one camera in the strict sense, yet the pads on both sides are what a camera above
the grasp sees. A contact behind something that the measured depth shows and the scene does not
have (a hand) is not seen either.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Mask, UInt8
from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics, GraspSet
from realsim.rendering.labels import LabelRenderer
from realsim_sim_bridge.annotation.config import SightConfig
from realsim_sim_bridge.annotation.unmodelled import UnmodelledRegion

LENS_ROUND_TRIP = 1e-3
"""How far [normalised] a projected point may come back from the lens model: a point far out of
view can be folded into the image by the distortion polynomial, and then does not come back."""


class GraspVisibility(IntEnum):
    """How much of a grasp a view sees."""

    HIDDEN = 0
    """Neither contact."""
    PARTLY = 1
    """One of the two contacts."""
    VISIBLE = 2
    """Both contacts."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class GraspsInView:
    """The grasps of one object instance in one view."""

    Ts_cam_grasp: Array
    """(N, 4, 4) grasp in camera [m]."""
    grasp_set: GraspSet
    """Widths, scores and measures of the same N grasps."""
    contact_seen: Mask
    """(N, 2) whether the contact at -y and at +y is seen."""

    @property
    def visibility(self) -> UInt8:
        """(N,) codes of `GraspVisibility`: how many contacts are seen."""
        return np.sum(self.contact_seen, axis=1).astype(np.uint8)


def contact_points(Ts_x_grasp: ArrayLike, widths_m: ArrayLike, clearance_m: float = 0.0) -> Array:
    """Return the contacts (N, 2, 3) at -y and +y in frame x [m].

    Args:
        Ts_x_grasp: (N, 4, 4) grasps.
        widths_m: (N,) distance of the contacts [m].
        clearance_m: how much further out the points lie [m].
    """
    T = np.asarray(Ts_x_grasp, dtype=np.float64).reshape(-1, 4, 4)
    reach = np.asarray(widths_m, dtype=np.float64) / 2 + clearance_m
    offset = T[:, :3, 1] * reach[:, None]
    return T[:, None, :3, 3] + offset[:, None] * np.array([-1.0, 1.0])[:, None]


def in_image(intrinsics: CameraIntrinsics, points_cam: ArrayLike) -> Mask:
    """Return (N,) which camera points (N, 3) [m] fall on a pixel of the image."""
    p = np.asarray(points_cam, dtype=np.float64)
    uv = camera.project(intrinsics, p)
    known = np.all(np.isfinite(uv), axis=1)
    inside = np.zeros(len(p), dtype=bool)
    u, v = uv[known, 0], uv[known, 1]
    inside[known] = (u >= -0.5) & (u < intrinsics.width - 0.5)
    inside[known] &= (v >= -0.5) & (v < intrinsics.height - 0.5)
    if intrinsics.is_distorted and np.any(inside):
        xy, valid = camera.undistort(intrinsics, uv[inside])
        back = np.abs(xy - p[inside, :2] / p[inside, 2:3]).max(-1)
        inside[inside] = valid & (np.nan_to_num(back, nan=np.inf) < LENS_ROUND_TRIP)
    return inside


def free_lines(
    renderer: LabelRenderer, eye_world: ArrayLike, points_world: ArrayLike, tolerance_m: float
) -> Mask:
    """Return (N,) whether the straight lines from `eye_world` (3,) to points (N, 3) are free."""
    eye = np.asarray(eye_world, dtype=np.float64)
    lines = np.asarray(points_world, dtype=np.float64).reshape(-1, 3) - eye
    length = np.linalg.norm(lines, axis=1)
    rays = np.concatenate([np.broadcast_to(eye, lines.shape), lines / length[:, None]], axis=1)
    return np.asarray(renderer.cast_rays(rays).t >= length - tolerance_m, dtype=bool)


def is_behind(
    region: UnmodelledRegion, intrinsics: CameraIntrinsics, points_cam: ArrayLike
) -> Mask:
    """Return (N,) which camera points (N, 3) [m] lie behind a thing that is not in the model."""
    p = np.asarray(points_cam, dtype=np.float64)
    rows, columns = region.window
    pixel = np.rint(np.nan_to_num(camera.project(intrinsics, p), nan=-1.0)).astype(np.int64)
    u, v = pixel[:, 0] - columns.start, pixel[:, 1] - rows.start
    height, width = region.mask.shape
    behind = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    u, v = u[behind], v[behind]
    # Where it was not measured it is a hole inside the thing: as near as the rest of it.
    behind[behind] = region.mask[v, u] & (region.depth_m[v, u] < p[behind, 2])
    return behind


def grasps_in_view(
    renderer: LabelRenderer,
    intrinsics: CameraIntrinsics,
    T_world_cam: ArrayLike,
    grasp_sets: Sequence[tuple[ArrayLike, GraspSet]],
    config: SightConfig,
    region: UnmodelledRegion | None = None,
) -> list[GraspsInView]:
    """Return the objects' grasps in the camera, each contact marked as seen or not.

    Args:
        renderer: the scene that may stand in the way.
        intrinsics: the camera.
        T_world_cam: (4, 4) camera in world [m].
        grasp_sets: per object where it stands, T_world_obj (4, 4) [m], and its grasps.
        config: when a contact counts as seen.
        region: where something that is not in the scene stands in front; None = nowhere.
    """
    T = np.asarray(T_world_cam, dtype=np.float64)
    T_cam_world = se3.invert(T)
    Ts = [T_cam_world @ np.asarray(o, dtype=np.float64) @ g.Ts_obj_grasp for o, g in grasp_sets]
    # One cast for all objects: a cast has a price, whatever the number of its lines.
    widths_m = np.concatenate([np.zeros(0), *(g.widths_m for _, g in grasp_sets)])
    Ts_pads = [T_cam_world @ np.asarray(o, dtype=np.float64) @ g.Ts_obj_pads for o, g in grasp_sets]
    Ts_cam_pads = np.concatenate([np.zeros((0, 4, 4)), *Ts_pads])
    pads_cam = contact_points(Ts_cam_pads, widths_m, config.clearance_m).reshape(-1, 3)
    seen = in_image(intrinsics, pads_cam)
    if region is not None:
        seen &= ~is_behind(region, intrinsics, pads_cam)
    if np.any(seen):
        pads_world = se3.transform(T, pads_cam[seen])
        seen[seen] = free_lines(renderer, T[:3, 3], pads_world, config.tolerance_m)
    ends = np.cumsum([len(g) for _, g in grasp_sets])
    contact_seen = np.split(seen.reshape(-1, 2), ends[:-1])
    return [
        GraspsInView(Ts_cam_grasp=Ts_of, grasp_set=grasps, contact_seen=seen_of)
        for (_, grasps), Ts_of, seen_of in zip(grasp_sets, Ts, contact_seen, strict=False)
    ]
