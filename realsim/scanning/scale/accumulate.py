"""The normal equations of the joint fit, added up point by point in compiled code.

Unknowns of one view's block (18): the object [omega, v, lambda] (7), the camera [omega, v] (6), the
table [tilt, tilt, height] (3), the depth bias c (1) and the outline's offset (1).

Object: m = exp(-omega) (R^T (p - t) - v) / (s exp(lambda)), residual r = s phi(m), g = grad phi:
    dr/domega = -s (m x g),   dr/dv = -g,   dr/dlambda = r - s g.m
Camera: p = T exp(xi) p_cam, h the residual's gradient in camera axes:
    dr/domega_c = p_cam x h,  dr/dv_c = h
Bias: dz = c z^2 along the ray, dr/dc = h.ray z^2.
Table: r = n.(p - o) - height, with n tilted about two axes of the plane through o.
Outline: r = (D(u) - b) z / f, D the signed distance to the measured outline in pixels.
Shape: the real surface lies outside of the mesh by delta_k in patch k of the surface; then a
surface point has r - delta_k and an outline point r + delta_k.
"""

import numpy as np
from numpy.typing import NDArray

from realsim.compiled import njit
from realsim.geometry.distance_field import sample
from realsim.geometry.lens_loops import pixel

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
BLOCK = 18
FRONT_STEPS = 6
"""Cells by which a point behind a thin wall is followed towards the camera that saw it."""
KINK = 0.64
"""Squared gradient below which a cell of the field holds two surfaces."""
EDGE_CELLS = 0.3
"""Points nearer than this to the surface are not asked whether they lie beyond an edge [cells]."""
DEEP_CELLS = 1.5
"""Cells inside of the surface at which the direction of the face is looked up."""
EDGE_COS = 0.9
"""Cosine between the directions outside and inside below which a point lies beyond an edge."""
WALL_COS = 0.2
"""... unless it is below this."""
LEAST_ALONG = 0.15
"""Least cosine between ray and normal at which the ray is followed to the surface."""
GATE = 0.05
"""Least cosine between a surface and the direction to the camera that saw it."""


@njit(inline="always")
def _turned(M: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the vector turned by the rotation of M."""
    return (
        M[0, 0] * x + M[0, 1] * y + M[0, 2] * z,
        M[1, 0] * x + M[1, 1] * y + M[1, 2] * z,
        M[2, 0] * x + M[2, 1] * y + M[2, 2] * z,
    )


@njit(inline="always")
def _turned_back(M: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the vector turned by the inverse of the rotation of M."""
    return (
        M[0, 0] * x + M[1, 0] * y + M[2, 0] * z,
        M[0, 1] * x + M[1, 1] * y + M[2, 1] * z,
        M[0, 2] * x + M[1, 2] * y + M[2, 2] * z,
    )


@njit(inline="always")
def _camera_terms(
    J: Array, a: tuple[float, float, float], h: tuple[float, float, float], r: float
) -> None:
    """Fill in the derivatives by the camera and the depth's bias of a measured point's residual.

    The noise of a point is in its residual and must not be in its derivative too: the derivative
    is taken where the ray meets the surface.

    Args:
        J: (18,) filled in.
        a: the point in camera axes [m].
        h: the residual's gradient there.
        r: the residual [m].
    """
    along = (h[0] * a[0] + h[1] * a[1] + h[2] * a[2]) / a[2]
    f = 1.0 - r / (along * a[2]) if abs(along) > LEAST_ALONG else 1.0
    x, y, z = f * a[0], f * a[1], f * a[2]
    J[7], J[8], J[9] = y * h[2] - z * h[1], z * h[0] - x * h[2], x * h[1] - y * h[0]
    J[10], J[11], J[12] = h
    J[16] = along * z * z


@njit(inline="always")
def _facing(
    lattice: tuple[NDArray[np.float32], Array, float],
    m: tuple[float, float, float],
    v: tuple[float, float, float],
) -> tuple[float, float, float, float, bool]:
    """Return distance and gradient towards the surface that the camera can have seen from m.

    v is the unit direction to the camera. A point within or behind a thin wall is moved towards the
    camera until a surface faces it; the distance is then that to the tangent plane there.
    """
    grid, origin, cell = lattice
    x, y, z = m
    r, gx, gy, gz = sample(grid, origin, cell, x, y, z)
    t = 0.0
    while t < FRONT_STEPS * cell and (
        gx * v[0] + gy * v[1] + gz * v[2] <= GATE or gx * gx + gy * gy + gz * gz < KINK
    ):
        t += cell
        r, gx, gy, gz = sample(grid, origin, cell, x + t * v[0], y + t * v[1], z + t * v[2])
    facing = gx * v[0] + gy * v[1] + gz * v[2]
    # Beyond an edge the nearest place is the edge itself, and the distance to it says that the
    # model is too small; short of it there is nothing to say that it is too large. Such a point is
    # known by the direction inside of the surface, which is that of a face.
    if facing > GATE and r > EDGE_CELLS * cell:
        deep = r + DEEP_CELLS * cell
        _, ix, iy, iz = sample(
            grid, origin, cell, x + t * v[0] - deep * gx, y + t * v[1] - deep * gy,
            z + t * v[2] - deep * gz,
        )  # fmt: skip
        size = ix * ix + iy * iy + iz * iz
        # The other side of a thin wall points the other way: that is no edge.
        along = (gx * ix + gy * iy + gz * iz) / np.sqrt(max(size, 1e-12))
        if size > KINK and WALL_COS < along < EDGE_COS:
            return r - t * facing, gx, gy, gz, False
    return r - t * facing, gx, gy, gz, facing > GATE


@njit
def add_surface(
    lattice: tuple[NDArray[np.float32], Array, float],
    pose: tuple[float, Array, Array],
    cameras: Array,
    data: tuple[Array, NDArray[np.int64], Array, Array],
    patches: tuple[NDArray[np.int64], Array],
    system: tuple[Array, Array, Array, Array, Array],
    out: tuple[Array, Array],
) -> None:
    """Add the object's points.

    Args:
        lattice: grid, origin and cell of the distance field.
        pose: s, R and t of the object.
        cameras: (V, 4, 4) cameras as they stand now.
        data: points in camera axes (N, 3), view (N,), weight (N,) [1/m^2], and the square (N,) of
            the distance at which Tukey's kernel ends [m^2].
        patches: patch (N,) of every point, and where the real surface is believed to lie outside
            of the mesh there (K,) [m].
        system: H (V, 18, 18) upper triangles and b (V, 18); Hd (V, K, 18), D (K,) and e (K,) of the
            patches' offsets. All are added to.
        out: residuals (N,) [m] and Tukey's weights (N,), filled; NaN and 0 = not used.
    """
    s, R, t = pose
    points, views, weight, reach = data
    patch, offset = patches
    H, b, Hd, D, e = system
    residuals, kernels = out
    J = np.zeros(BLOCK)
    for i in range(len(points)):
        k = views[i]
        C = cameras[k]
        a = points[i, 0], points[i, 1], points[i, 2]
        # From the object's centre to the camera and to the point, and from the point to the camera.
        c0, c1, c2 = C[0, 3] - t[0], C[1, 3] - t[1], C[2, 3] - t[2]
        q0, q1, q2 = _turned(C, a[0], a[1], a[2])
        far = np.sqrt(q0 * q0 + q1 * q1 + q2 * q2)
        m0, m1, m2 = _turned_back(R, (c0 + q0) / s, (c1 + q1) / s, (c2 + q2) / s)
        v = _turned_back(R, -q0 / far, -q1 / far, -q2 / far)
        r, gx, gy, gz, ok = _facing(lattice, (m0, m1, m2), v)
        r *= s
        residuals[i], kernels[i] = np.nan, 0.0
        if not ok:
            continue
        residuals[i] = r
        n = patch[i]
        q = (r - offset[n]) ** 2 / reach[i]
        if q >= 1.0:
            continue
        tukey = (1.0 - q) ** 2
        kernels[i] = tukey
        w = tukey * weight[i]
        J[0], J[1], J[2] = (
            -s * (m1 * gz - m2 * gy),
            -s * (m2 * gx - m0 * gz),
            -s * (m0 * gy - m1 * gx),
        )
        J[3], J[4], J[5] = -gx, -gy, -gz
        J[6] = r - s * (gx * m0 + gy * m1 + gz * m2)
        w0, w1, w2 = _turned(R, gx, gy, gz)
        _camera_terms(J, a, _turned_back(C, w0, w1, w2), r)
        D[n] += w
        e[n] += w * r
        for c in range(17):
            if 13 <= c < 16:
                continue
            b[k, c] -= w * J[c] * r
            Hd[k, n, c] -= w * J[c]
            for d in range(c, 17):
                H[k, c, d] += w * J[c] * J[d]


@njit
def add_table(
    frame: tuple[Array, Array, Array, Array],
    cameras: Array,
    data: tuple[Array, NDArray[np.int64], Array],
    cut: float,
    H: Array,
    b: Array,
) -> float:
    """Add the table's points; return the weighted sum of their squares.

    Args:
        frame: normal n, two axes of the plane, and a point o on it, each (3,) in world.
        cameras: (V, 4, 4).
        data: points in camera axes (N, 3), view (N,), variance (N,).
        cut: Tukey's cut-off [sigma].
        H: (V, 18, 18) added to.
        b: (V, 18) added to.
    """
    normal, e1, e2, o = frame
    points, views, variance = data
    J = np.zeros(BLOCK)
    total = 0.0
    for i in range(len(points)):
        k = views[i]
        C = cameras[k]
        a = points[i, 0], points[i, 1], points[i, 2]
        p0, p1, p2 = _turned(C, a[0], a[1], a[2])
        p0, p1, p2 = p0 + C[0, 3] - o[0], p1 + C[1, 3] - o[1], p2 + C[2, 3] - o[2]
        r = normal[0] * p0 + normal[1] * p1 + normal[2] * p2
        q = r * r / (cut * cut * variance[i])
        if q >= 1.0:
            continue
        w = (1.0 - q) ** 2 / variance[i]
        h = _turned_back(C, normal[0], normal[1], normal[2])
        J[13] = e1[0] * p0 + e1[1] * p1 + e1[2] * p2
        J[14] = e2[0] * p0 + e2[1] * p1 + e2[2] * p2
        J[15] = -1.0
        _camera_terms(J, a, h, r)
        for c in range(7, 17):
            b[k, c] -= w * J[c] * r
            for d in range(c, 17):
                H[k, c, d] += w * J[c] * J[d]
        total += w * r * r
    return total


@njit
def add_outline(  # noqa: PLR0915 - one pass over the points, in compiled code
    pose: tuple[float, Array, Array],
    T_world_cam: Array,
    camera: Array,
    rim: tuple[Array32, Array32, float, float],
    data: tuple[Array, Array, float, float],
    limits: tuple[float, float, float, bool],
    patches: tuple[NDArray[np.int64], Array],
    system: tuple[Array, Array, Array, Array, Array],
) -> None:
    """Add the points of the model's outline in one view, or its points outside of the measured one.

    Args:
        pose: s, R and t of the object.
        T_world_cam: (4, 4).
        camera: (12,) fx fy cx cy and the eight distortion terms.
        rim: distance and gap images [px], left and top of the crop.
        data: points (N, 3) in the inner mesh's axes, factor (N,), the outline's offset [px], and
            the variance of a point without gap [px^2].
        limits: widest gap that says anything [px], Tukey's cut-off [sigma], variance of the shape
            [m^2], and whether only points outside count: the camera looked through there.
        patches: as of `add_surface`.
        system: H (18, 18) and b (18) of this view; Hd (K, 18), D (K,) and e (K,) of the patches.
    """
    s, R, t = pose
    distance, gaps, left, top = rim
    points, factor, offset, base = data
    widest, cut, shape, one_sided = limits
    patch, outer = patches
    H, b, Hd, D_patch, e_patch = system
    fx, fy = camera[0], camera[1]
    C = T_world_cam
    f = 0.5 * (fx + fy)
    height, width = distance.shape
    J = np.zeros(BLOCK)
    for i in range(len(points)):
        m0, m1, m2 = s * points[i, 0], s * points[i, 1], s * points[i, 2]
        p0, p1, p2 = _turned(R, m0, m1, m2)
        a0, a1, a2 = _turned_back(C, p0 + t[0] - C[0, 3], p1 + t[1] - C[1, 3], p2 + t[2] - C[2, 3])
        if a2 <= 0.02:
            continue
        x, y = a0 / a2, a1 / a2
        u, v = pixel(camera, x, y)
        u, v = u - left, v - top
        j, i0 = int(np.floor(u)), int(np.floor(v))
        if j < 1 or i0 < 1 or j >= width - 2 or i0 >= height - 2:
            continue
        gap = gaps[i0, j]
        if gap > widest and not one_sided:
            continue
        gap = 1.0 if one_sided else gap
        du, dv = u - j, v - i0
        d00, d01 = distance[i0, j], distance[i0, j + 1]
        d10, d11 = distance[i0 + 1, j], distance[i0 + 1, j + 1]
        top_row, low_row = d00 + du * (d01 - d00), d10 + du * (d11 - d10)
        D = top_row + dv * (low_row - top_row)
        gu = (d01 - d00) * (1 - dv) + (d11 - d10) * dv
        gv = low_row - top_row
        if one_sided and D <= offset:
            continue
        metre = a2 / f
        r = (D - offset) * metre
        # Uniform over the gap: gap^2 / 12; a gap of one pixel is none.
        variance = (base + (gap - 1.0) ** 2 / 12.0) * metre * metre
        n = patch[i]
        # Where the real surface lies outside of the mesh, so does the outline.
        q = (r + outer[n]) ** 2 / (cut * cut * (variance + shape))
        if q >= 1.0:
            continue
        w = (1.0 - q) ** 2 * factor[i] / variance
        # Gradient of r in camera axes, the lens taken for straight here.
        h0 = gu * fx / f
        h1 = gv * fy / f
        h2 = -(h0 * x + h1 * y)
        w0, w1, w2 = _turned(C, h0, h1, h2)
        g0, g1, g2 = _turned_back(R, w0, w1, w2)
        J[0], J[1], J[2] = m1 * g2 - m2 * g1, m2 * g0 - m0 * g2, m0 * g1 - m1 * g0
        J[3], J[4], J[5] = g0, g1, g2
        J[6] = g0 * m0 + g1 * m1 + g2 * m2
        J[7], J[8], J[9] = -(a1 * h2 - a2 * h1), -(a2 * h0 - a0 * h2), -(a0 * h1 - a1 * h0)
        J[10], J[11], J[12] = -h0, -h1, -h2
        J[17] = -metre
        D_patch[n] += w
        e_patch[n] -= w * r
        for c in range(18):
            if 13 <= c < 17:
                continue
            b[c] -= w * J[c] * r
            Hd[n, c] += w * J[c]
            for d in range(c, 18):
                H[c, d] += w * J[c] * J[d]
