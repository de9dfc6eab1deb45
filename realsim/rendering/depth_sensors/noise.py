"""Noise of a depth sensor: what varies from frame to frame, and what stays on the chip.

All fields are in units of the disparity's standard deviation or in pixels of disparity; the sensor
model adds them there.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array32

WARP_SHARE = 1 / 8
"""Radius of the slow part of the fixed pattern, as a share of the image's width."""
STRONGEST_SHRINK = 4
"""A field of radius s is drawn on a grid that is coarser by s / 4: it holds nothing finer."""


def correlated(
    rng: np.random.Generator, shape: tuple[int, int], sigma_px: float, aspect: float = 1.0
) -> Array32:
    """Return normal noise (H, W) of unit variance, correlated over a Gaussian radius.

    Smoothing white noise with a Gaussian of radius s leaves the autocorrelation
    exp(-lag^2 / (4 s^2)).

    Args:
        rng: source of chance.
        shape: (H, W).
        sigma_px: radius along rows [px]; 0 = white.
        aspect: radius along columns over the radius along rows.
    """
    import cv2

    if sigma_px <= 0:
        return rng.standard_normal(shape, dtype=np.float32)
    pad_u, pad_v = int(np.ceil(3 * sigma_px)), max(1, int(np.ceil(3 * sigma_px * aspect)))
    size = (shape[0] + 2 * pad_v, shape[1] + 2 * pad_u)
    noise = rng.standard_normal(size, dtype=np.float32)
    along_v = _kernel(max(sigma_px * aspect, 1e-3), pad_v)
    smooth = cv2.sepFilter2D(noise, -1, _kernel(sigma_px, pad_u), along_v)
    return np.ascontiguousarray(np.asarray(smooth, np.float32)[pad_v:-pad_v, pad_u:-pad_u])


def _kernel(sigma_px: float, pad: int) -> Array32:
    """Return a Gaussian of unit length: so scaled, it keeps the variance of white noise."""
    import cv2

    kernel: Any = cv2.getGaussianKernel(2 * pad + 1, sigma_px)
    return np.asarray(kernel, np.float32) / np.float32(np.linalg.norm(kernel))


def slow(
    rng: np.random.Generator, shape: tuple[int, int], sigma_px: float, aspect: float = 1.0
) -> Array32:
    """Return `correlated` noise of a large radius, drawn on a coarse grid and interpolated."""
    import cv2

    shrink = max(1.0, sigma_px * min(1.0, aspect) / STRONGEST_SHRINK)
    small = tuple(int(np.ceil(n / shrink)) + 1 for n in shape)
    field = correlated(rng, (small[0], small[1]), sigma_px / shrink, aspect)
    # Grid point k lies at pixel k * shrink, so the frame's size does not move the pattern.
    u = np.arange(shape[1], dtype=np.float32) / np.float32(shrink)
    v = np.arange(shape[0], dtype=np.float32) / np.float32(shrink)
    grid_u, grid_v = np.meshgrid(u, v)
    return np.asarray(cv2.remap(field, grid_u, grid_v, cv2.INTER_LINEAR), np.float32)


def whole_pixel(quantum_px: float) -> float:
    """Return what a whole pixel of the chip is worth, whose step is a unit fraction of it [px].

    A focal length or baseline that is a little off makes all disparities a little too great or
    small, the step and the chip's pixel with them.
    """
    return round(1 / quantum_px) * quantum_px if 0 < quantum_px <= 1 else 1.0


def uniform(normal: Array32) -> Array32:
    """Return numbers uniform in (0, 1) of the same rank as standard normal ones."""
    from scipy.special import ndtr

    return np.asarray(ndtr(normal), np.float32)


def fixed_pattern(
    shape: tuple[int, int],
    *,
    warp_px: float,
    column_band_px: float,
    row_band_px: float,
    band_width_px: float,
    seed: int,
) -> Array32:
    """Return the error (H, W) [px] that one specimen makes in every frame.

    A slow warp is what rectification leaves; stripes along columns and rows, constant between
    sudden steps, are those of sensors whose pattern repeats (the vertical bands of PrimeSense
    cameras: Khoshelham and Oude Elberink, Sensors 2012).

    Args:
        shape: (H, W).
        warp_px: standard deviation of the slow part [px].
        column_band_px: standard deviation of the stripes that stand upright [px].
        row_band_px: standard deviation of the stripes that lie [px].
        band_width_px: mean width of a stripe [px].
        seed: which specimen.
    """
    rng = np.random.default_rng(seed)
    pattern = np.zeros(shape, np.float32)
    if warp_px > 0:
        pattern += np.float32(warp_px) * slow(rng, shape, WARP_SHARE * shape[1])
    if column_band_px > 0:
        pattern += np.float32(column_band_px) * _bands(rng, shape[1], band_width_px)[None]
    if row_band_px > 0:
        pattern += np.float32(row_band_px) * _bands(rng, shape[0], band_width_px)[:, None]
    return pattern


def _bands(rng: np.random.Generator, length: int, width_px: float) -> Array32:
    """Return values (length,) of unit variance that are constant between steps at random places."""
    steps = rng.random(length) < 1 / max(width_px, 1.0)
    levels = rng.standard_normal(length, dtype=np.float32)
    return levels[np.cumsum(steps) - int(steps[0])]


def native_pixels(length: int, pitch_px: float) -> NDArray[np.intp]:
    """Return the pixel (length,) whose measurement each pixel repeats.

    A depth image that was resampled into a finer colour image holds every measurement over
    `pitch_px` pixels.
    """
    cell = np.floor(np.arange(length) / pitch_px)
    middle = np.floor((cell + 0.5) * pitch_px).astype(np.intp)
    return np.clip(middle, 0, length - 1)
