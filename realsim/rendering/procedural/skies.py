"""Skies out of formulas: clear (Preetham), overcast (CIE), and clouds between; and their light.

Radiances are in kcd/m^2. The sun's light is separate from its sky, as `Environment` wants it.

Sources: A. Preetham, P. Shirley, B. Smits, "A Practical Analytic Model for Daylight", SIGGRAPH
1999 (sky, air mass and extinction); P. Moon, D. Spencer 1942, the CIE overcast sky.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.geometry.colors import luminance
from realsim.rendering.appearance import Color, Environment
from realsim.rendering.procedural.noise import fractal, step

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


HEIGHT = 256
"""Rows of a sky: 0.7 deg each, finer than what a rough surface mirrors."""
SUN_KLX = 128.0
"""Illuminance of the sun outside the atmosphere [klx]."""
RGB_UM = np.array([0.610, 0.550, 0.465])
"""Wavelengths that stand for red, green and blue [um]."""
SUN_RADIUS_DEG = 0.27
"""Half the angle under which the sun is seen [deg]."""
PEREZ_SLOPES = np.array(
    [[0.1787, -0.3554, -0.0227, 0.1206, -0.0670],
     [-0.0193, -0.0665, -0.0004, -0.0641, -0.0033],
     [-0.0167, -0.0950, -0.0079, -0.0441, -0.0109]]
)  # fmt: skip
PEREZ_STARTS = np.array(
    [[-1.4630, 0.4275, 5.3251, -2.5771, 0.3703],
     [-0.2592, 0.0008, 0.2125, -0.8989, 0.0452],
     [-0.2608, 0.0092, 0.2102, -1.6537, 0.0529]]
)  # fmt: skip
"""Preetham's A to E of Y, x and y: slope times turbidity plus start."""
ZENITH_X = np.array(
    [[0.00166, -0.00375, 0.00209, 0.0], [-0.02903, 0.06377, -0.03202, 0.00394],
     [0.11693, -0.21196, 0.06052, 0.25886]]
)  # fmt: skip
ZENITH_Y = np.array(
    [[0.00275, -0.00610, 0.00317, 0.0], [-0.04214, 0.08970, -0.04153, 0.00516],
     [0.15346, -0.26756, 0.06670, 0.26688]]
)  # fmt: skip
GROUNDS = np.array([[0.09, 0.12, 0.05], [0.12, 0.12, 0.12], [0.32, 0.26, 0.19], [0.2, 0.17, 0.13]])
"""Linear reflectances of grass, asphalt, sand and earth."""
SKYLINES = np.array([[0.035, 0.055, 0.03], [0.11, 0.10, 0.10], [0.05, 0.06, 0.08]])
"""Linear reflectances of trees, houses and far hills."""


def perez(theta: ArrayLike, gamma: ArrayLike, turbidity: float) -> Array:
    """Return Perez' function (3, ...) of Y, x and y.

    Args:
        theta: angle from the zenith [rad].
        gamma: angle from the sun [rad].
        turbidity: 2 = very clear, 6 = hazy.
    """
    theta, gamma = np.asarray(theta, np.float64), np.asarray(gamma, np.float64)
    up = np.maximum(np.cos(theta), 0.02)
    rows: list[Array] = []
    for a, b, c, d, e in PEREZ_SLOPES * turbidity + PEREZ_STARTS:
        rows.append((1 + a * np.exp(b / up)) * (1 + c * np.exp(d * gamma) + e * np.cos(gamma) ** 2))
    return np.stack(rows)


def zenith(theta_sun: float, turbidity: float) -> Array:
    """Return luminance [kcd/m^2] and chromaticities x, y (3,) straight up."""
    chi = (4 / 9 - turbidity / 120) * (np.pi - 2 * theta_sun)
    Y = (4.0453 * turbidity - 4.9710) * np.tan(chi) - 0.2155 * turbidity + 2.4192
    t = np.array([turbidity**2, turbidity, 1.0])
    s = np.array([theta_sun**3, theta_sun**2, theta_sun, 1.0])
    return np.array([max(Y, 0.05), t @ ZENITH_X @ s, t @ ZENITH_Y @ s])


def clear_sky(view: Array, sun: Array, turbidity: float) -> Array:
    """Return the radiance (..., 3) of a clear sky along unit vectors (..., 3) that look up."""
    theta_sun = float(np.arccos(np.clip(sun[2], 0.0, 1.0)))
    theta = np.arccos(np.clip(view[..., 2], 0.0, 1.0))
    gamma = np.arccos(np.clip(view @ sun, -1.0, 1.0))
    whole = perez(theta, gamma, turbidity) / perez(0.0, theta_sun, turbidity).reshape(
        (3,) + (1,) * theta.ndim
    )
    Y, x, y = whole * zenith(theta_sun, turbidity).reshape((3,) + (1,) * theta.ndim)
    return from_xyY(x, y, np.maximum(Y, 0.0))


def sun_light(elevation_deg: float, turbidity: float) -> Array:
    """Return the sun's irradiance divided by pi (3,) after Rayleigh's and the haze's extinction.

    Ozone, water vapour and mixed gases take a few per cent more; they are left out.
    """
    zenith_deg = 90.0 - elevation_deg
    air_mass = 1.0 / (
        np.cos(np.radians(zenith_deg)) + 0.15 * max(93.885 - zenith_deg, 0.1) ** -1.253
    )
    beta = max(0.04608 * turbidity - 0.04586, 0.0)
    through = np.exp(-(0.008735 * RGB_UM**-4.08 + beta * RGB_UM**-1.3) * air_mass)
    return SUN_KLX / np.pi * planck(5900) * through


def _unit(azimuth: float, elevation_deg: float) -> Array:
    up = np.radians(elevation_deg)
    return np.array([np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth), np.sin(up)])


def sunny_sky(
    rng: np.random.Generator, elevation_deg: float, turbidity: float, cover: float
) -> Environment:
    """Return a sky with its sun, with fair-weather clouds where `cover` says so.

    Args:
        rng: azimuth, clouds, ground and skyline.
        elevation_deg: of the sun over the horizon [deg].
        turbidity: 2 = very clear, 6 = hazy.
        cover: share of the sky that is clouded [0, 1].
    """
    sun = _unit(rng.uniform(0, 2 * np.pi), elevation_deg)
    light = sun_light(elevation_deg, turbidity)
    view = directions(HEIGHT)
    panorama = np.zeros(view.shape)
    above = view[..., 2] > 0
    panorama[above] = clear_sky(view[above], sun, turbidity)
    through = 1.0
    if cover > 0:
        flat = card_light(panorama, (0, 0, 0), (0, 0, 1)) + max(sun[2], 0.05) * light
        density = _clouds(rng, view, cover)
        near = 0.5 + 0.5 * np.clip(view @ sun, -1, 1)
        cloud = (0.75 + 0.9 * near**6)[..., None] * flat * (1.0 - 0.45 * density**3)[..., None]
        panorama += density[..., None] * (cloud - panorama)
        row, column = _texel(sun)
        through = float(np.exp(-4.0 * density[row, column]))
    r, g, b = (light * through).tolist()
    direction = (float(sun[0]), float(sun[1]), float(sun[2]))
    _lay_ground(rng, panorama, view, (r, g, b), direction)
    kind = "golden hour" if elevation_deg < 12 else "clear sky"
    return Environment(
        panorama=panorama.astype(np.float32),
        sun_direction=direction,
        sun=(r, g, b),
        sun_radius_deg=SUN_RADIUS_DEG,
        name=kind if cover < 0.05 else f"{kind} with clouds",
    )


def overcast_sky(rng: np.random.Generator) -> Environment:
    """Return a closed grey sky: three times as bright at the zenith as at the horizon (CIE)."""
    view = directions(HEIGHT)
    up = np.clip(view[..., 2], 0, 1)
    base = planck(rng.uniform(5800, 7500)) * rng.uniform(2.0, 9.0)
    billow = 1.0 + 0.18 * (_clouds(rng, view, 0.5) - 0.5)
    panorama = ((1 + 2 * up) / 3 * billow)[..., None] * base
    panorama[view[..., 2] <= 0] = 0.0
    _lay_ground(rng, panorama, view, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    return Environment(panorama=panorama.astype(np.float32), sun_direction=(0.0, 0.0, 1.0),
                       name="overcast sky")  # fmt: skip


def _texel(direction: Array) -> tuple[int, int]:
    """Return row and column of the texel that looks along a unit vector."""
    theta = np.arccos(np.clip(direction[2], -1, 1))
    phi = np.arctan2(direction[1], direction[0]) % (2 * np.pi)
    row = min(int(theta / np.pi * HEIGHT), HEIGHT - 1)
    return row, min(int(phi / np.pi * HEIGHT), 2 * HEIGHT - 1)


def _clouds(rng: np.random.Generator, view: Array, cover: float) -> Array:
    """Return the density (H, 2H) [0, 1] of a flat layer of clouds, thinning to the horizon."""
    import cv2

    n = 512
    field = fractal(rng, n, 1.7, 2.0)
    level = float(np.quantile(field, 1.0 - cover))
    density = step(field, level - 0.3, level + 1.1)
    rise = np.maximum(view[..., 2], 0.0) + 0.12
    at = [(view[..., k] / rise * 0.28 * n) % n for k in (0, 1)]
    out = cv2.remap(
        density, at[0].astype(np.float32), at[1].astype(np.float32), cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_WRAP,
    )  # fmt: skip
    return np.asarray(out, np.float64) * np.clip(view[..., 2] / 0.12, 0, 1)


def _lay_ground(
    rng: np.random.Generator, panorama: Array, view: Array, sun: Color, direction: Color
) -> None:
    """Put lit ground below the horizon and a skyline of trees, houses or hills upon it."""
    lit = card_light(panorama, sun, direction)
    phi = 2 * np.pi * (np.arange(view.shape[1]) + 0.5) / view.shape[1]
    waves = np.arange(1, 40)
    size = rng.normal(0, 1, (2, len(waves))) / waves**0.9
    line = np.cos(np.outer(phi, waves)) @ size[0] + np.sin(np.outer(phi, waves)) @ size[1]
    top = np.radians(np.clip(rng.uniform(0, 7) + rng.uniform(0.5, 3) * line, 0, 25))
    elevation = np.arcsin(np.clip(view[..., 2], -1, 1))
    paint = SKYLINES[rng.integers(len(SKYLINES))]
    hidden = (elevation > 0) & (elevation < top[None, :])
    panorama[hidden] = 0.6 * paint * lit
    ground = GROUNDS[rng.integers(len(GROUNDS))] * rng.uniform(0.8, 1.2)
    haze = np.clip(np.exp(elevation / 0.06), 0, 1)[..., None]
    below = elevation <= 0
    panorama[below] = (ground * lit * (1 + 0.4 * haze))[below]
