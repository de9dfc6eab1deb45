"""Height templates laid over the whole table: where an object may stand, from nothing.

Nothing is segmented, so objects that touch are no problem. Every resting pose, yaw and position is
scored: +1 where the heights agree, -1 where the space of the model was seen free, a little less
than nothing where something else lies above it, nothing where nothing was measured. What stands
out is moved to the best place nearby. It is a search for candidates: which of them is right is
judged by rendering them.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from realsim.arrays import Array, Array32, Int64, Mask
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import SupportPlane
from realsim.registration.search.height_grid import HeightGrid, Maps, maps_of, near_enough
from realsim.registration.search.matching_kernels import climbed, correlated, maxima, rule_of
from realsim.registration.search.records import Hypothesis, Region
from realsim.registration.search.templates import ModelTemplates, turned

CLIMB_HALVINGS = 3
"""The steps of the climb are halved so often: 3 mm to 0.4 mm, 5 deg to 0.6 deg."""


@dataclass(frozen=True, kw_only=True, slots=True)
class MatchConfig:
    """How templates are compared with the measured heights."""

    step_cells: int = 2
    """Positions are so many cells apart (6 mm): a fit converges from twice as far."""
    agree_m: float = 0.004
    """Heights agree fully up to this [m]: noise, and what a surface rises over half a cell."""
    differ_m: float = 0.010
    """From here on they do not agree at all [m]; beyond, a measurement is free space or lies in
    front."""
    free_cost: float = 1.0
    """Cost of a point in space that was seen free."""
    hidden_cost: float = 0.3
    """Cost of a point that something else lies above."""
    table_low_m: float = 0.001
    """Agreement with a surface up to this height over the plane counts nothing [m]: it is the table
    itself."""
    table_high_m: float = 0.004
    """Height over the plane from which on agreement counts fully [m]."""
    standing_m: float = 0.006
    """Something stands where the surface is so high over the plane [m]: far and slanted views of
    the table are noisy."""
    standing_share: float = 0.6
    """The same as a share of the height of a lying object, if that is less."""
    standing_low_m: float = 0.0015
    """Least of these heights [m]: the noise of a table that many views see."""
    inner_share: float = 0.45
    """Positions are skipped where the nearest thing is further off than this share of the
    template's points are: (1 - s) - s < `least_score`."""
    outside_cost: float = 0.25
    """Cost, if the measured surface goes on all around the footprint as high as the object's
    edge: then it is a part of something larger."""
    patience: float = 4.0
    """A comparison ends when the sum over its first k points is so much below `least_score` k: on
    the free table after 4 points. Of places with a mean of 0.5 this loses 1 %."""
    patience_points: float = 12.0
    """It ends, too, when so many more points are not measured than `least_measured` allows."""
    coarse_share: float = 0.5
    """Share of the points that the search over all places uses; the refinement uses all."""
    least_measured: float = 0.15
    """Least share of a template's points that must be measured."""
    least_score: float = 0.15
    """Candidates below are dropped: they agree with nothing."""
    yaw_slack: float = 0.05
    """A candidate may score so much less than the same one turned by one step: small features
    decide the yaw of a flange, and only its rendering shows them."""
    refined: int = 160
    """Number of best candidates that are moved to the best place nearby; each costs 20 us."""
    climb_m: float = 0.003
    """First step of the climb [m]: half the step of the search."""
    climb_deg: float = 5.0
    """First step of its yaw [deg]: nearly half a step of the search."""
    climb_reach_deg: float = 7.5
    """It does not turn further than this [deg], half a step of the search: else the candidates of
    all yaws end at the one that the heights favour."""
    climb_gain: float = 0.005
    """A turn must improve the score by so much, one point of 200: else the candidates of a disc
    with a few small holes gather at yaws that mean nothing."""
    same_m: float = 0.012
    """Candidates nearer than this [m]."""
    same_deg: float = 8.0
    """Candidates turned by less, modulo symmetry, are then one [deg]: half a step of the search.
    With 13 deg a flange whose yaw only its bores tell had no candidate within 18 deg."""
    most_per_place: int = 10
    """Candidates with the same centre at most: else an object that looks nearly the same after
    many turns has no candidate elsewhere."""
    most: int = 24
    """Hypotheses returned. Simpler scores needed them all; now 99 % are among the first 8."""
    most_in_region: int = 8
    """The same if a region is given."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        if not (0 < self.agree_m < self.differ_m and self.step_cells >= 1 and self.most >= 1):
            raise InputError(
                f"agree_m {self.agree_m}, differ_m {self.differ_m}, step_cells {self.step_cells}, "
                f"most {self.most}; needed are 0 < agree < differ and at least 1 of the others."
            )


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
    config: MatchConfig,
    *,
    region: Region | None = None,
    plane: SupportPlane,
    taken: Mask | None = None,
) -> list[Hypothesis]:
    """Return where an object may rest on the table, the best first.

    Args:
        grid: the measured heights.
        templates: of the object.
        config: settings.
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
    standing = replace(config, standing_m=_standing_m(templates, config))
    maps = maps_of(grid, templates.reach_m, taken, standing)
    found = _searched(maps, templates, config, region, plane)
    best = np.argsort(-found.score, kind="stable")[: config.refined]
    found = _refined(maps, templates, found.select(best), config)
    Ts = plane.T_world_table @ _poses(templates, found)
    allowed = found.score > config.least_score
    if region is not None:
        allowed &= _turns(Ts, templates, region) <= math.radians(region.turn_deg)
    order = np.argsort(-found.score, kind="stable")
    most = config.most if region is None else config.most_in_region
    return [
        Hypothesis(
            obj_id=templates.obj_id,
            T_world_obj=Ts[k],
            score=float(found.score[k]),
            source=_source(found, k),
        )
        for k in _distinct(Ts, order[allowed[order]], templates, config, most)
    ]


def _standing_m(templates: ModelTemplates, config: MatchConfig) -> float:
    """Return from which height on something stands that may be this object [m]."""
    flattest = float(np.median(templates.points[..., 2], axis=1).min())
    least = max(config.standing_low_m, config.standing_share * flattest)
    return min(config.standing_m, least)


def _source(found: _Candidates, k: int) -> str:
    """Return a text that tells where a candidate is from."""
    return f"resting {found.pose[k]}, yaw {math.degrees(found.place[k, 2]) % 360.0:.0f}"


def _searched(
    maps: Maps,
    templates: ModelTemplates,
    config: MatchConfig,
    region: Region | None,
    plane: SupportPlane,
) -> _Candidates:
    """Return the local maxima of the score over all poses, yaws and positions."""
    inner = [maps.bands.shape[k] - 2 * maps.pad for k in (0, 1)]
    # Half a template may lie outside of what was measured.
    rows, columns = (maps.pad + np.arange(0, n, config.step_cells) for n in inner)
    x, y = (maps.origin[k] + (c + 0.5) * maps.cell for k, c in enumerate((rows, columns)))
    poses: list[Int64] = [np.zeros(0, np.int64)]
    places: list[Array] = [np.zeros((0, 3))]
    scores: list[Array] = [np.zeros(0)]
    for d in range(len(templates.rotations)):
        yaws = np.arange(templates.yaw_counts[d]) * templates.yaw_steps[d]
        wanted = _wanted(templates, d, yaws, (x, y), region, plane)
        wanted &= near_enough(maps, templates.points[d], config)[np.ix_(rows, columns)]
        if not wanted.any():
            continue
        volume = correlated(
            maps.bands, rows, columns, wanted,
            _first(templates.points[d], config), _first(templates.outside[d], config),
            yaws, (rule_of(config), maps.cell),
        )  # fmt: skip
        peaks = maxima(volume, config.least_score, config.yaw_slack)
        n = len(peaks)
        poses.append(np.full(n, d, np.int64))
        places.append(np.stack([x[peaks[:, 1]], y[peaks[:, 2]], yaws[peaks[:, 0]]], 1))
        scores.append(volume[peaks[:, 0], peaks[:, 1], peaks[:, 2]].astype(np.float64))
    return _Candidates(
        pose=np.concatenate(poses), place=np.concatenate(places), score=np.concatenate(scores)
    )


def _first(points: Array32, config: MatchConfig) -> Array32:
    """Return the points (K, 3) that the search uses: they are in random order."""
    return points[: math.ceil(config.coarse_share * len(points))]


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


def _refined(
    maps: Maps, templates: ModelTemplates, found: _Candidates, config: MatchConfig
) -> _Candidates:
    """Return the candidates at the best place near each."""
    steps = np.array(
        [
            config.climb_m, math.radians(config.climb_deg), CLIMB_HALVINGS,
            math.radians(config.climb_reach_deg), config.climb_gain,
        ]
    )  # fmt: skip
    place, score = climbed(
        maps.own, np.array([*maps.origin, maps.cell]), found.pose, found.place,
        templates.points, templates.outside, rule_of(config), steps,
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


def _distinct(
    Ts: Array, order: Int64, templates: ModelTemplates, config: MatchConfig, most: int
) -> list[int]:
    """Return the numbers of the first poses that differ, modulo symmetry."""
    centers = se3.transform(Ts, templates.center_obj[None])[:, 0]
    kept: list[int] = []
    for k in order:
        near = [i for i in kept if np.linalg.norm(centers[i] - centers[k]) < config.same_m]
        if len(near) >= config.most_per_place or (near and templates.is_ball):
            continue
        angles = _least_angles(Ts[near, :3, :3], Ts[k, :3, :3], templates.symmetries)
        if np.all(angles > math.radians(config.same_deg)):
            kept.append(int(k))
            if len(kept) == most:
                break
    return kept
