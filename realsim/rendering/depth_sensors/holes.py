"""Holes in a plane: how many and how large, and how their share grows with obliquity."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.rendering.depth_sensors.estimate import Estimate
from realsim.rendering.depth_sensors.plane import PlaneView

Array = NDArray[np.float64]
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
    pixels: NDArray[np.int64]
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
