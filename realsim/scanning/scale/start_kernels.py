"""The compiled part of the search for starts: scan over a map, judge a placement, climb."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from realsim.compiled import njit
from realsim.scanning.scale.height_maps import agreement, map_score

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
OUTSIDE = 1e3
"""Distance [m or radii] outside of a grid: farther than anything that counts."""


class Evidence3(NamedTuple):
    """The measurement, as the compiled functions take it."""

    heights: Array
    place: Array
    """(3,) corner of the map and its cell."""
    area: float
    points: Array
    """(N, 3) of the cloud in the table's frame."""
    distances: Array32
    """Distance to the cloud."""
    corner: Array
    """(4,) origin and cell of `distances`."""


class Model3(NamedTuple):
    """The mesh of radius 1, as the compiled functions take it."""

    support: Array
    distances: Array32
    corner: Array
    """(4,) origin and cell of `distances`."""
    samples: Array


class Rule(NamedTuple):
    """How a placement is judged."""

    map_rule: Array
    """(3,) see `map_score`."""
    near_m: float
    lowest_m: float
    weights: Array
    """(3,)."""


@njit
def scan(
    evidence: Evidence3, points: Array, area: float, scales: Array, turns: Array, centers: Array,
    rule: Array,
) -> Array:  # fmt: skip
    """Return the map score (S, Y, H) for every scale, yaw and place of a centred template."""
    heights, place = evidence.heights, evidence.place
    out = np.empty((len(scales), len(turns), len(centers)))
    n = len(points)
    for s in range(len(scales)):
        share = area * scales[s] * scales[s] / n
        for y in range(len(turns)):
            c, d = scales[s] * turns[y, 0], scales[s] * turns[y, 1]
            for h in range(len(centers)):
                total, covered = 0.0, 0
                for k in range(n):
                    x = c * points[k, 0] - d * points[k, 1] + centers[h, 0]
                    v = d * points[k, 0] + c * points[k, 1] + centers[h, 1]
                    i = int(np.floor((x - place[0]) / place[2]))
                    j = int(np.floor((v - place[1]) / place[2]))
                    measured = 0.0
                    if 0 <= i < heights.shape[0] and 0 <= j < heights.shape[1]:
                        measured = heights[i, j]
                    covered += measured > 0.0
                    total += agreement(scales[s] * points[k, 2], measured, rule[0], rule[1])
                uncovered = max(0.0, evidence.area - share * covered)
                greater = max(evidence.area, share * n)
                out[s, y, h] = (share * total - rule[2] * uncovered) / greater
    return out


@njit(inline="always")
def _at(grid: Array32, corner: Array, x: float, y: float, z: float) -> float:
    """Return the distance at a point, a large one outside of the grid."""
    i = int(np.floor((x - corner[0]) / corner[3]))
    j = int(np.floor((y - corner[1]) / corner[3]))
    k = int(np.floor((z - corner[2]) / corner[3]))
    if 0 <= i < grid.shape[0] and 0 <= j < grid.shape[1] and 0 <= k < grid.shape[2]:
        return grid[i, j, k]
    return OUTSIDE


@njit
def judge(
    evidence: Evidence3, model: Model3, template: tuple[Array, float, Array], R: Array, at: Array,
    rule: Rule,
) -> float:  # fmt: skip
    """Return the weighted score of one placement, at most 1."""
    points, area, lit = template
    scale = np.exp(at[2])
    deepest = 1e9
    for k in range(len(model.support)):
        q = model.support[k]
        deepest = min(deepest, R[2, 0] * q[0] + R[2, 1] * q[1] + R[2, 2] * q[2])
    move = np.empty((3, 4))
    move[:, :3] = scale * R
    move[0, 3], move[1, 3], move[2, 3] = at[0], at[1], -scale * deepest
    areas = np.array([evidence.area, area * scale * scale])
    score = map_score(evidence.heights, evidence.place, points, move, rule.map_rule, areas)
    if rule.weights[1] == 0.0 and rule.weights[2] == 0.0:
        return score
    near = 0.0
    for k in range(len(evidence.points)):
        x = (evidence.points[k, 0] - move[0, 3]) / scale
        y = (evidence.points[k, 1] - move[1, 3]) / scale
        z = (evidence.points[k, 2] - move[2, 3]) / scale
        d = scale * _at(
            model.distances, model.corner,
            R[0, 0] * x + R[1, 0] * y + R[2, 0] * z,
            R[0, 1] * x + R[1, 1] * y + R[2, 1] * z,
            R[0, 2] * x + R[1, 2] * y + R[2, 2] * z,
        )  # fmt: skip
        near += 1.0 - 2.0 * min(1.0, d / rule.near_m)
    seen, weight = 0.0, 1e-9
    for k in range(len(model.samples)):
        q = model.samples[k]
        x = move[0, 0] * q[0] + move[0, 1] * q[1] + move[0, 2] * q[2] + move[0, 3]
        y = move[1, 0] * q[0] + move[1, 1] * q[1] + move[1, 2] * q[2] + move[1, 3]
        z = move[2, 0] * q[0] + move[2, 1] * q[1] + move[2, 2] * q[2] + move[2, 3]
        if z > rule.lowest_m:
            d = _at(evidence.distances, evidence.corner, x, y, z)
            seen += lit[k] * (1.0 - 2.0 * min(1.0, d / rule.near_m))
            weight += lit[k]
    w = rule.weights
    return w[0] * score + w[1] * near / len(evidence.points) + w[2] * seen / weight


@njit
def climb(
    evidence: Evidence3, model: Model3, template: tuple[Array, float, Array],
    start: tuple[Array, Array], rule: Rule, steps: Array, limits: tuple[int, int],
) -> tuple[Array, Array, float]:  # fmt: skip
    """Return rotation, (x, y, log scale) and score after a compass search.

    Every coordinate is tried both ways; when none helps, the steps are halved.
    """
    R, at = start[0].copy(), start[1].copy()
    best = judge(evidence, model, template, R, at, rule)
    factor, halved = 1.0, 0
    for _ in range(limits[1]):
        moved = False
        for axis in range(6):
            for sign in (1.0, -1.0):
                step = sign * factor * steps[axis]
                new_R, new_at = R, at.copy()
                if axis < 3:
                    c, d = np.cos(step), np.sin(step)
                    turn = np.eye(3)
                    i, j = (axis + 1) % 3, (axis + 2) % 3
                    turn[i, i], turn[i, j], turn[j, i], turn[j, j] = c, -d, d, c
                    new_R = turn @ R
                else:
                    new_at[axis - 3] += step
                score = judge(evidence, model, template, new_R, new_at, rule)
                if score > best:
                    best, R, at, moved = score, new_R, new_at, True
                    break
        if not moved:
            factor *= 0.5
            halved += 1
            if halved > limits[0]:
                break
    return R, at, best


@njit
def near_share(model: Model3, relative: Array, limit: float) -> float:
    """Return which share of the samples, moved by (3, 4) relative, lies near the surface.

    Args:
        model: the mesh of radius 1.
        relative: of one placement in the frame of another.
        limit: what is near, in radii.
    """
    near = 0
    for k in range(len(model.samples)):
        q, m = model.samples[k], relative
        d = _at(
            model.distances, model.corner,
            m[0, 0] * q[0] + m[0, 1] * q[1] + m[0, 2] * q[2] + m[0, 3],
            m[1, 0] * q[0] + m[1, 1] * q[1] + m[1, 2] * q[2] + m[1, 3],
            m[2, 0] * q[0] + m[2, 1] * q[1] + m[2, 2] * q[2] + m[2, 3],
        )  # fmt: skip
        near += d <= limit
    return near / len(model.samples)
