"""The table of a scene, before anything is known of the objects: the plane the cameras look at.

Candidates are the largest planes of the measured points around the point that the cameras look at.
A plane is no surface where cameras measure something behind it: their rays pass through the very
places where other points lie on it. Of what is left, the table is the plane with most points that
faces the cameras; a lower parallel one close by wins, because the larger may be the lid of a box.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.clouds import fit_plane_ransac, refine_plane
from realsim.records import SupportPlane
from realsim.registration.evidence import DepthNoise
from realsim.registration.views import ViewPoints

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class TableSearchConfig:
    """How the table is searched without any object's pose."""

    tolerance_m: float = 0.004
    """Points within this (plus the depth noise) belong to a plane: tables are flat to 2 mm, and
    cameras of a 0.4 deg hand-eye disagree by 3 mm at 0.4 m."""
    noise_sigmas: float = 2.0
    """Plus so many sigma_z of the typical point."""
    search_points: int = 12_000
    """Points of all views that the planes are fitted to."""
    view_points: int = 600
    """Points of each view by which its own table is measured."""
    iterations: int = 300
    """Random triples; finds a plane of 25 % of the points with p = 0.99."""
    searches: int = 2
    """Random searches per plane, each over other points."""
    triple_points: int = 4_000
    """Points that a random search counts."""
    widenings: tuple[float, ...] = (4.0, 1.0)
    """Tolerances of the refinement, in turn, in units of the tolerance; the last must be 1."""
    candidates: int = 5
    """Planes looked at, largest first: table, floor, two walls and the lid of a box."""
    reach: float = 0.6
    """Region of interest: so many median camera distances around the point looked at. A lens of
    60 deg sees 0.58 of its distance to either side."""
    least_reach_m: float = 0.15
    """The region of interest is never smaller [m]: one large object."""
    least_share: float = 0.08
    """A plane with a smaller share of the points looked at is no table; below a pile that covers
    half of it there is still a fifth."""
    least_points: int = 200
    """Fewer points tell nothing about a scene."""
    gravity_cos: float = 0.9
    """Least cosine between the normal and the given up direction (26 deg)."""
    facing_cos: float = 0.08
    """Least mean cosine between the normal and the way to the cameras: walls seen edge-on."""
    pierced_m: float = 0.02
    """A point further behind the plane than this [m] was seen through it; 3 times the noise of a
    depth camera at 1 m."""
    pierced_share: float = 0.25
    """A plane through whose points more than this share of the rays pass is no surface."""
    cell_m: float = 0.02
    """Cells of a plane's footprint [m]: where points lie on it."""
    lid_share: float = 0.3
    """A lower parallel plane with at least this share of the largest one's points is the table."""
    lid_gap_m: float = 0.25
    """At most so far below [m]: a floor lies deeper, an object is not taller."""
    lid_cos: float = 0.985
    """Planes nearer to parallel than this (10 deg) are lid and table."""
    view_slope: float = 0.36
    """Steepest tilt of one view's own table against the common one (tan of 20 deg)."""
    view_height_m: float = 0.15
    """Largest height of one view's own table over the common one [m]."""
    view_triples: int = 96
    """Random triples per view; finds a table of a third of the points with p = 0.97."""
    view_share: float = 0.10
    """A view whose best plane holds a smaller share of its points does not see the table."""
    seed: int = 0
    """Of the random search."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ViewTable:
    """The table as one view alone sees it."""

    index: int
    """Number of the view."""
    share: float
    """Share of the view's points on the common table."""
    own_share: float
    """Share of the view's points on the best plane near the common table; 0 = none."""
    height_m: float
    """How far that plane lies above the common one, below the view's points [m]; NaN = none."""
    tilt_deg: float
    """Angle between the two [deg]; NaN = none."""
    rms_m: float
    """RMS distance of the points from the view's own plane [m]; NaN = none."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TableFound:
    """The table of a scene, or why there is none."""

    plane: SupportPlane | None
    reason: str
    """Why there is no plane; empty if there is one."""
    views: tuple[ViewTable, ...] = ()
    """One per view, in the order given; empty if there is no plane."""
    share: float = 0.0
    """Share of the points around the point looked at that lie on the plane."""

    @property
    def seen_by(self) -> tuple[int, ...]:
        """The numbers of the views that see the table."""
        return tuple(v.index for v in self.views if v.own_share > 0)


@dataclass(frozen=True, eq=False, slots=True)
class _Candidate:
    """A plane n.p = offset, the points of the search that lie on it, and how good a table it is."""

    normal: Array
    offset: float
    count: int
    score: float


def looked_at(views: Sequence[ViewPoints]) -> Array:
    """Return the point (3,) nearest to all optical axes, in world [m].

    Least squares over the axes, with a little weight on each view's own middle depth: parallel
    axes, and the axis of a single view, meet nowhere.

    Raises:
        InputError: no view holds a point.
    """
    A, b = np.zeros((3, 3)), np.zeros(3)
    for v in views:
        if len(v.points) == 0:
            continue
        z = float(np.median(v.points[::7, 2]))
        eye, axis = v.T_world_cam[:3, 3], v.T_world_cam[:3, 2]
        M = np.eye(3) - np.outer(axis, axis) + 0.02 * np.outer(axis, axis)
        A += M
        b += M @ (eye + z * axis)
    if not A.any():
        raise InputError(f"none of {len(views)} views holds a trusted depth; there is no scene.")
    return np.linalg.solve(A, b)


def region_of_interest(
    views: Sequence[ViewPoints], plane: SupportPlane | None, config: TableSearchConfig
) -> tuple[Array, float]:
    """Return the middle (3,) of what the views look at, on the table, and its radius [m].

    Without a plane the middle is the point nearest to the optical axes.
    """
    aim = looked_at(views)
    eyes = np.stack([v.T_world_cam[:3, 3] for v in views if len(v.points)])
    radius = config.reach * float(np.median(np.linalg.norm(eyes - aim, axis=1)))
    if plane is not None:
        z = plane.T_world_table[:3, 2]
        aim = aim - z * float(z @ (aim - plane.T_world_table[:3, 3]))
    return aim, max(config.least_reach_m, radius)


def find_table(
    views: Sequence[ViewPoints],
    noise: DepthNoise,
    config: TableSearchConfig,
    *,
    gravity_up_world: ArrayLike | None = None,
) -> TableFound:
    """Return the plane that the scene stands on, and how every view sees it.

    Frame `table`: origin at the foot of the point the cameras look at, z towards the cameras, x
    along world x projected into the plane (world y where x is nearly upright).

    Args:
        views: the trusted points of the views, where their cameras are said to be.
        noise: of the depth.
        config: see there.
        gravity_up_world: (3,) direction up, or None.
    """
    full = [v for v in views if len(v.points)]
    total = sum(len(v.points) for v in full)
    if total < config.least_points:
        return TableFound(
            plane=None,
            reason=f"the {len(views)} views hold {total} trusted points; at least "
            f"{config.least_points} are needed. Is the unit of the depth right, and its range?",
        )
    rng = np.random.default_rng(config.seed)
    aim, radius = region_of_interest(full, None, config)
    points, eyes, sigma = _search_points(full, aim, radius, noise, config, rng)
    tolerance = config.tolerance_m + config.noise_sigmas * sigma
    best, reason = _best_plane(points, eyes, (aim, radius), tolerance, config, gravity_up_world)
    if best is None:
        return TableFound(plane=None, reason=reason)
    on = np.abs(points @ best.normal - best.offset) < tolerance
    rms = float(np.sqrt(np.mean(np.square(points[on] @ best.normal - best.offset))))
    plane = SupportPlane(
        T_world_table=_table_frame(best.normal, best.offset, aim),
        rms_m=rms,
        inliers=int(np.count_nonzero(on)),
    )
    tables = tuple(view_table(v, plane, noise, config) for v in views)
    return TableFound(plane=plane, reason="", views=tables, share=best.count / len(points))


def view_table(
    view: ViewPoints, plane: SupportPlane, noise: DepthNoise, config: TableSearchConfig
) -> ViewTable:
    """Return the table as one view alone sees it, near the common one.

    Random triples propose z = a x + b y + c in the table's frame; the one with most points is
    fitted again by least squares to its points.
    """
    few = view.points[:: max(1, len(view.points) // config.view_points)].astype(np.float64)
    nan = float("nan")
    none = ViewTable(
        index=view.index, share=0.0, own_share=0.0, height_m=nan, tilt_deg=nan, rms_m=nan
    )
    if len(few) < 3:
        return none
    p = se3.transform(se3.invert(plane.T_world_table) @ view.T_world_cam, few)
    tolerance = config.tolerance_m + config.noise_sigmas * noise.sigma(few[:, 2])
    share = float(np.mean(np.abs(p[:, 2]) < tolerance))
    rng = np.random.default_rng((config.seed, view.index))
    fit = _best_sheet(p, tolerance, config, rng)
    if fit is None:
        return none
    abc, on = fit
    if np.mean(on) < config.view_share:
        return ViewTable(
            index=view.index, share=share, own_share=0.0, height_m=nan, tilt_deg=nan, rms_m=nan
        )
    middle = p[on].mean(0)
    rest = p[on, 2] - _heights(p[on], abc)
    return ViewTable(
        index=view.index,
        share=share,
        own_share=float(np.mean(on)),
        height_m=float(middle[:2] @ abc[:2] + abc[2]),
        tilt_deg=float(np.degrees(np.arctan(np.hypot(abc[0], abc[1])))),
        rms_m=float(np.sqrt(np.mean(np.square(rest)))),
    )


def _best_sheet(
    p: Array, tolerance: Array, config: TableSearchConfig, rng: np.random.Generator
) -> tuple[Array, NDArray[np.bool_]] | None:
    """Return (a, b, c) of z = a x + b y + c with most points (N, 3), and which they are."""
    triples = p[rng.integers(0, len(p), size=(config.view_triples, 3))]
    A = np.concatenate([triples[..., :2], np.ones((*triples.shape[:2], 1))], axis=-1)
    usable = np.abs(np.linalg.det(A)) > 1e-6  # twice a triangle's area [m^2]: 1 mm x 1 mm at least
    if not usable.any():
        return None
    sheets = np.linalg.solve(A[usable], triples[usable, :, 2:])[..., 0]
    # The common plane itself is tried, too.
    sheets = np.concatenate([np.zeros((1, 3)), sheets])
    near = np.hypot(sheets[:, 0], sheets[:, 1]) < config.view_slope
    middle = np.median(p[:, :2], axis=0)
    near &= np.abs(sheets[:, :2] @ middle + sheets[:, 2]) < config.view_height_m
    sheets = sheets[near]
    flat = np.concatenate([p[:, :2], np.ones((len(p), 1))], axis=1)
    gaps = np.abs(p[:, 2] - sheets @ flat.T)
    best = sheets[int(np.argmax(np.sum(gaps < tolerance, axis=1)))]
    on = np.abs(p[:, 2] - flat @ best) < tolerance
    for _ in range(3):
        if np.count_nonzero(on) < 3:
            return None
        best = np.linalg.lstsq(flat[on], p[on, 2], rcond=None)[0]
        on = np.abs(p[:, 2] - flat @ best) < tolerance
    return best, on


def _heights(p: Array, abc: Array) -> Array:
    """Return the height (N,) of a sheet (a, b, c) under points (N, 3) [m]."""
    return p[:, :2] @ abc[:2] + abc[2]


def _search_points(
    views: Sequence[ViewPoints],
    aim: Array,
    radius: float,
    noise: DepthNoise,
    config: TableSearchConfig,
    rng: np.random.Generator,
) -> tuple[Array, Array, float]:
    """Return points (N, 3) of all views around the aim, the eyes (N, 3) that saw them, sigma_z.

    Every view gives equally many, chosen at random: a regular step would pick the same columns.
    """
    each = max(40, 2 * config.search_points // len(views))
    points: list[Array] = []
    eyes: list[Array] = []
    z: list[Array] = []
    for v in views:
        few = v.points[rng.integers(0, len(v.points), size=min(each, len(v.points)))]
        world = se3.transform(v.T_world_cam, few.astype(np.float64))
        near = np.linalg.norm(world - aim, axis=1) < radius
        points.append(world[near])
        z.append(few[near, 2].astype(np.float64))
        eyes.append(np.tile(v.T_world_cam[:3, 3], (int(near.sum()), 1)))
    p, e, depth = np.concatenate(points), np.concatenate(eyes), np.concatenate(z)
    sigma = float(np.median(noise.sigma(depth))) if len(depth) else 0.0
    keep = slice(None)
    if len(p) > config.search_points:
        keep = np.sort(rng.permutation(len(p))[: config.search_points])
    return p[keep], e[keep], sigma


def _best_plane(
    points: Array,
    eyes: Array,
    region: tuple[Array, float],
    tolerance: float,
    config: TableSearchConfig,
    up: ArrayLike | None,
) -> tuple[_Candidate | None, str]:
    """Return the table among the largest planes, or why there is none."""
    if len(points) < config.least_points:
        return None, (
            f"only {len(points)} points lie within {region[1]:.2f} m of where the cameras look "
            f"({', '.join(f'{x:.2f}' for x in region[0])} m); at least {config.least_points} are "
            "needed. Are the camera poses camera-to-world, and in metres?"
        )
    rng = np.random.default_rng(config.seed)
    left, found, largest = points, [], 0.0
    for _ in range(config.candidates):
        if len(left) < max(50, config.least_share * len(points)):
            break
        normal, offset, inliers = _largest_plane(left, tolerance, config, rng)
        count = int(np.count_nonzero(inliers))
        largest = max(largest, count / len(points))
        candidate = _judged(normal, offset, points, eyes, tolerance, config, up)
        if candidate is not None:
            found.append(candidate)
        left = left[~inliers]
    if not found:
        return None, (
            f"the largest plane holds {100 * largest:.0f} % of the points that the cameras look "
            f"at; at least {100 * config.least_share:.0f} % are needed, on a plane that no camera "
            "looks through"
            + ("" if up is None else " and that lies across the given up direction")
            + ". A flat table is expected; check the camera poses."
        )
    best = max(found, key=lambda c: c.score)
    return _lowest_parallel(best, found, region[0], config), ""


def _largest_plane(
    points: Array, tolerance: float, config: TableSearchConfig, rng: np.random.Generator
) -> tuple[Array, float, NDArray[np.bool_]]:
    """Return normal, offset and inliers of the plane with most points, out of several searches.

    Three noisy points close together are a plane turned by degrees: the refinement begins with a
    tolerance wide enough to turn it back.
    """
    found: list[tuple[int, Array, float, NDArray[np.bool_]]] = []
    for _ in range(config.searches):
        few = points[rng.integers(0, len(points), size=min(len(points), config.triple_points))]
        normal, offset, _ = fit_plane_ransac(few, rng, tolerance, config.iterations)
        for widening in config.widenings:
            normal, offset, on = refine_plane(points, normal, offset, widening * tolerance)
            found.append((int(np.count_nonzero(on)) if widening == 1 else 0, normal, offset, on))
    _, normal, offset, on = max(found, key=lambda f: f[0])
    return normal, offset, on


def _judged(
    normal: Array,
    offset: float,
    points: Array,
    eyes: Array,
    tolerance: float,
    config: TableSearchConfig,
    up: ArrayLike | None,
) -> _Candidate | None:
    """Return the plane, turned to the cameras, with its score; None = it cannot be the table."""
    if np.mean(eyes @ normal - offset) < 0:
        normal, offset = -normal, -offset
    if up is not None:
        u = np.asarray(up, dtype=np.float64)
        if normal @ u / np.linalg.norm(u) < config.gravity_cos:
            return None
    height = points @ normal - offset
    on = np.abs(height) < tolerance
    count = int(np.count_nonzero(on))
    if count < config.least_share * len(points):
        return None
    towards = eyes[on] - points[on]
    facing = float(np.mean(towards @ normal / np.linalg.norm(towards, axis=1)))
    if facing < config.facing_cos:
        return None
    pierced = _pierced(normal, offset, points, eyes, height, on, config)
    if pierced > config.pierced_share * count:
        return None
    # What stands on a table lies above it; behind a wall of a shelf nothing is seen, but before it
    # is everything: the plane that faces the cameras more is what they were moved around.
    score = count * (0.5 + 0.5 * facing) - pierced
    return _Candidate(normal, offset, count, score)


def _pierced(
    normal: Array, offset: float, points: Array, eyes: Array, height: Array,
    on: NDArray[np.bool_], config: TableSearchConfig,
) -> int:  # fmt: skip
    """Return how many rays pass through cells of the plane where other points lie on it."""
    T = se3.invert(_table_frame(normal, offset, points[on].mean(0)))
    flat = se3.transform(T, points[on])[:, :2]
    low = flat.min(0)
    size = np.floor((flat.max(0) - low) / config.cell_m).astype(np.int64) + 1
    covered = np.zeros((int(size[0]), int(size[1])), dtype=bool)
    index = np.floor((flat - low) / config.cell_m).astype(np.int64)
    covered[index[:, 0], index[:, 1]] = True
    eye_height = eyes @ normal - offset
    through = (height < -config.pierced_m) & (eye_height > 0)
    if not through.any():
        return 0
    share = eye_height[through] / (eye_height[through] - height[through])
    hit = eyes[through] + share[:, None] * (points[through] - eyes[through])
    index = np.floor((se3.transform(T, hit)[:, :2] - low) / config.cell_m).astype(np.int64)
    inside = np.all((index >= 0) & (index < size), axis=1)
    return int(np.count_nonzero(covered[index[inside, 0], index[inside, 1]]))


def _lowest_parallel(
    best: _Candidate, found: Sequence[_Candidate], aim: Array, config: TableSearchConfig
) -> _Candidate:
    """Return the lowest plane that is parallel to the best and not much smaller: not a lid."""
    # Height of the plane over the aim, along the best one's normal.
    heights = {id(c): float(c.offset - c.normal @ aim) for c in (best, *found)}
    below = [
        c
        for c in found
        if c.normal @ best.normal > config.lid_cos
        and c.count >= config.lid_share * best.count
        and 0 < heights[id(best)] - heights[id(c)] < config.lid_gap_m
    ]
    return min(below, key=lambda c: heights[id(c)], default=best)


def _table_frame(normal: Array, offset: float, aim: Array) -> Array:
    """Return T_world_table (4, 4): z the normal, x along world x, origin under the aim (3,)."""
    z = normal / np.linalg.norm(normal)
    # World x, unless it is nearly upright; a threshold far from any usual table keeps x steady.
    axis = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = axis - (axis @ z) * z
    x = x / np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z], axis=-1)
    return se3.from_rt(R, aim - z * (z @ aim - offset))
