"""A panorama as a light: what it sends to matte surfaces, and what glossy ones mirror of it.

Matte: the panorama averaged over the cosine lobe of every normal (an irradiance map). Glossy: the
panorama averaged over GGX lobes of growing roughness, sampled by importance from its halvings
(Krivanek and Colbert, "Real-time shading with filtered importance sampling", EGSR 2008) and
stored as one stack (the first half of the split sum of Karis, "Real shading in Unreal Engine 4",
SIGGRAPH 2013).
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from realsim.arrays import Array, Array32, Int64
from realsim.compiled import njit
from realsim.rendering.appearance import Environment

LOBES = ((0.1, 128), (0.2, 64), (0.3, 64), (0.45, 32), (0.6, 32), (0.8, 16), (1.0, 16))
"""Roughness and rows of the averaged panoramas: a texel is finer than its lobe."""
MIRROR_ROWS = 512
"""Rows of the panorama that mirrors show: 0.35 deg a texel."""
LOBE_SAMPLES = 64
"""Directions by which a lobe is averaged; the halvings fill the space between them."""
IRRADIANCE_ROWS = 32
"""Rows of the irradiance map and of the panorama it is summed from: the cosine lobe is wide."""
OCTAHEDRON = 32
"""Edge of the coarse octahedral map by which rays to the sky are weighted."""
LAMP_LEVEL = 2.0
"""What exceeds the mean of the coarse map so many times is a lamp: rays are aimed at it."""
MOST_LAMP_RAYS = 0.6
"""Share of the ambient rays that lamps get at most; the others look for neighbours, too."""


class MapStack(NamedTuple):
    """Equirectangular pictures of different sizes, one after another in memory."""

    texels: Array32
    """(T, 3) linear radiance."""
    layout: Int64
    """(K, 2) first texel and number of rows; twice as many columns."""
    roughness: Array
    """(K,) roughness of each picture's lobe, ascending from 0; halvings count up from 0."""


class SkyArrays(NamedTuple):
    """The light of an environment as the shading kernels read it."""

    panorama: MapStack
    """The panorama itself and its halvings."""
    lobes: MapStack
    """The panorama averaged over GGX lobes."""
    irradiance: MapStack
    """One picture: radiance of a white matte surface with that normal."""
    coarse: Array32
    """(OCTAHEDRON, OCTAHEDRON) luminance, octahedral, mean 1."""
    lamps: Array
    """(OCTAHEDRON^2 + 1,) sums of the lamps' luminance over the texels of `coarse`, 0 to 1."""
    lamp_excess: float
    """Sum of the lamps' luminance over the texels."""
    lamp_rays: float
    """Share of the ambient rays that are aimed at the lamps."""
    sun_direction: Array
    """(3,) unit, world."""
    sun: Array
    """(3,) radiance of a white matte surface that faces the sun."""
    sun_radius: float
    """Half the angle under which the sun is seen [rad]."""


@lru_cache(maxsize=2)
def sky_arrays(environment: Environment) -> SkyArrays:
    """Return the averaged maps of an environment; kept for the next renderer under that sky."""
    halvings = _halvings(environment.panorama)
    mirror = next((p for p in halvings if p.shape[0] <= MIRROR_ROWS), halvings[-1])
    sources = _stack(_halvings(mirror), np.arange(32.0))
    lobes, roughness = [mirror], [0.0]
    for rough, rows in LOBES:
        out = np.empty((rows, 2 * rows, 3), np.float32)
        _average_lobes(sources, rough * rough, LOBE_SAMPLES, out)
        lobes.append(out)
        roughness.append(rough)
    irradiance = np.empty((IRRADIANCE_ROWS, 2 * IRRADIANCE_ROWS, 3), np.float32)
    _cosine_average(_resized(environment.panorama, IRRADIANCE_ROWS), irradiance)
    sun = np.array(environment.sun_direction, dtype=np.float64)
    coarse = _coarse(_resized(environment.panorama, IRRADIANCE_ROWS))
    lamps, lamp_excess, lamp_rays = _lamps(coarse)
    return SkyArrays(
        panorama=_stack(halvings, np.arange(float(len(halvings)))),
        lobes=_stack(lobes, np.array(roughness)),
        irradiance=_stack([irradiance], np.zeros(1)),
        coarse=coarse,
        lamps=lamps,
        lamp_excess=lamp_excess,
        lamp_rays=lamp_rays,
        sun_direction=sun / np.linalg.norm(sun),
        sun=np.array(environment.sun, dtype=np.float64),
        sun_radius=float(np.radians(environment.sun_radius_deg)),
    )


def _resized(panorama: Array32, rows: int) -> Array32:
    """Return the panorama (rows, 2 rows, 3), averaged where it shrinks."""
    import cv2

    larger = panorama.shape[0] > rows
    how = cv2.INTER_AREA if larger else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(panorama, (2 * rows, rows), interpolation=how), np.float32)


def _halvings(panorama: Array32) -> list[Array32]:
    """Return the panorama and its halvings, down to two rows."""
    out = [panorama]
    while out[-1].shape[0] >= 4:
        out.append(_resized(out[-1], out[-1].shape[0] // 2))
    return out


def _stack(pictures: list[Array32], roughness: Array) -> MapStack:
    """Return pictures (H_k, 2 H_k, 3) as one stack."""
    rows = np.array([p.shape[0] for p in pictures], np.int64)
    first = np.concatenate([[0], np.cumsum(2 * rows * rows)[:-1]])
    texels = np.concatenate([p.reshape(-1, 3) for p in pictures])
    return MapStack(texels, np.stack([first, rows], 1), roughness[: len(pictures)].copy())


def _coarse(panorama: Array32) -> Array32:
    """Return the octahedral luminance map, mean 1; ones if all is black."""
    n = OCTAHEDRON
    stack = _stack([panorama], np.zeros(1))
    out = np.empty((n, n), np.float32)
    _fill_octahedron(stack, out)
    mean = float(out.mean())
    if mean <= 0:
        return np.ones_like(out)
    return np.asarray(out / mean, np.float32)


def _lamps(coarse: Array32) -> tuple[Array, float, float]:
    """Return the lamps' cumulative sums (n^2 + 1,), their total, and their share of the rays.

    The share is that of the light: in an even sky no ray is aimed.
    """
    excess = np.maximum(coarse.astype(np.float64).ravel() - LAMP_LEVEL, 0.0)
    # Every second row runs backwards, so that texels that follow one another touch.
    n = coarse.shape[0]
    excess = excess.reshape(n, n)
    excess[1::2] = excess[1::2, ::-1]
    total = float(excess.sum())
    sums = np.concatenate([[0.0], np.cumsum(excess.ravel())])
    share = min(total / float(coarse.sum()), MOST_LAMP_RAYS)
    return sums / max(total, 1e-30), total, share


@njit(inline="always", error_model="numpy")
def _unfolded(x: float, y: float) -> tuple[float, float, float]:
    """Return the unit direction of a place of the octahedral map, x and y from -1 to 1."""
    z = 1 - abs(x) - abs(y)
    if z < 0:
        x, y = (1 - abs(y)) * (1.0 if x >= 0 else -1.0), (1 - abs(x)) * (1.0 if y >= 0 else -1.0)
    length = np.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


@njit(error_model="numpy")
def _fill_octahedron(stack: MapStack, out: Array32) -> None:
    """Fill the octahedral map (n, n) with the luminance of a panorama."""
    n = out.shape[0]
    for i in range(n):
        for j in range(n):
            x, y, z = _unfolded(2 * (j + 0.5) / n - 1, 2 * (i + 0.5) / n - 1)
            r, g, b = map_at(stack, 0, x, y, z)
            out[i, j] = 0.2126 * r + 0.7152 * g + 0.0722 * b


@njit(inline="always", error_model="numpy")
def coarse_at(coarse: Array32, x: float, y: float, z: float) -> float:
    """Return the coarse luminance in a unit direction."""
    n = coarse.shape[0]
    total = abs(x) + abs(y) + abs(z)
    a, b = x / total, y / total
    if z < 0:
        a, b = (1 - abs(b)) * (1.0 if a >= 0 else -1.0), (1 - abs(a)) * (1.0 if b >= 0 else -1.0)
    j, i = int((0.5 * a + 0.5) * n), int((0.5 * b + 0.5) * n)
    return coarse[min(max(i, 0), n - 1), min(max(j, 0), n - 1)]


@njit(inline="always", error_model="numpy")
def lamp_direction(sky: SkyArrays, u1: float, u2: float) -> tuple[float, float, float]:
    """Return a unit direction to the lamps, spread by their luminance, of two numbers in [0, 1)."""
    n = sky.coarse.shape[0]
    low, high = 0, n * n
    while high - low > 1:
        middle = (low + high) // 2
        if sky.lamps[middle] <= u1:
            low = middle
        else:
            high = middle
    i, j = low // n, low % n
    part = (u1 - sky.lamps[low]) / max(sky.lamps[low + 1] - sky.lamps[low], 1e-30)
    if i % 2:
        j, part = n - 1 - j, 1.0 - part
    return _unfolded(2 * (j + part) / n - 1, 2 * (i + u2) / n - 1)


@njit(inline="always", error_model="numpy")
def ray_weight(sky: SkyArrays, d: tuple[float, float, float], cosine: float) -> float:
    """Return by what an ambient ray counts: the cosine's density over that of all the rays.

    The balance heuristic of Veach and Guibas ("Optimally combining sampling techniques", SIGGRAPH
    1995) for rays spread by the cosine and rays aimed at the lamps.
    """
    if cosine <= 0:
        return 0.0
    if sky.lamp_rays <= 0:
        return 1.0
    n = sky.coarse.shape[0]
    excess = max(coarse_at(sky.coarse, d[0], d[1], d[2]) - LAMP_LEVEL, 0.0)
    # Solid angle of a texel of the octahedral map: (2 / n)^2 |d|_1^3.
    side = abs(d[0]) + abs(d[1]) + abs(d[2])
    aimed = excess / sky.lamp_excess * n * n / (4 * side * side * side)
    spread = cosine / np.pi
    return spread / (sky.lamp_rays * aimed + (1 - sky.lamp_rays) * spread)


@njit(inline="always", error_model="numpy")
def _angles(x: float, y: float, z: float) -> tuple[float, float]:
    """Return azimuth and polar angle of a unit direction as shares of the map, [0, 1].

    Polynomials of Abramowitz and Stegun, "Handbook of mathematical functions", 4.4.47 and 4.4.45:
    within 1e-4 rad of arctan2 and arccos at a third of their time.
    """
    c, s = abs(x), abs(y)
    q = min(c, s) / max(c, s, 1e-30)
    q2 = q * q
    high = 0.1801410 + q2 * (0.0208351 * q2 - 0.0851330)
    turn = q * (0.9998660 + q2 * (-0.3302995 + q2 * high))
    turn = turn if c >= s else 0.5 * np.pi - turn
    turn = turn if x >= 0 else np.pi - turn
    azimuth = turn / (2 * np.pi) if y >= 0 else 1.0 - turn / (2 * np.pi)
    up = min(abs(z), 1.0)
    polar = np.sqrt(1.0 - up)
    polar *= 1.5707288 + up * (-0.2121144 + up * (0.0742610 - 0.0187293 * up))
    return azimuth, (polar if z >= 0 else np.pi - polar) / np.pi


@njit(inline="always", error_model="numpy")
def _bilinear(stack: MapStack, k: int, s: float, t: float) -> tuple[float, float, float]:
    """Return the radiance of picture k at shares s of its width and t of its height."""
    first, rows = stack.layout[k, 0], stack.layout[k, 1]
    columns = 2 * rows
    x, y = s * columns - 0.5, t * rows - 0.5
    j, i = int(np.floor(x)), int(np.floor(y))
    a, b = x - j, y - i
    j0, j1 = j if j >= 0 else columns - 1, j + 1 if j + 1 < columns else 0
    i0, i1 = max(i, 0), min(i + 1, rows - 1)
    p, q = first + i0 * columns, first + i1 * columns
    w00, w01, w10, w11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
    v = stack.texels
    red = w00 * v[p + j0, 0] + w01 * v[p + j1, 0] + w10 * v[q + j0, 0] + w11 * v[q + j1, 0]
    green = w00 * v[p + j0, 1] + w01 * v[p + j1, 1] + w10 * v[q + j0, 1] + w11 * v[q + j1, 1]
    blue = w00 * v[p + j0, 2] + w01 * v[p + j1, 2] + w10 * v[q + j0, 2] + w11 * v[q + j1, 2]
    return red, green, blue


@njit(error_model="numpy")
def map_at(stack: MapStack, k: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the radiance of picture k of a stack in a unit direction."""
    s, t = _angles(x, y, z)
    return _bilinear(stack, k, s, t)


@njit(error_model="numpy")
def lobe_at(
    stack: MapStack, roughness: float, x: float, y: float, z: float
) -> tuple[float, float, float]:
    """Return the radiance averaged over a lobe about a unit direction, between two pictures."""
    steps = stack.roughness
    k = 0
    while k < len(steps) - 2 and steps[k + 1] <= roughness:
        k += 1
    mix = min(max((roughness - steps[k]) / (steps[k + 1] - steps[k]), 0.0), 1.0)
    s, t = _angles(x, y, z)
    r0, g0, b0 = _bilinear(stack, k, s, t)
    r1, g1, b1 = _bilinear(stack, k + 1, s, t)
    return r0 + mix * (r1 - r0), g0 + mix * (g1 - g0), b0 + mix * (b1 - b0)


@njit(error_model="numpy")
def _cosine_average(panorama: Array32, out: Array32) -> None:
    """Fill `out` (H, 2H, 3) with the cosine-weighted mean of a panorama about each direction."""
    rows, columns = panorama.shape[0], panorama.shape[1]
    polar = (np.arange(rows) + 0.5) * np.pi / rows
    azimuth = (np.arange(columns) + 0.5) * 2 * np.pi / columns
    height = out.shape[0]
    for i in range(height):
        z = np.cos((i + 0.5) * np.pi / height)
        ring = np.sqrt(1 - z * z)
        for j in range(2 * height):
            phi = (j + 0.5) * np.pi / height
            red, green, blue, total = 0.0, 0.0, 0.0, 0.0
            for m in range(rows):
                along, across = z * np.cos(polar[m]), ring * np.sin(polar[m])
                solid = np.sin(polar[m])
                for n in range(columns):
                    w = along + across * np.cos(azimuth[n] - phi)
                    if w > 0:
                        w *= solid
                        total += w
                        red += w * panorama[m, n, 0]
                        green += w * panorama[m, n, 1]
                        blue += w * panorama[m, n, 2]
            out[i, j, 0], out[i, j, 1], out[i, j, 2] = red / total, green / total, blue / total


@njit(error_model="numpy")
def _average_lobes(sources: MapStack, alpha: float, samples: int, out: Array32) -> None:
    """Fill `out` (H, 2H, 3) with the panorama averaged over the GGX lobe about each direction."""
    rows = out.shape[0]
    texel = 2 * np.pi / (sources.layout[0, 1] * sources.layout[0, 1])
    last = float(len(sources.layout) - 1)
    # A lobe seen head on is the same about every axis: its samples once, in local axes.
    local = np.empty((samples, 5))
    for m in range(samples):
        u1, u2 = (m + 0.5) / samples, m * 0.6180339887498949
        c2 = (1 - u1) / (1 + (alpha * alpha - 1) * u1)
        d = alpha / (c2 * (alpha * alpha - 1) + 1)
        solid = 4 * np.pi / (samples * d * d)
        cz, sz = 2 * c2 - 1, 2 * np.sqrt(max(c2 * (1 - c2), 0.0))
        local[m, 0], local[m, 1] = sz * np.cos(2 * np.pi * u2), sz * np.sin(2 * np.pi * u2)
        local[m, 2], local[m, 3] = cz, max(cz, 0.0)
        local[m, 4] = min(max(0.5 * np.log2(solid / texel) + 1.0, 0.0), last)
    for i in range(rows):
        theta = (i + 0.5) * np.pi / rows
        for j in range(2 * rows):
            phi = (j + 0.5) * np.pi / rows
            ct, st, cp, sp = np.cos(theta), np.sin(theta), np.cos(phi), np.sin(phi)
            red, green, blue, total = 0.0, 0.0, 0.0, 0.0
            for m in range(samples):
                a, b, c, w, level = local[m]
                if w <= 0:
                    continue
                # Axes of the lobe: along the meridian, along the parallel, outwards.
                x = a * ct * cp - b * sp + c * st * cp
                y = a * ct * sp + b * cp + c * st * sp
                s, t = _angles(x, y, -a * st + c * ct)
                r, g, bl = _bilinear(sources, int(level + 0.5), s, t)
                red, green, blue, total = red + w * r, green + w * g, blue + w * bl, total + w
            out[i, j, 0], out[i, j, 1], out[i, j, 2] = red / total, green / total, blue / total


def background_level(sky: SkyArrays, pixel_rad: float) -> int:
    """Return the halving of the panorama whose texels are about as wide as a pixel [rad]."""
    texel = np.pi / float(sky.panorama.layout[0, 1])
    level: Any = np.clip(np.round(np.log2(max(pixel_rad / texel, 1.0))), 0, None)
    return min(int(level), len(sky.panorama.layout) - 1)
