"""Planes among measured points, and which of them a scene stands on."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array, Mask
from realsim.geometry import se3
from realsim.geometry.clouds import fit_plane_ransac, frame_about, plane_frame, refine_plane
from realsim.records import SupportPlane
from realsim.registration.body import Body

ITERATIONS = 300
"""Random triples; finds a plane of 25 % of the points with p = 0.99."""
SEARCHES = 2
"""Random searches per plane, each over other points."""
TRIPLE_POINTS = 4_000
"""Points that a random search counts."""
WIDENINGS = (4.0, 1.0)
"""Tolerances of the refinement, in turn, in units of the tolerance; the last must be 1."""
CANDIDATES = 5
"""Planes looked at, largest first: table, floor, two walls and the lid of a box."""
LEAST_SHARE = 0.08
"""A plane with a smaller share of the points looked at is no table; below a pile that covers
half of it there is still a fifth."""
LEAST_POINTS = 200
"""Fewer points tell nothing about a scene."""
GRAVITY_COS = 0.9
"""Least cosine between the normal and the given up direction (26 deg)."""
FACING_COS = 0.08
"""Least mean cosine between the normal and the way to the cameras: walls seen edge-on."""
PIERCED_M = 0.02
"""A point further behind the plane than this [m] was seen through it; 3 times the noise of a
depth camera at 1 m."""
PIERCED_SHARE = 0.25
"""A plane through whose points more than this share of the rays pass is no surface."""
CELL_M = 0.02
"""Cells of a plane's footprint [m]: where points lie on it."""
LID_SHARE = 0.3
"""A lower parallel plane with at least this share of the largest one's points is the table."""
LID_GAP_M = 0.25
"""At most so far below [m]: a floor lies deeper, an object is not taller."""
LID_COS = 0.985
"""Planes nearer to parallel than this (10 deg) are lid and table."""
SEED = 0
"""Seed of the random search."""


@dataclass(frozen=True, eq=False, slots=True)
class TablePlane:
    """A plane n.p = offset, the points of the search that lie on it, and how good a table it is."""

    normal: Array
    offset: float
    count: int
    score: float


def best_plane(
    points: Array, eyes: Array, region: tuple[Array, float], tolerance: float, up: ArrayLike | None
) -> tuple[TablePlane | None, str]:
    """Return the table among the largest planes, or why there is none."""
    if len(points) < LEAST_POINTS:
        return None, (
            f"only {len(points)} points lie within {region[1]:.2f} m of where the cameras look "
            f"({', '.join(f'{x:.2f}' for x in region[0])} m); at least {LEAST_POINTS} are "
            "needed. Are the camera poses camera-to-world, and in metres?"
        )
    rng = np.random.default_rng(SEED)
    left, largest = points, 0.0
    found: list[TablePlane] = []
    for _ in range(CANDIDATES):
        if len(left) < max(50, LEAST_SHARE * len(points)):
            break
        normal, offset, inliers = _largest_plane(left, tolerance, rng)
        count = int(np.count_nonzero(inliers))
        largest = max(largest, count / len(points))
        candidate = _judged(normal, offset, points, eyes, tolerance, up)
        if candidate is not None:
            found.append(candidate)
        left = left[~inliers]
    if not found:
        return None, (
            f"the largest plane holds {100 * largest:.0f} % of the points that the cameras look "
            f"at; at least {100 * LEAST_SHARE:.0f} % are needed, on a plane that no camera "
            "looks through"
            + ("" if up is None else " and that lies across the given up direction")
            + ". A flat table is expected; check the camera poses."
        )
    best = max(found, key=lambda c: c.score)
    return _lowest_parallel(best, found, region[0]), ""


def _largest_plane(
    points: Array, tolerance: float, rng: np.random.Generator
) -> tuple[Array, float, Mask]:
    """Return normal, offset and inliers of the plane with most points, out of several searches.

    Three noisy points close together are a plane turned by degrees: one refinement begins with a
    tolerance wide enough to turn it back. In clutter that width pulls a good plane up into the
    objects, so another keeps to the tolerance.
    """
    found: list[tuple[int, Array, float, Mask]] = []
    for _ in range(SEARCHES):
        few = points[rng.integers(0, len(points), size=min(len(points), TRIPLE_POINTS))]
        normal, offset, _ = fit_plane_ransac(few, rng, tolerance, ITERATIONS)
        narrow = refine_plane(points, normal, offset, tolerance)
        found.append((int(np.count_nonzero(narrow[2])), *narrow))
        for widening in WIDENINGS:
            normal, offset, on = refine_plane(points, normal, offset, widening * tolerance)
            found.append((int(np.count_nonzero(on)) if widening == 1 else 0, normal, offset, on))
    _, normal, offset, on = max(found, key=lambda f: f[0])
    return normal, offset, on


def _judged(
    normal: Array, offset: float, points: Array, eyes: Array, tolerance: float, up: ArrayLike | None
) -> TablePlane | None:
    """Return the plane, turned to the cameras, with its score; None = it cannot be the table."""
    if np.mean(eyes @ normal - offset) < 0:
        normal, offset = -normal, -offset
    if up is not None:
        u = np.asarray(up, dtype=np.float64)
        if normal @ u / np.linalg.norm(u) < GRAVITY_COS:
            return None
    height = points @ normal - offset
    on = np.abs(height) < tolerance
    count = int(np.count_nonzero(on))
    if count < LEAST_SHARE * len(points):
        return None
    towards = eyes[on] - points[on]
    facing = float(np.mean(towards @ normal / np.linalg.norm(towards, axis=1)))
    if facing < FACING_COS:
        return None
    pierced = _pierced(normal, offset, points, eyes, height, on)
    if pierced > PIERCED_SHARE * count:
        return None
    # What stands on a table lies above it; behind a wall of a shelf nothing is seen, but before it
    # is everything: the plane that faces the cameras more is what they were moved around.
    score = count * (0.5 + 0.5 * facing) - pierced
    return TablePlane(normal, offset, count, score)


def _pierced(
    normal: Array, offset: float, points: Array, eyes: Array, height: Array,
    on: Mask,
) -> int:  # fmt: skip
    """Return how many rays pass through cells of the plane where other points lie on it."""
    T = se3.invert(table_frame(normal, offset, points[on].mean(0)))
    flat = se3.transform(T, points[on])[:, :2]
    low = flat.min(0)
    size = np.floor((flat.max(0) - low) / CELL_M).astype(np.int64) + 1
    covered = np.zeros((int(size[0]), int(size[1])), dtype=bool)
    index = np.floor((flat - low) / CELL_M).astype(np.int64)
    covered[index[:, 0], index[:, 1]] = True
    eye_height = eyes @ normal - offset
    through = (height < -PIERCED_M) & (eye_height > 0)
    if not through.any():
        return 0
    share = eye_height[through] / (eye_height[through] - height[through])
    hit = eyes[through] + share[:, None] * (points[through] - eyes[through])
    index = np.floor((se3.transform(T, hit)[:, :2] - low) / CELL_M).astype(np.int64)
    inside = np.all((index >= 0) & (index < size), axis=1)
    return int(np.count_nonzero(covered[index[inside, 0], index[inside, 1]]))


def _lowest_parallel(best: TablePlane, found: Sequence[TablePlane], aim: Array) -> TablePlane:
    """Return the lowest plane that is parallel to the best and not much smaller: not a lid."""
    # Height of the plane over the aim, along the best one's normal.
    heights = {id(c): float(c.offset - c.normal @ aim) for c in (best, *found)}
    below = [
        c
        for c in found
        if c.normal @ best.normal > LID_COS
        and c.count >= LID_SHARE * best.count
        and 0 < heights[id(best)] - heights[id(c)] < LID_GAP_M
    ]
    return min(below, key=lambda c: heights[id(c)], default=best)


def table_frame(normal: Array, offset: float, aim: Array) -> Array:
    """Return T_world_table (4, 4): z the normal, x along world x, origin under the aim (3,)."""
    z = normal / np.linalg.norm(normal)
    # World x, unless it is nearly upright; a threshold far from any usual table keeps x steady.
    axis = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    return frame_about(z, axis, aim - z * (z @ aim - offset))


@dataclass(frozen=True, kw_only=True, slots=True)
class PlaneConfig:
    """How the support plane is searched."""

    tolerance_m: float = 0.004
    """Points within this (plus the depth noise) belong to the plane: tables are flat to 2 mm."""
    iterations: int = 300
    """Random triples; finds a plane of 25 % of the points with p = 0.99."""
    points: int = 20_000
    """At most so many points are used by the random search; the refinement uses all."""
    attempts: int = 4
    """Planes tried, largest first, before there is said to be none."""
    least_share: float = 0.05
    """A plane with a smaller share of the points around the objects carries nothing."""
    gravity_cos: float = 0.9
    """Least cosine between the normal and the given up direction (26 deg)."""
    sunk_m: float = 0.02
    """How far an object's centre may lie below the plane (rough starts are off by 20 mm)."""
    seed: int = 0
    """Seed of the random search."""


def find_support_plane(
    points: ArrayLike,
    centers: ArrayLike,
    cameras: ArrayLike,
    config: PlaneConfig,
    noise_m: float,
    gravity_up_world: ArrayLike | None = None,
) -> tuple[SupportPlane | None, str]:
    """Return the plane that carries the objects, or None and why there is none.

    The largest plane of the points around the objects that has the cameras and the objects on one
    side and, if the up direction is given, agrees with it. Found by random triples, refined by
    re-weighted least squares (Tukey), its normal turned to the objects' side.

    Args:
        points: (N, 3) measured points around the objects but not on them, world [m].
        centers: (K, 3) the objects' centres at their start poses, world [m].
        cameras: (F, 3) camera positions, world [m].
        config: settings.
        noise_m: typical 1-sigma of a point [m].
        gravity_up_world: (3,) direction up, or None.
    """
    p = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    centers, cameras = np.asarray(centers, float), np.asarray(cameras, float)
    total = len(p)
    tolerance = config.tolerance_m + noise_m
    rng = np.random.default_rng(config.seed)
    for _ in range(config.attempts):
        if len(p) < max(50, config.least_share * total):
            return None, f"only {len(p)} of {total} points around the objects are left for a plane."
        few = p[:: max(1, len(p) // config.points)]
        normal, offset, _ = fit_plane_ransac(few, rng, tolerance, config.iterations)
        normal, offset, inliers = refine_plane(p, normal, offset, tolerance)
        if np.mean(cameras @ normal - offset) < 0:
            normal, offset = -normal, -offset
        if _carries(normal, offset, centers, config, gravity_up_world):
            if np.count_nonzero(inliers) < config.least_share * total:
                break
            rms = float(np.sqrt(np.mean(np.square(p[inliers] @ normal - offset))))
            T = plane_frame(normal, offset, p[inliers])
            n = int(np.count_nonzero(inliers))
            return SupportPlane(T_world_table=T, rms_m=rms, inliers=n), ""
        p = p[~inliers]
    return None, f"none of the {config.attempts} largest planes has the objects on its upper side."


def _carries(
    normal: Array,
    offset: float,
    centers: Array,
    config: PlaneConfig,
    gravity_up_world: ArrayLike | None,
) -> bool:
    """Return whether the plane can be what the objects stand on."""
    if gravity_up_world is not None:
        up = np.asarray(gravity_up_world, dtype=np.float64)
        if normal @ up / np.linalg.norm(up) < config.gravity_cos:
            return False
    heights = centers @ normal - offset
    return bool(np.min(heights, initial=np.inf) > -config.sunk_m)


def lowest_height(plane: SupportPlane, vertices: Sequence[Array] | Array, T: Array) -> float:
    """Return the height [m] of the lowest of the vertices (V, 3), mapped by T, above the plane."""
    T_table_obj = se3.invert(plane.T_world_table) @ T
    return float(np.min(se3.transform(T_table_obj, vertices)[:, 2]))


def table_depth(plane: SupportPlane, T_world_cam: Array, rays: NDArray[np.floating]) -> Array:
    """Return the depth (N,) [m] where camera rays (N, 3) of z = 1 meet the plane; inf = never."""
    T = se3.invert(plane.T_world_table) @ T_world_cam
    slope = rays @ T[2, :3]
    with np.errstate(divide="ignore", invalid="ignore"):
        z = -T[2, 3] / slope
    return np.where((z > 0) & np.isfinite(z), z, np.inf)


def support_checks(
    bodies: Sequence[Body], poses: Sequence[Array], plane: SupportPlane | None, off_m: float = 0.0
) -> list[dict[str, float]]:
    """Return of every object how deep it is sunk into the table and how far it floats.

    What a table that is not flat can be off by, `off_m`, counts for neither.

    In a pile an object may stand on another: it floats by the least of its heights over the table
    and its distances to the other objects.

    Returns:
        sunk_mm and floating_mm, both 0 or more; nothing without a table.
    """
    if plane is None:
        return [{} for _ in bodies]
    results: list[dict[str, float]] = []
    for k, (body, T) in enumerate(zip(bodies, poses, strict=True)):
        gap = lowest_height(plane, body.model.mesh.vertices, T)
        floating = max(0.0, gap - off_m)
        for j, (other, T_other) in enumerate(zip(bodies, poses, strict=True)):
            apart = float(np.linalg.norm(body.center(T) - other.center(T_other)))
            if floating == 0.0 or j == k or apart > body.radius_m + other.radius_m + floating:
                continue
            near = other.field.distance(body.samples, se3.invert(T_other) @ T)
            back = body.field.distance(other.samples, se3.invert(T) @ T_other)
            floating = max(0.0, min(floating, float(near.min()), float(back.min())))
        results.append({"sunk_mm": 1e3 * max(0.0, -gap - off_m), "floating_mm": 1e3 * floating})
    return results
