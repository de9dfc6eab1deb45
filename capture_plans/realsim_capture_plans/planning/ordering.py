"""In which order, and in which arm branch: a short tour through one candidate of every view.

A generalised travelling-salesman path from home, solved by alternation: with one joint vector per
view the order is improved by nearest neighbour, 2-opt and or-opt; with the order fixed, the best
branch of every view at once is a shortest path (Viterbi). The cost of a move is its time.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim_capture_plans.planning.record import PlanConfig

Array = NDArray[np.float64]
Ints = NDArray[np.intp]
Edge = tuple[int, int, int, int]
"""(view, candidate) -> (view, candidate); the view -1 is home."""
OR_OPT_LENGTHS = (1, 2, 3)
"""Segments moved elsewhere by or-opt; longer ones are found by 2-opt."""
EPSILON_S = 1e-9
"""Gains below this [s] are rounding."""


def move_seconds(distance_rad: ArrayLike, config: PlanConfig) -> Array:
    """Return the time (...) [s] of a stop-to-stop move whose leading joint turns by distance (...).

    T(d) = d / v + v / a, or 2 sqrt(d / a) where the speed v is never reached (d < v^2 / a).
    """
    d = np.asarray(distance_rad, dtype=np.float64)
    v, a = config.speed, config.acceleration
    return np.where(d >= v * v / a, d / v + v / a, 2.0 * np.sqrt(d / a))


def tour(
    candidates: list[Array],
    home: Array,
    config: PlanConfig,
    start_order: Ints | None = None,
    forbidden: Mapping[Edge, float] | None = None,
) -> tuple[Ints, Ints]:
    """Return the order (N,) of the views and the candidate (N,) taken at each place of it.

    Args:
        candidates: per view, (Ki, 6) joints [rad].
        home: (6,) where the tour begins [rad].
        config: speeds and the number of rounds.
        start_order: an order to begin with; by default nearest neighbour from home.
        forbidden: extra seconds of moves that collide.
    """
    penalties = forbidden or {}
    picked = np.array([np.argmin(np.abs(q - home).max(-1)) for q in candidates], dtype=np.intp)
    order = start_order
    best = np.inf
    result = (np.arange(len(candidates)), picked)
    for _ in range(config.tour_rounds):
        stops = np.stack([q[i] for q, i in zip(candidates, picked, strict=True)])
        all_stops = np.concatenate([home[None], stops])
        seconds = move_seconds(np.abs(all_stops[:, None] - all_stops[None]).max(-1), config)
        if order is None:
            order = _nearest_neighbour(seconds)
        order = _improve(order, seconds)
        choice, total = best_branches(
            [candidates[i] for i in order], home, config, order, penalties
        )
        picked[order] = choice
        if total >= best - EPSILON_S:
            break
        best, result = total, (order.copy(), choice)
    return result


def best_branches(
    stages: list[Array],
    home: Array,
    config: PlanConfig,
    order: Ints,
    forbidden: Mapping[Edge, float],
) -> tuple[Ints, float]:
    """Return the candidate (N,) of every stage that makes the path shortest, and its time [s].

    Viterbi over the stages (Ki, 6) in tour order; `forbidden` adds seconds to single moves.
    """
    by_views: dict[tuple[int, int], list[tuple[int, int, float]]] = {}
    for (i, ci, j, cj), extra in forbidden.items():
        by_views.setdefault((i, j), []).append((ci, cj, extra))
    cost = np.zeros(1)
    previous_stage, previous_view = home[None], -1
    came_from: list[Ints] = []
    for stage, view in zip(stages, order.tolist(), strict=True):
        step = move_seconds(np.abs(previous_stage[:, None] - stage[None]).max(-1), config)
        for a, b, extra in by_views.get((previous_view, view), ()):
            step[a, b] += extra
        total = cost[:, None] + step
        came_from.append(np.argmin(total, axis=0))
        cost = np.min(total, axis=0)
        previous_stage, previous_view = stage, view
    choice = np.zeros(len(stages), dtype=np.intp)
    choice[-1] = int(np.argmin(cost))
    for k in range(len(stages) - 1, 0, -1):
        choice[k - 1] = came_from[k][choice[k]]
    return choice, float(cost.min())


def _nearest_neighbour(seconds: Array) -> Ints:
    """Return an order (N,) of stops 1..N (given as 0..N-1), starting from stop 0 = home."""
    n = len(seconds) - 1
    left = np.ones(n + 1, dtype=bool)
    left[0] = False
    order = np.zeros(n, dtype=np.intp)
    here = 0
    for k in range(n):
        here = int(np.argmin(np.where(left, seconds[here], np.inf)))
        left[here] = False
        order[k] = here - 1
    return order


def _improve(order: Ints, seconds: Array) -> Ints:
    """Return the order after 2-opt and or-opt, until neither finds a gain."""
    path = np.concatenate([[0], order + 1])
    while True:
        better = _or_opt(_two_opt(path, seconds), seconds)
        if np.array_equal(better, path):
            return path[1:] - 1
        path = better


def _two_opt(path: Ints, seconds: Array) -> Ints:
    """Return the open path after reversals of stretches, each time the one that gains most."""
    path = path.copy()
    n = len(path)
    upper = np.triu(np.ones((n - 1, n - 1), dtype=bool), 1)
    while n > 2:
        here, there = path[:-1], path[1:]
        # Reversing stops i+1..j replaces the moves i -> i+1 and j -> j+1; the last has no j+1.
        leave = seconds[here, there]
        gain = (
            leave[:, None] + leave[None]
            - seconds[here[:, None], here[None]] - seconds[there[:, None], there[None]]
        )  # fmt: skip
        gain = np.where(upper, gain, -np.inf)
        tail = leave - seconds[here, path[-1]]
        i, j = np.unravel_index(int(np.argmax(gain)), gain.shape)
        k = int(np.argmax(tail))
        if max(gain[i, j], tail[k]) <= EPSILON_S:
            break
        if tail[k] > gain[i, j]:
            path[k + 1 :] = path[k + 1 :][::-1]
        else:
            path[i + 1 : j + 1] = path[i + 1 : j + 1][::-1]
    return path


def _or_opt(path: Ints, seconds: Array) -> Ints:
    """Return the open path after moving short stretches to where they cost least."""
    path = path.copy()
    for length in OR_OPT_LENGTHS:
        for first in range(1, len(path) - length + 1):
            segment = path[first : first + length]
            rest = np.concatenate([path[:first], path[first + length :]])
            closing = seconds[rest[:-1], rest[1:]]
            ends_open = first == len(rest)
            removed = seconds[rest[first - 1], segment[0]]
            if not ends_open:
                removed += seconds[segment[-1], rest[first]] - closing[first - 1]
            for piece in (segment, segment[::-1]):
                added = seconds[rest, piece[0]]
                added[:-1] += seconds[piece[-1], rest[1:]] - closing
                place = int(np.argmin(added))
                if removed - added[place] > EPSILON_S:
                    path = np.concatenate([rest[: place + 1], piece, rest[place + 1 :]])
                    break
    return path
