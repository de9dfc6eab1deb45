"""In which order, and in which arm branch: a short tour through one candidate of every view.

A generalised travelling-salesman path from home: every view is a cluster of joint vectors (branch,
roll, radius, whole turns), and the path visits each cluster once. Begun by nearest neighbour; then
ruin and recreate (SISR: Christiaens and Vanden Berghe, Transportation Science 2020) with simulated
annealing: strings of neighbouring views are taken out and put back where, and in which candidate,
they cost least; now and then the best candidates of the whole order at once (Viterbi). The cost of
a move is its time. Moves that were found to collide are charged extra.
"""

from collections.abc import Collection
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array
from realsim.errors import InputError
from realsim_capture_plans.planning.tour_search import (
    COLLISION_SECONDS,
    Problem,
    best_candidates,
    lower_least,
    nearest_neighbour,
    ruin_and_recreate,
)

if TYPE_CHECKING:
    from realsim_capture_plans.planning.record import PlanConfig

Ints = NDArray[np.intp]
HOME = -1
"""The view number that stands for where the tour begins."""
Stop = tuple[int, int]
"""(view, candidate of it); (HOME, 0) is home."""


def move_seconds(distance_rad: ArrayLike, speed: float, acceleration: float) -> Array:
    """Return the time (...) [s] of a stop-to-stop move whose leading joint turns by distance (...).

    T(d) = d / v + v / a, or 2 sqrt(d / a) where the speed v is never reached (d < v^2 / a).
    """
    d, v, a = np.asarray(distance_rad, dtype=np.float64), speed, acceleration
    return np.where(d >= v * v / a, d / v + v / a, 2.0 * np.sqrt(d / a))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Clusters:
    """Home and the candidates of every view, one after the other."""

    joints: Array
    """(M, n) joint vectors [rad]; row 0 is home."""
    first: Ints
    """(N + 2,) row of the first candidate of home, of view 0, 1, ... and one past the last."""
    least_s: Array
    """(N + 1, N + 1) least time between any candidates of two clusters [s]; 0 is home."""
    _least_rad: Array
    """(N + 1, N + 1) the same as turns of the leading joint [rad]."""

    @classmethod
    def of(cls, candidates: list[Array], home: Array, config: "PlanConfig") -> "Clusters":
        """Return the clusters of views with candidates (Ki, n) and of home (n,).

        Raises:
            InputError: a view has no candidate.
        """
        if empty := [k for k, q in enumerate(candidates) if len(q) == 0]:
            raise InputError(f"views {empty[:8]} have no candidate; each needs at least one.")
        joints, first = _rows([home[None], *candidates])
        least = np.full((len(first) - 1, len(first) - 1), np.inf)
        lower_least(least, joints, first, first[:-1])
        return cls(joints=joints, first=first, least_s=_timed(least, config), _least_rad=least)

    def with_more(self, further: list[Array], config: "PlanConfig") -> "Clusters":
        """Return the clusters with further candidates (Ki, n) behind those of every view."""
        own = [self.joints[a:b] for a, b in zip(self.first[:-1], self.first[1:], strict=True)]
        none = np.zeros((0, self.joints.shape[1]))
        pairs = zip(own, [none, *further], strict=True)
        joints, first = _rows([np.concatenate(pair) for pair in pairs])
        new = first[:-1] + np.diff(self.first)
        least = self._least_rad.copy()
        lower_least(least, joints, first, new)
        return Clusters(joints=joints, first=first, least_s=_timed(least, config), _least_rad=least)

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self.first) - 2

    def row(self, stop: Stop) -> int:
        """Return the row of a stop."""
        return int(self.first[stop[0] + 1] + stop[1])

    def stop(self, row: int) -> Stop:
        """Return the stop of a row."""
        cluster = int(np.searchsorted(self.first, row, side="right")) - 1
        return cluster - 1, row - int(self.first[cluster])


def tour(
    clusters: Clusters,
    config: "PlanConfig",
    rng: np.random.Generator,
    *,
    steps: int,
    start: Ints | None = None,
    colliding: Collection[tuple[int, int]] = (),
) -> Ints:
    """Return the rows (N,) of a short path from home through one candidate of every view.

    Args:
        clusters: home and the candidates.
        config: speed and acceleration.
        rng: draws what is taken out.
        steps: of ruin and recreate; the work grows with it, the gain flattens.
        start: rows (N,) of a tour to improve; by default nearest neighbour from home.
        colliding: pairs of rows whose straight move collides.
    """
    n = len(clusters)
    m = len(clusters.joints)
    owner = np.repeat(np.arange(n + 1), np.diff(clusters.first)).astype(np.intp)
    suspects = np.zeros((n + 1, n + 1), dtype=np.bool_)
    keys = np.array(sorted(min(a, b) * m + max(a, b) for a, b in colliding), dtype=np.int64)
    for a, b in colliding:
        suspects[owner[a], owner[b]] = suspects[owner[b], owner[a]] = True
    problem = Problem(
        clusters.joints, clusters.first, owner, suspects, keys, config.speed, config.acceleration
    )
    path = nearest_neighbour(clusters.least_s, problem) if start is None else np.array(start)
    path = best_candidates(path, clusters.least_s, problem)
    if n <= 2 or steps == 0:
        return path
    return ruin_and_recreate(path, clusters.least_s, steps, problem, rng)


def tour_seconds(
    clusters: Clusters,
    path: Ints,
    config: "PlanConfig",
    colliding: Collection[tuple[int, int]] = (),
) -> float:
    """Return the time of a path of rows (N,) from home [s], with the charge for collisions."""
    rows = [0, *path.tolist()]
    hits = sum(move in colliding for move in pairwise(rows))
    legs = np.abs(np.diff(clusters.joints[rows], axis=0)).max(-1)
    return (
        float(move_seconds(legs, config.speed, config.acceleration).sum())
        + COLLISION_SECONDS * hits
    )


def _rows(clusters: list[Array]) -> tuple[Array, Ints]:
    """Return all candidates (M, n), and the first row of each cluster and one past the last."""
    first = np.concatenate([[0], np.cumsum([len(c) for c in clusters])]).astype(np.intp)
    return np.ascontiguousarray(np.concatenate(clusters), dtype=np.float64), first


def _timed(least_rad: Array, config: "PlanConfig") -> Array:
    """Return the times [s] of least turns between clusters; none from a cluster to itself."""
    finite = np.where(np.isfinite(least_rad), least_rad, 0.0)
    least = move_seconds(finite, config.speed, config.acceleration)
    np.fill_diagonal(least, 0.0)
    return least
