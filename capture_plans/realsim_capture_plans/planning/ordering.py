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

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from realsim.errors import InputError
from realsim_capture_plans.planning.record import PlanConfig

Array = NDArray[np.float64]
Ints = NDArray[np.intp]
HOME = -1
"""The view number that stands for where the tour begins."""
Stop = tuple[int, int]
"""(view, candidate of it); (HOME, 0) is home."""
COLLISION_SECONDS = 5.0
"""Charged for a move that is known to collide [s]: more than a detour over via points takes."""
STRING_LENGTH = 12
"""Longest stretch of the tour that is taken out at once."""
REMOVED_VIEWS = 10
"""Views taken out per step on average; more is slower per step and gains no more."""
START_TEMPERATURE_S = 0.4
"""Worse tours are accepted with exp(-loss / temperature) at the beginning: one typical move [s]."""
END_TEMPERATURE_S = 0.004
"""The same at the end: next to nothing worse is accepted."""
VITERBI_EVERY = 400
"""Steps between two choices of all candidates at once."""
BLINK = 0.01
"""Probability with which a place is overlooked, so that equal views do not always go in alike."""


def move_seconds(distance_rad: ArrayLike, config: PlanConfig) -> Array:
    """Return the time (...) [s] of a stop-to-stop move whose leading joint turns by distance (...).

    T(d) = d / v + v / a, or 2 sqrt(d / a) where the speed v is never reached (d < v^2 / a).
    """
    d = np.asarray(distance_rad, dtype=np.float64)
    v, a = config.speed, config.acceleration
    return np.where(d >= v * v / a, d / v + v / a, 2.0 * np.sqrt(d / a))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Clusters:
    """Home and the candidates of every view, one after the other."""

    joints: Array
    """(M, 6) joint vectors [rad]; row 0 is home."""
    first: Ints
    """(N + 2,) row of the first candidate of home, of view 0, 1, ... and one past the last."""
    least_s: Array
    """(N + 1, N + 1) least time between any candidates of two clusters [s]; 0 is home."""
    _least_rad: Array
    """(N + 1, N + 1) the same as turns of the leading joint [rad]."""

    @classmethod
    def of(cls, candidates: list[Array], home: Array, config: PlanConfig) -> "Clusters":
        """Return the clusters of views with candidates (Ki, 6) and of home (6,).

        Raises:
            InputError: a view has no candidate.
        """
        if empty := [k for k, q in enumerate(candidates) if len(q) == 0]:
            raise InputError(f"views {empty[:8]} have no candidate; each needs at least one.")
        joints, first = _rows([home[None], *candidates])
        least = np.full((len(first) - 1, len(first) - 1), np.inf)
        _lower(least, joints, first, first[:-1])
        return cls(joints=joints, first=first, least_s=_timed(least, config), _least_rad=least)

    def with_more(self, further: list[Array], config: PlanConfig) -> "Clusters":
        """Return the clusters with further candidates (Ki, 6) behind those of every view."""
        own = [self.joints[a:b] for a, b in zip(self.first[:-1], self.first[1:], strict=True)]
        none = np.zeros((0, self.joints.shape[1]))
        pairs = zip(own, [none, *further], strict=True)
        joints, first = _rows([np.concatenate(pair) for pair in pairs])
        new = first[:-1] + np.diff(self.first)
        least = self._least_rad.copy()
        _lower(least, joints, first, new)
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
    config: PlanConfig,
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
    fixed = (clusters.joints, clusters.first, owner, suspects, keys, config.speed, config.acceleration)
    path = _nearest_neighbour(clusters.least_s, *fixed) if start is None else np.array(start)
    path = _best_candidates(path, *fixed)
    if n <= 2 or steps == 0:
        return path
    return _ruin_and_recreate(
        path, clusters.least_s, int(rng.integers(2**31)), steps, *fixed
    )


def tour_seconds(
    clusters: Clusters, path: Ints, config: PlanConfig, colliding: Collection[tuple[int, int]] = ()
) -> float:
    """Return the time of a path of rows (N,) from home [s], with the charge for collisions."""
    rows = [0, *path.tolist()]
    hits = sum(move in colliding for move in zip(rows[:-1], rows[1:], strict=True))
    legs = np.abs(np.diff(clusters.joints[rows], axis=0)).max(-1)
    return float(move_seconds(legs, config).sum()) + COLLISION_SECONDS * hits


def _rows(clusters: list[Array]) -> tuple[Array, Ints]:
    """Return all candidates (M, 6), and the first row of each cluster and one past the last."""
    first = np.concatenate([[0], np.cumsum([len(c) for c in clusters])]).astype(np.intp)
    return np.ascontiguousarray(np.concatenate(clusters), dtype=np.float64), first


def _timed(least_rad: Array, config: PlanConfig) -> Array:
    """Return the times [s] of least turns between clusters; none from a cluster to itself."""
    least = move_seconds(np.where(np.isfinite(least_rad), least_rad, 0.0), config)
    np.fill_diagonal(least, 0.0)
    return least


@njit(cache=True)  # pyright: ignore[reportUntypedFunctionDecorator]
def _lower(least: Array, joints: Array, first: Ints, new: Ints) -> None:
    """Lower the least turns between clusters to those of candidates from rows `new` (N + 1,) on."""
    n = len(first) - 1
    for i in range(n):
        for j in range(i + 1, n):
            best = least[i, j]
            for a in range(first[i], first[i + 1]):
                # Pairs of two old candidates have been looked at before.
                begin = first[j] if a >= new[i] else new[j]
                for b in range(begin, first[j + 1]):
                    d = 0.0
                    for k in range(joints.shape[1]):
                        d = max(d, abs(joints[a, k] - joints[b, k]))
                        if d >= best:
                            break
                    best = min(best, d)
            least[i, j] = best
            least[j, i] = best


@njit(cache=True)
def _seconds(a, b, joints, first, owner, suspects, keys, v, acc):  # type: ignore[no-untyped-def]
    """Return the time of the move between two rows, with the charge if it collides."""
    d = 0.0
    for k in range(6):
        d = max(d, abs(joints[a, k] - joints[b, k]))
    t = d / v + v / acc if d >= v * v / acc else 2.0 * np.sqrt(d / acc)
    if suspects[owner[a], owner[b]]:
        key = min(a, b) * len(joints) + max(a, b)
        at = np.searchsorted(keys, key)
        if at < len(keys) and keys[at] == key:
            t += COLLISION_SECONDS
    return t


@njit(cache=True)
def _nearest_neighbour(least, joints, first, owner, suspects, keys, v, acc):  # type: ignore
    """Return rows (N,): always the nearest candidate of any view that is left."""
    n = len(first) - 2
    left = np.ones(n + 1, dtype=np.bool_)
    path = np.zeros(n, dtype=np.intp)
    here = 0
    for k in range(n):
        best, best_row, best_view = np.inf, 0, 0
        for view in range(1, n + 1):
            if not left[view] or least[owner[here], view] >= best:
                continue
            for row in range(first[view], first[view + 1]):
                t = _seconds(here, row, joints, first, owner, suspects, keys, v, acc)
                if t < best:
                    best, best_row, best_view = t, row, view
        path[k] = best_row
        left[best_view] = False
        here = best_row
    return path


@njit(cache=True)
def _length(path, joints, first, owner, suspects, keys, v, acc):  # type: ignore[no-untyped-def]
    total = 0.0
    here = 0
    for row in path:
        total += _seconds(here, row, joints, first, owner, suspects, keys, v, acc)
        here = row
    return total


@njit(cache=True)
def _best_candidates(path, joints, first, owner, suspects, keys, v, acc):  # type: ignore
    """Return rows (N,) with the same order of views and the candidates that make it shortest."""
    n = len(path)
    widest = 0
    for row in path:
        widest = max(widest, first[owner[row] + 1] - first[owner[row]])
    cost = np.zeros(1)
    came = np.zeros((n, widest), dtype=np.intp)
    previous = 0
    for k in range(n):
        view = owner[path[k]]
        size = first[view + 1] - first[view]
        new = np.full(size, np.inf)
        base = first[previous]
        for c in range(size):
            row = first[view] + c
            for p in range(len(cost)):
                if cost[p] >= new[c]:
                    continue
                t = cost[p] + _seconds(
                    base + p, row, joints, first, owner, suspects, keys, v, acc
                )
                if t < new[c]:
                    new[c] = t
                    came[k, c] = p
        cost = new
        previous = view
    out = np.zeros(n, dtype=np.intp)
    best = int(np.argmin(cost))
    for k in range(n - 1, -1, -1):
        out[k] = first[owner[path[k]]] + best
        best = came[k, best]
    return out


@njit(cache=True)
def _taken_out(path, place, nearest, owner):  # type: ignore[no-untyped-def]
    """Return (N,) which places of the tour go out: strings round a view and its neighbours."""
    n = len(path)
    out = np.zeros(n, dtype=np.bool_)
    seed = np.random.randint(n)
    wanted = 1 + np.random.randint(2 * REMOVED_VIEWS - 1)
    taken = 0
    for j in range(n):
        if taken >= wanted:
            break
        at = place[nearest[seed, j]]
        if out[at]:
            continue
        length = 1 + np.random.randint(min(STRING_LENGTH, wanted - taken))
        begin = max(0, at - np.random.randint(length))
        for k in range(begin, min(n, begin + length)):
            if not out[k]:
                out[k] = True
                taken += 1
    return out


@njit(cache=True)
def _put_back(kept, size, view, least, joints, first, owner, suspects, keys, v, acc):  # type: ignore
    """Insert one view where, and in the candidate in which, it costs least; kept[:size] grows."""
    gain = np.zeros(size + 1)
    saved = np.zeros(size + 1)
    for k in range(size + 1):
        a = 0 if k == 0 else kept[k - 1]
        gain[k] = least[owner[a], view]
        if k < size:
            saved[k] = _seconds(a, kept[k], joints, first, owner, suspects, keys, v, acc)
            gain[k] += least[view, owner[kept[k]]] - saved[k]
    best, best_place, best_row = np.inf, size, first[view]
    # The most promising places first: the others are then ruled out by their bound alone.
    for k in np.argsort(gain):
        if gain[k] >= best:
            break
        if np.random.random() < BLINK:
            continue
        a = 0 if k == 0 else kept[k - 1]
        for row in range(first[view], first[view + 1]):
            t = _seconds(a, row, joints, first, owner, suspects, keys, v, acc) - saved[k]
            if t >= best:
                continue
            if k < size:
                t += _seconds(row, kept[k], joints, first, owner, suspects, keys, v, acc)
            if t < best:
                best, best_place, best_row = t, k, row
    for k in range(size, best_place, -1):
        kept[k] = kept[k - 1]
    kept[best_place] = best_row


@njit(cache=True)
def _ruin_and_recreate(path, least, seed, steps, joints, first, owner, suspects, keys, v, acc):  # type: ignore
    """Return the best rows (N,) met while annealing."""
    np.random.seed(seed)
    n = len(path)
    nearest = np.zeros((n, n), dtype=np.intp)
    for i in range(n):
        nearest[i] = np.argsort(least[i + 1, 1:])
    place = np.zeros(n, dtype=np.intp)
    now = _length(path, joints, first, owner, suspects, keys, v, acc)
    best, best_path = now, path.copy()
    cooling = (END_TEMPERATURE_S / START_TEMPERATURE_S) ** (1.0 / steps)
    temperature = START_TEMPERATURE_S
    for step in range(steps):
        temperature *= cooling
        for k in range(n):
            place[owner[path[k]] - 1] = k
        out = _taken_out(path, place, nearest, owner)
        kept = np.zeros(n, dtype=np.intp)
        size = 0
        for k in range(n):
            if not out[k]:
                kept[size] = path[k]
                size += 1
        back = owner[path[out]]
        np.random.shuffle(back)
        for view in back:
            _put_back(kept, size, view, least, joints, first, owner, suspects, keys, v, acc)
            size += 1
        if step % VITERBI_EVERY == VITERBI_EVERY - 1:
            kept = _best_candidates(kept, joints, first, owner, suspects, keys, v, acc)
        t = _length(kept, joints, first, owner, suspects, keys, v, acc)
        if t < now - temperature * np.log(1.0 - np.random.random()):
            path, now = kept, t
        if now < best:
            best, best_path = now, path.copy()
    return _best_candidates(best_path, joints, first, owner, suspects, keys, v, acc)
