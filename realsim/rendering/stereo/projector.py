"""The projector between the eyes: its pattern of dots or stripes, and what it reaches."""

from functools import lru_cache

import numpy as np

from realsim.arrays import Array32
from realsim.compiled import njit

TEXEL_RAD = 0.9e-3
"""Texel of the pattern on the plane at distance 1 [m]: finer than a pixel at f = 920 px."""
HALF_WIDTH = 1.15
HALF_HEIGHT = 0.75
"""Tangents of the field that is lit: 98 by 74 degrees, more than a D435 sees."""
JITTER = 0.42
"""Greatest displacement of a dot from its place on the grid, in pitches."""


@lru_cache(maxsize=4)
def dot_pattern(spacing_mrad: float, radius_mrad: float) -> Array32:
    """Return the brightness (h, w) of the pattern over the tangent plane, 1 = centre of a dot.

    Texel (i, j) lies at tangents (j TEXEL_RAD - HALF_WIDTH, i TEXEL_RAD - HALF_HEIGHT).
    """
    rng = np.random.default_rng(435)
    height, width = (int(2 * half / TEXEL_RAD) + 1 for half in (HALF_HEIGHT, HALF_WIDTH))
    pitch = spacing_mrad * 1e-3
    x, y = np.meshgrid(
        np.arange(-HALF_WIDTH, HALF_WIDTH, pitch), np.arange(-HALF_HEIGHT, HALF_HEIGHT, pitch)
    )
    x = x + pitch * (rng.uniform(-JITTER, JITTER, x.shape) + 0.5 * (np.arange(len(x)) % 2)[:, None])
    y = y + pitch * rng.uniform(-JITTER, JITTER, y.shape)
    gain = rng.uniform(0.6, 1.0, x.shape)
    out = np.zeros((height, width), np.float32)
    sigma = radius_mrad * 1e-3 / TEXEL_RAD
    reach = int(np.ceil(3 * sigma))
    u, v = (x.ravel() + HALF_WIDTH) / TEXEL_RAD, (y.ravel() + HALF_HEIGHT) / TEXEL_RAD
    iu, iv = np.round(u).astype(int), np.round(v).astype(int)
    for dv in range(-reach, reach + 1):
        for du in range(-reach, reach + 1):
            a, b = iu + du, iv + dv
            inside = (a >= 0) & (a < width) & (b >= 0) & (b < height)
            square = (a - u) ** 2 + (b - v) ** 2
            bright = gain.ravel() * np.exp(-0.5 * square / sigma**2)
            np.maximum.at(out, (b[inside], a[inside]), bright[inside].astype(np.float32))
    out.setflags(write=False)
    return out


@lru_cache(maxsize=1)
def even_field() -> Array32:
    """Return a pattern that lights its whole field evenly: stripes, averaged over their phases."""
    out = np.ones_like(dot_pattern(50.0, 3.0))
    out.setflags(write=False)
    return out


SAME_SURFACE_PX = np.float32(1.0)
"""Neighbours whose disparities differ by more are not joined [px]."""


def depth_between(left_m: Array32, right_m: Array32, fB: float, share: float) -> Array32:
    """Return the nearest depth (H, W) [m] that either eye has met, as seen from between them.

    Args:
        left_m: (H, W) first hits of the left eye [m]; 0 = nothing.
        right_m: (H, W) of the right eye, rectified with it.
        fB: focal length times baseline [px m].
        share: where it stands, in baselines from the left eye.

    Returns:
        depth [m]; 0 where neither eye has met anything.
    """
    disparity = np.zeros_like(left_m)
    _carry(left_m, np.float32(fB), np.float32(share), disparity)
    _carry(right_m, np.float32(fB), np.float32(share - 1), disparity)
    out = np.zeros_like(left_m)
    np.divide(np.float32(fB), disparity, out=out, where=disparity > 0)
    return out


@njit
def _carry(depth: Array32, fB: np.float32, share: np.float32, out: Array32) -> None:
    """Raise `out` [px] to the disparities of an eye, moved by a share of themselves.

    Disparity is linear along a plane's row, so between two neighbours it is exact.
    """
    height, width = depth.shape
    zero = np.float32(0.0)
    for v in range(height):
        before, at = zero, zero
        for u in range(width):
            d = fB / depth[v, u] if depth[v, u] > zero else zero
            x = np.float32(u) - share * d
            if d > zero and before > zero and abs(d - before) <= SAME_SURFACE_PX and x > at:
                slope = (d - before) / (x - at)
                for column in range(max(int(np.ceil(at)), 0), min(int(np.floor(x)), width - 1) + 1):
                    value = before + slope * (np.float32(column) - at)
                    out[v, column] = max(out[v, column], value)
            before, at = d, x
