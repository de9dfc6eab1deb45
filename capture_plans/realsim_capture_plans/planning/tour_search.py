"""The tour's inner loops, compiled: nearest neighbour, ruin and recreate, Viterbi.

Rows number the candidates of all views one after the other; row 0 is home, cluster 0 is home.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array, Int64, Mask
from realsim.compiled import njit

Ints = NDArray[np.intp]
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
VITERBI_EVERY = 1000
"""Steps between two choices of all candidates at once."""
PLACES = 12
"""Places looked at when a view goes back, by the least that they can cost."""
BLINK = 0.01
"""Probability with which a place is overlooked, so that equal views do not always go in alike."""


class Problem(NamedTuple):
    """What the searches ask: candidates, collisions that are known, and how fast the arm is."""

    joints: Array
    """(M, n) candidates [rad]."""
    first: Ints
    """(N + 2,) first row of every cluster, and one past the last."""
    owner: Ints
    """(M,) cluster of every row."""
    suspects: Mask
    """(N + 1, N + 1) whether any move between two clusters is known to collide."""
    keys: Int64
    """(K,) sorted, smaller row * M + larger row of every move that is known to collide."""
    speed: float
    """Speed of the leading joint [rad/s]."""
    acceleration: float
    """Acceleration of the leading joint [rad/s^2]."""


@njit
def lower_least(least: Array, joints: Array, first: Ints, new: Ints) -> None:
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


@njit
def _seconds(a: int, b: int, p: Problem) -> float:
    """Return the time of the move between two rows, with the charge if it collides."""
    q = p.joints
    d = max(
        abs(q[a, 0] - q[b, 0]),
        abs(q[a, 1] - q[b, 1]),
        abs(q[a, 2] - q[b, 2]),
        abs(q[a, 3] - q[b, 3]),
        abs(q[a, 4] - q[b, 4]),
        abs(q[a, 5] - q[b, 5]),
    )
    for k in range(6, q.shape[1]):  # all arms have the first six
        d = max(d, abs(q[a, k] - q[b, k]))
    v, acc = p.speed, p.acceleration
    t = d / v + v / acc if d >= v * v / acc else 2.0 * np.sqrt(d / acc)
    if p.suspects[p.owner[a], p.owner[b]]:
        key = min(a, b) * len(p.joints) + max(a, b)
        at = np.searchsorted(p.keys, key)
        if at < len(p.keys) and p.keys[at] == key:
            t += COLLISION_SECONDS
    return t


@njit
def nearest_neighbour(least: Array, p: Problem) -> Ints:
    """Return rows (N,): always the nearest candidate of any view that is left."""
    n = len(p.first) - 2
    left = np.ones(n + 1, dtype=np.bool_)
    path = np.zeros(n, dtype=np.intp)
    here = 0
    for k in range(n):
        best, best_row, best_view = np.inf, 0, 0
        for view in range(1, n + 1):
            if not left[view] or least[p.owner[here], view] >= best:
                continue
            for row in range(p.first[view], p.first[view + 1]):
                t = _seconds(here, row, p)
                if t < best:
                    best, best_row, best_view = t, row, view
        path[k] = best_row
        left[best_view] = False
        here = best_row
    return path


@njit
def _length(path: Ints, p: Problem) -> float:
    """Return the time of a path from home, with the charges for collisions."""
    total = 0.0
    here = 0
    for row in path:
        total += _seconds(here, row, p)
        here = row
    return total


@njit
def best_candidates(path: Ints, least: Array, p: Problem) -> Ints:
    """Return rows (N,) with the same order of views and the candidates that make it shortest."""
    n = len(path)
    widest = 0
    for row in path:
        widest = max(widest, p.first[p.owner[row] + 1] - p.first[p.owner[row]])
    cost = np.zeros(1)
    came = np.zeros((n, widest), dtype=np.intp)
    previous = 0
    for k in range(n):
        view = p.owner[path[k]]
        size = p.first[view + 1] - p.first[view]
        new = np.full(size, np.inf)
        base = p.first[previous]
        cheapest = np.argsort(cost)
        shortest = least[previous, view]
        for c in range(size):
            row = int(p.first[view]) + c
            for j in range(len(cost)):
                before = int(cheapest[j])
                if cost[before] + shortest >= new[c]:
                    break
                t = cost[before] + _seconds(base + before, row, p)
                if t < new[c]:
                    new[c] = t
                    came[k, c] = before
        cost = new
        previous = view
    out = np.zeros(n, dtype=np.intp)
    best = int(np.argmin(cost))
    for k in range(n - 1, -1, -1):
        out[k] = p.first[p.owner[path[k]]] + best
        best = came[k, best]
    return out


@njit
def _taken_out(place: Ints, nearest: Ints, rng: np.random.Generator) -> Mask:
    """Return (N,) which places of the tour go out: strings round a view and its neighbours."""
    n = len(place)
    out = np.zeros(n, dtype=np.bool_)
    seed = rng.integers(0, n)
    wanted = 1 + rng.integers(0, 2 * REMOVED_VIEWS - 1)
    taken = 0
    for j in range(n):
        if taken >= wanted:
            break
        at = place[nearest[seed, j]]
        if out[at]:
            continue
        length = 1 + rng.integers(0, min(STRING_LENGTH, wanted - taken))
        begin = max(0, at - rng.integers(0, length))
        for k in range(begin, min(n, begin + length)):
            if not out[k]:
                out[k] = True
                taken += 1
    return out


@njit
def _put_back(
    kept: Ints, size: int, view: int, least: Array, p: Problem, rng: np.random.Generator
) -> None:
    """Insert one view where, and in the candidate in which, it costs least; kept[:size] grows."""
    gain = np.zeros(size + 1)
    saved = np.zeros(size + 1)
    for k in range(size + 1):
        a = 0 if k == 0 else kept[k - 1]
        gain[k] = least[p.owner[a], view]
        if k < size:
            saved[k] = _seconds(a, kept[k], p)
            gain[k] += least[view, p.owner[kept[k]]] - saved[k]
    best, best_place, best_row = np.inf, size, p.first[view]
    # The most promising places first: the others are then ruled out by their bound alone.
    order = np.argsort(gain)
    for j in range(min(PLACES, size + 1)):
        k = int(order[j])
        if gain[k] >= best:
            break
        if rng.random() < BLINK:
            continue
        a = 0 if k == 0 else int(kept[k - 1])
        for row in range(p.first[view], p.first[view + 1]):
            t = _seconds(a, row, p) - saved[k]
            if t >= best:
                continue
            if k < size:
                t += _seconds(row, kept[k], p)
            if t < best:
                best, best_place, best_row = t, k, row
    for k in range(size, best_place, -1):
        kept[k] = kept[k - 1]
    kept[best_place] = best_row


@njit
def ruin_and_recreate(
    path: Ints, least: Array, steps: int, p: Problem, rng: np.random.Generator
) -> Ints:
    """Return the best rows (N,) met while annealing."""
    n = len(path)
    nearest = np.zeros((n, n), dtype=np.intp)
    for i in range(n):
        nearest[i] = np.argsort(least[i + 1, 1:])
    place = np.zeros(n, dtype=np.intp)
    now = _length(path, p)
    best, best_path = now, path.copy()
    cooling = (END_TEMPERATURE_S / START_TEMPERATURE_S) ** (1.0 / steps)
    temperature = START_TEMPERATURE_S
    for step in range(steps):
        temperature *= cooling
        for k in range(n):
            place[p.owner[path[k]] - 1] = k
        out = _taken_out(place, nearest, rng)
        kept = np.zeros(n, dtype=np.intp)
        size = 0
        for k in range(n):
            if not out[k]:
                kept[size] = path[k]
                size += 1
        back = p.owner[path[out]]
        rng.shuffle(back)
        for view in back:
            _put_back(kept, size, view, least, p, rng)
            size += 1
        if step % VITERBI_EVERY == VITERBI_EVERY - 1:
            kept = best_candidates(kept, least, p)
        t = _length(kept, p)
        if t < now - temperature * np.log(1.0 - rng.random()):
            path, now = kept, t
        if now < best:
            best, best_path = now, path.copy()
    return best_candidates(best_path, least, p)


ASCENT_STEPS = 400
"""Steps of the subgradient ascent; the bound grows by less than 0.1 % in the last hundred."""
LEAST_GAP_S = 1e-6
"""Least difference between tour and bound that sets a step [s]."""
ASCENT_SHRINK = 0.9
"""The step length is shrunk by this every ten steps (Held, Wolfe and Crowder, 1974)."""


def two_nearest_bound(least_s: Array) -> float:
    """Return half the sum over the views of the times to their two nearest [s].

    Args:
        least_s: (N + 1, N + 1) least times between clusters [s]; 0 is home, where a tour begins.

    Home has one move and so has the last view, whichever it is: the view whose second nearest is
    farthest gives its second move back.
    """
    n = len(least_s) - 1
    times = least_s + np.where(np.eye(n + 1, dtype=bool), np.inf, 0.0)
    near = np.sort(times, axis=1)
    if n == 1:
        return float(near[0, 0])
    return float(0.5 * (near[0, 0] + near[1:, :2].sum() - near[1:, 1].max()))


def held_karp_bound(least_s: Array, tour_s: float) -> float:
    """Return the Held-Karp bound [s]: the best 1-tree under prices on the views.

    The path from home is closed over a stop of its own that is next to home and to every view at
    no cost; a minimum spanning tree plus that stop's two moves is then never longer than a tour,
    with any prices. Held and Karp, Operations Research 1970 and Mathematical Programming 1971.

    Args:
        least_s: (N + 1, N + 1) least times between clusters [s]; 0 is home.
        tour_s: time of some tour [s]; sets the step length only.
    """
    if len(least_s) < 4:
        return two_nearest_bound(least_s)
    return max(_ascend(np.ascontiguousarray(least_s), tour_s), two_nearest_bound(least_s))


@njit
def _ascend(least: Array, upper: float) -> float:
    """Return the best bound met while raising the prices of views with too many moves."""
    n = len(least)
    price = np.zeros(n)
    best, pace = 0.0, 2.0
    for step in range(ASCENT_STEPS):
        total, degree = _one_tree(least, price)
        bound = total - 2.0 * price.sum()
        best = max(best, bound)
        gap = ((degree - 2.0) ** 2).sum()
        if gap == 0.0:
            return best
        price += pace * max(upper - bound, LEAST_GAP_S) / gap * (degree - 2.0)
        if step % 10 == 9:
            pace *= ASCENT_SHRINK
    return best


@njit
def _one_tree(least: Array, price: Array) -> tuple[float, Array]:
    """Return the priced length of the least 1-tree, and the moves (N + 1,) at every stop."""
    n = len(least)
    inside = np.zeros(n, dtype=np.bool_)
    reach = np.full(n, np.inf)
    parent = np.zeros(n, dtype=np.intp)
    degree = np.zeros(n)
    reach[0] = 0.0
    total = 0.0
    for _ in range(n):
        here = int(np.argmin(np.where(inside, np.inf, reach)))
        inside[here] = True
        if here != 0:
            total += reach[here]
            degree[here] += 1
            degree[parent[here]] += 1
        for j in range(n):
            t = least[here, j] + price[here] + price[j]
            if not inside[j] and t < reach[j]:
                reach[j], parent[j] = t, here
    # The stop that closes the path: one move to home, one to the cheapest view.
    end = 1 + int(np.argmin(price[1:]))
    degree[0] += 1
    degree[end] += 1
    return total + price[0] + price[end], degree
