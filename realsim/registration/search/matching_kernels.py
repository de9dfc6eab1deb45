"""The loops of the template matching: every pose, yaw and position, then the climb.

Maps are (X, Y, 3): least and greatest height around a cell, and the cell's own [m]; 1000 m stands
for 'never measured', 10 m for 'another object'. A rule is `RULE` of `matching`.
"""

import numpy as np

from realsim.arrays import Array, Array32, Int64, Mask
from realsim.compiled import njit

Rule = tuple[np.float32, ...]
ZERO, ONE = np.float32(0), np.float32(1)
"""Everything is single precision: twice as fast, and heights are known to 0.1 mm at best."""
CHANNELS = 3
"""Numbers per cell."""
MEASURED_M = np.float32(100.0)
"""Heights above this stand for 'never measured' [m]."""
NOTHING = -1.0
"""Score of a place that was not compared to the end."""
MOST_STEPS = 60
"""Most steps of a climb; it ends by itself after 10 to 20."""


@njit(inline="always", error_model="numpy")
def _agreement(h: np.float32, low: np.float32, high: np.float32, rule: Rule) -> np.float32:
    """Return from -1 to 1 how well a model's height agrees with measured ones [low, high] [m]."""
    above = h - high
    value = min(ONE, (rule[1] - max(above, low - h)) * rule[2])
    if value <= ZERO:
        return -rule[3] if above > ZERO else -rule[4]
    return value * min(ONE, max(ZERO, (high - rule[5]) * rule[6]))


@njit(inline="always", error_model="numpy")
def _goes_on(h: np.float32, measured: np.float32, rule: Rule) -> np.float32:
    """Return from 0 to 1 whether a surface measured outside goes on at the edge's height [m]."""
    value = min(ONE, max(ZERO, (rule[1] - abs(measured - h)) * rule[2]))
    return value * min(ONE, max(ZERO, (measured - rule[5]) * rule[6]))


@njit(error_model="numpy")
def _score_at(
    flat: Array32, base: int, shifts: Int64, heights: Array32, around: int, rule: Rule
) -> float:
    """Return the score of a template at one cell; NOTHING if it was given up.

    Args:
        flat: (3 X Y,) the maps.
        base: where the reference point's cell begins in them.
        shifts: (K + L,) where the cells of the points begin, from there.
        heights: (K + L,) of the points [m].
        around: L, how many points lie outside of the footprint.
        rule: see the module.
    """
    n = len(shifts) - around
    total, least = ZERO, -rule[10]
    measured, needed = ZERO, -rule[11]
    for k in range(n):
        at = np.uint64(base + shifts[k])  # unsigned: no check for negative indices
        low = flat[at]
        if low < MEASURED_M:
            measured += ONE
            total += _agreement(heights[k], low, flat[at + np.uint64(1)], rule)
        if total < least or measured < needed:
            return NOTHING
        least += rule[8]
        needed += rule[9]
    if measured < rule[9] * n:
        return NOTHING
    beyond = ZERO
    for k in range(n, len(shifts)):
        own = flat[np.uint64(base + shifts[k] + 2)]
        if own < MEASURED_M:
            beyond += _goes_on(heights[k], own, rule)
    return float(total) / n - float(rule[7]) * float(beyond) / max(1, around)


@njit
def correlated(
    maps: Array32,
    rows: Int64,
    columns: Int64,
    wanted: Mask,
    points: Array32,
    outside: Array32,
    yaws: Array,
    rule_and_cell: tuple[Rule, float],
) -> Array32:
    """Return the score (Y, R, C) of a template at every yaw and position.

    Args:
        maps: see the module.
        rows: (R,) cells along x at which the reference point is put.
        columns: (C,) the same along y.
        wanted: (Y, R, C) which are to be compared.
        points: (K, 3) of the template.
        outside: (L, 3) around its footprint.
        yaws: (Y,) [rad].
        rule_and_cell: see the module; edge of a cell [m].
    """
    rule, cell = rule_and_cell
    out = np.full(wanted.shape, NOTHING, np.float32)
    width = maps.shape[1]
    flat = maps.reshape(-1)
    everything = np.concatenate((points, outside))
    heights = everything[:, 2].copy()
    shifts = np.empty(len(everything), np.int64)
    for y in range(len(yaws)):
        c, s = np.cos(yaws[y]), np.sin(yaws[y])
        for k in range(len(everything)):
            a, b = everything[k, 0], everything[k, 1]
            i = int(np.floor((c * a - s * b) / cell + 0.5))
            j = int(np.floor((s * a + c * b) / cell + 0.5))
            shifts[k] = CHANNELS * (i * width + j)
        for i in range(len(rows)):
            for j in range(len(columns)):
                if wanted[y, i, j]:
                    base = CHANNELS * (rows[i] * width + columns[j])
                    out[y, i, j] = _score_at(flat, base, shifts, heights, len(outside), rule)
    return out


@njit
def maxima(volume: Array32, least: float, slack: float) -> Int64:
    """Return the local maxima (N, 3) of a volume (Y, R, C) that is cyclic in its first axis.

    Of neighbours that are equal the first one counts; those at another yaw may be greater by
    `slack`.
    """
    turns, rows, columns = volume.shape
    found = np.empty((volume.size, 3), np.int64)
    n = 0
    for y in range(turns):
        for i in range(rows):
            for j in range(columns):
                value = volume[y, i, j]
                if value <= least:
                    continue
                here = (y * rows + i) * columns + j
                greatest = True
                for dy in range(-1, 2):
                    b = (y + dy) % turns
                    for r in range(max(0, i - 1), min(rows, i + 2)):
                        for c in range(max(0, j - 1), min(columns, j + 2)):
                            other = volume[b, r, c]
                            earlier = (b * rows + r) * columns + c < here
                            margin = 0.0 if dy == 0 else slack
                            if other > value + margin or (other == value and earlier and dy == 0):
                                greatest = False
                if greatest:
                    found[n, 0], found[n, 1], found[n, 2] = y, i, j
                    n += 1
    return found[:n].copy()


@njit
def climbed(
    maps: Array32,
    frame: Array,
    pose: Int64,
    places: Array,
    points: Array32,
    outside: Array32,
    rule: Rule,
    steps: Array,
) -> tuple[Array, Array]:
    """Return the best place (N, 3) near each given one, by a pattern search, and its score (N,).

    Args:
        maps: see the module.
        frame: (3,) corner of cell (0, 0) and edge of a cell [m].
        pose: (N,) resting pose.
        places: (N, 3) x, y [m] and yaw [rad].
        points: (D, K, 3) of the templates.
        outside: (D, L, 3) around their footprints.
        rule: see the module.
        steps: (5,) first step [m] and of the yaw [rad], how often they are halved, how far the
            yaw may go [rad], and by how much a turn must improve the score.
    """
    flat = maps.reshape(-1)
    out, scores = places.copy(), np.empty(len(places))
    shifts = np.empty(points.shape[1] + outside.shape[1], np.int64)
    for n in range(len(places)):
        template = np.concatenate((points[pose[n]], outside[pose[n]]))
        shape = (template, template[:, 2].copy(), shifts, outside.shape[1])
        best = _score_near(flat, frame, maps, out[n], shape, rule)
        size, trial = 1.0, out[n].copy()
        halvings = 0
        for _ in range(MOST_STEPS):
            winner, change = -1, 0.0
            for axis in range(3):
                if axis == 2 and winner >= 0:
                    break  # only a place that no shift improves is turned
                step = size * (steps[1] if axis == 2 else steps[0])
                gain = steps[4] if axis == 2 else 0.0
                for direction in (-1.0, 1.0):
                    trial[:] = out[n]
                    trial[axis] += direction * step
                    if abs(trial[2] - places[n, 2]) > steps[3]:
                        continue
                    value = _score_near(flat, frame, maps, trial, shape, rule)
                    if value > best + gain:
                        best, winner, change = value, axis, direction * step
            if winner >= 0:
                out[n, winner] += change
            elif halvings == int(steps[2]):
                break
            else:
                halvings += 1
                size /= 2
        scores[n] = best
    return out, scores


@njit
def _score_near(
    flat: Array32,
    frame: Array,
    maps: Array32,
    place: Array,
    template: tuple[Array32, Array32, Int64, int],
    rule: Rule,
) -> float:
    """Return the score of a template at any place; NOTHING where it leaves the maps."""
    points, heights, shifts, around = template
    c, s = np.cos(place[2]), np.sin(place[2])
    rows, width = maps.shape[0], maps.shape[1]
    for k in range(len(points)):
        a, b = points[k, 0], points[k, 1]
        i = int(np.floor((c * a - s * b + place[0] - frame[0]) / frame[2]))
        j = int(np.floor((s * a + c * b + place[1] - frame[1]) / frame[2]))
        if not (0 <= i < rows and 0 <= j < width):
            return NOTHING
        shifts[k] = CHANNELS * (i * width + j)
    return _score_at(flat, 0, shifts, heights, around, rule)
