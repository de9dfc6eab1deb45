"""From the pictures of two eyes to disparity: semi-global search, sub-pixels, what is kept.

The search is OpenCV's (Hirschmueller, PAMI 2008) over the range that the scene can have; what it
finds is refined and judged on the images by `subpixel`.

Sub-pixel disparity on the grey values, without pixel-locking.

Semi-global matching fits a parabola to three integer costs, which draws disparities to whole
pixels (Shimizu and Okutomi, ICCV 2001) and makes bands on tilted surfaces. Here the shift of each
window is solved for on the images (Lucas and Kanade, IJCAI 1981, along the row): with e = left -
right(u - d) and g the mean gradient of both, delta = -cov(g, e) / var(g); means are taken out, so
that a difference of brightness between the eyes does no harm. Value and gradient of the right eye
are interpolated by the same weights: noise in e and g stays uncorrelated, or it would lock too.
Only pixels at nearly the same disparity share a window, so edges do not bend, and every pixel is
compared at its own smoothed disparity, so tilted surfaces are as good as facing ones.
"""

from typing import Any

import numpy as np

from realsim.arrays import Array32, UInt8
from realsim.compiled import njit
from realsim.rendering.stereo.config import StereoConfig

SIMILAR_PX = np.float32(1.0)
"""Neighbours whose disparity differs by more are another surface [px]."""
STEPS = 2
"""Newton steps: the first leaves a tenth of the parabola's error, the second nothing."""
GREATEST_STEP_PX = np.float32(0.75)
"""A larger correction means that the integer match was wrong."""


def refined(
    left: UInt8, right: UInt8, disparity: Array32, window_px: int
) -> tuple[Array32, Array32, Array32]:
    """Return the disparity on sub-pixels and how well it is founded.

    Args:
        left: (H, W) the reference.
        right: (H, W).
        disparity: (H, W) the integer matcher's [px]; 0 = none.
        window_px: edge of the window.

    Returns:
        disparity (H, W) [px], 0 = none; mean square gradient in the window (H, W) and mean square
        of what the matched windows differ by (H, W), both of bytes and free of their means.
    """
    shape = disparity.shape
    ours, theirs = left.astype(np.float32), right.astype(np.float32)
    slopes = _central_slope(ours), _central_slope(theirs)
    half = window_px // 2
    current, following = np.empty(shape, np.float32), np.empty(shape, np.float32)
    _smooth(disparity, following)
    error, gradient = np.empty(shape, np.float32), np.empty(shape, np.float32)
    texture, residual = np.empty(shape, np.float32), np.empty(shape, np.float32)
    for _ in range(STEPS):
        # A window corrects its pixels together: what varies within it must be gone before.
        _smooth(following, current)
        _compare(ours, theirs, slopes[0], slopes[1], current, error, gradient)
        _solve(current, error, gradient, half, following, texture, residual)
    return following, texture, residual


def _central_slope(image: Array32) -> Array32:
    """Return the change per pixel along the row (H, W)."""
    out = np.zeros_like(image)
    np.subtract(image[:, 2:], image[:, :-2], out=out[:, 1:-1])
    out *= np.float32(0.5)
    return out


@njit(fastmath=True)
def _smooth(disparity: Array32, out: Array32) -> None:
    """Write the mean disparity of the similar neighbours, every other one of a 9x9 window."""
    height, width = disparity.shape
    zero, one = np.float32(0.0), np.float32(1.0)
    total, count = np.empty(width, np.float32), np.empty(width, np.float32)
    for v in range(height):
        center = disparity[v]
        total[:] = zero
        count[:] = zero
        for dv in range(-4, 5, 2):
            if v + dv < 0 or v + dv >= height:
                continue
            row = disparity[v + dv]
            for u in range(4, width - 4):
                c, t, k = center[u], zero, zero
                for i in range(5):  # unrolled by the compiler, so that the loop above is vectorised
                    n = row[u - 4 + 2 * i]
                    w = one if abs(n - c) <= SIMILAR_PX else zero
                    t += w * n
                    k += w
                total[u] += t
                count[u] += k
        for u in range(width):
            found = center[u] > 0 and count[u] > 0
            out[v, u] = total[u] / count[u] if found else center[u]


@njit(fastmath=True)
def _compare(
    left: Array32,
    right: Array32,
    left_slope: Array32,
    right_slope: Array32,
    disparity: Array32,
    error: Array32,
    gradient: Array32,
) -> None:
    """Write left - right(u - d) and the mean slope; both 0 where there is no match.

    Interpolation is the cubic convolution of Keys (IEEE TASSP 1981) over four pixels.
    """
    height, width = disparity.shape
    f = np.float32
    for v in range(height):
        for u in range(width):
            d = disparity[v, u]
            x = f(u) - d
            i = int(np.floor(x))
            if d <= 0 or i < 1 or i + 2 >= width:
                error[v, u] = f(0.0)
                gradient[v, u] = f(0.0)
                continue
            t = x - f(i)
            t2 = t * t
            t3 = t2 * t
            w0 = f(0.5) * (f(2.0) * t2 - t3 - t)
            w1 = f(1.0) + f(0.5) * (f(3.0) * t3 - f(5.0) * t2)
            w2 = f(0.5) * (f(4.0) * t2 - f(3.0) * t3 + t)
            w3 = f(0.5) * (t3 - t2)
            r, s = right[v], right_slope[v]
            value = w0 * r[i - 1] + w1 * r[i] + w2 * r[i + 1] + w3 * r[i + 2]
            slope = w0 * s[i - 1] + w1 * s[i] + w2 * s[i + 1] + w3 * s[i + 2]
            error[v, u] = left[v, u] - value
            gradient[v, u] = f(0.5) * (left_slope[v, u] + slope)


@njit(fastmath=True)
def _row_sums(
    disparity: Array32, error: Array32, gradient: Array32, half: int, sums: Array32
) -> None:
    """Write for each pixel of a row the sums over its similar neighbours in the row.

    Args:
        disparity: (W,).
        error: (W,) e.
        gradient: (W,) g.
        half: neighbours to either side.
        sums: (6, W) changed: count, g, e, gg, ge, ee.
    """
    width = len(disparity)
    sums[:] = np.float32(0.0)
    for du in range(-half, half + 1):
        first, last = max(0, -du), min(width, width - du)
        c, n = disparity[first:last], disparity[first + du : last + du]
        e, g = error[first + du : last + du], gradient[first + du : last + du]
        k, sg, se = sums[0, first:last], sums[1, first:last], sums[2, first:last]
        gg, ge, ee = sums[3, first:last], sums[4, first:last], sums[5, first:last]
        for i in range(last - first):
            w = np.float32(1.0) if abs(n[i] - c[i]) <= SIMILAR_PX else np.float32(0.0)
            wg, we = w * g[i], w * e[i]
            k[i] += w
            sg[i] += wg
            se[i] += we
            gg[i] += wg * g[i]
            ge[i] += wg * e[i]
            ee[i] += we * e[i]


@njit(fastmath=True)
def _add_similar(center: Array32, other: Array32, sums: Array32, total: Array32) -> None:
    """Add to a row's sums those of another row, where the disparity is similar."""
    for channel in range(6):
        s, t = sums[channel], total[channel]
        for u in range(len(center)):
            w = np.float32(1.0) if abs(other[u] - center[u]) <= SIMILAR_PX else np.float32(0.0)
            t[u] += w * s[u]


@njit(fastmath=True)
def _solve(
    disparity: Array32,
    error: Array32,
    gradient: Array32,
    half: int,
    out: Array32,
    texture: Array32,
    residual: Array32,
) -> None:
    """Write the corrected disparity, the windows' texture and their residual.

    A window is summed first along rows, then along the column: a neighbour counts if it is similar
    to the one in its row that is similar to the centre.
    """
    height, width = disparity.shape
    f = np.float32
    zero, one = f(0.0), f(1.0)
    span = 2 * half + 1
    rows = np.zeros((span, 6, width), np.float32)
    total = np.empty((6, width), np.float32)
    for ahead in range(height + half):
        if ahead < height:
            _row_sums(disparity[ahead], error[ahead], gradient[ahead], half, rows[ahead % span])
        v = ahead - half
        if v < 0:
            continue
        center = disparity[v]
        total[:] = zero
        for row in range(max(0, v - half), min(height, v + half + 1)):
            _add_similar(center, disparity[row], rows[row % span], total)
        for u in range(width):
            if center[u] <= 0:
                out[v, u] = zero
                texture[v, u] = zero
                residual[v, u] = zero
                continue
            share = one / total[0, u]
            mg, me = total[1, u] * share, total[2, u] * share
            var = max(total[3, u] * share - mg * mg, f(1e-6))
            cov = total[4, u] * share - mg * me
            # A larger d moves the sample down the slope: e = -g (true d - d).
            step = -cov / var
            texture[v, u] = var
            residual[v, u] = max(total[5, u] * share - me * me - cov * cov / var, zero)
            out[v, u] = center[u] + step if abs(step) <= GREATEST_STEP_PX else zero


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
