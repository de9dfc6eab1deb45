"""Light from far away: where the texels of a panorama look, how much they shine on a card.

Panoramas are laid out as `Environment` says: row 0 straight up, column 0 towards +x, the azimuth
growing to the right.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.rendering.appearance import Color, Environment
from realsim.rendering.procedural.texels import luminance

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
XYZ_TO_RGB = np.array(
    [[3.2404542, -1.5371385, -0.4985314], [-0.9692660, 1.8760108, 0.0415560],
     [0.0556434, -0.2040259, 1.0572252]]
)  # fmt: skip
"""CIE XYZ to linear sRGB with white D65 (IEC 61966-2-1)."""


def directions(height: int) -> Array:
    """Return the unit vectors (H, 2H, 3) along which the texels of a panorama look."""
    theta = np.pi * (np.arange(height) + 0.5) / height
    phi = 2 * np.pi * (np.arange(2 * height) + 0.5) / (2 * height)
    out = np.empty((height, 2 * height, 3))
    out[..., 0] = np.sin(theta)[:, None] * np.cos(phi)
    out[..., 1] = np.sin(theta)[:, None] * np.sin(phi)
    out[..., 2] = np.cos(theta)[:, None]
    return out


def solid_angles(height: int) -> Array:
    """Return the solid angle (H,) of a texel of every row [sr]; all texels make 4 pi."""
    edge = np.cos(np.pi * np.arange(height + 1) / height)
    return (edge[:-1] - edge[1:]) * np.pi / height


def card_light(panorama: ArrayLike, sun: Color, sun_direction: Color) -> Array:
    """Return the radiance (3,) of a white matte card that lies flat under the light.

    That is its irradiance divided by pi. The cosine is integrated over each texel exactly.
    """
    p = np.asarray(panorama, np.float64)
    height = p.shape[0]
    edge = np.sin(np.pi * np.arange(height + 1) / height) ** 2
    # The integral of cos(theta) sin(theta); texels below the horizon do not shine on it.
    weight = np.maximum(edge[1:] - edge[:-1], 0.0) * np.pi / height / 2
    sky = np.einsum("h,hwc->c", weight, p) / np.pi
    toward = np.asarray(sun_direction, np.float64)
    cosine = max(float(toward[2] / np.linalg.norm(toward)), 0.0)
    return sky + cosine * np.asarray(sun)


def exposed(environment: Environment) -> Environment:
    """Return the environment, exposed so that a card lying flat keeps its own brightness.

    A grey card of reflectance 0.18 then has the value 0.18, which sRGB shows as mid-grey 118.
    """
    e = environment
    light = float(luminance(card_light(e.panorama, e.sun, e.sun_direction)))
    return replace(e, exposure=1.0 / light) if light > 0 else e


def balanced(environment: Environment, strength: float) -> Environment:
    """Return the environment as a camera's white balance sees it.

    Args:
        environment: with its true colours.
        strength: 0 = as it is, 1 = a white card lying flat is white.
    """
    e = environment
    light = np.maximum(card_light(e.panorama, e.sun, e.sun_direction), 1e-9)
    gain = (float(luminance(light)) / light) ** strength
    r, g, b = (np.asarray(e.sun) * gain).tolist()
    return replace(e, panorama=(e.panorama * gain).astype(np.float32), sun=(r, g, b))


def from_xyY(x: ArrayLike, y: ArrayLike, Y: ArrayLike) -> Array:
    """Return linear sRGB (..., 3), not negative, of CIE chromaticities and a luminance."""
    x, y, Y = np.broadcast_arrays(*(np.asarray(a, np.float64) for a in (x, y, Y)))
    y = np.maximum(y, 1e-6)
    xyz = np.stack([x * Y / y, Y, (1.0 - x - y) * Y / y], -1)
    return np.maximum(xyz @ XYZ_TO_RGB.T, 0.0)


def planck(kelvin: float) -> Array:
    """Return linear sRGB (3,) of luminance 1 of a black body (Kim et al. 2002, 1667-25000 K)."""
    t = float(np.clip(kelvin, 1667.0, 25000.0))
    if t < 4000:
        x = -0.2661239e9 / t**3 - 0.2343589e6 / t**2 + 0.8776956e3 / t + 0.179910
    else:
        x = -3.0258469e9 / t**3 + 2.1070379e6 / t**2 + 0.2226347e3 / t + 0.240390
    if t < 2222:
        y = -1.1063814 * x**3 - 1.34811020 * x**2 + 2.18555832 * x - 0.20219683
    elif t < 4000:
        y = -0.9549476 * x**3 - 1.37418593 * x**2 + 2.09137015 * x - 0.16748867
    else:
        y = 3.0817580 * x**3 - 5.87338670 * x**2 + 3.75112997 * x - 0.37001483
    rgb = from_xyY(x, y, 1.0)
    return rgb / luminance(rgb)
