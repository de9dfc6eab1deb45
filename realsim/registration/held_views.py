"""Views held against each other: each with its partners, by points of what stands on the table."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from realsim.arrays import Array, Int64
from realsim.geometry import se3
from realsim.records import SupportPlane
from realsim.registration.evidence import DepthNoise
from realsim.registration.find_table import region_of_interest
from realsim.registration.view_agreement import (
    NO_COUNTS,
    Counts,
    ViewFinding,
    ViewMaps,
    compare,
    make_maps,
    partners,
)
from realsim.registration.views import ViewPoints

T_CAM_GL = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenGL's camera (y up, z backward) in OpenCV's."""
OVERDRAWN = 20
"""Factor of points drawn before those above the table, which may be few, are picked."""


ABOVE_M = 0.008
"""Points higher than this over the table are of what stands there [m]."""
MARGIN_M = 0.008
"""Depths that differ by less agree [m]: twice what a 0.4 deg hand-eye does at 0.5 m."""
SIGMAS = 3.0
"""Plus so many sigma_z."""
POINTS = 300
"""Points of a view that others are asked about, of each kind."""
NEAR = 3
"""Partners of a view: the nearest."""
SPREAD = 5
"""Further partners of a view, spread over the session."""
LEAST_DECIDED = 60
"""With fewer points that partners decide upon, nothing is said."""
SCENE_SUPPORT = 0.2
"""Points that agree less those looked through; below it the views are not of one scene. Clean
scenes: 0.55 to 0.7."""
TRIAL_GAIN = 0.2
"""A mistake of all poses is named if undoing it raises the support by this."""
TRIAL_VIEWS = 24
"""Views by which mistakes of all poses are tried."""
SEED = 0
"""Seed of the choice of points."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class HeldViews:
    """Views that hold points, with what is needed to hold them against each other."""

    views: tuple[ViewPoints, ...]
    maps: ViewMaps
    partners: Int64
    """(F, P) the views that each is held against."""
    above: tuple[Array, ...]
    """Per view: (N, 3) points above the table in camera axes [m]; any if there is no table."""
    everywhere: tuple[Array, ...]
    """Per view: (N, 3) any points in camera axes [m]."""


def hold_views(
    views: Sequence[ViewPoints], plane: SupportPlane | None, noise: DepthNoise
) -> HeldViews:
    """Return the views with their maps, partners and points."""
    aim, radius = region_of_interest(views, plane)
    above: list[Array] = []
    everywhere: list[Array] = []
    for v in views:
        rng = np.random.default_rng((SEED, v.index))
        mine = v.points[rng.integers(0, len(v.points), OVERDRAWN * POINTS)]
        mine = mine.astype(np.float64)
        everywhere.append(mine[:POINTS])
        if plane is not None:
            T = se3.invert(plane.T_world_table) @ v.T_world_cam
            height = se3.transform(T, mine)[:, 2]
            near = np.linalg.norm(se3.transform(v.T_world_cam, mine) - aim, axis=1) < radius
            least = ABOVE_M + SIGMAS * noise.sigma(mine[:, 2])
            mine = mine[near & (height > least)]
        above.append(mine[:POINTS])
    maps = make_maps(views, noise)
    return HeldViews(
        views=tuple(views),
        maps=maps,
        partners=partners(maps.Ts_world_cam, NEAR, SPREAD),
        above=tuple(above),
        everywhere=tuple(everywhere),
    )


def contradiction(
    held: HeldViews, k: int, others: Sequence[int] | Int64, T_world_cam: Array | None = None
) -> float:
    """Return the median share by which others contradict view k, above the table; 0 = none can.

    Args:
        held: the views.
        k: which is asked about.
        others: the views that it is held against.
        T_world_cam: (4, 4) where it is supposed to be; None = where it is said to be.
    """
    maps = held.maps if T_world_cam is None else _move_camera(held.maps, k, T_world_cam)
    Ts = maps.Ts_world_cam
    mine = se3.transform(Ts[k], held.above[k])
    counts: list[Counts] = []
    for j in (int(j) for j in others):
        theirs = se3.transform(Ts[j], held.above[j])
        ours = compare(maps, j, mine, MARGIN_M, SIGMAS)
        counts.append(ours.plus(compare(maps, k, theirs, MARGIN_M, SIGMAS)))
    told = [c for c in counts if c.decided >= LEAST_DECIDED // 3]
    if sum(c.decided for c in counts) < LEAST_DECIDED or not told:
        return 0.0
    return float(np.median([c.contradicted for c in told]))


def support(held: HeldViews, k: int, others: Sequence[int] | Int64, T_world_cam: Array) -> float:
    """Return which share of all points of view k, supposed at T_world_cam, others confirm."""
    p = se3.transform(T_world_cam, held.everywhere[k])
    total = NO_COUNTS
    for j in others:
        total = total.plus(compare(held.maps, int(j), p, MARGIN_M, SIGMAS))
    return total.support


def sheet_contradiction(held: HeldViews, k: int, margin_m: float) -> float:
    """Return the share of all points by which view k and its partners contradict each other."""
    Ts = held.maps.Ts_world_cam
    total = NO_COUNTS
    mine = se3.transform(Ts[k], held.everywhere[k])
    for j in (int(j) for j in held.partners[k]):
        theirs = se3.transform(Ts[j], held.everywhere[j])
        total = total.plus(compare(held.maps, j, mine, margin_m, SIGMAS))
        total = total.plus(compare(held.maps, k, theirs, margin_m, SIGMAS))
    return total.contradicted


def check_all_poses(held: HeldViews, plane: SupportPlane | None) -> list[ViewFinding]:
    """Return what is wrong with all poses or units alike, if the views are not of one scene."""
    n = len(held.views)
    now = _scene_support(held, held.maps.Ts_world_cam, 1.0)
    if now > SCENE_SUPPORT:
        return []
    trials = _trials(held.maps.Ts_world_cam)
    then = [_scene_support(held, Ts, scale) for _, Ts, scale in trials]
    best = int(np.argmax(then))
    words = (
        f"the {n} views do not show one scene: where they are said to be, others confirm "
        f"{100 * now:.0f} % more of what a view measures than they look through (of a sound "
        f"session over {100 * SCENE_SUPPORT:.0f} %)"
    )
    if then[best] > max(SCENE_SUPPORT, now + TRIAL_GAIN):
        words += f"; {trials[best][0]}. Then it is {100 * then[best]:.0f} %."
    elif plane is None:
        words += (
            ". Neither inverted poses, other axes, other units nor poses shifted by one view help: "
            "are poses and images of the same session, and was the hand-eye calibrated?"
        )
    else:
        return []  # they share a table: whatever is wrong is wrong with single views
    return [ViewFinding(index=None, kind="all_disagree", words=words, exclude=False)]


def _trials(Ts: Array) -> list[tuple[str, Array, float]]:
    """Return the usual mistakes: words, the poses with it undone, and the factor of the depth."""
    inverse = np.stack([se3.invert(T) for T in Ts])
    in_m = Ts.copy()
    in_m[:, :3, 3] *= 1e-3
    inverse_in_m = np.stack([se3.invert(T) for T in in_m])
    return [
        ("the camera poses seem to be world-to-camera: invert them", inverse, 1.0),
        ("the camera axes seem to be OpenGL's (y up, z backward): turn them", Ts @ T_CAM_GL, 1.0),
        (
            "the camera poses seem to be world-to-camera with OpenGL's axes (y up, z backward)",
            np.stack([se3.invert(T_CAM_GL @ T) for T in Ts]),
            1.0,
        ),
        ("the camera poses seem to be in millimetres", in_m, 1.0),
        ("the camera poses seem to be world-to-camera in millimetres", inverse_in_m, 1.0),
        ("the depth seems to be ten times too large", Ts, 0.1),
        ("the depth seems to be ten times too small", Ts, 10.0),
        ("every image seems to belong to the next view's pose", np.roll(Ts, -1, axis=0), 1.0),
        ("every image seems to belong to the previous view's pose", np.roll(Ts, 1, axis=0), 1.0),
    ]


def _scene_support(held: HeldViews, Ts: Array, scale: float) -> float:
    """Return which share of some views' points others confirm, less those looked through."""
    n = len(held.views)
    pick = np.unique(np.linspace(0, n - 1, min(n, TRIAL_VIEWS)).round().astype(int))
    maps = replace(held.maps, Ts_world_cam=Ts)
    if scale != 1.0:
        factor = np.float32(scale)
        # sigma_z = k z^2 of the depth as it was: scale k (z / scale)^2.
        noise = DepthNoise(per_m=maps.noise.per_m / scale, floor_m=maps.noise.floor_m * scale)
        maps = replace(maps, low=maps.low * factor, high=maps.high * factor, noise=noise)
    near = partners(Ts, NEAR, SPREAD)
    total = NO_COUNTS
    for k in pick:
        p = se3.transform(Ts[k], scale * held.everywhere[k])
        for j in near[k]:
            total = total.plus(compare(maps, int(j), p, MARGIN_M, SIGMAS))
    return total.support


def _move_camera(maps: ViewMaps, k: int, T_world_cam: Array) -> ViewMaps:
    """Return the maps with camera k elsewhere."""
    Ts = maps.Ts_world_cam.copy()
    Ts[k] = T_world_cam
    return replace(maps, Ts_world_cam=Ts)
