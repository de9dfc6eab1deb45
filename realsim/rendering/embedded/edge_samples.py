"""Where one ray per pixel is not enough, and what the further rays borrow from the pixels."""

from math import gcd

import numba
import numpy as np
from numpy.typing import NDArray

from realsim.rendering.embedded.sky_light import SkyArrays, map_at
from realsim.rendering.embedded.surface_table import SurfacePoints

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Int32 = NDArray[np.int32]
Mask = NDArray[np.bool_]


def pixel_lattice(samples: int) -> Array32:
    """Return offsets (samples, 2) [px] that cover the square about a pixel's centre.

    A rank-1 lattice by the golden section: every offset occurs once along u and once along v, so
    that an edge along either gets all `samples` levels. Their mean is zero.
    """
    step = max(1, round(samples * 0.6180339887498949))
    while gcd(step, samples) != 1:
        step += 1
    k = np.arange(samples)
    uv = np.stack([k, (k * step) % samples], -1)
    return ((uv + 0.5) / samples - 0.5).astype(np.float32)


@numba.njit(cache=True, inline="always", error_model="numpy")  # pyright: ignore[reportUntypedFunctionDecorator]
def _same_surface(
    away: tuple[float, float, float],
    n: tuple[float, float, float],
    m: tuple[float, float, float],
    slope: float,
) -> float:
    """Return how far a point `away` from another lies in its plane and looks the same way [0, 1].

    Args:
        away: from the one to the other [m].
        n: normal of the one.
        m: normal of the other.
        slope: against the plane, from which it is 0.
    """
    off = away[0] * n[0] + away[1] * n[1] + away[2] * n[2]
    d2 = away[0] * away[0] + away[1] * away[1] + away[2] * away[2]
    near = max(1.0 - off * off / (slope * slope * d2 + 1e-12), 0.0)
    turn = n[0] * m[0] + n[1] * m[1] + n[2] * m[2]
    return near * min(max(5.0 * turn - 4.0, 0.0), 1.0)


@numba.njit(cache=True, error_model="numpy")  # pyright: ignore[reportUntypedFunctionDecorator]
def edge_filtered(
    values: Array32,
    points: SurfacePoints,
    geometry: Int32,
    size: tuple[int, int, float],
    taps: tuple[int, int, float],
) -> Array32:
    """Return values (H * W, K) averaged along rows and then along columns, not across edges.

    A joint bilateral filter whose guides are the pixels' planes and normals (Eisemann and Durand,
    SIGGRAPH 2004), applied to each axis by itself.

    Args:
        values: of the pixels.
        points: what they see.
        geometry: (H * W,) placed mesh, -1 = none; such pixels stay zero.
        size: height, width, and the slope against a pixel's plane at which its neighbours end.
        taps: neighbours on either side, the outermost by half; their spacing [px]; and the
            difference of the first value at which they end.
    """
    reach, step, span = taps
    height, width, slope = size
    count = values.shape[1]
    half = np.empty_like(values)
    out = np.empty_like(values)
    for axis in range(2):
        source = values if axis == 0 else half
        target = half if axis == 0 else out
        for y in range(height):
            for x in range(width):
                i = y * width + x
                for c in range(count):
                    target[i, c] = 0.0
                if geometry[i] < 0:
                    continue
                px, py, pz = points.position[i]
                nx, ny, nz = points.smooth[i, 0], points.smooth[i, 1], points.smooth[i, 2]
                total = 0.0
                for k in range(-reach, reach + 1):
                    u, v = (x + k * step, y) if axis == 0 else (x, y + k * step)
                    if u < 0 or v < 0 or u >= width or v >= height:
                        continue
                    j = v * width + u
                    if geometry[j] < 0:
                        continue
                    w = 0.5 if abs(k) == reach else 1.0
                    if k != 0:
                        differ = (source[j, 0] - source[i, 0]) / span
                        w *= max(1.0 - differ * differ, 0.0)
                        away = (
                            points.position[j, 0] - px,
                            points.position[j, 1] - py,
                            points.position[j, 2] - pz,
                        )
                        m = (points.smooth[j, 0], points.smooth[j, 1], points.smooth[j, 2])
                        w *= _same_surface(away, (nx, ny, nz), m, slope)
                    if w > 0:
                        total += w
                        for c in range(count):
                            target[i, c] += w * source[j, c]
                for c in range(count):
                    target[i, c] /= total
    return out


@numba.njit(cache=True, error_model="numpy")  # pyright: ignore[reportUntypedFunctionDecorator]
def busy_pixels(
    color: Array32,
    base: Array32,
    geometry: Int32,
    sunlit: Array32,
    size: tuple[int, int, float, float],
) -> Mask:
    """Return (H * W,) where neighbours differ in mesh, in sunshine or in the light on them.

    What is printed on a surface counts as if it were grey: the look-up has averaged it already.

    Args:
        color: (H * W, 3) radiance.
        base: (H * W, 3) base colour.
        geometry: (H * W,) placed mesh.
        sunlit: (H * W,) share of the sun that is seen.
        size: height, width, exposure, and the contrast from which pixels are busy [1 = white,
            on a square-root scale, which is near to what is seen].
    """
    height, width, exposure, contrast = size
    out = np.zeros(height * width, np.bool_)
    tone = np.empty(height * width, np.float32)
    for i in range(height * width):
        y = 0.2126 * color[i, 0] + 0.7152 * color[i, 1] + 0.0722 * color[i, 2]
        if geometry[i] >= 0:
            b = 0.2126 * base[i, 0] + 0.7152 * base[i, 1] + 0.0722 * base[i, 2]
            y *= 0.2 / max(b, 0.05)
        tone[i] = np.sqrt(min(exposure * y, 1.0))
    for y in range(height):
        for x in range(width):
            i = y * width + x
            for k in range(4):
                u, v = x + (1, 0, 1, -1)[k], y + (0, 1, 1, 1)[k]
                if u < 0 or u >= width or v >= height:
                    continue
                j = v * width + u
                differ = geometry[i] != geometry[j] or abs(tone[i] - tone[j]) > contrast
                if not differ and geometry[i] >= 0:
                    differ = sunlit[i] != sunlit[j]
                if differ:
                    out[i] = True
                    out[j] = True
    return out


@numba.njit(cache=True, error_model="numpy")  # pyright: ignore[reportUntypedFunctionDecorator]
def borrow_light(
    sky: SkyArrays,
    samples: tuple[SurfacePoints, Int32, NDArray[np.int64]],
    pixels: tuple[SurfacePoints, Int32, Array32, Array32],
    size: tuple[int, int],
    out: tuple[Array32, Array32],
) -> None:
    """Fill the ambient and mirrored light of samples from the pixels around them.

    Args:
        sky: for samples without a pixel of their mesh around them.
        samples: what they see, their placed mesh (N,), and the pixel (N,) they belong to.
        pixels: what the pixels see, their mesh (H * W,), their ambient light (H * W, 4) and
            mirrored light (H * W, 4).
        size: height and width of the image.
        out: ambient (N, 4) and mirrored (N, 4); are filled.
    """
    mine, geometry, of_pixel = samples
    theirs, mesh, ambient, mirrored = pixels
    height, width = size
    for m in range(len(geometry)):
        if geometry[m] < 0:
            continue
        row, column = of_pixel[m] // width, of_pixel[m] % width
        total = 0.0
        for c in range(4):
            out[0][m, c] = 0.0
            out[1][m, c] = 0.0
        for v in range(max(row - 1, 0), min(row + 2, height)):
            for u in range(max(column - 1, 0), min(column + 2, width)):
                j = v * width + u
                if mesh[j] != geometry[m]:
                    continue
                turn, d2 = 0.0, 1e-12
                for k in range(3):
                    turn += mine.smooth[m, k] * theirs.smooth[j, k]
                    d2 += (mine.position[m, k] - theirs.position[j, k]) ** 2
                w = max(turn, 0.05) ** 8 / d2
                total += w
                for c in range(4):
                    out[0][m, c] += w * ambient[j, c]
                    out[1][m, c] += w * mirrored[j, c]
        if total > 0:
            for c in range(4):
                out[0][m, c] /= total
                out[1][m, c] /= total
        else:
            n = mine.normal[m]
            light = map_at(sky.irradiance, 0, n[0], n[1], n[2])
            out[0][m, 0], out[0][m, 1], out[0][m, 2] = light
            out[0][m, 3] = 1.0
