"""What the points of one body say in every view: one 8x8 block each, added up in compiled code.

Unknowns of a block: the twist xi = [omega, v] of the view's points in the body's frame, about the
body's centre, and the depth's bias. A point p of the camera becomes m = M p, M = T_body_cam, and
    m' = exp(xi) m:   dr/domega = m x g,   dr/dv = g        (g the surface's normal, r = g.(m - s))
    1/z' = scale/z + offset:   dr/dscale = -L,   dr/doffset = -L z,   L = g.(m - eye)
where z is the depth along the camera's axis, not the range, which is a third more at the border.
Object, camera, hand-eye and table twists all follow from xi by adjoints (see `equations`).

The noise of a point is in its residual. Were it in the derivative too, the two would be correlated
and hardly visible directions would be pulled by many sigma (errors in variables); so derivatives
are taken where the point's ray meets the surface.
"""

import numpy as np
from numpy.typing import NDArray

from realsim.compiled import njit

Array = NDArray[np.float64]
Ints = NDArray[np.int32]
BLOCK = 8
LEAST_ALONG = 0.15
"""Least cosine between ray and normal at which the ray is followed to the surface."""


@njit
def add_blocks(
    surface: tuple[Array, Array, Array],
    views: Ints,
    frame: tuple[Array, Array, Array],
    precision: tuple[Array, Array],
    system: tuple[Array, Array],
    kernels: Array,
) -> float:
    """Add a body's points to the blocks of their views; return the weighted sum of squares.

    Args:
        surface: places (N, 3) in the body's frame, distances (N,), normals (N, 3).
        views: (N,).
        frame: the body's centre (3,), and of the cameras in the body's frame the place (V, 3) and
            the unit direction (V, 3) in which they look.
        precision: weight (N,) [1/m^2], and the square (N,) of the distance at which Tukey's kernel
            ends [m^2].
        system: H (V, 8, 8) upper triangles and b (V, 8), added to.
        kernels: (N,) filled with Tukey's weights; 0 = not used.
    """
    places, distances, normals = surface
    center, eyes, axes = frame
    weight, reach = precision
    H, b = system
    J = np.empty(BLOCK)
    total = 0.0
    for i in range(len(places)):
        kernels[i] = 0.0
        r = distances[i]
        if np.isnan(r):
            continue
        q = r * r / reach[i]
        if q >= 1.0:
            continue
        k = views[i]
        kernels[i] = (1.0 - q) ** 2
        w = kernels[i] * weight[i]
        gx, gy, gz = normals[i, 0], normals[i, 1], normals[i, 2]
        ex, ey, ez = eyes[k, 0], eyes[k, 1], eyes[k, 2]
        x, y, z = places[i, 0] - ex, places[i, 1] - ey, places[i, 2] - ez
        far = np.sqrt(x * x + y * y + z * z)
        along = gx * x + gy * y + gz * z
        deep = axes[k, 0] * x + axes[k, 1] * y + axes[k, 2] * z
        f = 1.0 - r / along if abs(along) > LEAST_ALONG * far else 1.0
        x, y, z = ex + f * x - center[0], ey + f * y - center[1], ez + f * z - center[2]
        J[0], J[1], J[2] = y * gz - z * gy, z * gx - x * gz, x * gy - y * gx
        J[3], J[4], J[5] = gx, gy, gz
        J[6] = -f * along
        J[7] = -f * along * f * deep
        for c in range(BLOCK):
            b[k, c] -= w * J[c] * r
            for d in range(c, BLOCK):
                H[k, c, d] += w * J[c] * J[d]
        total += w * r * r
    return total
