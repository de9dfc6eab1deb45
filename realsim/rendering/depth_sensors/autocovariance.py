"""How the residuals of planes are alike at a distance: size, radius and shape of a sensor's noise.

The picture is cut into tiles; products of residuals are summed per tile, so that every figure's
uncertainty comes from leaving tiles out (a jackknife), whatever the noise looks like.
"""

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array, Array32, Mask

LAGS = 16
"""Distances that are looked at [px]."""
TILE_PX = 64
"""Side of a tile [px]: several radii of the noise, so that tiles are nearly independent."""
TRENDS_PX = (24.0, 10.0, 5.0)
"""Gaussian radius of what counts as slow: bowls and stripes, no noise [px]. The smaller ones are
for surfaces that are not quite flat, whose residuals would stay alike over any distance."""
TAIL = 0.22
"""Autocorrelation at the longest lags from which on a surface is not flat enough: noise of a radius
of 10 px reaches 0.15."""
WILD = 4.0
"""Tiles whose variance exceeds this many medians hold an edge or a bump."""
GROUPS = 16
"""Groups of tiles that the jackknife leaves out in turn."""
WHITE_PX = 0.45
"""A correlation below this radius is none: neighbours then share less than 0.3."""
CLIP = 6.0
"""Residuals beyond so many robust deviations are faults, no noise."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TileSums:
    """Sums of products per tile: (N, 2, LAGS + 1), along rows and along columns."""

    products: Array
    counts: Array

    @staticmethod
    def joined(parts: Sequence["TileSums"]) -> "TileSums":
        """Return the tiles of several pictures as one."""
        return TileSums(
            products=np.concatenate([p.products for p in parts]),
            counts=np.concatenate([p.counts for p in parts]),
        )

    def covariance(self, left_out: Mask | None = None) -> Array:
        """Return the autocovariance (2, LAGS + 1) [px^2], without the tiles (N,) left out."""
        keep = slice(None) if left_out is None else ~left_out
        return self.products[keep].sum(0) / np.maximum(self.counts[keep].sum(0), 1)


@dataclass(frozen=True, slots=True)
class NoiseShape:
    """Size and extent of noise."""

    sigma_px: float
    """Standard deviation of the fast part [px of disparity]."""
    radius_px: float
    """Its Gaussian radius along rows [px]."""
    aspect: float
    """Radius along columns over that along rows."""
    slow_sigma_px: float
    """Standard deviation of the slow part [px]; 0 = none is needed."""
    slow_radius_px: float
    """Its radius along rows [px]; the aspect is the same."""


def without_trend(residual: Array32, radius_px: float = TRENDS_PX[0]) -> tuple[Array32, Array32]:
    """Return residuals (H, W) less their local mean, and that mean; NaN stays NaN."""
    import cv2

    known = np.isfinite(residual)
    filled = np.where(known, residual, 0).astype(np.float32)
    weight = cv2.GaussianBlur(known.astype(np.float32), (0, 0), radius_px)
    mean = cv2.GaussianBlur(filled, (0, 0), radius_px) / np.maximum(weight, 1e-3)
    fast = np.where(known, residual - mean, np.nan)
    spread = 1.4826 * float(np.nanmedian(np.abs(fast)))
    fast = np.where(np.abs(fast) <= CLIP * max(spread, 1e-6), fast, np.nan)
    return fast.astype(np.float32), np.where(known, mean, np.nan).astype(np.float32)


def steady_sums(residuals: Sequence[Array32]) -> tuple[TileSums, float]:
    """Return the tile sums of residuals (H, W) less their trend, and the trend's radius [px].

    The widest trend is taken at which the residuals are no longer alike at a distance.
    """
    for trend in TRENDS_PX[:-1]:
        sums = _calm_sums(residuals, trend)
        covariance = sums.covariance()
        rho = covariance / np.maximum(covariance[:, :1], 1e-12)
        if float(rho[:, LAGS - 2 :].mean(1).max()) < TAIL:
            return sums, trend
    return _calm_sums(residuals, TRENDS_PX[-1]), TRENDS_PX[-1]


def _calm_sums(residuals: Sequence[Array32], trend_px: float) -> TileSums:
    """Return the tile sums without the tiles that hold an edge or a bump."""
    sums = TileSums.joined([tile_sums(without_trend(r, trend_px)[0]) for r in residuals])
    if len(sums.products) == 0:
        return sums
    variance = sums.products[:, 0, 0] / np.maximum(sums.counts[:, 0, 0], 1)
    calm = variance <= WILD * float(np.median(variance))
    return TileSums(products=sums.products[calm], counts=sums.counts[calm])


def tile_sums(fast: Array32) -> TileSums:
    """Return the sums of products of residuals (H, W) that lie 0 to LAGS apart, per tile."""
    known = np.isfinite(fast)
    r = np.where(known, fast, 0).astype(np.float64)
    products: list[list[Array]] = []
    counts: list[list[Array]] = []
    for axis in (1, 0):
        along: list[Array] = []
        number: list[Array] = []
        for lag in range(LAGS + 1):
            ahead, here = _pair(r, lag, axis)
            ahead_known, here_known = _pair(known, lag, axis)
            along.append(_per_tile(ahead * here))
            number.append(_per_tile((ahead_known & here_known).astype(np.float64)))
        products.append(along)
        counts.append(number)
    p = np.asarray(products).transpose(2, 0, 1)
    n = np.asarray(counts).transpose(2, 0, 1)
    kept = n[:, 0, 0] >= 0.2 * TILE_PX**2
    return TileSums(products=p[kept], counts=n[kept])


def _pair(values: NDArray[Any], lag: int, axis: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return values and those a lag further, both cut to the same frame."""
    height, width = values.shape[0] - LAGS, values.shape[1] - LAGS
    down, right = (lag, 0) if axis == 0 else (0, lag)
    return values[down : down + height, right : right + width], values[:height, :width]


def _per_tile(values: Array) -> Array:
    """Return the sum of each tile (N,)."""
    rows = np.arange(0, values.shape[0], TILE_PX)
    columns = np.arange(0, values.shape[1], TILE_PX)
    return np.add.reduceat(np.add.reduceat(values, rows, 0), columns, 1).ravel()


def fit_noise(
    sums: TileSums, rounding_px2: float, trend_px: float = TRENDS_PX[0]
) -> tuple[NoiseShape, NoiseShape | None]:
    """Return the noise behind the residuals, and its uncertainty (one standard deviation).

    The autocovariance of white noise that was smoothed with a Gaussian of radius s is
    sigma^2 exp(-lag^2 / (4 s^2)); rounding adds `rounding_px2` at lag 0 alone. A second, slower
    part is taken in where it halves what the first leaves unexplained.

    Args:
        sums: of all pictures.
        rounding_px2: variance of the rounding of disparity and depth [px^2].
        trend_px: radius of the trend that was taken out [px].
    """
    covariance = sums.covariance()
    best, two = _fitted(covariance, rounding_px2, None, trend_px)
    n = len(sums.products)
    groups = min(GROUPS, n)
    if groups < 4:
        return best, None
    order = np.arange(n) % groups
    parts = [
        astuple(_fitted(sums.covariance(order == g), rounding_px2, two, trend_px)[0])
        for g in range(groups)
    ]
    spread = np.sqrt((groups - 1) * np.var(np.array(parts), axis=0))
    return best, NoiseShape(*(float(v) for v in spread))


def _fitted(
    covariance: Array, rounding: float, two: bool | None, trend_px: float
) -> tuple[NoiseShape, bool]:
    """Return the fit to a covariance (2, LAGS + 1), and whether it has a slow part."""
    total = float(covariance[:, 0].mean())
    rho = covariance / max(total, 1e-12)
    if float(rho[:, 1].mean()) < np.exp(-1 / (4 * WHITE_PX**2)):
        sigma = float(np.sqrt(max(total - rounding, 0)))
        return NoiseShape(sigma, 0.0, 1.0, 0.0, 0.0), False
    floor = min(rounding / max(total, 1e-12), 0.9)
    one_fit, one_cost = _solve(rho, floor, trend_px, slow=False)
    if two is False:
        return _scaled(one_fit, total), False
    two_fit, two_cost = _solve(rho, floor, trend_px, slow=True)
    # What is slower than the trend went with it.
    slower = 2 * two_fit[1] < two_fit[4] < trend_px and two_fit[3] > 0.15
    if two or (slower and two_cost < 0.35 * one_cost and one_cost > LEAST_MISFIT):
        return _scaled(two_fit, total), True
    return _scaled(one_fit, total), False


LEAST_MISFIT = 1e-4
"""Mean squared misfit of the autocorrelation that needs an explanation."""


def _solve(rho: Array, floor: float, trend_px: float, *, slow: bool) -> tuple[list[float], float]:
    """Return sigma, radius, aspect, slow sigma, slow radius of a correlation, and the misfit."""
    from scipy.optimize import least_squares

    # Near lags decide what a matcher and a filter see; far ones are left-over trend.
    weight = 1 / (1 + np.arange(LAGS + 1) / 4)

    def model(x: Array) -> Array:
        fast = x[0] ** 2 * detrended_correlation(x[1], x[1] * x[2], trend_px)
        if slow:
            fast = fast + x[3] ** 2 * detrended_correlation(x[4], x[4] * x[2], trend_px)
        fast[:, 0] += floor
        return fast

    def misfit(x: Array) -> Array:
        return ((model(x) - rho) * weight).ravel()

    start, low, high = [0.9, 1.5, 1.0], [0.0, 0.3, 0.2], [1.2, 8.0, 5.0]
    if slow:
        start, low, high = [0.7, 1.5, 1.0, 0.6, 6.0], [*low, 0.0, 2.0], [*high, 1.2, 20.0]
    found: Any = least_squares(misfit, start, bounds=(low, high))
    x = [float(v) for v in found.x]
    return (x if slow else [*x, 0.0, 0.0]), float(np.mean(np.square(found.fun)))


def detrended_correlation(radius_u: float, radius_v: float, trend_px: float) -> Array:
    """Return the autocorrelation (2, LAGS + 1) of smoothed white noise less its local mean.

    Smoothing with a Gaussian of radius s gives a Gaussian of variance V = 2 s^2 in the lag. The
    local mean is a convolution g with variance T^2, so what is left is R - 2 R*g + R*g*g, each a
    Gaussian again, wider by T^2 or 2 T^2 and lower by sqrt(V / (V + T^2)) along each axis.
    """
    lag2 = np.square(np.arange(LAGS + 1, dtype=np.float64))
    u, v = 2 * radius_u**2, 2 * radius_v**2
    total = np.zeros((2, LAGS + 1))
    for factor, wider in ((1.0, 0.0), (-2.0, trend_px**2), (1.0, 2 * trend_px**2)):
        height = factor * np.sqrt(u / (u + wider) * v / (v + wider))
        total[0] += height * np.exp(-lag2 / (2 * (u + wider)))
        total[1] += height * np.exp(-lag2 / (2 * (v + wider)))
    return total


def _scaled(x: list[float], total: float) -> NoiseShape:
    unit = float(np.sqrt(max(total, 0)))
    return NoiseShape(x[0] * unit, x[1], x[2], x[3] * unit, x[4])
