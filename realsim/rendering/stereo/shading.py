"""The compiled pass that shades an eye: the light of every pixel from what its ray meets first.

Everything it inlines stands in this file, because a compiled function kept on disk is renewed when
its own file changes, not when another one does.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from realsim.rendering.stereo.light import MAP_ROUGHNESS
from realsim.rendering.stereo.pattern import HALF_HEIGHT, HALF_WIDTH, TEXEL_RAD
from realsim.rendering.stereo.solid_noise import CELLS_PER_M, FIRST_OCTAVE, NOISE_STEPS
from realsim.rendering.stereo.surfaces import LEVELS

Array32 = NDArray[np.float32]
Scalar = float | np.float32
F0_PLASTIC = 0.04
"""Reflectance of a dielectric at normal incidence, glTF 2.0's value."""
SHARPEST_LOBE = 2000.0
"""Exponent of the narrowest highlight: 2 deg, what a lamp itself spans."""
DIFFUSE_FROM = MAP_ROUGHNESS[-1]
"""Rougher dielectrics mirror nothing that nine harmonics do not hold."""
PER_LOG_2 = 1 / np.log(2.0)
SHADOW_SLACK = 0.01
"""A point is in the projector's shadow when something is nearer to it by more than this share."""


@numba.njit(cache=True, inline="always")  # pyright: ignore[reportUntypedFunctionDecorator]
def _block_value(block: NDArray[np.int8], x: Scalar, y: Scalar, z: Scalar) -> Scalar:
    """Return the block's value [counts] at (x, y, z) [cells], trilinear, repeating."""
    f = np.float32
    fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
    a, b, c = x - fx, y - fy, z - fz
    i, j, k = int(fx) & 63, int(fy) & 63, int(fz) & 63
    i1, j1, k1 = (i + 1) & 63, (j + 1) & 63, (k + 1) & 63
    v00, v01 = f(block[i, j, k]), f(block[i, j1, k])
    v10, v11 = f(block[i1, j, k]), f(block[i1, j1, k])
    v00 += c * (f(block[i, j, k1]) - v00)
    v01 += c * (f(block[i, j1, k1]) - v01)
    v10 += c * (f(block[i1, j, k1]) - v10)
    v11 += c * (f(block[i1, j1, k1]) - v11)
    v00 += b * (v01 - v00)
    v10 += b * (v11 - v10)
    return v00 + a * (v10 - v00)


@numba.njit(cache=True, inline="always")  # pyright: ignore[reportUntypedFunctionDecorator]
def _micro_texture(
    block: NDArray[np.int8], x: Scalar, y: Scalar, z: Scalar, pixel_octave: Scalar
) -> Scalar:
    """Return the unevenness, sd about 1, at a point in block axes [m] seen by pixels of 2^octave m.

    Two neighbouring octaves are blended, so that no line is seen where the finer one ends.
    """
    level = max(pixel_octave + np.float32(FIRST_OCTAVE), np.float32(0.0))
    octave = min(int(np.ceil(level)), len(CELLS_PER_M) - 1)
    fade = max(np.float32(octave) - level, np.float32(0.0))
    per_m = CELLS_PER_M[octave]
    shift = np.float32(17.3 * octave)
    fine = _block_value(block, x * per_m + shift, y * per_m, z * per_m)
    per_m *= np.float32(0.5)
    shift += np.float32(17.3)
    coarse = _block_value(block, x * per_m + shift, y * per_m, z * per_m)
    rest = np.float32(1.0) - fade
    even = np.float32(1 / NOISE_STEPS) / np.sqrt(fade * fade + rest * rest)
    return even * (fade * fine + rest * coarse)


@numba.njit(cache=True, inline="always")  # pyright: ignore[reportUntypedFunctionDecorator]
def _image_value(
    texels: NDArray[np.uint16],
    levels: NDArray[np.int64],
    image: int,
    step: int,
    u: Scalar,
    v: Scalar,
) -> Scalar:
    """Return a halving's brightness at texture coordinates, bilinear, repeating, v up."""
    start, height = levels[image, step, 0], levels[image, step, 1]
    width = levels[image, step, 2]
    x = (u - np.floor(u)) * np.float32(width) - np.float32(0.5)
    y = (np.float32(1.0) - (v - np.floor(v))) * np.float32(height) - np.float32(0.5)
    fx, fy = np.floor(x), np.floor(y)
    a, b = x - fx, y - fy
    i, j = np.int64(fx), np.int64(fy)
    i0 = i + width if i < 0 else i
    j0 = j + height if j < 0 else j
    i1 = i0 + 1 if i0 + 1 < width else 0
    j1 = j0 + 1 if j0 + 1 < height else 0
    top, bottom = start + j0 * width, start + j1 * width
    t0, t1 = np.float32(texels[top + i0]), np.float32(texels[top + i1])
    b0, b1 = np.float32(texels[bottom + i0]), np.float32(texels[bottom + i1])
    p, q = t0 + a * (t1 - t0), b0 + a * (b1 - b0)
    return (p + b * (q - p)) * np.float32(1 / 65535)


@numba.njit(cache=True, inline="always")  # pyright: ignore[reportUntypedFunctionDecorator]
def _octahedral(maps: Array32, n: int, x: Scalar, y: Scalar, z: Scalar) -> Scalar:
    """Return a map's radiance in a unit direction, bilinear between texel centres."""
    side = np.float32(maps.shape[1])
    s = np.float32(1.0) / (abs(x) + abs(y) + abs(z))
    p, q = x * s, y * s
    if z < 0:
        p, q = (
            (np.float32(1.0) - abs(q)) * np.float32(1.0 if p >= 0 else -1.0),
            (np.float32(1.0) - abs(p)) * np.float32(1.0 if q >= 0 else -1.0),
        )
    c = (p + np.float32(1.0)) * np.float32(0.5) * side - np.float32(0.5)
    r = (q + np.float32(1.0)) * np.float32(0.5) * side - np.float32(0.5)
    c = min(max(c, np.float32(0.0)), side - np.float32(1.001))
    r = min(max(r, np.float32(0.0)), side - np.float32(1.001))
    i, j = int(c), int(r)
    a, b = c - np.float32(i), r - np.float32(j)
    top = maps[n, j, i] + a * (maps[n, j, i + 1] - maps[n, j, i])
    bottom = maps[n, j + 1, i] + a * (maps[n, j + 1, i + 1] - maps[n, j + 1, i])
    return top + b * (bottom - top)


@numba.njit(cache=True, inline="always")  # pyright: ignore[reportUntypedFunctionDecorator]
def _irradiance(h: Array32, x: Scalar, y: Scalar, z: Scalar) -> Scalar:
    """Return what a white matte surface of unit normal returns under nine harmonics."""
    f = np.float32
    value = h[0] * f(0.282095) + f(0.488603) * (h[1] * y + h[2] * z + h[3] * x)
    value += f(1.092548) * (h[4] * x * y + h[5] * y * z + h[7] * x * z)
    value += f(0.315392) * h[6] * (f(3.0) * z * z - f(1.0)) + f(0.546274) * h[8] * (x * x - y * y)
    return max(value, f(0.0))


@numba.njit(cache=True, inline="always")  # pyright: ignore[reportUntypedFunctionDecorator]
def _lobe(roughness: Scalar, along: Scalar) -> Scalar:
    """Return the highlight of a lamp for the cosine between it and the mirrored ray.

    exp(k (cos - 1)) with k = 2 / alpha^2, scaled so that over all directions a mirror returns what
    a white matte surface does.
    """
    alpha = roughness * roughness
    k = min(np.float32(2.0) / (alpha * alpha), np.float32(SHARPEST_LOBE))
    fall = k * (along - np.float32(1.0))
    if fall < np.float32(-12.0):
        return np.float32(0.0)
    return np.float32(0.5) * k * np.exp(fall)


@numba.njit(cache=True, inline="always")  # pyright: ignore[reportUntypedFunctionDecorator]
def _dots(projector: tuple, point: tuple, column: Scalar, row: int, fx: Scalar) -> Scalar:  # pyright: ignore
    """Return the projector's light per unit cosine on a point in eye axes, and its direction."""
    pattern, depth, offset, power = projector
    x, y, z = point
    x -= offset
    # The projector's picture is rectified with the eye's: the same row, shifted by the disparity.
    shadow_u = column - fx * offset / z
    i = np.int64(np.floor(shadow_u))
    if 0 <= i and i + 1 < depth.shape[1]:
        limit = z * np.float32(1.0 - SHADOW_SLACK)
        near, far = depth[row, i], depth[row, i + 1]
        if 0 < near < limit and 0 < far < limit:
            return np.float32(0.0)
    p = (x / z + np.float32(HALF_WIDTH)) * np.float32(1.0 / TEXEL_RAD)
    q = (y / z + np.float32(HALF_HEIGHT)) * np.float32(1.0 / TEXEL_RAD)
    if p < 0 or q < 0 or p >= pattern.shape[1] - 1 or q >= pattern.shape[0] - 1:
        return np.float32(0.0)
    a, b = int(p), int(q)
    s, t = np.float32(p - a), np.float32(q - b)
    top = pattern[b, a] + s * (pattern[b, a + 1] - pattern[b, a])
    bottom = pattern[b + 1, a] + s * (pattern[b + 1, a + 1] - pattern[b + 1, a])
    return power * (top + t * (bottom - top)) / (x * x + y * y + z * z)


@numba.njit(cache=True, fastmath=True, error_model="numpy")  # pyright: ignore[reportUntypedFunctionDecorator]
def shade(hits, view, surfaces, images, light, projector, ambient, out):  # pyright: ignore  # noqa: PLR0915
    """Write the light of every pixel; the arguments are those of `radiance`, unpacked."""
    depth, geometry, face = hits
    pinhole, placed, R = view
    faces, first_face, looks, image_of = surfaces
    texels, levels, block = images
    harmonics, reflections, sun_direction, sun = light
    f = np.float32
    fx, fy, cx, cy = pinhole
    one, zero = f(1.0), f(0.0)
    per_fx, per_fy = one / fx, one / fy
    for v in range(depth.shape[0]):
        ry = (f(v) - cy) * per_fy
        for u in range(depth.shape[1]):
            rx = (f(u) - cx) * per_fx
            per_length = one / np.sqrt(rx * rx + ry * ry + one)
            # The ray in world, unit.
            wx = (R[0, 0] * rx + R[0, 1] * ry + R[0, 2]) * per_length
            wy = (R[1, 0] * rx + R[1, 1] * ry + R[1, 2]) * per_length
            wz = (R[2, 0] * rx + R[2, 1] * ry + R[2, 2]) * per_length
            g = geometry[v, u]
            if g < 0:
                out[v, u] = ambient * _octahedral(reflections, 2, wx, wy, wz)
                continue
            z = depth[v, u]
            x, y = rx * z, ry * z
            a = placed[g, 0, 0] * x + placed[g, 0, 1] * y + placed[g, 0, 2] * z + placed[g, 0, 3]
            b = placed[g, 1, 0] * x + placed[g, 1, 1] * y + placed[g, 1, 2] * z + placed[g, 1, 3]
            c = placed[g, 2, 0] * x + placed[g, 2, 1] * y + placed[g, 2, 2] * z + placed[g, 2, 3]
            k = first_face[g] + face[v, u]
            na = faces[k, 0] * a + faces[k, 1] * b + faces[k, 2] * c + faces[k, 3]
            nb = faces[k, 4] * a + faces[k, 5] * b + faces[k, 6] * c + faces[k, 7]
            nc = faces[k, 8] * a + faces[k, 9] * b + faces[k, 10] * c + faces[k, 11]
            # Mesh axes to eye axes is the transpose of the rotation above.
            ex = placed[g, 0, 0] * na + placed[g, 1, 0] * nb + placed[g, 2, 0] * nc
            ey = placed[g, 0, 1] * na + placed[g, 1, 1] * nb + placed[g, 2, 1] * nc
            ez = placed[g, 0, 2] * na + placed[g, 1, 2] * nb + placed[g, 2, 2] * nc
            scale = one / max(np.sqrt(ex * ex + ey * ey + ez * ez), f(1e-12))
            facing = (ex * rx + ey * ry + ez) * scale * per_length
            if facing > 0:
                scale = -scale
            ex, ey, ez = ex * scale, ey * scale, ez * scale
            facing = abs(facing)
            nx = R[0, 0] * ex + R[0, 1] * ey + R[0, 2] * ez
            ny = R[1, 0] * ex + R[1, 1] * ey + R[1, 2] * ez
            nz = R[2, 0] * ex + R[2, 1] * ey + R[2, 2] * ez

            # log2 of the edge of the patch that a pixel covers, z / f / sqrt(cosine).
            pixel_m = z * per_fx
            pixel_octave = np.log(pixel_m * pixel_m / max(facing, f(0.1))) * f(0.5 * PER_LOG_2)
            paint = faces[k, 20] * a + faces[k, 21] * b + faces[k, 22] * c + faces[k, 23]
            paint *= looks[g, 0]
            image = image_of[g]
            if image >= 0:
                tu = faces[k, 12] * a + faces[k, 13] * b + faces[k, 14] * c + faces[k, 15]
                tv = faces[k, 16] * a + faces[k, 17] * b + faces[k, 18] * c + faces[k, 19]
                # The nearest halving; both eyes see a point from the same distance.
                step = int(max(pixel_octave + looks[g, 8], zero) + f(0.5))
                paint *= _image_value(texels, levels, image, min(step, LEVELS - 1), tu, tv)
            if looks[g, 3] > 0:
                ga = placed[g, 3, 0] * x + placed[g, 3, 1] * y
                ga += placed[g, 3, 2] * z + placed[g, 3, 3]
                gb = placed[g, 4, 0] * x + placed[g, 4, 1] * y
                gb += placed[g, 4, 2] * z + placed[g, 4, 3]
                gc = placed[g, 5, 0] * x + placed[g, 5, 1] * y
                gc += placed[g, 5, 2] * z + placed[g, 5, 3]
                grain = one + looks[g, 3] * _micro_texture(block, ga, gb, gc, pixel_octave)
                paint *= max(grain, zero)

            metallic = looks[g, 2]
            matte = paint * (one - metallic)
            even = _irradiance(harmonics, nx, ny, nz)
            to_sun = nx * sun_direction[0] + ny * sun_direction[1] + nz * sun_direction[2]
            value = matte * (even + sun * max(to_sun, zero))
            f0 = f(F0_PLASTIC) * (one - metallic) + paint * metallic
            rise = one - facing
            fresnel = f0 + (max(one - looks[g, 1], f0) - f0) * rise * rise * rise * rise * rise
            if metallic == 0 and looks[g, 1] > f(DIFFUSE_FROM):
                value += fresnel * even
            else:
                mx, my, mz = (wx + f(2.0) * facing * nx, wy + f(2.0) * facing * ny,
                              wz + f(2.0) * facing * nz)  # fmt: skip
                value += fresnel * _octahedral(reflections, int(looks[g, 4]), mx, my, mz)
                along = mx * sun_direction[0] + my * sun_direction[1] + mz * sun_direction[2]
                if sun > 0:
                    value += fresnel * sun * _lobe(looks[g, 1], along)
            value *= ambient
            if projector[3] > 0:
                dots = _dots(projector, (x, y, z), f(u), v, fx)
                if dots > 0:
                    px = x - projector[2]
                    near = one / np.sqrt(px * px + y * y + z * z)
                    lit = -(ex * px + ey * y + ez * z) * near
                    value += matte * dots * max(lit, zero)
                    hx, hy, hz = (rx * per_length + f(2.0) * facing * ex,
                                  ry * per_length + f(2.0) * facing * ey,
                                  per_length + f(2.0) * facing * ez)  # fmt: skip
                    along = -(hx * px + hy * y + hz * z) * near
                    value += fresnel * dots * _lobe(looks[g, 1], along)
            out[v, u] = value
