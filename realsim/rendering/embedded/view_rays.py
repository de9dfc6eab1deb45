"""The rays of a view in world, and how they change over a pixel."""

import numpy as np
from numpy.typing import NDArray

from realsim.compiled import njit

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]


@njit(error_model="numpy")
def world_rays(
    table: Array32,
    camera: tuple[Array, float, float],
    pixels: NDArray[np.int64],
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
