"""The table of a scene, before anything is known of the objects: the plane the cameras look at.

Candidates are the largest planes of the measured points around the point that the cameras look at.
A plane is no surface where cameras measure something behind it: their rays pass through the very
places where other points lie on it. Of what is left, the table is the plane with most points that
faces the cameras; a lower parallel one close by wins, because the larger may be the lid of a box.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Mask
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import SupportPlane
from realsim.registration.evidence import DepthNoise
from realsim.registration.table_planes import LEAST_POINTS, SEED, best_plane, table_frame
from realsim.registration.views import ViewPoints

TOLERANCE_M = 0.004
"""Points within this (plus the depth noise) belong to a plane: tables are flat to 2 mm, and
cameras of a 0.4 deg hand-eye disagree by 3 mm at 0.4 m."""
NOISE_SIGMAS = 2.0
"""Plus so many sigma_z of the typical point."""
SEARCH_POINTS = 12_000
"""Points of all views that the planes are fitted to."""
VIEW_POINTS = 600
"""Points of each view by which its own table is measured."""
COMMON_DEG = 3.0
"""Where views see their planes tilted by more than this against the common one, in the median,
it is no table [deg]: a hand-eye is off by a degree at most."""
REACH = 0.6
"""Region of interest: so many median camera distances around the point looked at. A lens of
60 deg sees 0.58 of its distance to either side."""
LEAST_REACH_M = 0.15
"""The region of interest is never smaller [m]: one large object."""
VIEW_SLOPE = 0.36
"""Steepest tilt of one view's own table against the common one (tan of 20 deg)."""
VIEW_HEIGHT_M = 0.15
"""Largest height of one view's own table over the common one [m]."""
VIEW_TRIPLES = 96
"""Random triples per view; finds a table of a third of the points with p = 0.97."""
VIEW_SHARE = 0.10
"""A view whose best plane holds a smaller share of its points does not see the table."""


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
    return np.asarray(np.linalg.solve(A, b), dtype=np.float64)


def region_of_interest(
    views: Sequence[ViewPoints], plane: SupportPlane | None
) -> tuple[Array, float]:
    """Return the middle (3,) of what the views look at, on the table, and its radius [m].

    Without a plane the middle is the point nearest to the optical axes.
    """
    aim = looked_at(views)
    eyes = np.stack([v.T_world_cam[:3, 3] for v in views if len(v.points)])
    radius = REACH * float(np.median(np.linalg.norm(eyes - aim, axis=1)))
    if plane is not None:
        z = plane.T_world_table[:3, 2]
        aim = aim - z * float(z @ (aim - plane.T_world_table[:3, 3]))
    return aim, max(LEAST_REACH_M, radius)


def find_table(
    views: Sequence[ViewPoints], noise: DepthNoise, *, gravity_up_world: ArrayLike | None = None
) -> TableFound:
    """Return the plane that the scene stands on, and how every view sees it.

    Frame `table`: origin at the foot of the point the cameras look at, z towards the cameras, x
    along world x projected into the plane (world y where x is nearly upright).

    Args:
        views: the trusted points of the views, where their cameras are said to be.
        noise: of the depth.
        gravity_up_world: (3,) direction up, or None.
    """
    full = [v for v in views if len(v.points)]
    total = sum(len(v.points) for v in full)
    if total < LEAST_POINTS:
        return TableFound(
            plane=None,
            reason=f"the {len(views)} views hold {total} trusted points; at least "
            f"{LEAST_POINTS} are needed. Is the unit of the depth right, and its range?",
        )
    rng = np.random.default_rng(SEED)
    aim, radius = region_of_interest(full, None)
    points, eyes, sigma = _search_points(full, aim, radius, noise, rng)
    tolerance = TOLERANCE_M + NOISE_SIGMAS * sigma
    best, reason = best_plane(points, eyes, (aim, radius), tolerance, gravity_up_world)
    if best is None:
        return TableFound(plane=None, reason=reason)
    on = np.abs(points @ best.normal - best.offset) < tolerance
    rms = float(np.sqrt(np.mean(np.square(points[on] @ best.normal - best.offset))))
    plane = SupportPlane(
        T_world_table=table_frame(best.normal, best.offset, aim),
        rms_m=rms,
        inliers=int(np.count_nonzero(on)),
    )
    tables = tuple(view_table(v, plane, noise) for v in views)
    tilts = [t.tilt_deg for t in tables if t.own_share > 0]
    if tilts and float(np.median(tilts)) > COMMON_DEG:
        # Without a table, objects' faces make one up; every view sees another.
        return TableFound(
            plane=None,
            reason=f"the views see planes that are tilted by {np.median(tilts):.1f} degrees "
            f"against the best common one; {COMMON_DEG:g} is the most of a table",
        )
    return TableFound(plane=plane, reason="", views=tables, share=best.count / len(points))


def view_table(view: ViewPoints, plane: SupportPlane, noise: DepthNoise) -> ViewTable:
    """Return the table as one view alone sees it, near the common one.

    Random triples propose z = a x + b y + c in the table's frame; the one with most points is
    fitted again by least squares to its points.
    """
    few = view.points[:: max(1, len(view.points) // VIEW_POINTS)].astype(np.float64)
    nan = float("nan")
    none = ViewTable(
        index=view.index, share=0.0, own_share=0.0, height_m=nan, tilt_deg=nan, rms_m=nan
    )
    if len(few) < 3:
        return none
    p = se3.transform(se3.invert(plane.T_world_table) @ view.T_world_cam, few)
    tolerance = TOLERANCE_M + NOISE_SIGMAS * noise.sigma(few[:, 2])
    share = float(np.mean(np.abs(p[:, 2]) < tolerance))
    rng = np.random.default_rng((SEED, view.index))
    fit = _best_sheet(p, tolerance, rng)
    if fit is None:
        return none
    abc, on = fit
    if np.mean(on) < VIEW_SHARE:
        return replace(none, share=share)
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


def _best_sheet(p: Array, tolerance: Array, rng: np.random.Generator) -> tuple[Array, Mask] | None:
    """Return (a, b, c) of z = a x + b y + c with most points (N, 3), and which they are."""
    triples = p[rng.integers(0, len(p), size=(VIEW_TRIPLES, 3))]
    A = np.concatenate([triples[..., :2], np.ones((*triples.shape[:2], 1))], axis=-1)
    usable = np.abs(np.linalg.det(A)) > 1e-6  # twice a triangle's area [m^2]: 1 mm x 1 mm at least
    if not usable.any():
        return None
    sheets = np.linalg.solve(A[usable], triples[usable, :, 2:])[..., 0]
    # The common plane itself is tried, too.
    sheets = np.concatenate([np.zeros((1, 3)), sheets])
    near = np.hypot(sheets[:, 0], sheets[:, 1]) < VIEW_SLOPE
    middle = np.median(p[:, :2], axis=0)
    near &= np.abs(sheets[:, :2] @ middle + sheets[:, 2]) < VIEW_HEIGHT_M
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
    rng: np.random.Generator,
) -> tuple[Array, Array, float]:
    """Return points (N, 3) of all views around the aim, the eyes (N, 3) that saw them, sigma_z.

    Every view gives equally many, chosen at random: a regular step would pick the same columns.
    """
    each = max(40, 2 * SEARCH_POINTS // len(views))
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
    if len(p) > SEARCH_POINTS:
        keep = np.sort(rng.permutation(len(p))[:SEARCH_POINTS])
    return p[keep], e[keep], sigma
