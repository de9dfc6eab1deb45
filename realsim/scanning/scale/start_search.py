"""The search for starts: every direction, scale and yaw over the height map, the best climb on."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.scanning.scale.height_maps import HeightMap, Template
from realsim.scanning.scale.start_kernels import (
    Evidence3,
    Model3,
    Rule,
    climb,
    near_share,
    scan,
)
from realsim.scanning.scale.start_shape import Grid, Shape

Array = NDArray[np.float64]
NEARLY_ALL = 0.95
"""Share of two surfaces that must be near each other to be one: the rest may be a handle's edge."""
SCALE_SHARES = 4.0
"""Two starts whose scales differ by more than so many times the shares are never one: a mesh that
is scaled about its foot moves by up to its height, on average by a third of that."""
SEEN_FROM_DEG = 25.0
"""Cameras look down at least so steeply [deg]; a lower one would see the object's side only."""
SEEN_SHARE = 0.1
"""A sample that is seen from so many of the directions above counts fully: two or three of 24
views look at it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SearchConfig:
    """How scales, directions and yaws are tried and judged."""

    shape_error: float = 0.025
    """Error of the mesh's outline as a share of its size, 1-sigma: generated meshes have 2 % RMS.
    It says how well height, area and widths must agree on one scale."""
    map_error_m: float = 0.0015
    """Error of a measured height or width [m], 1-sigma: half a cell and the depth noise."""
    directions_kept: int = 90
    """Directions whose height, area and widths agree best on one scale; the other two thirds are
    not scanned, which halves the time."""
    scale_steps: tuple[float, ...] = (-0.14, -0.07, 0.0, 0.07, 0.14)
    """Logarithms of scale tried about the value that height, area and widths agree on."""
    yaws: int = 36
    """Yaws tried: 10 deg apart, within the reach of the climb."""
    shift_share: float = 0.04
    """Shifts tried along the table's axes, as a share of the size: centroids are about so good."""
    scan_points: int = 110
    """Points of a template in the scan."""
    climb_points: int = 300
    """Points of a template in the climb."""
    tolerance_share: float = 0.03
    """Heights agree within this share of the size: 2 % of shape error, some tilt."""
    tolerance_m: float = 0.003
    """But never within less [m]: two cells of a slope."""
    low_cost: float = 0.5
    """What a model that is lower than the measurement costs; one that is higher costs 1. Lower may
    be a hole of the mesh that the cameras could not look into."""
    uncovered_cost: float = 0.7
    """What measured area costs that the model leaves uncovered."""
    peaks: int = 4
    """Yaws of each direction that climb on at most."""
    climbers: int = 100
    """Placements that climb on over the height map."""
    finalists: int = 32
    """Of these, placements that climb on over map, cloud and surface together."""
    near_share: float = 0.08
    """Distance of a cloud point from the surface, as a share of the size, from which it disagrees
    entirely."""
    weights: tuple[float, float, float] = (0.5, 0.25, 0.25)
    """Of the height map, of the cloud's distance to the mesh, of the mesh's distance to it."""
    lowest_m: float = 0.004
    """The cloud begins so high over the table [m]: lower samples are not looked for."""
    turn_deg: float = 6.0
    """First step of the climb for turns [deg]: half the spacing of yaws and directions."""
    log_scale: float = 0.05
    """First step of the climb for the logarithm of the scale."""
    halvings: int = 3
    """How often the steps are halved."""
    rounds: int = 14
    """Rounds of the climb at most."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Placement:
    """The mesh of radius 1 on the table: p_table = scale R p + (x, y, deep enough to stand)."""

    template: int
    R: Array
    """(3, 3)."""
    scale: float
    """[m]: the radius of the real object."""
    xy: Array
    """(2,) of the mesh's centre [m]."""
    score: float


def evidence_of(measured: HeightMap, points: Array, grid: Grid) -> Evidence3:
    """Return the measurement of points (N, 3) in the table's frame."""
    return Evidence3(
        measured.heights, np.array([*measured.origin, measured.cell]), measured.area, points,
        grid.distances, np.array([*grid.origin, grid.cell]),
    )  # fmt: skip


def model_of(shape: Shape) -> Model3:
    """Return the mesh as the compiled functions take it."""
    g = shape.surface
    return Model3(shape.support, g.distances, np.array([*g.origin, g.cell]), shape.samples)


def rule_of(measured: HeightMap, config: SearchConfig, weights: tuple[float, ...]) -> Rule:
    """Return how placements are judged for a measurement of this size."""
    tolerance = max(config.tolerance_m, config.tolerance_share * measured.size)
    return Rule(
        np.array([tolerance, config.low_cost, config.uncovered_cost]),
        max(2 * config.tolerance_m, config.near_share * measured.size), config.lowest_m,
        np.array(weights),
    )  # fmt: skip


def common_scale(
    measured: HeightMap, template: Template, config: SearchConfig
) -> tuple[float, float]:
    """Return the log scale on which height, area and widths agree best, and their disagreement.

    Each gives a scale of its own, with an error of a fixed length: of a flat object the height says
    little, of a thin one the width. The disagreement is chi-square per figure.
    """
    lengths = np.array([measured.top, np.sqrt(measured.area), *(3.5 * measured.spread)])
    units = np.array([template.height, np.sqrt(template.area), *(3.5 * template.spread)])
    logs = np.log(np.maximum(lengths, 1e-6) / np.maximum(units, 1e-6))
    error = np.hypot(config.shape_error * measured.size, config.map_error_m)
    relative = np.hypot(error / lengths, config.shape_error)
    weights = 1 / np.square(relative)
    middle = float(weights @ logs / weights.sum())
    return middle, float(np.mean(np.square((logs - middle) / relative)))


def scanned(
    measured: HeightMap, evidence: Evidence3, shape: Shape, config: SearchConfig
) -> list[Placement]:
    """Return the best placements over all directions, scales, yaws and shifts, best first."""
    agreed = [common_scale(measured, t, config) for t in shape.templates]
    order = np.argsort([chi for _, chi in agreed], kind="stable")[: config.directions_kept]
    angles = 2 * np.pi * np.arange(config.yaws) / config.yaws
    turns = np.stack([np.cos(angles), np.sin(angles)], -1)
    step = config.shift_share * measured.size
    shifts = step * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], dtype=np.float64)
    rule = rule_of(measured, config, config.weights).map_rule
    found: list[Placement] = []
    for k in order:
        t = shape.templates[k]
        points = t.points[: config.scan_points] @ t.R.T
        points[:, :2] -= t.center
        points[:, 2] -= (shape.support @ t.R[2]).min()
        scales = np.exp(agreed[k][0] + np.array(config.scale_steps))
        table = scan(evidence, points, t.area, scales, turns, measured.center + shifts, rule)
        best = table.max(axis=(0, 2))
        peak = (best >= np.roll(best, 1)) & (best > np.roll(best, -1))
        for y in sorted(np.flatnonzero(peak), key=lambda y: -best[y])[: config.peaks]:
            s, h = np.unravel_index(int(np.argmax(table[:, y])), table[:, y].shape)
            c, d = turns[y]
            yaw = np.array([[c, -d, 0], [d, c, 0], [0, 0, 1]])
            offset = (yaw @ [*t.center, 0.0])[:2]
            found.append(
                Placement(
                    template=int(k), R=yaw @ t.R, scale=float(scales[s]),
                    xy=measured.center + shifts[h] - scales[s] * offset,
                    score=float(best[y]) + t.prior,
                )
            )  # fmt: skip
    return sorted(found, key=lambda p: -p.score)


def climbed(
    placements: list[Placement],
    evidence: Evidence3,
    shape: Shape,
    rule: Rule,
    config: SearchConfig,
) -> list[Placement]:
    """Return the placements after each went uphill to its nearest maximum, best first."""
    model = model_of(shape)
    size = rule.near_m / config.near_share
    turn = np.radians(config.turn_deg)
    steps = np.array([turn, turn, turn, 0.5 * config.shift_share * size,
                      0.5 * config.shift_share * size, config.log_scale])  # fmt: skip
    found: list[Placement] = []
    upper = np.sin(np.radians(SEEN_FROM_DEG))
    for p in placements:
        t = shape.templates[p.template]
        above = shape.directions @ p.R[2] > upper
        lit = np.clip(shape.lit[:, above].mean(1) / SEEN_SHARE, 0, 1).astype(np.float64)
        start = np.array([p.xy[0], p.xy[1], np.log(p.scale)])
        R, end, score = climb(
            evidence, model, (t.points[: config.climb_points], t.area, lit), (p.R, start), rule,
            steps, (config.halvings, config.rounds),
        )  # fmt: skip
        found.append(
            Placement(
                template=p.template, R=R, scale=float(np.exp(end[2])), xy=end[:2],
                score=score + t.prior,
            )
        )  # fmt: skip
    return sorted(found, key=lambda p: -p.score)


def lowest(shape: Shape, R: Array) -> float:
    """Return the height of the lowest point of the turned mesh of radius 1."""
    return float((shape.support @ R[2]).min())


def distinct(
    placements: list[Placement], shape: Shape, same_share: float, most: int
) -> list[Placement]:
    """Return the placements, best first, without those whose surface a better one has too."""
    model = model_of(shape)
    kept: list[Placement] = []
    for p in placements:
        if not any(_same(p, other, shape, model, same_share) for other in kept):
            kept.append(p)
        if len(kept) == most:
            break
    return kept


def place_of(p: Placement, shape: Shape) -> Array:
    """Return where the middle of the placed mesh is in the table's frame (3,) [m]."""
    return np.array([*p.xy, -p.scale * lowest(shape, p.R)])


def _same(a: Placement, b: Placement, shape: Shape, model: Model3, share: float) -> bool:
    """Return whether 95 % of each placed surface lie near the other."""
    if abs(np.log(a.scale / b.scale)) > SCALE_SHARES * share:
        return False
    # Distances on a grid are off by half a cell; shares are of the diameter, which is 2.
    limit = 2 * share + 0.5 * shape.surface.cell
    for p, q in ((a, b), (b, a)):
        gap = q.R.T @ (place_of(p, shape) - place_of(q, shape)) / q.scale
        relative = np.column_stack([p.scale / q.scale * q.R.T @ p.R, gap])
        if near_share(model, relative, limit) < NEARLY_ALL:
            return False
    return True
