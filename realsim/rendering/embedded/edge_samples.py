"""Where one ray per pixel is not enough, and what the further rays borrow from the pixels."""

from math import gcd

import numpy as np

from realsim.arrays import Array, Array32, Int32, Int64, Mask
from realsim.compiled import njit
from realsim.rendering.embedded.sky_light import SkyArrays, map_at
from realsim.rendering.embedded.surface_table import SAME_DIRECTION, SurfacePoints


@njit(error_model="numpy")
def world_rays(
    table: Array32,
    camera: tuple[Array, float, float],
    pixels: Int64,
    offsets: Array32,
    scale: float,
) -> tuple[Array32, Array32, Array32]:
    """Return directions (M * S, 3) in world, and their change along u and v (M * S, 3) each.

    z is 1 in camera axes. Between pixel centres the table is continued by its own differences.

    Args:
        table: (H, W, 3) rays of the pixel centres; NaN where the lens has none.
        camera: R_world_cam (3, 3), fx, fy.
        pixels: (M,) flat pixel numbers, with a ray.
        offsets: (S, 2) from the pixel's centre [px].
        scale: part of a pixel that each ray stands for, along each axis.
    """
    R, fx, fy = camera
    height, width = table.shape[0], table.shape[1]
    count = len(offsets)
    rays = np.empty((len(pixels) * count, 3), np.float32)
    along_u = np.empty_like(rays)
    along_v = np.empty_like(rays)
    for m in range(len(pixels)):
        y, x = pixels[m] // width, pixels[m] % width
        left, right = max(x - 1, 0), min(x + 1, width - 1)
        up, down = max(y - 1, 0), min(y + 1, height - 1)
        ux = (table[y, right, 0] - table[y, left, 0]) / max(right - left, 1)
        uy = (table[y, right, 1] - table[y, left, 1]) / max(right - left, 1)
        vx = (table[down, x, 0] - table[up, x, 0]) / max(down - up, 1)
        vy = (table[down, x, 1] - table[up, x, 1]) / max(down - up, 1)
        # At the rim of the invertible region a neighbour is missing: the paraxial change will do.
        if np.isnan(ux) or right == left:
            ux, uy = 1.0 / fx, 0.0
        if np.isnan(vx) or down == up:
            vx, vy = 0.0, 1.0 / fy
        for s in range(count):
            a = table[y, x, 0] + offsets[s, 0] * ux + offsets[s, 1] * vx
            b = table[y, x, 1] + offsets[s, 0] * uy + offsets[s, 1] * vy
            i = m * count + s
            for k in range(3):
                rays[i, k] = R[k, 0] * a + R[k, 1] * b + R[k, 2]
                along_u[i, k] = scale * (R[k, 0] * ux + R[k, 1] * uy)
                along_v[i, k] = scale * (R[k, 0] * vx + R[k, 1] * vy)
    return rays, along_u, along_v


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


@njit(error_model="numpy")
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


@njit(error_model="numpy")
def settle_by_neighbours(
    geometry: Int32, rows: Int64, size: tuple[int, int], values: Array32
) -> Int64:
    """Fill the values of pixels whose neighbours are on their mesh and agree; return the others.

    Args:
        geometry: (H * W,) placed mesh.
        rows: (M,) pixels.
        size: height and width of the image.
        values: (H * W,) known to the left, right, above and below of `rows`; are filled there.
    """
    height, width = size
    left = np.empty(len(rows), np.int64)
    count = 0
    for m in range(len(rows)):
        i = rows[m]
        y, x = i // width, i % width
        settled = 0 < y < height - 1 and 0 < x < width - 1
        if settled:
            for j in (i - 1, i + 1, i - width, i + width):
                if geometry[j] != geometry[i] or values[j] != values[i - 1]:
                    settled = False
        if settled:
            values[i] = values[i - 1]
        else:
            left[count] = i
            count += 1
    return left[:count]


@njit(inline="always", error_model="numpy")
def _alike(p: SurfacePoints, i: int, q: SurfacePoints, j: int) -> bool:
    """Return whether point i of p and point j of q look the same way."""
    turn = p.smooth[i, 0] * q.smooth[j, 0] + p.smooth[i, 1] * q.smooth[j, 1]
    return turn + p.smooth[i, 2] * q.smooth[j, 2] > SAME_DIRECTION


@njit(error_model="numpy")
def borrow_light(
    sky: SkyArrays,
    samples: tuple[SurfacePoints, Int32, Int64],
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
        own = of_pixel[m]
        if mesh[own] == geometry[m] and _alike(mine, m, theirs, own):
            out[0][m], out[1][m] = ambient[own], mirrored[own]
            continue
        row, column = own // width, own % width
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
