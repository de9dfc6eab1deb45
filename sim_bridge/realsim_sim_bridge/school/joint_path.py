"""Collision-free moves in joint space: the straight one, or RRT-Connect (Kuffner & LaValle 2000).

The planner is written here because a plan must be the same for the same seed, whatever was planned
before and in which process: OMPL seeds one generator per process, once.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim_sim_bridge.school import panda

Array = NDArray[np.float64]
FreeCheck = Callable[[Array], NDArray[np.bool_]]
"""(M, 7) joint angles -> (M,) whether each configuration is free."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PlannerConfig:
    """How hard a path is looked for."""

    resolution_rad: float = 0.08
    """Largest joint step between two checked configurations [rad]: 6 cm at 0.8 m, about a link's
    radius."""
    extension_rad: float = 0.6
    """Length of a tree's edge [rad]."""
    iterations: int = 60
    """Random targets before giving up."""


def straight(start: Array, goal: Array, resolution_rad: float) -> Array:
    """Return configurations (M, 7) from start to goal, both included."""
    steps = int(np.ceil(np.max(np.abs(goal - start)) / resolution_rad)) + 1
    return start + np.linspace(0.0, 1.0, max(steps, 2))[:, None] * (goal - start)


def connect(
    start: Array,
    goal: Array,
    is_free: FreeCheck,
    config: PlannerConfig,
    rng: np.random.Generator,
) -> Array | None:
    """Return a free path (M, 7) of corner points from start to goal, or None if none was found.

    Start and goal must be free themselves.
    """
    if is_free(straight(start, goal, config.resolution_rad)).all():
        return np.stack([start, goal])
    trees = (_Tree(start), _Tree(goal))
    for i in range(config.iterations):
        grown, other = trees[i % 2], trees[1 - i % 2]
        target = rng.uniform(panda.LOWER, panda.UPPER)
        new = grown.grow(target, is_free, config, greedy=False)
        if new is None:
            continue
        reached = other.grow(grown.nodes[new], is_free, config, greedy=True)
        if reached is not None and np.allclose(other.nodes[reached], grown.nodes[new]):
            here, there = grown.branch(new), other.branch(reached)
            forward = i % 2 == 0
            first, second = (here, there) if forward else (there, here)
            return np.concatenate([first[::-1], second[1:]])
    return None


class _Tree:
    """A tree of free configurations."""

    def __init__(self, root: Array) -> None:
        self.nodes = [root]
        self._parents = [-1]

    def grow(
        self, target: Array, is_free: FreeCheck, config: PlannerConfig, *, greedy: bool
    ) -> int | None:
        """Grow towards the target and return the last new node, or None if blocked at once.

        A greedy tree goes on until it is blocked or there; the other takes one edge.
        """
        nearest = int(np.argmin(np.linalg.norm(np.stack(self.nodes) - target, axis=1)))
        last = None
        while True:
            here = self.nodes[nearest]
            gap = target - here
            length = float(np.linalg.norm(gap))
            if length < 1e-9:
                return nearest
            there = (
                target
                if length <= config.extension_rad
                else (here + gap * (config.extension_rad / length))
            )
            if not is_free(straight(here, there, config.resolution_rad)).all():
                return last
            self.nodes.append(there)
            self._parents.append(nearest)
            nearest = last = len(self.nodes) - 1
            if not greedy:
                return last

    def branch(self, node: int) -> Array:
        """Return the nodes from `node` to the root (M, 7)."""
        path: list[Array] = []
        while node >= 0:
            path.append(self.nodes[node])
            node = self._parents[node]
        return np.stack(path)
