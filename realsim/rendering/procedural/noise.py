"""Noise that repeats without a seam, and the images of a material made of it.

Every field is (n, n) float32, periodic in both directions, of mean 0 and standard deviation 1
unless said otherwise. Column = u to the right, row 0 = v at the top. A field is a filtered draw
from a generator, so the same generator gives the same bytes. Colours are sRGB in [0, 255] while
they are mixed, because people choose and mix them there.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array32, Image, Int32
from realsim.rendering.appearance import Material

Values = NDArray[np.floating[Any]]
"""What numpy's mixed arithmetic makes of fields: of either precision."""


def _waves(n: int) -> tuple[Array32, Array32]:
    """Return the waves per side (1, n/2+1) along u and (n, 1) along v of a real spectrum."""
    fu = np.arange(n // 2 + 1, dtype=np.float32)[None, :]
    fv = np.fft.fftfreq(n, 1.0 / n).astype(np.float32)[:, None]
    return fu, fv


def _filtered(rng: np.random.Generator, gain: Array32) -> Array32:
    """Return white noise after a filter (n, n/2+1), normalised."""
    from scipy import fft

    n = gain.shape[0]
    spectrum: Any = fft.rfft2(rng.standard_normal((n, n), dtype=np.float32))
    spectrum *= gain
    spectrum[0, 0] = 0.0
    field = np.asarray(fft.irfft2(spectrum, s=(n, n), overwrite_x=True), np.float32)
    return field / max(float(field.std()), 1e-12)


def smooth(
    rng: np.random.Generator, n: int, waves_u: float, waves_v: float | None = None
) -> Array32:
    """Return noise with features of about 1 / waves of the side, Gaussian in frequency.

    Args:
        rng: source of the noise.
        n: side [px].
        waves_u: waves per side along u.
        waves_v: along v; default the same, so that there is no grain.
    """
    fu, fv = _waves(n)
    along_v = waves_u if waves_v is None else waves_v
    return _filtered(rng, np.exp(-0.5 * (fu / waves_u) ** 2) * np.exp(-0.5 * (fv / along_v) ** 2))


def fractal(rng: np.random.Generator, n: int, slope: float, lowest: float = 1.0) -> Array32:
    """Return clouds: the amplitude falls as frequency^-slope (fractional Brownian surface).

    Args:
        rng: source of the noise.
        n: side [px].
        slope: 1 = rough, 2.5 = soft.
        lowest: waves per side below which nothing is added.
    """
    fu, fv = _waves(n)
    f = np.sqrt(fu**2 + fv**2)
    gain = np.maximum(f, 1e-6) ** np.float32(-slope) * (1 - np.exp(-((f / lowest) ** 4)))
    return _filtered(rng, gain.astype(np.float32))


def fine(rng: np.random.Generator, n: int, waves: float) -> Array32:
    """Return an even grain with features of about 1 / waves of the side and nothing coarser."""
    fu, fv = _waves(n)
    f = np.sqrt(fu**2 + fv**2)
    return _filtered(rng, np.exp(-(((f - waves) / (0.35 * waves)) ** 2)).astype(np.float32))


def grid(n: int) -> tuple[Array32, Array32]:
    """Return u (1, n) and v (n, 1) in [0, 1) at the texel centres; v grows with the row."""
    at = ((np.arange(n) + 0.5) / n).astype(np.float32)
    return at[None, :], at[:, None]


def warped(field: Values, shift_u: Values, shift_v: Values) -> Array32:
    """Return the field looked up where the shifts (in tiles) lead, around the edges."""
    import cv2

    n = field.shape[0]
    base = np.arange(n, dtype=np.float32)
    x = np.mod(base[None, :] + shift_u * n, n).astype(np.float32)
    y = np.mod(base[:, None] + shift_v * n, n).astype(np.float32)
    out = cv2.remap(field, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return np.asarray(out, np.float32)


def blurred(field: Values, sigma_px: float) -> Array32:
    """Return the field after a Gaussian blur that goes around the edges."""
    import cv2

    pad = min(field.shape[0], int(np.ceil(4 * sigma_px)) + 1)
    wide = np.pad(field, pad, mode="wrap")
    out = np.asarray(cv2.GaussianBlur(wide, (0, 0), sigma_px), np.float32)
    return np.ascontiguousarray(out[pad:-pad, pad:-pad])


def cells(
    rng: np.random.Generator, n: int, per_side: int, jitter: float = 0.9
) -> tuple[Int32, Array32]:
    """Return a Voronoi division of the tile: grains, chips, pebbles.

    Args:
        rng: source of the seeds, one in every square of a grid.
        n: side [px].
        per_side: seeds per side.
        jitter: how far a seed may stray in its square; 0 = a grid, 1 = anywhere.

    Returns:
        The cell (n, n) of every texel, 0..per_side^2 - 1, and the distance (n, n) to the next
        border, in widths of a cell (not normalised).
    """
    import cv2

    corner = np.arange(per_side, dtype=np.float64)
    u, v = np.meshgrid(corner, corner)
    seeds = np.stack([u.ravel(), v.ravel()], -1) + 0.5
    seeds = (seeds + jitter * (rng.random(seeds.shape) - 0.5)) * n / per_side
    at = np.floor(seeds).astype(np.int64) % n
    pad = min(n, int(np.ceil(2.0 * n / per_side)) + 2)
    free = np.ones((n, n), np.uint8)
    free[at[:, 1], at[:, 0]] = 0
    number = np.full((n, n), -1, np.int32)
    number[at[:, 1], at[:, 0]] = np.arange(len(at))
    wide_free, wide_number = np.pad(free, pad, mode="wrap"), np.pad(number, pad, mode="wrap")
    _, region = cv2.distanceTransformWithLabels(
        wide_free, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    region = np.asarray(region, np.int32)
    of_region = np.zeros(int(region.max()) + 1, np.int32)
    seeded = wide_free == 0
    of_region[region[seeded]] = wide_number[seeded]
    label = of_region[region]
    inside = np.ones(label.shape, np.uint8)
    inside[:, 1:][label[:, 1:] != label[:, :-1]] = 0
    inside[1:, :][label[1:, :] != label[:-1, :]] = 0
    distance = np.asarray(cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_5), np.float32)
    middle = slice(pad, pad + n)
    return label[middle, middle].copy(), distance[middle, middle] * np.float32(per_side / n)


def step(field: Values, low: float, high: float) -> Array32:
    """Return 0 below `low`, 1 above `high`, and a smooth ramp between (smoothstep)."""
    t = np.clip((field - low) / (high - low), 0.0, 1.0)
    return (t * t * (3.0 - 2.0 * t)).astype(np.float32)


Tint = Sequence[float]
"""An sRGB colour (r, g, b), each 0 to 255."""


def mixed(low: ArrayLike, high: ArrayLike, share: Values) -> Array32:
    """Return colours (n, n, 3) between two colours or colour fields; share (n, n) of `high`."""
    a, b = np.asarray(low, np.float32), np.asarray(high, np.float32)
    return (a + (b - a) * np.clip(share, 0.0, 1.0)[..., None]).astype(np.float32)


def image8(values: Values) -> Image:
    """Return values in [0, 255] as bytes."""
    return np.round(np.clip(values, 0.0, 255.0)).astype(np.uint8)


def normals8(height_m: Values, period_m: float) -> Image:
    """Return the tangent-space normals (n, n, 3) of a height field (n, n) [m], OpenGL's y up.

    Args:
        height_m: height over the surface [m], periodic.
        period_m: edge of the tile [m].
    """
    step_m = 2.0 * period_m / height_m.shape[0]
    du = (np.roll(height_m, -1, 1) - np.roll(height_m, 1, 1)) / step_m
    dv = (np.roll(height_m, 1, 0) - np.roll(height_m, -1, 0)) / step_m
    normal = np.stack([-du, -dv, np.ones_like(du)], -1)
    normal /= np.sqrt(1.0 + du * du + dv * dv)[..., None]
    return np.round(128.0 + 127.0 * normal).astype(np.uint8)


def finished(
    name: str,
    period_m: float,
    color: Values,
    roughness: float,
    *,
    gloss: Values | None = None,
    height_m: Values | None = None,
    metallic: float = 0.0,
) -> Material:
    """Return the material of a tile.

    Args:
        name: for people.
        period_m: edge of the tile [m].
        color: (n, n, 3) sRGB [0, 255].
        roughness: [0.04, 1], multiplied by `gloss`.
        gloss: (n, n) share of the roughness [0, 1]; None = even.
        height_m: (n, n) relief [m]; None = flat.
        metallic: 0 or 1.
    """
    return Material(
        base_color=(1.0, 1.0, 1.0),
        base_color_image=image8(color),
        roughness=float(roughness),
        roughness_image=None if gloss is None else image8(255.0 * gloss),
        metallic=metallic,
        normal_image=None if height_m is None else normals8(height_m.astype(np.float32), period_m),
        period_m=period_m,
        name=name,
    )


def hsv_tint(hue: float, saturation: float, value: float) -> tuple[float, float, float]:
    """Return the sRGB colour [0, 255] of hue, saturation and value in [0, 1]."""
    import colorsys

    r, g, b = colorsys.hsv_to_rgb(hue % 1.0, saturation, value)
    return 255 * r, 255 * g, 255 * b


def random_tint(
    rng: np.random.Generator,
    saturation: tuple[float, float] = (0.35, 0.9),
    value: tuple[float, float] = (0.35, 0.95),
) -> tuple[float, float, float]:
    """Return a colour of any hue."""
    return hsv_tint(rng.random(), rng.uniform(*saturation), rng.uniform(*value))


def shaded(rng: np.random.Generator, tint: Tint, spread: float = 6.0) -> Array32:
    """Return a colour (3,) near another: lighter or darker, a little warmer or colder."""
    light, warm = spread * rng.standard_normal(2)
    return np.clip(np.asarray(tint) + light + 0.3 * warm * np.array([1, 0, -1]), 2, 253).astype(
        np.float32
    )
