"""How short could a tour be: lower bounds of the time of any path through all views.

Both use the least time between the candidates of two views, whichever candidates a tour takes, and
so hold for every order and every choice.
"""

import numpy as np
from numpy.typing import NDArray

from realsim.compiled import njit

Array = NDArray[np.float64]
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
