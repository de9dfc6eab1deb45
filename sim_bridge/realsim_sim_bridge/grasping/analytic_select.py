"""A few of an object's many analytic grasps, far apart and of every friction level."""

import numpy as np

from realsim.arrays import Array, Int64, Rows
from realsim.errors import InputError
from realsim.formats.graspnet.grasp_labels import GraspLabels

# --- Rows far apart from one another -------------------------------------------------------------


def farthest_rows(features: Array, count: int, first: int = 0, least: float = 0.0) -> Int64:
    """Return rows (N,) of features (M, D), each the farthest from those before.

    Args:
        features: (M, D), at least one row.
        count: rows at most.
        first: where to begin.
        least: end when all others are nearer than this to one that was chosen.
    """
    chosen = [first]
    nearest = np.full(len(features), np.inf)
    while len(chosen) < min(count, len(features)):
        step = np.sum((features - features[chosen[-1]]) ** 2, axis=1)
        # Equal rows are chosen once each.
        nearest = np.minimum(nearest, step)
        nearest[chosen[-1]] = -1.0
        farthest = int(np.argmax(nearest))
        if nearest[farthest] < least**2:
            break
        chosen.append(farthest)
    return np.array(chosen, dtype=np.int64)


SPREAD_M = 0.03
"""Distance [m] that counts as much as opposite approach directions, as of generated candidates."""
MOST_COMPARED = 4000
"""Grasps of a level that are looked at; a level of a large object has 100,000."""


def select_rows(labels: GraspLabels, count: int, rng: np.random.Generator) -> Rows:
    """Return increasing rows (N,) of at most `count` analytic labels for the School to try.

    Grasps whose gripper is in the object are left out.

    Raises:
        InputError: the count is negative.
    """
    if count < 0:
        raise InputError(f"analytic grasps: {count} are asked for; a number from 0 is expected.")
    free = np.flatnonzero(~labels.collision)
    levels = [free[labels.friction[free] == f] for f in np.unique(labels.friction[free])]
    shares = _shares([len(rows) for rows in levels], count)
    chosen = [np.zeros(0, dtype=np.int64)]
    for level, share in zip(levels, shares, strict=True):
        few = len(level) <= MOST_COMPARED
        rows = level if few else np.sort(rng.choice(level, MOST_COMPARED, replace=False))
        if share > 0:
            features = grasp_features(labels.rows(rows).Ts_obj_grasp(), SPREAD_M)
            chosen.append(rows[farthest_rows(features, share, int(rng.integers(len(rows))))])
    return np.sort(np.concatenate(chosen))


def _shares(available: list[int], count: int) -> list[int]:
    """Return how many each level gives: as even as they allow, the lower levels first."""
    shares = [0] * len(available)
    left = min(count, sum(available), sum(min(a, MOST_COMPARED) for a in available))
    while left > 0:
        open_levels = [k for k, a in enumerate(available) if shares[k] < min(a, MOST_COMPARED)]
        each = max(left // len(open_levels), 1)
        for k in open_levels[:left]:
            more = min(each, min(available[k], MOST_COMPARED) - shares[k])
            shares[k] += more
            left -= more
    return shares


def grasp_features(Ts: Array, spread_m: float) -> Array:
    """Return numbers (N, 15) whose distances say how different grasps (N, 4, 4) are.

    A grasp and its half turn about the approach are one: the closing axis enters as y y'.

    Args:
        Ts: grasps.
        spread_m: distance that counts as much as opposite approach directions [m].
    """
    y = Ts[:, :3, 1]
    axis = (y[:, :, None] * y[:, None, :]).reshape(-1, 9)
    return np.concatenate([2.0 / spread_m * Ts[:, :3, 3], Ts[:, :3, 2], axis], axis=1)
