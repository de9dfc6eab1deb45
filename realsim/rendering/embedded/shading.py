"""What a point of a surface sends to the eye: metallic-roughness material under sky and sun.

glTF 2.0 appendix B: Lambert below a GGX coat with Schlick's Fresnel term. The coat takes from the
matte part what it mirrors itself, and light that bounces within its facets is given back (Kulla
and Conty 2017 as in Lagarde and de Rousiers, "Moving Frostbite to PBR", and Filament): a white
surface in a white room is white at any roughness.
"""

import numpy as np

from realsim.arrays import Array32, Int32
from realsim.compiled import njit
from realsim.rendering.embedded.sky_light import SkyArrays, lobe_at
from realsim.rendering.embedded.surface_table import SurfacePoints

DIELECTRIC = 0.04
"""Reflectance of plastic, wood and paper seen head on (refractive index 1.5)."""
MIRROR_UNTIL, MIRROR_FADES = 0.5, 0.2
"""Reflected rays count fully up to roughness 0.3 and not at all from 0.5: wider lobes are served
by the ambient rays."""


@njit(inline="always", error_model="numpy")
def coat(nv: float, roughness: float) -> tuple[float, float]:
    """Return scale and offset of the reflectance of a GGX coat under even light.

    Fit of Karis, "Physically based shading on mobile", 2014.

    Args:
        nv: cosine between normal and view.
        roughness: perceptual roughness.
    """
    x, y = 1 - roughness, 0.0425 - 0.0275 * roughness
    z, w = 1.04 - 0.572 * roughness, 0.022 * roughness - 0.04
    a = min(x * x, np.exp2(-9.28 * nv)) * x + y
    return -1.04 * a + z, 1.04 * a + w


@njit(inline="always", error_model="numpy")
def mirror_share(roughness: float) -> float:
    """Return how far a reflected ray stands for the whole lobe [0, 1]."""
    return min(max((MIRROR_UNTIL - roughness) / MIRROR_FADES, 0.0), 1.0)


@njit(inline="always", error_model="numpy")
def highlight(
    n: tuple[float, float, float],
    v: tuple[float, float, float],
    s: tuple[float, float, float],
    alpha: float,
) -> tuple[float, float]:
    """Return pi D V n.s of GGX (without Fresnel), and the cosine between half-way and view.

    Heitz, "Understanding the masking-shadowing function", JCGT 2014.
    """
    nl = n[0] * s[0] + n[1] * s[1] + n[2] * s[2]
    nv = max(n[0] * v[0] + n[1] * v[1] + n[2] * v[2], 1e-3)
    hx, hy, hz = v[0] + s[0], v[1] + s[1], v[2] + s[2]
    length = max(np.sqrt(hx * hx + hy * hy + hz * hz), 1e-9)
    nh = (n[0] * hx + n[1] * hy + n[2] * hz) / length
    vh = (v[0] * hx + v[1] * hy + v[2] * hz) / length
    a2 = alpha * alpha
    d = nh * nh * (a2 - 1) + 1
    spread = a2 / (d * d)
    masking = nl * np.sqrt(nv * nv * (1 - a2) + a2) + nv * np.sqrt(nl * nl * (1 - a2) + a2)
    return spread * 0.5 / max(masking, 1e-9) * nl, vh


@njit(error_model="numpy")
def shade(
    sky: SkyArrays,
    points: SurfacePoints,
    geometry: Int32,
    directions: Array32,
    light: tuple[Array32, Array32, Array32],
    out: Array32,
) -> None:
    """Fill the radiance (N, 3) of the rays that meet a surface.

    Args:
        sky: the light from far away.
        points: what the rays see.
        geometry: (N,) placed mesh, -1 = none.
        directions: (N, 3) of the rays, world.
        light: ambient (N, 4), radiance a white matte surface would send under sky and neighbours,
            and the open share of the sky; sunlit share (N,); mirrored (N, 4), radiance that a
            reflected ray met and 1, or zeros where it met the sky.
        out: is filled.
    """
    ambient, sunlit, mirrored = light
    sun = (sky.sun_direction[0], sky.sun_direction[1], sky.sun_direction[2])
    spread = np.tan(sky.sun_radius)
    color, coats = np.empty(3), np.empty(3)
    for i in range(len(geometry)):
        if geometry[i] < 0:
            continue
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        length = np.sqrt(x * x + y * y + z * z)
        v = (-x / length, -y / length, -z / length)
        nx, ny, nz = points.normal[i, 0], points.normal[i, 1], points.normal[i, 2]
        nv = nx * v[0] + ny * v[1] + nz * v[2]
        if nv < 0.02:  # a bent normal that looks away is turned back to the rim
            nx, ny, nz = nx + (0.02 - nv) * v[0], ny + (0.02 - nv) * v[1], nz + (0.02 - nv) * v[2]
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            nx, ny, nz, nv = nx / length, ny / length, nz / length, 0.02
        n = (nx, ny, nz)
        rough, metal = points.roughness[i], points.metallic[i]
        alpha = rough * rough
        scale, offset = coat(nv, rough)
        gain = 1.0 / (scale + offset) - 1.0
        open_sky = _open_for_gloss(nv, ambient[i, 3], alpha)
        glossy = _mirrored_sky(sky, points, i, n, v, nv)
        share = mirrored[i, 3] * mirror_share(rough)

        facing = nx * sun[0] + ny * sun[1] + nz * sun[2]
        lit = sunlit[i] if facing > 0 else 0.0
        peak, vh = 0.0, 1.0
        if lit > 0:
            peak, vh = highlight(n, v, sun, min(alpha + 0.5 * spread, 1.0))
        bounce = (1 - vh) * (1 - vh)
        bounce *= bounce * (1 - vh)
        for k in range(3):
            base = points.base[i, k]
            f0 = DIELECTRIC + metal * (base - DIELECTRIC)
            gained = 1.0 + f0 * gain
            coats[k] = (f0 * scale + offset) * gained
            matte = base * (1 - metal) * (1 - coats[k])
            color[k] = matte * ambient[i, k]
            seen = open_sky * glossy[k] + (1 - open_sky) * ambient[i, k]
            color[k] += coats[k] * (seen + share * (mirrored[i, k] - seen))
            if lit > 0:
                fresnel = (f0 + (1 - f0) * bounce) * gained
                color[k] += lit * sky.sun[k] * (matte * facing + fresnel * peak)
            out[i, k] = color[k]


@njit(inline="always", error_model="numpy")
def _open_for_gloss(nv: float, open_share: float, alpha: float) -> float:
    """Return the open share of the glossy lobe (Lagarde and de Rousiers 2014, listing 26)."""
    if open_share >= 1.0:
        return 1.0
    power = np.exp2(-16.0 * alpha - 1.0)
    return min(max((nv + open_share) ** power - 1.0 + open_share, 0.0), 1.0)


@njit(inline="always", error_model="numpy")
def _mirrored_sky(
    sky: SkyArrays,
    points: SurfacePoints,
    i: int,
    n: tuple[float, float, float],
    v: tuple[float, float, float],
    nv: float,
) -> tuple[float, float, float]:
    """Return the sky as point i mirrors it: about the reflected ray, on the face's outer side."""
    rx, ry, rz = 2 * nv * n[0] - v[0], 2 * nv * n[1] - v[1], 2 * nv * n[2] - v[2]
    fx, fy, fz = points.flat[i, 0], points.flat[i, 1], points.flat[i, 2]
    below = min(rx * fx + ry * fy + rz * fz, 0.0)
    rx, ry, rz = rx - 2 * below * fx, ry - 2 * below * fy, rz - 2 * below * fz
    length = np.sqrt(rx * rx + ry * ry + rz * rz)
    return lobe_at(sky.lobes, points.roughness[i], rx / length, ry / length, rz / length)
