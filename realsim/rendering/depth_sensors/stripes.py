"""Errors that stay in every frame: upright and lying stripes, and slow bowls."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from realsim.rendering.depth_sensors.estimate import Estimate
from realsim.rendering.depth_sensors.plane import PlaneView

Array = NDArray[np.float64]
LEAST_LINES = 25
"""Pixels of a row or column that its mean needs."""
STRIPE_PX = 60.0
"""Width that counts as one independent stripe [px]."""


def bands_of(planes: Sequence[PlaneView]) -> dict[str, Estimate]:
    """Return the deviation of upright and lying stripes [px].

    The means of a column over the upper and over the lower half of the plane share the stripe, not
    the noise: their covariance over the columns is the stripes' variance.
    """
    upright = [_halves(_without_bowl(p), 0) for p in planes]
    lying = [_halves(_without_bowl(p), 1) for p in planes]
    return {
        "column_band_px": _shared(upright),
        "row_band_px": _shared(lying),
    }


def _halves(residual: Array, axis: int) -> Array:
    """Return the means (2, N) of each line over the plane's two halves."""
    known = np.isfinite(residual)
    parts: list[Array] = []
    order = np.cumsum(known, axis=axis)
    half = order[-1:, :] / 2 if axis == 0 else order[:, -1:] / 2
    for part in (known & (order <= half), known & (order > half)):
        n = part.sum(axis)
        total = np.where(part, residual, 0).sum(axis)
        parts.append(np.where(n >= LEAST_LINES, total / np.maximum(n, 1), np.nan))
    return np.stack(parts)


def _shared(pairs: Sequence[Array]) -> Estimate:
    """Return the deviation that both halves share, over all planes."""
    covariance: list[float] = []
    errors: list[float] = []
    for pair in pairs:
        both = np.isfinite(pair).all(0)
        if both.sum() < 2 * STRIPE_PX:
            continue
        a, b = (x - x.mean() for x in pair[:, both])
        lines = both.sum() / STRIPE_PX
        covariance.append(float(np.mean(a * b)))
        errors.append(float((a.var() * b.var() + covariance[-1] ** 2) / lines))
    if not covariance:
        return Estimate(0.0, float("inf"), False, "the planes are too narrow to show stripes.")
    variance = float(np.mean(covariance))
    spread = float(np.sqrt(np.sum(errors)) / len(errors))
    if variance < 2 * spread:
        return Estimate(0.0, float(np.sqrt(max(variance, 0) + spread)), True)
    sigma = float(np.sqrt(variance))
    return Estimate(sigma, spread / (2 * sigma), True)


def _bowl(plane: PlaneView) -> tuple[Array, Array]:
    """Return the quadratic part (H, W) of the residual, and the residual without it."""
    r = plane.residual.astype(np.float64)
    height, width = r.shape
    v, u = np.mgrid[:height, :width]
    x, y = 2 * u / width - 1, 2 * v / height - 1
    A = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    known = np.isfinite(r)
    some = slice(None, None, max(1, int(known.sum()) // 50_000))
    c = np.linalg.lstsq(A[known][some], r[known][some], rcond=None)[0]
    return (A[..., 3:] * c[3:]).sum(-1), r - (A * c).sum(-1)


def _without_bowl(plane: PlaneView) -> Array:
    return _bowl(plane)[1]


def without_bands(plane: PlaneView, bands: Mapping[str, Estimate]) -> NDArray[np.float32]:
    """Return the residual (H, W) [px] less the mean of each line, where there are stripes."""
    r = _without_bowl(plane)
    for name, axis in (("column_band_px", 0), ("row_band_px", 1)):
        if bands[name].value > 0:
            known = np.isfinite(r)
            n = known.sum(axis, keepdims=True)
            mean = np.where(known, r, 0).sum(axis, keepdims=True) / np.maximum(n, 1)
            r = r - np.where(n >= LEAST_LINES, mean, 0)
    return r.astype(np.float32)


def warp_of(planes: Sequence[PlaneView]) -> Estimate:
    """Return the deviation of the bowl [px] over the plane."""
    if len(planes) < 2:
        bent = _bowl(planes[0])[0][planes[0].mask]
        return Estimate(
            0.0, float(np.std(bent)), False,
            f"one plane's residual bends by {float(np.std(bent)):.2f} px (standard deviation); one "
            "frame cannot tell a bent wall from a bent sensor. Add frames from other places.",
        )  # fmt: skip
    bowls = [_bowl(p)[0] for p in planes]
    common = np.logical_and.reduce([p.mask for p in planes])
    if common.sum() < LEAST_LINES**2:
        return Estimate(0.0, float("inf"), False, "the planes share no part of the picture.")
    inside = np.array([b[common] - b[common].mean() for b in bowls])
    products = inside @ inside.T / inside.shape[1]
    pairs = products[np.triu_indices(len(planes), 1)]
    variance = float(np.mean(pairs))
    spread = float(np.std(pairs) / np.sqrt(len(pairs)) + 0.1 * abs(variance))
    sigma = float(np.sqrt(max(variance, 0)))
    if variance < 2 * spread:
        return Estimate(0.0, float(np.sqrt(max(variance, 0) + spread)), True)
    return Estimate(sigma, spread / (2 * sigma), True)
