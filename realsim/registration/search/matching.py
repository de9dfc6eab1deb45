"""Height templates laid over the whole table: where an object may stand, from nothing.

Nothing is segmented, so objects that touch are no problem. Every resting pose, yaw and position is
scored: +1 where the heights agree, -1 where the space of the model was seen free, a little less
than nothing where something else lies above it, nothing where nothing was measured. What stands
out is moved to the best place nearby. It is a search for candidates: which of them is right is
judged by rendering them.
"""

import math
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Array32, Int64, Mask
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import SupportPlane
from realsim.registration.search.height_grid import HeightGrid, Maps, maps_of, near_enough
from realsim.registration.search.matching_kernels import Rule, climbed, correlated, maxima
from realsim.registration.search.records import Hypothesis, Region
from realsim.registration.search.templates import ModelTemplates, turned

CLIMB_HALVINGS = 3
"""The steps of the climb are halved so often: 3 mm to 0.4 mm, 5 deg to 0.6 deg."""


STEP_CELLS = 2
"""Positions are so many cells apart (6 mm): a fit converges from twice as far."""
AGREE_M = 0.004
"""Heights agree fully up to this [m]: noise, and what a surface rises over half a cell."""
DIFFER_M = 0.010
"""From here on they do not agree at all [m]; beyond, a measurement is free space or lies in
front."""
FREE_COST = 1.0
"""Cost of a point in space that was seen free."""
HIDDEN_COST = 0.3
"""Cost of a point that something else lies above."""
TABLE_LOW_M = 0.001
"""Agreement with a surface up to this height over the plane counts nothing [m]: it is the table
itself."""
TABLE_HIGH_M = 0.004
"""Height over the plane from which on agreement counts fully [m]."""
STANDING_M = 0.006
"""Something stands where the surface is so high over the plane [m]: far and slanted views of
the table are noisy."""
STANDING_SHARE = 0.6
"""The same as a share of the height of a lying object, if that is less."""
STANDING_LOW_M = 0.0015
"""Least of these heights [m]: the noise of a table that many views see."""
INNER_SHARE = 0.45
"""Positions are skipped where the nearest thing is further off than this share of the
template's points are: (1 - s) - s < `LEAST_SCORE`."""
OUTSIDE_COST = 0.25
"""Cost, if the measured surface goes on all around the footprint as high as the object's
edge: then it is a part of something larger."""
PATIENCE = 4.0
"""A comparison ends when the sum over its first k points is so much below `LEAST_SCORE` k: on
the free table after 4 points. Of places with a mean of 0.5 this loses 1 %."""
PATIENCE_POINTS = 12.0
"""It ends, too, when so many more points are not measured than `LEAST_MEASURED` allows."""
COARSE_SHARE = 0.5
"""Share of the points that the search over all places uses; the refinement uses all."""
LEAST_MEASURED = 0.15
"""Least share of a template's points that must be measured."""
LEAST_SCORE = 0.15
"""Candidates below are dropped: they agree with nothing."""
YAW_SLACK = 0.05
"""A candidate may score so much less than the same one turned by one step: small features
decide the yaw of a flange, and only its rendering shows them."""
REFINED = 160
"""Number of best candidates that are moved to the best place nearby; each costs 20 us."""
CLIMB_M = 0.003
"""First step of the climb [m]: half the step of the search."""
CLIMB_DEG = 5.0
"""First step of its yaw [deg]: nearly half a step of the search."""
CLIMB_REACH_DEG = 7.5
"""It does not turn further than this [deg], half a step of the search: else the candidates of
all yaws end at the one that the heights favour."""
CLIMB_GAIN = 0.005
"""A turn must improve the score by so much, one point of 200: else the candidates of a disc
with a few small holes gather at yaws that mean nothing."""
SAME_M = 0.012
"""Candidates nearer than this [m]."""
SAME_DEG = 8.0
"""Candidates turned by less, modulo symmetry, are then one [deg]: half a step of the search.
With 13 deg a flange whose yaw only its bores tell had no candidate within 18 deg."""
MOST_PER_PLACE = 10
"""Candidates with the same centre at most: else an object that looks nearly the same after
many turns has no candidate elsewhere."""
MOST = 24
"""Hypotheses returned. Simpler scores needed them all; now 99 % are among the first 8."""
MOST_IN_REGION = 8
"""The same if a region is given."""


RULE: Rule = tuple(
    np.float32(f)
    for f in (
        AGREE_M, DIFFER_M, 1 / (DIFFER_M - AGREE_M), FREE_COST, HIDDEN_COST,
        TABLE_LOW_M, 1 / (TABLE_HIGH_M - TABLE_LOW_M), OUTSIDE_COST, LEAST_SCORE,
        LEAST_MEASURED, PATIENCE, PATIENCE_POINTS,
    )
)  # fmt: skip
"""The figures of the comparison as the loops use them."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Candidates:
    """Placed templates; N of them."""

    pose: Int64
    """(N,) resting pose."""
    place: Array
    """(N, 3) x and y of the reference point in the table's frame [m], yaw [rad]."""
    score: Array
    """(N,)."""

    def select(self, index: Int64) -> "_Candidates":
        """Return the candidates of these numbers."""
        return _Candidates(pose=self.pose[index], place=self.place[index], score=self.score[index])


def match_templates(
    grid: HeightGrid,
    templates: ModelTemplates,
    *,
    region: Region | None = None,
    plane: SupportPlane,
    taken: Mask | None = None,
) -> list[Hypothesis]:
    """Return where an object may rest on the table, the best first.

    Args:
        grid: the measured heights.
        templates: of the object.
        region: where the object may be and how it may be turned; None = anywhere.
        plane: the plane of the grid.
        taken: (X, Y) cells that other objects explain; nothing is found there.

    Raises:
        InputError: the mask is not the grid's.
    """
    if taken is not None and taken.shape != grid.heights.shape:
        raise InputError(
            f"the mask of taken cells is {taken.shape}, the grid {grid.heights.shape}; they must "
            "have the same shape."
        )
    maps = maps_of(grid, templates.reach_m, taken, _standing_m(templates), STEP_CELLS)
    found = _searched(maps, templates, region, plane)
    best = np.argsort(-found.score, kind="stable")[:REFINED]
    found = _refined(maps, templates, found.select(best))
    Ts = plane.T_world_table @ _poses(templates, found)
    allowed = found.score > LEAST_SCORE
    if region is not None:
        allowed &= _turns(Ts, templates, region) <= math.radians(region.turn_deg)
    order = np.argsort(-found.score, kind="stable")
    most = MOST if region is None else MOST_IN_REGION
    return [
        Hypothesis(T_world_obj=Ts[k], score=float(found.score[k]), source=_source(found, k))
        for k in _distinct(Ts, order[allowed[order]], templates, most)
    ]


def _standing_m(templates: ModelTemplates) -> float:
    """Return from which height on something stands that may be this object [m]."""
    flattest = float(np.median(templates.points[..., 2], axis=1).min())
    least = max(STANDING_LOW_M, STANDING_SHARE * flattest)
    return min(STANDING_M, least)


def _source(found: _Candidates, k: int) -> str:
    """Return a text that tells where a candidate is from."""
    return f"resting {found.pose[k]}, yaw {math.degrees(found.place[k, 2]) % 360.0:.0f}"


def _searched(
    maps: Maps, templates: ModelTemplates, region: Region | None, plane: SupportPlane
) -> _Candidates:
    """Return the local maxima of the score over all poses, yaws and positions."""
    inner = [maps.bands.shape[k] - 2 * maps.pad for k in (0, 1)]
    # Half a template may lie outside of what was measured.
    rows, columns = (maps.pad + np.arange(0, n, STEP_CELLS) for n in inner)
    x, y = (maps.origin[k] + (c + 0.5) * maps.cell for k, c in enumerate((rows, columns)))
    poses: list[Int64] = [np.zeros(0, np.int64)]
    places: list[Array] = [np.zeros((0, 3))]
    scores: list[Array] = [np.zeros(0)]
    for d in range(len(templates.rotations)):
        yaws = np.arange(templates.yaw_counts[d]) * templates.yaw_steps[d]
        wanted = _wanted(templates, d, yaws, (x, y), region, plane)
        wanted &= near_enough(maps, templates.points[d], INNER_SHARE)[np.ix_(rows, columns)]
        if not wanted.any():
            continue
        volume = correlated(
            maps.bands, rows, columns, wanted,
            _first(templates.points[d]), _first(templates.outside[d]),
            yaws, (RULE, maps.cell),
        )  # fmt: skip
        peaks = maxima(volume, LEAST_SCORE, YAW_SLACK)
        n = len(peaks)
        poses.append(np.full(n, d, np.int64))
        places.append(np.stack([x[peaks[:, 1]], y[peaks[:, 2]], yaws[peaks[:, 0]]], 1))
        scores.append(volume[peaks[:, 0], peaks[:, 1], peaks[:, 2]].astype(np.float64))
    return _Candidates(
        pose=np.concatenate(poses), place=np.concatenate(places), score=np.concatenate(scores)
    )


def _first(points: Array32) -> Array32:
    """Return the points (K, 3) that the search uses: they are in random order."""
    return points[: math.ceil(COARSE_SHARE * len(points))]


def _wanted(
    templates: ModelTemplates,
    d: int,
    yaws: Array,
    xy: tuple[Array, Array],
    region: Region | None,
    plane: SupportPlane,
) -> Mask:
    """Return which yaws and positions (Y, X, Y) of a resting pose lie in a region."""
    x, y = xy
    if region is None:
        return np.ones((len(yaws), len(x), len(y)), dtype=np.bool_)
    places = np.stack([np.zeros(len(yaws)), np.zeros(len(yaws)), yaws], 1)
    candidates = _Candidates(pose=np.full(len(yaws), d), place=places, score=np.zeros(len(yaws)))
    Ts = _poses(templates, candidates)
    near_turn = _turns(plane.T_world_table @ Ts, templates, region) <= (
        math.radians(region.turn_deg) + templates.yaw_steps[d] / 2
    )
    center = se3.transform(se3.invert(plane.T_world_table), region.center_world[None])[0]
    from_reference = se3.transform(Ts, templates.center_obj[None])[:, 0, :2]
    dx = x[None, :] + from_reference[:, :1] - center[0]
    dy = y[None, :] + from_reference[:, 1:] - center[1]
    near = np.hypot(dx[:, :, None], dy[:, None, :]) <= region.radius_m
    return near & near_turn[:, None, None]


def _refined(maps: Maps, templates: ModelTemplates, found: _Candidates) -> _Candidates:
    """Return the candidates at the best place near each."""
    steps = np.array(
        [
            CLIMB_M, math.radians(CLIMB_DEG), CLIMB_HALVINGS,
            math.radians(CLIMB_REACH_DEG), CLIMB_GAIN,
        ]
    )  # fmt: skip
    place, score = climbed(
        maps.own, np.array([*maps.origin, maps.cell]), found.pose, found.place,
        templates.points, templates.outside, RULE, steps,
    )  # fmt: skip
    return _Candidates(pose=found.pose, place=place, score=score)


def _poses(templates: ModelTemplates, found: _Candidates) -> Array:
    """Return T_table_obj (N, 4, 4) of candidates."""
    turn = turned(found.place[:, 2])
    t = (turn @ templates.offsets[found.pose][:, :, None])[:, :, 0]
    t[:, :2] += found.place[:, :2]
    return se3.from_rt(turn @ templates.rotations[found.pose], t)


def _turns(Ts: Array, templates: ModelTemplates, region: Region) -> Array:
    """Return the least angle (N,) [rad], modulo symmetry, from poses to the region's rotation."""
    if region.R_world_obj is None or templates.is_ball:
        return np.zeros(len(Ts))
    return _least_angles(Ts[:, :3, :3], region.R_world_obj, templates.symmetries)


def _least_angles(Rs: Array, R: Array, symmetries: Array) -> Array:
    """Return min over S (N,) of the angle [rad] between rotations (N, 3, 3) and R S."""
    # trace(R_n^T R S) is the sum of the products of the entries of R_n^T R and of S^T.
    between = (np.swapaxes(Rs, 1, 2) @ R).reshape(-1, 9)
    traces = between @ np.swapaxes(symmetries, 1, 2).reshape(-1, 9).T
    return np.arccos(np.clip((traces.max(1) - 1) / 2, -1.0, 1.0))


def _distinct(Ts: Array, order: Int64, templates: ModelTemplates, most: int) -> list[int]:
    """Return the numbers of the first poses that differ, modulo symmetry."""
    centers = se3.transform(Ts, templates.center_obj[None])[:, 0]
    kept: list[int] = []
    for k in order:
        near = [i for i in kept if np.linalg.norm(centers[i] - centers[k]) < SAME_M]
        if len(near) >= MOST_PER_PLACE or (near and templates.is_ball):
            continue
        angles = _least_angles(Ts[near, :3, :3], Ts[k, :3, :3], templates.symmetries)
        if np.all(angles > math.radians(SAME_DEG)):
            kept.append(int(k))
            if len(kept) == most:
                break
    return kept
