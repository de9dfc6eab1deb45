"""Geometry of one face under a ray: where it is met, how it is rounded, how its normal bends."""

import numpy as np

from realsim.arrays import Array32
from realsim.compiled import njit

Edges = tuple[float, float, float, float, float, float]
"""The two edges of a face from its first corner [m]."""


@njit(inline="always", error_model="numpy")
def edges_of(corners: Array32, f: int) -> Edges:
    """Return the two edges of face f from its first corner."""
    x, y, z = corners[f, 0, 0], corners[f, 0, 1], corners[f, 0, 2]
    return (
        corners[f, 1, 0] - x, corners[f, 1, 1] - y, corners[f, 1, 2] - z,
        corners[f, 2, 0] - x, corners[f, 2, 1] - y, corners[f, 2, 2] - z,
    )  # fmt: skip


@njit(inline="always", error_model="numpy")
def plane_met(
    e: Edges,
    o: tuple[float, float, float],
    q: tuple[float, float, float],
    d: tuple[float, float, float],
) -> tuple[float, float, float]:
    """Return the weights of the second and third corner, and t, where a ray meets a plane.

    Moller and Trumbore, "Fast, minimum storage ray/triangle intersection", 1997.

    Args:
        e: the two edges from the first corner.
        o: origin of the ray minus the first corner.
        q: o x first edge.
        d: direction of the ray.
    """
    x, y, z = d
    px, py, pz = y * e[5] - z * e[4], z * e[3] - x * e[5], x * e[4] - y * e[3]
    det = e[0] * px + e[1] * py + e[2] * pz
    safe = det if abs(det) > 1e-30 else 1e-30
    u = (o[0] * px + o[1] * py + o[2] * pz) / safe
    v = (x * q[0] + y * q[1] + z * q[2]) / safe
    return u, v, (e[3] * q[0] + e[4] * q[1] + e[5] * q[2]) / safe


@njit(inline="always", error_model="numpy")
def bulge_of(e: Edges, m: Array32, weights: tuple[float, float, float]) -> float:
    """Return how high the rounded surface stands above a point of the face; 0 in hollows.

    The mean of the heights of the corners' tangent planes (Hanika, "Hacking the shadow
    terminator", Ray Tracing Gems II, 2021): rays to the sun that start there do not show the facets
    of the mesh.

    Args:
        e: the two edges from the first corner.
        m: normals of the corners.
        weights: of the corners.
    """
    a, b, w = weights
    px, py, pz = b * e[0] + w * e[3], b * e[1] + w * e[4], b * e[2] + w * e[5]
    height = a * max(-(px * m[0, 0] + py * m[0, 1] + pz * m[0, 2]), 0.0)
    qx, qy, qz = px - e[0], py - e[1], pz - e[2]
    height += b * max(-(qx * m[1, 0] + qy * m[1, 1] + qz * m[1, 2]), 0.0)
    qx, qy, qz = px - e[3], py - e[4], pz - e[5]
    return height + w * max(-(qx * m[2, 0] + qy * m[2, 1] + qz * m[2, 2]), 0.0)


@njit(error_model="numpy")
def bent_normal(
    n: tuple[float, float, float],
    e: Edges,
    uv: tuple[float, float, float, float],
    bend: tuple[float, float, float, float],
) -> tuple[float, float, float, float]:
    """Return the normal bent by the normal image, and the spread of normals it stands for.

    The averaged normal of many texels is shorter than 1; the rest widens the highlight (Toksvig,
    "Mipmapping normal maps", 2005).
    """
    ux, uy, vx, vy = uv
    det = ux * vy - uy * vx
    if abs(det) < 1e-20:
        return n[0], n[1], n[2], 0.0
    tx, ty, tz = (
        (e[0] * vy - e[3] * uy) / det,
        (e[1] * vy - e[4] * uy) / det,
        (e[2] * vy - e[5] * uy) / det,
    )
    along = tx * n[0] + ty * n[1] + tz * n[2]
    tx, ty, tz = tx - along * n[0], ty - along * n[1], tz - along * n[2]
    length = max(np.sqrt(tx * tx + ty * ty + tz * tz), 1e-20)
    tx, ty, tz = tx / length, ty / length, tz / length
    # The second axis runs along +v; mirrored coordinates turn it round.
    bx, by, bz = n[1] * tz - n[2] * ty, n[2] * tx - n[0] * tz, n[0] * ty - n[1] * tx
    wx, wy, wz = e[3] * ux - e[0] * vx, e[4] * ux - e[1] * vx, e[5] * ux - e[2] * vx
    if (bx * wx + by * wy + bz * wz) * det < 0:
        bx, by, bz = -bx, -by, -bz
    # 8-bit images say 128 for "not bent", half a step off the middle.
    x, y, z = (255 * bend[0] - 128) / 127, (255 * bend[1] - 128) / 127, (255 * bend[2] - 128) / 127
    size = min(max(np.sqrt(x * x + y * y + z * z), 0.2), 1.0)
    sx, sy, sz = (
        tx * x + bx * y + n[0] * z,
        ty * x + by * y + n[1] * z,
        tz * x + bz * y + n[2] * z,
    )
    length = max(np.sqrt(sx * sx + sy * sy + sz * sz), 1e-12)
    return sx / length, sy / length, sz / length, 2 * (1 - size) / size
