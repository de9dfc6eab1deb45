"""The compiled pass that shades an eye: the light of every pixel from what its ray meets first.

A row is shaded in pieces of `CHUNK_PX` columns, in plain loops over a small scratch: what a run of
pixels on one face sees, then grain, image, light and dots of a run on one mesh. Loops without
branches over rows at fixed distances are what the compiler turns into vector instructions; their
counters are unsigned, because a signed index may count from the end.

The projector between the eyes: its pattern of dots or stripes, and what it reaches.
"""

from functools import lru_cache

import numpy as np

from realsim.arrays import Array32
from realsim.compiled import njit
from realsim.geometry.point_loops import turn
from realsim.rendering.stereo.surfaces import MAP_ROUGHNESS
from realsim.rendering.stereo.texture import (
    CHUNK_PX,
    COARSE,
    DOTS,
    EVEN,
    EX,
    EY,
    EZ,
    FACING,
    FAR,
    FINE,
    FRESNEL,
    MATTE,
    NEAR,
    PAINT,
    PART_X,
    PATCH,
    ROWS,
    TU,
    TV,
    VALUE,
    X,
    Y,
    add_grain,
    add_image,
    grain_points,
    noise,
    pixel_octave,
)

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


SAME_SURFACE_PX = np.float32(1.0)
"""Neighbours whose disparities differ by more are not joined [px]."""


def depth_between(left_m: Array32, right_m: Array32, fB: float, share: float) -> Array32:
    """Return the nearest depth (H, W) [m] that either eye has met, as seen from between them.

    Args:
        left_m: (H, W) first hits of the left eye [m]; 0 = nothing.
        right_m: (H, W) of the right eye, rectified with it.
        fB: focal length times baseline [px m].
        share: where it stands, in baselines from the left eye.

    Returns:
        depth [m]; 0 where neither eye has met anything.
    """
    disparity = np.zeros_like(left_m)
    _carry(left_m, np.float32(fB), np.float32(share), disparity)
    _carry(right_m, np.float32(fB), np.float32(share - 1), disparity)
    out = np.zeros_like(left_m)
    np.divide(np.float32(fB), disparity, out=out, where=disparity > 0)
    return out


@njit
def _carry(depth: Array32, fB: np.float32, share: np.float32, out: Array32) -> None:
    """Raise `out` [px] to the disparities of an eye, moved by a share of themselves.

    Disparity is linear along a plane's row, so between two neighbours it is exact.
    """
    height, width = depth.shape
    zero = np.float32(0.0)
    for v in range(height):
        before, at = zero, zero
        for u in range(width):
            d = fB / depth[v, u] if depth[v, u] > zero else zero
            x = np.float32(u) - share * d
            if d > zero and before > zero and abs(d - before) <= SAME_SURFACE_PX and x > at:
                slope = (d - before) / (x - at)
                for column in range(max(int(np.ceil(at)), 0), min(int(np.floor(x)), width - 1) + 1):
                    value = before + slope * (np.float32(column) - at)
                    out[v, column] = max(out[v, column], value)
            before, at = d, x


Scalar = float | np.float32
F0_PLASTIC = 0.04
"""Reflectance of a dielectric at normal incidence, glTF 2.0's value."""
SHARPEST_LOBE = 2000.0
"""Exponent of the narrowest highlight: 2 deg, what a lamp itself spans."""
DIFFUSE_FROM = MAP_ROUGHNESS[-1]
"""Rougher dielectrics mirror nothing that nine harmonics do not hold."""
SHADOW_SLACK = 0.01
"""A point is in the projector's shadow when something is nearer to it by more than this share."""


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
        mx, my, mz = turn(R, hx, hy, hz)
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
                pixel_octave(a, b, bits, scratch)
                if image_of[g] >= 0:
                    add_image(a, b, texels, levels[image_of[g]], look[8], bits, scratch)
                if look[3] > 0:
                    grain_points((a, b, start), placed[g], depth[v], bits, scratch)
                    noise(a, b, 0, block, bits, scratch, FINE)
                    noise(a, b, 1, block, bits, scratch, COARSE)
                    add_grain(a, b, look[3], scratch)
                _light_matte(a, b, look, R, light, ambient, scratch)
                if look[2] > 0 or look[1] <= f(DIFFUSE_FROM):
                    _add_mirrored((a, b, start), sizes, look, R, light, ambient, scratch)
                if projector[3] > 0:
                    shadow, offset = projector[1][v], projector[2]
                    _find_dots((a, b, start), sizes, projector, depth[v], shadow, bits, scratch)
                    _add_dots((a, b, start), sizes, look[1], offset, depth[v], scratch)
            out[v, column : column + count] = scratch[VALUE : VALUE + np.uint64(count)]
