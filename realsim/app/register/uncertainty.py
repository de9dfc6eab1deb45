"""How certain a pose is, with turns that change nothing set aside."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.records import ObjectModel

DEPENDENT = 1e-3
"""An axis whose direction the others give to this adds no freedom."""


def held(covariance: ArrayLike, directions: Sequence[ArrayLike]) -> Array:
    """Return a pose's covariance (6, 6) given that it does not turn about some directions.

    A turn about an axis of revolution changes nothing, so it may be said to be none. The rest is
    then known better than the marginal says: with a = (u, 0) the direction of the turn,

        C' = C - C A (A^T C A)^-1 A^T C,   A = the directions as columns

    (Gaussian conditioning). Projecting the marginal instead leaves sin(t)^2 of the free turn's
    variance where covariance and declared axis differ by t: at 2 degrees, thousands of times the
    variance that is asked for.

    Args:
        covariance: (6, 6) of the right perturbation, rotation first [rad, m].
        directions: (3,) each, in the object's frame.
    """
    C = np.asarray(covariance, dtype=np.float64)
    basis: list[Array] = []
    for direction in directions:
        u = np.asarray(direction, dtype=np.float64)
        u = u / np.linalg.norm(u)
        rest = u - sum((np.dot(u, b) * b for b in basis), np.zeros(3))
        if np.linalg.norm(rest) > DEPENDENT:
            basis.append(rest / np.linalg.norm(rest))
    if len(basis) == 2:  # turns about two directions make every turn
        basis.append(np.cross(basis[0], basis[1]))
    if not basis:
        return C
    A = np.zeros((6, len(basis)))
    A[:3] = np.stack(basis, axis=1)
    seen = A.T @ C @ A
    return C - C @ A @ np.linalg.pinv(seen, hermitian=True) @ A.T @ C


def sigmas(covariance: Any, model: ObjectModel | None) -> tuple[float, float]:
    """Return what `largest` does, a model's axes of revolution set aside."""
    return largest(covariance, [] if model is None else [axis for axis, _ in model.symmetry_axes])


def largest(covariance: Any, axes: Sequence[ArrayLike]) -> tuple[float, float]:
    """Return the largest 1 sigma along and about any axis [mm, deg]; NaN = not known.

    Args:
        covariance: (6, 6) of the right perturbation, rotation first [rad, m]; None = not known.
        axes: (3,) of revolution, which are set aside.
    """
    if covariance is None or not np.all(np.isfinite(covariance)):
        return float("nan"), float("nan")
    C = held(covariance, axes)
    shift, turn = (float(np.linalg.eigvalsh(c)[-1]) for c in (C[3:, 3:], C[:3, :3]))
    return 1e3 * float(np.sqrt(max(shift, 0.0))), float(np.degrees(np.sqrt(max(turn, 0.0))))
