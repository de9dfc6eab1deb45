"""What planes show beside noise: errors that stay in every frame, and holes."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from math import isfinite
from typing import Any

import numpy as np

from realsim.arrays import Array, Array32, Int64
from realsim.rendering.depth_sensors.plane import PlaneView


@dataclass(frozen=True, slots=True)
class Estimate:
    """A parameter as the frames show it."""

    value: float
    uncertainty: float
    """One standard deviation; inf where the frames say nothing."""
    determined: bool
    """Whether the frames say anything; otherwise the profile's value is kept."""
    note: str = ""
    """Why not, or on what ground; empty where there is nothing to say."""

    def document(self) -> dict[str, Any]:
        """Return the estimate for JSON, which knows no infinity: null stands for it."""
        known = self.uncertainty if isfinite(self.uncertainty) else None
        return asdict(self) | {"uncertainty": known}


LEAST_LINES = 25
"""Pixels of a row or column that its mean needs."""
STRIPE_PX = 60.0
"""Width that counts as one independent stripe [px]."""


def bands_of(planes: Sequence[PlaneView]) -> dict[str, Estimate]:
    """Return the deviation of upright and lying stripes [px].

    The means of a column over the upper and over the lower half of the plane share the stripe, not
    the noise: their covariance over the columns is the stripes' variance.
    """
    flat = [_without_bowl(p) for p in planes]
    upright, lying = ([_halves(r, axis) for r in flat] for axis in (0, 1))
    return {"column_band_px": _shared(upright), "row_band_px": _shared(lying)}


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


def without_bands(plane: PlaneView, bands: Mapping[str, Estimate]) -> Array32:
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


BIN_DEG = 3.0
"""Width of a bin of the angle between ray and normal [deg]."""
LEAST_PX = 2000
"""Pixels that a bin needs."""
BLOBS_BELOW_DEG = 50.0
"""Holes of surfaces seen less obliquely have another cause than obliquity."""
CLEAR, STRONG = 0.1, 0.4
"""Loss at which obliquity shows, and up to which it must be seen to know its slope."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class HoleCount:
    """Share of unmeasured pixels by the angle between ray and surface normal."""

    angle_deg: Array
    """(N,) middle of each bin [deg]."""
    pixels: Int64
    """(N,) pixels of the planes in it."""
    share: Array
    """(N,) of them that are holes; NaN where there are none."""

    def rows(self) -> list[dict[str, float]]:
        """Return the bins that hold anything, for JSON."""
        return [
            {"angle_deg": float(a), "pixels": int(n), "hole_share": float(s)}
            for a, n, s in zip(self.angle_deg, self.pixels, self.share, strict=True)
            if n > 0
        ]


def count_holes(planes: Sequence[PlaneView]) -> HoleCount:
    """Return the share of holes by angle over all planes."""
    edges = np.arange(0, 90 + BIN_DEG, BIN_DEG)
    total = np.zeros(len(edges) - 1, np.int64)
    lost = np.zeros(len(edges) - 1, np.int64)
    for plane in planes:
        counted = plane.area & (plane.mask | plane.holes)
        total += np.histogram(plane.angle_deg[counted], edges)[0]
        lost += np.histogram(plane.angle_deg[plane.holes], edges)[0]
    share = np.where(total > 0, lost / np.maximum(total, 1), np.nan)
    return HoleCount(angle_deg=(edges[:-1] + edges[1:]) / 2, pixels=total, share=share)


def blobs_of(planes: Sequence[PlaneView]) -> dict[str, Estimate]:
    """Return how many holes without cause there are, and how large."""
    import cv2

    sizes: list[int] = []
    pixels = 0
    for plane in planes:
        frontal = plane.area & (plane.angle_deg < BLOBS_BELOW_DEG)
        pixels += int(frontal.sum())
        holes = (plane.holes & frontal).astype(np.uint8)
        count, _, stats, _ = cv2.connectedComponentsWithStats(holes)
        sizes += [int(s) for s in stats[1:count, cv2.CC_STAT_AREA]]
    if pixels < 10 * LEAST_PX:
        note = f"fewer than {10 * LEAST_PX} pixels are seen at less than {BLOBS_BELOW_DEG:.0f} deg."
        return {"blobs_per_megapixel": Estimate(0.0, float("inf"), False, note)}
    density = 1e6 * len(sizes) / pixels
    if not sizes:
        return {"blobs_per_megapixel": Estimate(0.0, 1e6 / pixels, True)}
    # A drawn ellipse of half-axis h covers pixel centres up to h + 1/2.
    radius = max(float(np.sqrt(np.mean(sizes) / np.pi)) - 0.5, 0.5)
    spread = float(np.std(np.sqrt(np.array(sizes) / np.pi)) / np.sqrt(len(sizes)))
    return {
        "blobs_per_megapixel": Estimate(density, density / np.sqrt(len(sizes)), True),
        "blob_radius_px": Estimate(radius, float(np.hypot(spread, 0.1 * radius)), True),
    }


def grazing_of(holes: HoleCount) -> dict[str, Estimate]:
    """Return from where to where obliquity loses pixels: a ramp through the shares by angle."""
    from scipy.optimize import least_squares

    full = holes.pixels >= LEAST_PX
    angle, share, pixels = holes.angle_deg[full], holes.share[full], holes.pixels[full]
    steepest = float(angle.max()) if full.any() else 0.0
    flat = share[angle < BLOBS_BELOW_DEG]
    base = float(np.median(flat)) if len(flat) else 0.0
    shown = share - base
    if not full.any() or float(shown.max()) < STRONG or float(shown.min()) > CLEAR:
        seen = f"{100 * float(share.max()):.1f} %" if full.any() else "nothing"
        note = (
            f"planes are seen at up to {steepest:.0f} deg, where {seen} is lost: that does not say "
            "from where to where obliquity loses pixels. Add frames of the plane seen edge-on."
        )
        return {"grazing_from_deg": Estimate(0.0, float("inf"), False, note)}
    # Where most is lost the plane's own extent is not seen either: those bins show too little.
    until = int(np.argmax(shown > STRONG)) + 1
    angle, share, pixels = angle[:until], share[:until], pixels[:until]
    weight = np.sqrt(pixels / pixels.max())

    def misfit(x: Array) -> Array:
        ramp = np.clip((angle - x[0]) / max(x[1], 0.5), 0, 1)
        return weight * (base + (1 - base) * ramp - share)

    start = float(angle[np.argmax(shown > CLEAR)])
    fit: Any = least_squares(misfit, [start - 3, 15.0], bounds=([20, 0.5], [90, 70]))
    inverse = np.linalg.pinv(fit.jac.T @ fit.jac)
    noise = 2 * fit.cost / max(len(angle) - 2, 1)
    sd = np.sqrt(np.maximum(np.diag(inverse) * noise, 0))
    first, width = float(fit.x[0]), float(fit.x[1])
    return {
        "grazing_from_deg": Estimate(first, float(np.hypot(sd[0], 1.0)), True),
        "grazing_to_deg": Estimate(first + width, float(np.hypot(sd[0] + sd[1], 4.0)), True),
    }
