"""From the pictures of two eyes to disparity: semi-global search, sub-pixels, what is kept.

The search is OpenCV's (Hirschmueller, PAMI 2008) over the range that the scene can have; what it
finds is refined and judged on the images by `subpixel`.
"""

from typing import Any

import numpy as np

from realsim.arrays import Array32, UInt8
from realsim.compiled import njit
from realsim.rendering.stereo.config import StereoConfig
from realsim.rendering.stereo.subpixel import refined

SEARCH_BLOCK_PX = 5
"""Edge of the window of the search [px]; small, because the smoothness does the rest."""
SMALL_STEP = 8
LARGE_STEP = 32
"""Penalties of a change of disparity by one and by more, per pixel of the block (OpenCV's)."""
SEARCH_STEP_PX = 16
"""OpenCV searches multiples of this many disparities."""
SEARCHED_ROWS = 2
"""Every so many rows are searched; the sub-pixel step then moves every pixel to its own place. It
halves the search, and a row's match is within a pixel of its neighbour's."""
BAND_PX = 48
"""Searched rows that are searched over the same disparities."""
LEAD_PX = 12
"""Rows above a band from which the smoothness is carried into it."""
GRADIENT_NOISE = 0.25
"""Variance of the mean of two central differences, per variance of a pixel."""
DIFFERENCE_NOISE = 2.0
"""Variance of the difference of two pixels, per variance of one."""
ALIASING = 0.06
"""Share of the squared gradient by which equal surfaces differ between the eyes: they are sampled
at different places."""


def matched(left: UInt8, right: UInt8, exact: Array32, config: StereoConfig) -> Array32:
    """Return the disparity (H, W) [px] of the left eye's pixels, 0 = none.

    Args:
        left: (H, W).
        right: (H, W), the same rows.
        exact: (H, W) true disparity [px], 0 = nothing in range. It only bounds the search: the
            real chip goes through 128 disparities for every pixel.
        config: windows and limits.
    """
    import cv2

    rows = slice(None, None, SEARCHED_ROWS)
    found = _searched_in_bands(left[rows], right[rows], exact[rows], config)
    whole = np.repeat(found, SEARCHED_ROWS, axis=0)[: left.shape[0]]
    disparity, texture, residual = refined(left, right, whole, config.window_px)
    level = np.asarray(cv2.blur(left, (config.window_px,) * 2), np.uint8)
    limits = (*config.electron_noise, config.least_texture_snr**2, config.residual_limit**2)
    _judge(disparity, texture, residual, level, np.array(limits, np.float32))
    return _without_speckles(disparity, config.speckle_px)


@njit
def _judge(
    disparity: Array32, texture: Array32, residual: Array32, level: UInt8, limits: Array32
) -> None:
    """Set to 0 what has too little texture, fits badly, or lies left of the right eye's picture."""
    dark, per_value, least_texture, greatest_residual = limits
    f = np.float32
    for v in range(disparity.shape[0]):
        for u in range(disparity.shape[1]):
            value = f(level[v, u]) * f(1 / 255)
            # Rounding to bytes is noise of 1/12 as well.
            pixel = (dark + value * per_value) * f(255**2) + f(1 / 12)
            expected = f(DIFFERENCE_NOISE) * pixel + f(ALIASING) * texture[v, u]
            if (
                texture[v, u] < least_texture * f(GRADIENT_NOISE) * pixel
                or residual[v, u] > greatest_residual * expected
                or not 0 < disparity[v, u] <= f(u)
            ):
                disparity[v, u] = f(0.0)


def _searched_in_bands(left: UInt8, right: UInt8, exact: Array32, config: StereoConfig) -> Array32:
    """Return the semi-global match (H, W) [px], 0 = none, searched band by band of rows.

    On a table the distance changes from top to bottom: a band spans half the disparities.
    """
    height = left.shape[0]
    found = np.zeros(left.shape, np.float32)
    for top in range(0, height, BAND_PX):
        bottom = min(top + BAND_PX, height)
        there = exact[top:bottom] > 0
        columns = np.flatnonzero(there.any(0))
        if len(columns) == 0:
            continue
        seen = exact[top:bottom][there]
        span = (float(seen.min()), float(seen.max()))
        # Where nothing is in range nothing is searched; the right eye's part lies further left.
        reach = int(span[1]) + config.search_margin_px + SEARCH_STEP_PX + LEAD_PX
        first = max(0, int(columns[0]) - reach)
        window = slice(first, min(left.shape[1], int(columns[-1]) + 1 + LEAD_PX))
        rows = slice(max(0, top - LEAD_PX), min(height, bottom + SEARCH_BLOCK_PX))
        band = _searched(left[rows, window], right[rows, window], span, config)
        found[top:bottom, window] = band[top - rows.start : bottom - rows.start]
    return found


def _searched(
    left: UInt8, right: UInt8, search: tuple[float, float], config: StereoConfig
) -> Array32:
    """Return the semi-global match (H, W) [px], to sixteenths, 0 = none.

    Args:
        left: (H, W).
        right: (H, W).
        search: least and greatest disparity of what is in view [px].
        config: margin and limits.
    """
    import cv2

    least = max(0, int(np.floor(search[0])) - config.search_margin_px)
    greatest = int(np.ceil(search[1])) + config.search_margin_px
    count = -(-(greatest - least + 1) // SEARCH_STEP_PX) * SEARCH_STEP_PX
    # OpenCV gives up the columns left of the greatest disparity: they are lent a border.
    border = least + count
    wide = [cv2.copyMakeBorder(i, 0, 0, border, 0, cv2.BORDER_REPLICATE) for i in (left, right)]
    area = SEARCH_BLOCK_PX**2
    matcher: Any = cv2.StereoSGBM.create(
        minDisparity=least, numDisparities=count, blockSize=SEARCH_BLOCK_PX,
        P1=SMALL_STEP * area, P2=LARGE_STEP * area, disp12MaxDiff=config.left_right_px,
        preFilterCap=63, uniquenessRatio=config.uniqueness_percent,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    sixteenths = matcher.compute(*wide)[:, border:]
    found = sixteenths.astype(np.float32) * np.float32(1 / 16)
    found[sixteenths < 16 * least] = 0
    return np.maximum(found, 0)


def _without_speckles(disparity: Array32, least_px: int) -> Array32:
    """Return the disparity without islands of fewer pixels than `least_px`."""
    import cv2

    if least_px <= 1:
        return disparity
    sixteenths = (disparity * np.float32(16)).astype(np.int16)
    cv2.filterSpeckles(sixteenths, 0, least_px - 1, 16)
    return np.where(sixteenths > 0, disparity, np.float32(0))
