"""Weights of residuals that let outliers fade out, and the spread of residuals that have outliers.

Tukey's biweight (1 - (r / c)^2)^2 within the cut-off c and 0 beyond: smooth, and blind to whatever
lies further off. Everything here takes the square (r / c)^2.
"""

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.compiled import njit

MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution in units of its median absolute deviation."""


@njit(inline="always")
def tukey(square: float) -> float:
    """Return Tukey's weight of one squared residual in units of the squared cut-off."""
    return (1.0 - square) ** 2 if square < 1.0 else 0.0


def tukey_weights(squares: ArrayLike) -> Array:
    """Return Tukey's weights of squared residuals in units of the squared cut-off, same shape."""
    return np.square(np.clip(1.0 - np.asarray(squares, dtype=np.float64), 0.0, None))


def mad_sigma(residuals: ArrayLike) -> float:
    """Return the 1-sigma of residuals about zero from the median of their size [their unit]."""
    return MAD_TO_SIGMA * float(np.median(np.abs(residuals)))
