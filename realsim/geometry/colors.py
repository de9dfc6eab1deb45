"""Light and its encoding: sRGB both ways (IEC 61966-2-1), and brightness (ITU-R BT.709)."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Weights of linear red, green and blue."""


def srgb_encoded(value: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return sRGB [0, 1] of linear light [0, 1]."""
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * np.power(value, 1 / 2.4) - 0.055)


def srgb_decoded(value: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return linear light [0, 1] of sRGB [0, 1]."""
    return np.where(value <= 0.04045, value / 12.92, np.power((value + 0.055) / 1.055, 2.4))


def light_of_bytes(values: ArrayLike) -> Array:
    """Return linear light [0, 1] of sRGB values [0, 255]."""
    return np.asarray(srgb_decoded(np.asarray(values, np.float64) / 255.0), np.float64)


def luminance(linear: ArrayLike) -> Array:
    """Return the luminance (...) of linear colours (..., 3)."""
    return np.asarray(linear, np.float64) @ LUMINANCE
