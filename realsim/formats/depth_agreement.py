"""Whether depth images of several views agree: points of one, put into a neighbour's image.

A point that view i measured is brought into view j by the camera poses; what j measured at its
pixel must be as far. The 40th percentile of the difference over the points is small only if the
poses, their unit and their axes are right; points that fall beside the image count as disagreeing.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Array32
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.geometry.depth import points_from_depth
from realsim.records import CameraIntrinsics

DepthImage = Array32
DepthOf = Callable[[int], tuple[DepthImage, CameraIntrinsics]]
"""What returns, for a view's place, its depth (H, W) [m], 0 = none, and its camera."""
SAMPLED_VIEWS = 24
"""Depth images read at most; they are kept in memory while they are compared."""
POINTS = 1500
"""Points of a view, about."""
PAIRS = 10
"""Pairs of views that are compared."""
MOTION_RAD = 0.25
"""Motion between the views of a pair, as an angle: enough that a wrong pose shows, and little
enough that most of the image is seen by both (14 deg of a field of view of 50 to 70)."""
OVERLAP_PERCENTILE = 40.0
"""Percentile of the differences: two fifths of the points must be seen, and not hidden, in the
neighbour."""
BESIDE_MM = 200.0
"""Difference [mm] of a point that the neighbour does not see, and the largest that is counted."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class DepthView:
    """A depth image with some of its points."""

    depth_m: DepthImage
    """(H, W) [m], 0 = none."""
    intrinsics: CameraIntrinsics
    points_cam: Array
    """(M, 3) some of its points [m]."""


def sampled_views(Ts_world_cam: Array, depth_of: DepthOf) -> dict[int, DepthView]:
    """Return views with depth, by place, in runs of neighbours spread over all."""
    count = len(Ts_world_cam)
    places = range(count)
    if count > SAMPLED_VIEWS:
        # Sixths of the sequence, four frames each: neighbours in time are neighbours in space, and
        # frames of 30 per second must lie some apart to have moved at all.
        step = max(1, min(count // SAMPLED_VIEWS, 10))
        starts = np.linspace(0, count - 1 - 3 * step, SAMPLED_VIEWS // 4).round().astype(int)
        places = sorted({int(s) + k * step for s in starts for k in range(4)})
    views: dict[int, DepthView] = {}
    for k in places:
        depth_m, intrinsics = depth_of(k)
        stride = max(1, round((depth_m.size / POINTS) ** 0.5))
        points, _ = points_from_depth(depth_m, intrinsics, stride)
        if len(points):
            views[k] = DepthView(depth_m=depth_m, intrinsics=intrinsics, points_cam=points)
    return views


def near_pairs(Ts_world_cam: Array, views: Mapping[int, DepthView]) -> list[tuple[int, int]]:
    """Return pairs of views whose motion is about MOTION_RAD, the best ones first chosen.

    The motion of a pair is the angle between the cameras plus that under which their distance is
    seen from the scene.
    """
    keys = sorted(views)
    if len(keys) < 2:
        return []
    distance_m = float(np.median([np.median(views[k].points_cam[:, 2]) for k in keys]))
    T = Ts_world_cam[keys]
    angle = se3.angle(np.swapaxes(T[:, None, :3, :3], -1, -2) @ T[None, :, :3, :3])
    motion = angle + np.linalg.norm(T[:, None, :3, 3] - T[None, :, :3, 3], axis=-1) / distance_m
    i, j = np.triu_indices(len(keys), 1)
    # A ratio: half of the wanted motion is as far from it as twice.
    order = np.argsort(np.abs(np.log((motion[i, j] + 1e-9) / MOTION_RAD)), kind="stable")[:PAIRS]
    return [(keys[int(i[n])], keys[int(j[n])]) for n in order]


def disagreement_mm(
    Ts_world_cam: Array, views: Mapping[int, DepthView], pairs: Sequence[tuple[int, int]]
) -> float:
    """Return by how much the depth of pairs of views differs: the median over the pairs [mm].

    Args:
        Ts_world_cam: (N, 4, 4) camera poses [m].
        views: by place.
        pairs: of places.

    Returns:
        Difference [mm], at most BESIDE_MM; NaN without pairs.
    """
    if not pairs:
        return float("nan")
    Ts = Ts_world_cam
    both = [*pairs, *((j, i) for i, j in pairs)]
    return float(np.median([_difference_mm(Ts, views[i], i, views[j], j) for i, j in both]))


def _difference_mm(Ts: Array, a: DepthView, i: int, b: DepthView, j: int) -> float:
    """Return the percentile of |z expected - z measured| of the points of a view in another."""
    points = se3.transform(se3.invert(Ts[j]) @ Ts[i], a.points_cam)
    height, width = b.depth_m.shape
    with np.errstate(invalid="ignore"):
        uv = np.rint(project(b.intrinsics, points))
        inside = (uv[:, 0] >= 0) & (uv[:, 0] < width) & (uv[:, 1] >= 0) & (uv[:, 1] < height)
    off = np.full(len(points), BESIDE_MM)
    u, v = uv[inside].astype(np.int64).T
    measured = b.depth_m[v, u].astype(np.float64)
    known = np.isfinite(measured) & (measured > 0)
    difference = 1e3 * np.abs(points[inside, 2] - measured)
    off[inside] = np.where(known, np.minimum(difference, BESIDE_MM), BESIDE_MM)
    return float(np.percentile(off, OVERLAP_PERCENTILE))
