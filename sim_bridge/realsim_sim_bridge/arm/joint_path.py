"""Collision-free moves in joint space: RRT-Connect (Kuffner & LaValle 2000), and shorter corners.

Compiled with the collision check inside: a plan takes a few hundred checks of moves, and a check
takes less than a call from a library to Python. The seed is an argument, so that a plan is the same
whatever was planned before and in which process.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.compiled import njit
from realsim_sim_bridge.arm.arm_space import FREE, ArmSpace, blame_move, room_for


@dataclass(frozen=True, kw_only=True, slots=True)
class PlannerConfig:
    """How hard a path is looked for."""

    extension_rad: float = 0.8
    """Length of a tree's edge [rad]."""
    iterations: int = 150
    """Random targets before giving up."""
    shortcuts: int = 40
    """Random pairs of points on a found path that are joined by a straight move if it is free."""


def connect(
    start: Array,
    goal: Array,
    space: ArmSpace,
    opening_m: float,
    config: PlannerConfig,
    rng: np.random.Generator,
) -> Array | None:
    """Return a free path (M, n) of corner points from start to goal, or None if none was found.

    Args:
        start: (n,) free joint angles [rad].
        goal: (n,) free joint angles [rad].
        space: what must not be touched; arm and hand are checked.
        opening_m: distance of the finger faces [m].
        config: how hard to look.
        rng: one number is drawn from it.
    """
    state = np.array([rng.integers(1, 2**63, dtype=np.uint64)], dtype=np.uint64)
    return _connect(
        np.asarray(start, dtype=np.float64),
        np.asarray(goal, dtype=np.float64),
        opening_m,
        space.bodies[True],
        space.obstacles,
        (config.extension_rad, config.iterations, config.shortcuts),
        state,
    )


# --- compiled -----------------------------------------------------------------------------------

_EDGES_PER_GROWTH = 16
"""A greedy tree adds at most so many edges for one target: the joint space is shorter."""


@njit
def _uniform(state: Any) -> float:
    """Return the next number from 0 to 1 of a xorshift generator (Marsaglia 2003)."""
    x = state[0]
    x ^= x << np.uint64(13)
    x ^= x >> np.uint64(7)
    x ^= x << np.uint64(17)
    state[0] = x
    return float(x >> np.uint64(11)) * 2.0**-53


@njit
def _distance(a: Any, b: Any) -> float:
    total = 0.0
    for k in range(len(a)):
        total += (a[k] - b[k]) ** 2
    return np.sqrt(total)


@njit
def _grow(
    nodes: Any, parents: Any, count: int, target: Any, extension: float, greedy: bool, check: Any
) -> Any:
    """Grow a tree of `count` nodes towards the target.

    A greedy tree goes on until it is blocked or there; the other takes one edge.

    Returns:
        the new count, the last new node (-1 = blocked at once), and whether it is the target.
    """
    opening, body, obstacles, room = check
    nearest, least = 0, np.inf
    for n in range(count):
        distance = _distance(nodes[n], target)
        if distance < least:
            nearest, least = n, distance
    last = -1
    for _ in range(_EDGES_PER_GROWTH):
        length = _distance(nodes[nearest], target)
        if length < 1e-9:
            return count, nearest, True
        share = min(extension / length, 1.0)
        there = nodes[count]
        for k in range(len(there)):
            there[k] = nodes[nearest, k] + share * (target[k] - nodes[nearest, k])
        if share == 1.0:
            there[:] = target
        if blame_move(nodes[nearest], there, opening, body, obstacles, room) != FREE:
            return count, last, False
        parents[count] = nearest
        nearest = last = count
        count += 1
        if share == 1.0:
            return count, last, True
        if not greedy:
            break
    return count, last, False


@njit
def _branch(nodes: Any, parents: Any, node: int) -> Any:
    """Return the nodes from `node` to the root (M, n)."""
    count, at = 0, node
    while at >= 0:
        count, at = count + 1, parents[at]
    path = np.empty((count, nodes.shape[1]))
    for n in range(count):
        path[n] = nodes[node]
        node = parents[node]
    return path


@njit
def _connect(
    start: Any, goal: Any, opening: float, body: Any, obstacles: Any, config: Any, state: Any
) -> Any:
    """Return a free path (M, n) of corner points, or None."""
    extension, iterations, shortcuts = config
    check = (opening, body, obstacles, room_for(body))
    size = iterations * (_EDGES_PER_GROWTH + 1) + 2
    n = len(start)
    nodes, parents = np.empty((2, size, n)), np.full((2, size), -1, dtype=np.int64)
    nodes[0, 0], nodes[1, 0] = start, goal
    counts = np.ones(2, dtype=np.int64)
    target = np.empty(n)
    lower, upper = body.chain.lower.copy(), body.chain.upper.copy()
    for k in range(n):
        if upper[k] - lower[k] > 2 * np.pi:
            # A turn is enough: there the arm is wherever it can be.
            lower[k] = max(lower[k], start[k] - np.pi)
            upper[k] = min(upper[k], start[k] + np.pi)
    for i in range(iterations):
        a, b = i % 2, 1 - i % 2
        for k in range(n):
            target[k] = lower[k] + (upper[k] - lower[k]) * _uniform(state)
        if i < 2:
            # First straight at each other.
            target[:] = nodes[b, 0]
        counts[a], new, _ = _grow(nodes[a], parents[a], counts[a], target, extension, False, check)
        if new < 0:
            continue
        counts[b], met, there = _grow(
            nodes[b], parents[b], counts[b], nodes[a, new], extension, True, check
        )
        if there:
            first = _branch(nodes[0], parents[0], new if a == 0 else met)
            second = _branch(nodes[1], parents[1], met if a == 0 else new)
            path = np.concatenate((first[::-1], second[1:]))
            return _shortened(path, shortcuts, check, state)
    return None


@njit
def _shortened(path: Any, shortcuts: int, check: Any, state: Any) -> Any:
    """Return the path with straight moves between random pairs of its points, where free."""
    opening, body, obstacles, room = check
    for _ in range(shortcuts):
        if len(path) == 2:
            break
        a, b = _uniform(state) * (len(path) - 1), _uniform(state) * (len(path) - 1)
        if _uniform(state) < 0.3:
            # Whole corners go only where both ends are corners themselves.
            a, b = np.floor(a), np.floor(b) + 1.0
        a, b = min(a, b), max(a, b)
        i, j = int(a), min(int(np.ceil(b)), len(path) - 1)
        if j - i < 2:
            continue
        start = path[i] + (a - i) * (path[i + 1] - path[i])
        end = path[j] + (j - b) * (path[j - 1] - path[j])
        if blame_move(start, end, opening, body, obstacles, room) != FREE:
            continue
        head, tail = path[: i + 1], path[j:]
        middle = np.empty((2, path.shape[1]))
        middle[0], middle[1] = start, end
        # An end that is a corner itself is there already.
        first, last = (1 if a == i else 0), (1 if b == j else 2)
        path = np.concatenate((head, middle[first : max(first, last)], tail))
    return path
