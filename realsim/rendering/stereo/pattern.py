"""The infrared dot projector: a fixed pseudo-random constellation on the tangent plane.

Dots stand on a jittered grid of equal angular pitch: random enough to be unique within the search
range, even enough that every matching window holds one (as the D400 projectors' do).
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Array32 = NDArray[np.float32]
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
