"""Rows far apart from one another."""

import numpy as np
from numpy.typing import NDArray


def farthest_rows(
    features: NDArray[np.float64], count: int, first: int = 0, least: float = 0.0
) -> NDArray[np.int64]:
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
