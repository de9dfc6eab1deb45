"""The compiled pass that shades an eye: the light of every pixel from what its ray meets first.

A row is shaded in pieces of `CHUNK_PX` columns, in plain loops over a small scratch: what a run of
pixels on one face sees, then grain, image, light and dots of a run on one mesh. Loops without
branches over rows at fixed distances are what the compiler turns into vector instructions; their
counters are unsigned, because a signed index may count from the end.

Everything that is compiled into the pass stands in this file, because a compiled function kept on
disk is renewed when its own file changes, not when another one does.
"""

import numpy as np
from numpy.typing import NDArray

from realsim.compiled import njit
from realsim.rendering.stereo.light import MAP_ROUGHNESS
from realsim.rendering.stereo.projector import HALF_HEIGHT, HALF_WIDTH, TEXEL_RAD
from realsim.rendering.stereo.surfaces import FINEST_CELL_M, FIRST_OCTAVE, LEVELS, NOISE_STEPS

Array32 = NDArray[np.float32]
Scalar = float | np.float32
F0_PLASTIC = 0.04
"""Reflectance of a dielectric at normal incidence, glTF 2.0's value."""
SHARPEST_LOBE = 2000.0
"""Exponent of the narrowest highlight: 2 deg, what a lamp itself spans."""
DIFFUSE_FROM = MAP_ROUGHNESS[-1]
"""Rougher dielectrics mirror nothing that nine harmonics do not hold."""
SHADOW_SLACK = 0.01
"""A point is in the projector's shadow when something is nearer to it by more than this share."""
CHUNK_PX = 128
"""Columns that are shaded together: their scratch stays in the processor's first cache."""
ROWS = 25
"""Rows of the scratch."""
# Where they begin: the surface; the micro texture; what becomes of them.
(
    X, Y, EX, EY, EZ, PAINT, TU, TV, PATCH, FACING, LEVEL,
    GRAIN_X, GRAIN_Y, GRAIN_Z, OCTAVE, CELLS, FADE, PART_X, PART_Y, PART_Z, NEAR, FAR,
    VALUE, MATTE, FRESNEL,
) = (np.uint64(k * CHUNK_PX) for k in range(ROWS))  # fmt: skip
STEP, TEXEL_A, TEXEL_B, TEXEL_C, TEXEL_D = OCTAVE, GRAIN_X, GRAIN_Y, GRAIN_Z, CELLS
"""The image is read before the micro texture, in the same place."""
DOTS, EVEN = FADE, OCTAVE
FINE, COARSE = VALUE, MATTE
"""The two octaves' noise stands where light is written later."""
OCTAVE_SHIFT = 17.3
"""Octaves are moved against each other by this many cells, or their origins would coincide."""
COARSEST_OCTAVE = 22
"""With the one above it the coarsest: cells of 170 m."""


@njit(inline="always")
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


@njit(fastmath=True, error_model="numpy")
def _surface(run, sizes, placed, face, look, depth, scratch):  # pyright: ignore
    """Write what a run of pixels on one face sees: point, normal towards the eye, paint, texture.

    Args:
        run: place of its first pixel in the chunk, of the one after its last, and the column of the
            chunk's first pixel.
        sizes: (ray y, 1 / fx, cx).
        placed: (6, 4) eye to mesh axes, and to the grain's.
        face: (24,) the face's functions.
        look: (9,).
        depth: (W,) [m].
        scratch: changed.
    """
    f = np.float32
    first, last, column = run
    ry, per_fx, cx = sizes
    p00, p01, p02, p03 = placed[0, 0], placed[0, 1], placed[0, 2], placed[0, 3]
    p10, p11, p12, p13 = placed[1, 0], placed[1, 1], placed[1, 2], placed[1, 3]
    p20, p21, p22, p23 = placed[2, 0], placed[2, 1], placed[2, 2], placed[2, 3]
    n0, n1, n2, n3, n4, n5 = face[0], face[1], face[2], face[3], face[4], face[5]
    n6, n7, n8, n9, n10, n11 = face[6], face[7], face[8], face[9], face[10], face[11]
    u0, u1, u2, u3, v0, v1 = face[12], face[13], face[14], face[15], face[16], face[17]
    v2, v3, b0, b1, b2, b3 = face[18], face[19], face[20], face[21], face[22], face[23]
    tint = look[0]
    for i in range(first, last):
        rx = (f(column + i) - cx) * per_fx
        z = depth[column + i]
        x, y = rx * z, ry * z
        a = p00 * x + p01 * y + p02 * z + p03
        b = p10 * x + p11 * y + p12 * z + p13
        c = p20 * x + p21 * y + p22 * z + p23
        na = n0 * a + n1 * b + n2 * c + n3
        nb = n4 * a + n5 * b + n6 * c + n7
        nc = n8 * a + n9 * b + n10 * c + n11
        # Mesh axes to eye axes is the transpose of the rotation above.
        ex = p00 * na + p10 * nb + p20 * nc
        ey = p01 * na + p11 * nb + p21 * nc
        ez = p02 * na + p12 * nb + p22 * nc
        scale = f(1.0) / np.sqrt(ex * ex + ey * ey + ez * ez + f(1e-24))
        facing = (ex * rx + ey * ry + ez) * scale / np.sqrt(rx * rx + ry * ry + f(1.0))
        scale = -scale if facing > 0 else scale
        facing = abs(facing)
        scratch[X + i], scratch[Y + i] = x, y
        scratch[EX + i], scratch[EY + i], scratch[EZ + i] = ex * scale, ey * scale, ez * scale
        scratch[FACING + i] = facing
        # Area of the patch that a pixel covers.
        pixel_m = z * per_fx
        scratch[PATCH + i] = pixel_m * pixel_m / max(facing, f(0.1))
        scratch[PAINT + i] = tint * (b0 * a + b1 * b + b2 * c + b3)
        scratch[TU + i] = u0 * a + u1 * b + u2 * c + u3
        scratch[TV + i] = v0 * a + v1 * b + v2 * c + v3


@njit(fastmath=True, error_model="numpy")
def _pixel_octave(first, last, bits, scratch):  # pyright: ignore
    """Write log2 of the edge of the patch that each pixel covers.

    The exponent of a float is the whole part of its logarithm; log2(1 + m) = m + 0.344 m (1 - m)
    within 0.008 for the rest. `bits` is the scratch, read as whole numbers.
    """
    f = np.float32
    for i in range(first, last):
        pattern = bits[PATCH + i]
        m = f(pattern & 0x7FFFFF) * f(2.0**-23)
        whole = f(pattern >> 23) - f(127.0)
        scratch[LEVEL + i] = f(0.5) * (whole + m + f(0.344) * m * (f(1.0) - m))


@njit(fastmath=True, error_model="numpy")
def _grain_points(run, placed, depth, bits, scratch):  # pyright: ignore
    """Write points in the axes of the noise, the octave that a pixel resolves, and its cells."""
    f = np.float32
    first, last, column = run
    p00, p01, p02, p03 = placed[3, 0], placed[3, 1], placed[3, 2], placed[3, 3]
    p10, p11, p12, p13 = placed[4, 0], placed[4, 1], placed[4, 2], placed[4, 3]
    p20, p21, p22, p23 = placed[5, 0], placed[5, 1], placed[5, 2], placed[5, 3]
    for i in range(first, last):
        x, y, z = scratch[X + i], scratch[Y + i], depth[column + i]
        scratch[GRAIN_X + i] = p00 * x + p01 * y + p02 * z + p03
        scratch[GRAIN_Y + i] = p10 * x + p11 * y + p12 * z + p13
        scratch[GRAIN_Z + i] = p20 * x + p21 * y + p22 * z + p23
    for i in range(first, last):
        level = max(scratch[LEVEL + i] + f(FIRST_OCTAVE), f(0.0))
        octave = min(np.ceil(level), f(COARSEST_OCTAVE))
        scratch[FADE + i] = max(octave - level, f(0.0))
        scratch[OCTAVE + i] = octave
        # The bits of the float 2^-octave.
        bits[CELLS + i] = (127 - np.int32(octave)) << 23


@njit(fastmath=True, error_model="numpy")
def _noise(first, last, above, block, bits, scratch, value):  # pyright: ignore
    """Write the noise [counts] of the octave that is `above` the pixels' one: trilinear, repeating.

    Only the look-ups themselves are done one by one.
    """
    f = np.float32
    per_m = f(0.5**above / FINEST_CELL_M)
    for i in range(first, last):
        cells = per_m * scratch[CELLS + i]
        x = scratch[GRAIN_X + i] * cells + f(OCTAVE_SHIFT) * (scratch[OCTAVE + i] + f(above))
        y, z = scratch[GRAIN_Y + i] * cells, scratch[GRAIN_Z + i] * cells
        fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
        scratch[PART_X + i], scratch[PART_Y + i], scratch[PART_Z + i] = x - fx, y - fy, z - fz
        u = np.int32(fx)
        low = ((np.int32(fy) & 63) << 6) | (np.int32(fz) & 63)
        bits[NEAR + i] = ((u & 63) << 12) | low
        bits[FAR + i] = (((u + 1) & 63) << 12) | low
    for i in range(first, last):
        bits[NEAR + i] = block[np.uint64(bits[NEAR + i])]
        bits[FAR + i] = block[np.uint64(bits[FAR + i])]
    for i in range(first, last):
        near, far = np.int32(bits[NEAR + i]), np.int32(bits[FAR + i])
        b, c = scratch[PART_Y + i], scratch[PART_Z + i]
        p, q = f(near & 255), f((near >> 16) & 255)
        p += c * (f((near >> 8) & 255) - p)
        q += c * (f((near >> 24) & 255) - q)
        p += b * (q - p)
        r, s = f(far & 255), f((far >> 16) & 255)
        r += c * (f((far >> 8) & 255) - r)
        s += c * (f((far >> 24) & 255) - s)
        r += b * (s - r)
        scratch[value + i] = p + scratch[PART_X + i] * (r - p) - f(128.0)


@njit(fastmath=True, error_model="numpy")
def _add_grain(first, last, contrast, scratch):  # pyright: ignore
    """Multiply the paint by the micro texture, of rms `contrast`.

    Two neighbouring octaves are blended, so that no line is seen where the finer one ends.
    """
    f = np.float32
    one, zero = f(1.0), f(0.0)
    for i in range(first, last):
        fade = scratch[FADE + i]
        rest = one - fade
        even = f(1 / NOISE_STEPS) / np.sqrt(fade * fade + rest * rest)
        grain = one + contrast * even * (fade * scratch[FINE + i] + rest * scratch[COARSE + i])
        scratch[PAINT + i] *= max(grain, zero)


@njit(fastmath=True, error_model="numpy")
def _add_image(first, last, texels, levels, density, bits, scratch):  # pyright: ignore
    """Multiply the paint by a mesh's image, of 2^density texels per metre.

    The nearest halving is read; both eyes see a point from the same distance.
    """
    f = np.float32
    for i in range(first, last):
        bits[STEP + i] = np.int32(max(scratch[LEVEL + i] + density, f(0.0)) + f(0.5))
    i = first
    while i < last:
        step, j = bits[STEP + i], i
        while j < last and bits[STEP + j] == step:
            j += np.uint64(1)
        start, height, width = levels[min(step, LEVELS - 1)]
        _image_run(i, j, texels[start : start + height * width], height, width, bits, scratch)
        i = j


@njit(fastmath=True, error_model="numpy")
def _image_run(first, last, texels, height, width, bits, scratch):  # pyright: ignore
    """Multiply the paint by one halving of an image: bilinear, repeating, v up."""
    f = np.float32
    one, half = f(1.0), f(0.5)
    wide, high = f(width), f(height)
    right, bottom = np.int32(width - 1), np.int32(height - 1)
    columns = np.int32(width)
    for i in range(first, last):
        u, v = scratch[TU + i], scratch[TV + i]
        x = (u - np.floor(u)) * wide - half
        y = (one - (v - np.floor(v))) * high - half
        fx, fy = np.floor(x), np.floor(y)
        scratch[PART_X + i], scratch[PART_Y + i] = x - fx, y - fy
        x0, y0 = np.int32(fx), np.int32(fy)
        x1 = 0 if x0 >= right else x0 + 1
        y1 = 0 if y0 >= bottom else y0 + 1
        x0 = right if x0 < 0 else x0
        y0 = bottom if y0 < 0 else y0
        bits[TEXEL_A + i], bits[TEXEL_B + i] = y0 * columns + x0, y0 * columns + x1
        bits[TEXEL_C + i], bits[TEXEL_D + i] = y1 * columns + x0, y1 * columns + x1
    for i in range(first, last):
        bits[TEXEL_A + i] = texels[np.uint64(bits[TEXEL_A + i])]
        bits[TEXEL_B + i] = texels[np.uint64(bits[TEXEL_B + i])]
        bits[TEXEL_C + i] = texels[np.uint64(bits[TEXEL_C + i])]
        bits[TEXEL_D + i] = texels[np.uint64(bits[TEXEL_D + i])]
    for i in range(first, last):
        a, b = f(bits[TEXEL_A + i]), f(bits[TEXEL_B + i])
        c, d = f(bits[TEXEL_C + i]), f(bits[TEXEL_D + i])
        a += scratch[PART_X + i] * (b - a)
        c += scratch[PART_X + i] * (d - c)
        scratch[PAINT + i] *= (a + scratch[PART_Y + i] * (c - a)) * f(1 / 65535)


@njit(fastmath=True, error_model="numpy")
def _light_matte(first, last, look, R, light, ambient, scratch):  # pyright: ignore
    """Write light, matte share and mirrored share of a run that mirrors nothing sharp."""
    f = np.float32
    harmonics, _, sun_direction, sun = light
    one, zero = f(1.0), f(0.0)
    roughness, metallic = look[1], look[2]
    r00, r01, r02 = R[0, 0], R[0, 1], R[0, 2]
    r10, r11, r12 = R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22 = R[2, 0], R[2, 1], R[2, 2]
    h0, h1, h2, h3, h4 = harmonics[0], harmonics[1], harmonics[2], harmonics[3], harmonics[4]
    h5, h6, h7, h8 = harmonics[5], harmonics[6], harmonics[7], harmonics[8]
    sx, sy, sz = sun_direction[0], sun_direction[1], sun_direction[2]
    for i in range(first, last):
        ex, ey, ez = scratch[EX + i], scratch[EY + i], scratch[EZ + i]
        x = r00 * ex + r01 * ey + r02 * ez
        y = r10 * ex + r11 * ey + r12 * ez
        z = r20 * ex + r21 * ey + r22 * ez
        # What a white matte surface of this normal returns under nine harmonics.
        even = h0 * f(0.282095) + f(0.488603) * (h1 * y + h2 * z + h3 * x)
        even += f(1.092548) * (h4 * x * y + h5 * y * z + h7 * x * z)
        even += f(0.315392) * h6 * (f(3.0) * z * z - one) + f(0.546274) * h8 * (x * x - y * y)
        even = max(even, zero)
        paint = scratch[PAINT + i]
        matte = paint * (one - metallic)
        f0 = f(F0_PLASTIC) * (one - metallic) + paint * metallic
        rise = one - scratch[FACING + i]
        square = rise * rise
        fresnel = f0 + (max(one - roughness, f0) - f0) * square * square * rise
        lit = even + sun * max(x * sx + y * sy + z * sz, zero)
        scratch[VALUE + i] = ambient * (matte * lit + fresnel * even)
        scratch[EVEN + i] = even
        scratch[MATTE + i] = matte
        scratch[FRESNEL + i] = fresnel


@njit(fastmath=True, error_model="numpy")
def _add_mirrored(run, sizes, look, R, light, ambient, scratch):  # pyright: ignore
    """Put what a smooth surface mirrors in the place of the even light that it was given.

    The highlight of a lamp is exp(k (cos - 1)) with k = 2 / alpha^2, scaled so that over all
    directions a mirror returns what a white matte surface does.
    """
    f = np.float32
    first, last, column = run
    ry, per_fx, cx = sizes
    _, reflections, sun_direction, sun = light
    k = _sharpness(look[1])
    for i in range(first, last):
        rx = (f(column + i) - cx) * per_fx
        ex, ey, ez = scratch[EX + i], scratch[EY + i], scratch[EZ + i]
        per_length = f(1.0) / np.sqrt(rx * rx + ry * ry + f(1.0))
        twice = f(2.0) * scratch[FACING + i]
        # The mirrored ray, in eye axes and in world.
        hx, hy, hz = (
            rx * per_length + twice * ex,
            ry * per_length + twice * ey,
            (per_length + twice * ez),
        )
        mx = R[0, 0] * hx + R[0, 1] * hy + R[0, 2] * hz
        my = R[1, 0] * hx + R[1, 1] * hy + R[1, 2] * hz
        mz = R[2, 0] * hx + R[2, 1] * hy + R[2, 2] * hz
        seen = _octahedral(reflections, int(look[4]), mx, my, mz)
        if sun > 0:
            along = mx * sun_direction[0] + my * sun_direction[1] + mz * sun_direction[2]
            seen += sun * f(0.5) * k * np.exp(k * (along - f(1.0)))
        scratch[VALUE + i] += ambient * scratch[FRESNEL + i] * (seen - scratch[EVEN + i])


@njit(inline="always")
def _sharpness(roughness: Scalar) -> Scalar:
    """Return the exponent of a highlight."""
    alpha = max(roughness * roughness, np.float32(1e-3))
    return min(np.float32(2.0) / (alpha * alpha), np.float32(SHARPEST_LOBE))


@njit(fastmath=True, error_model="numpy")
def _find_dots(run, sizes, projector, depth, shadow, bits, scratch):  # pyright: ignore
    """Write the projector's light on a run per unit cosine; 0 in its shadow and outside its field.

    Its picture is rectified with the eye's: the same row, shifted by the disparity. `shadow` is
    that row of first hits.
    """
    f = np.float32
    first, last, column = run
    pattern, _, offset, power = projector
    ry, per_fx, cx = sizes
    height, width, columns = pattern.shape[0], pattern.shape[1], len(shadow)
    q = (ry + f(HALF_HEIGHT)) * f(1.0 / TEXEL_RAD)
    top = int(q)
    part_y = q - f(top)
    if top < 0 or top >= height - 1:
        for i in range(first, last):
            scratch[DOTS + i] = f(0.0)
        return
    upper, lower = pattern[top], pattern[top + 1]
    rightmost, last_column = f(width - 1.001), f(columns - 1.001)
    for i in range(first, last):
        z = depth[column + i]
        rx = (f(column + i) - cx) * per_fx
        p = (rx - offset / z + f(HALF_WIDTH)) * f(1.0 / TEXEL_RAD)
        u = f(column + i) - offset / (z * per_fx)
        inside = f(1.0) if (p >= 0) & (p <= rightmost) else f(0.0)
        p, u = min(max(p, f(0.0)), rightmost), np.floor(u)
        # Beyond the picture nothing is known to hide it.
        bits[FAR + i] = np.int32(u) if (u >= 0) & (u < last_column) else -1
        bits[NEAR + i] = np.int32(p)
        scratch[PART_X + i] = p - np.floor(p)
        x, y = scratch[X + i] - offset, scratch[Y + i]
        scratch[DOTS + i] = inside * power / (x * x + y * y + z * z)
    for i in range(first, last):
        k, at = bits[NEAR + i], bits[FAR + i]
        t = scratch[PART_X + i]
        a, b = upper[k] + t * (upper[k + 1] - upper[k]), lower[k] + t * (lower[k + 1] - lower[k])
        light = scratch[DOTS + i] * (a + part_y * (b - a))
        if at >= 0:
            limit = depth[column + i] * f(1.0 - SHADOW_SLACK)
            near, far = shadow[at], shadow[at + 1]
            hidden = (near > 0) & (near < limit) & (far > 0) & (far < limit)
            light = f(0.0) if hidden else light
        scratch[DOTS + i] = light


@njit(fastmath=True, error_model="numpy")
def _add_dots(run, sizes, roughness, offset, depth, scratch):  # pyright: ignore
    """Add the projector's light on a run, and its highlight (see `_add_mirrored`).

    Its exponential is (1 + x / 8)^8, which needs no call.
    """
    f = np.float32
    first, last, column = run
    ry, per_fx, cx = sizes
    k = _sharpness(roughness)
    for i in range(first, last):
        x, y, z = scratch[X + i] - offset, scratch[Y + i], depth[column + i]
        ex, ey, ez = scratch[EX + i], scratch[EY + i], scratch[EZ + i]
        rx = (f(column + i) - cx) * per_fx
        near = f(1.0) / np.sqrt(x * x + y * y + z * z)
        per_length = f(1.0) / np.sqrt(rx * rx + ry * ry + f(1.0))
        value = scratch[MATTE + i] * max(-(ex * x + ey * y + ez * z) * near, f(0.0))
        twice = f(2.0) * scratch[FACING + i]
        hx, hy = rx * per_length + twice * ex, ry * per_length + twice * ey
        hz = per_length + twice * ez
        along = -(hx * x + hy * y + hz * z) * near
        fall = max(f(1.0) + k * (along - f(1.0)) * f(1 / 8), f(0.0))
        fall *= fall
        fall *= fall
        value += scratch[FRESNEL + i] * f(0.5) * k * fall * fall
        scratch[VALUE + i] += scratch[DOTS + i] * value


@njit(fastmath=True, error_model="numpy")
def _nothing(run, sizes, R, reflections, ambient, scratch):  # pyright: ignore
    """Write the surroundings that a run sees past everything."""
    f = np.float32
    first, last, column = run
    ry, per_fx, cx = sizes
    for i in range(first, last):
        rx = (f(column + i) - cx) * per_fx
        per_length = f(1.0) / np.sqrt(rx * rx + ry * ry + f(1.0))
        wx = (R[0, 0] * rx + R[0, 1] * ry + R[0, 2]) * per_length
        wy = (R[1, 0] * rx + R[1, 1] * ry + R[1, 2]) * per_length
        wz = (R[2, 0] * rx + R[2, 1] * ry + R[2, 2]) * per_length
        scratch[VALUE + i] = ambient * _octahedral(reflections, 2, wx, wy, wz)


@njit(fastmath=True, error_model="numpy")
def shade(hits, view, surfaces, images, light, projector, ambient, out):  # pyright: ignore
    """Write the light of every pixel; the arguments are those of `radiance`, unpacked."""
    depth, geometry, face = hits
    pinhole, placed, R = view
    faces, first_face, looks, image_of = surfaces
    texels, levels, block = images
    f = np.float32
    fx, fy, cx, cy = pinhole
    scratch = np.empty(ROWS * CHUNK_PX, np.float32)
    bits = scratch.view(np.int32)
    width = depth.shape[1]
    for v in range(depth.shape[0]):
        sizes = ((f(v) - cy) / fy, f(1.0) / fx, cx)
        for column in range(0, width, CHUNK_PX):
            count, begin = min(CHUNK_PX, width - column), 0
            start = np.uint64(column)
            while begin < count:
                g, end = geometry[v, column + begin], begin
                while end < count and geometry[v, column + end] == g:
                    if g < 0:
                        end += 1
                        continue
                    of, run = face[v, column + end], end
                    while (
                        end < count
                        and face[v, column + end] == of
                        and (geometry[v, column + end] == g)
                    ):
                        end += 1
                    _surface(
                        (np.uint64(run), np.uint64(end), start), sizes, placed[g],
                        faces[first_face[g] + of], looks[g], depth[v], scratch,
                    )  # fmt: skip
                a, b, begin = np.uint64(begin), np.uint64(end), end
                if g < 0:
                    _nothing((a, b, start), sizes, R, light[1], ambient, scratch)
                    continue
                look = looks[g]
                _pixel_octave(a, b, bits, scratch)
                if image_of[g] >= 0:
                    _add_image(a, b, texels, levels[image_of[g]], look[8], bits, scratch)
                if look[3] > 0:
                    _grain_points((a, b, start), placed[g], depth[v], bits, scratch)
                    _noise(a, b, 0, block, bits, scratch, FINE)
                    _noise(a, b, 1, block, bits, scratch, COARSE)
                    _add_grain(a, b, look[3], scratch)
                _light_matte(a, b, look, R, light, ambient, scratch)
                if look[2] > 0 or look[1] <= f(DIFFUSE_FROM):
                    _add_mirrored((a, b, start), sizes, look, R, light, ambient, scratch)
                if projector[3] > 0:
                    shadow, offset = projector[1][v], projector[2]
                    _find_dots((a, b, start), sizes, projector, depth[v], shadow, bits, scratch)
                    _add_dots((a, b, start), sizes, look[1], offset, depth[v], scratch)
            out[v, column : column + count] = scratch[VALUE : VALUE + np.uint64(count)]
