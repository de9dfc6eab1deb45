"""The textures of the compiled shading pass: the grain of surfaces, and images on them.

The pass shades a row in pieces of `CHUNK_PX` columns over a small scratch, whose rows are named
here; see `shading`.
"""

import numpy as np

from realsim.compiled import njit
from realsim.rendering.stereo.surfaces import FINEST_CELL_M, FIRST_OCTAVE, LEVELS, NOISE_STEPS

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


@njit(fastmath=True, error_model="numpy")
def pixel_octave(first, last, bits, scratch):  # pyright: ignore
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
def grain_points(run, placed, depth, bits, scratch):  # pyright: ignore
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
def noise(first, last, above, block, bits, scratch, value):  # pyright: ignore
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
def add_grain(first, last, contrast, scratch):  # pyright: ignore
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
def add_image(first, last, texels, levels, density, bits, scratch):  # pyright: ignore
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
        image_run(i, j, texels[start : start + height * width], height, width, bits, scratch)
        i = j


@njit(fastmath=True, error_model="numpy")
def image_run(first, last, texels, height, width, bits, scratch):  # pyright: ignore
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
