"""From fields to the images of a material: colours, normals of a height field, grey values.

Colours are sRGB in [0, 255] while they are mixed, because people choose and mix them there.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.rendering.appearance import Material
from realsim.rendering.procedural.noise import Field, Values

Image = NDArray[np.uint8]
Tint = Sequence[float]
"""An sRGB colour (r, g, b), each 0 to 255."""


def mixed(low: ArrayLike, high: ArrayLike, share: Values) -> Field:
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


def srgb_to_linear(values: ArrayLike) -> NDArray[np.float64]:
    """Return linear light in [0, 1] of sRGB values in [0, 255] (IEC 61966-2-1)."""
    c = np.asarray(values, np.float64) / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((np.maximum(c, 0.0) + 0.055) / 1.055) ** 2.4)


def luminance(linear: ArrayLike) -> NDArray[np.float64]:
    """Return the luminance (...) of linear sRGB colours (..., 3) (ITU-R BT.709)."""
    return np.asarray(linear, np.float64) @ np.array([0.2126, 0.7152, 0.0722])


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


def shaded(rng: np.random.Generator, tint: Tint, spread: float = 6.0) -> NDArray[np.float32]:
    """Return a colour (3,) near another: lighter or darker, a little warmer or colder."""
    light, warm = spread * rng.standard_normal(2)
    return np.clip(np.asarray(tint) + light + 0.3 * warm * np.array([1, 0, -1]), 2, 253).astype(
        np.float32
    )
