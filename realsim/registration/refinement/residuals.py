"""How far measured points lie from the surface that the camera saw, and in which direction.

A point within or behind a thin wall is moved towards the camera until a surface faces it: that is
the surface the camera saw. What is fitted is the distance to the tangent plane there.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.compiled import njit
from realsim.geometry.distance_field import sample
from realsim.registration.body import Body

Array = NDArray[np.float64]
Ints = NDArray[np.int32]
FRONT_STEPS = 6
"""Cells by which a point behind a thin wall is followed towards the camera that saw it."""
KINK = 0.64
"""Squared gradient below which a cell of the field holds two surfaces."""
GATE = 0.05
"""Least cosine between a surface and the direction to the camera that saw it."""


@njit
def field_residuals(
    lattice: tuple[NDArray[np.float32], Array, float],
    points: Array,
    views: Ints,
    Ms: Array,
    eyes: Array,
) -> tuple[Array, Array, Array]:
    """Return places (N, 3) in the body's frame, distances (N,) and normals (N, 3); NaN = unseen.

    Args:
        lattice: grid, origin and cell of the distance field.
        points: (N, 3) corrected, in camera axes.
        views: (N,).
        Ms: (V, 4, 4) T_obj_cam of every view.
        eyes: (V, 3) the cameras in the body's frame.
    """
    grid, origin, cell = lattice
    n = len(points)
    places, distances, normals = np.empty((n, 3)), np.empty(n), np.empty((n, 3))
    for i in range(n):
        M, e = Ms[views[i]], eyes[views[i]]
        a, b, c = points[i, 0], points[i, 1], points[i, 2]
        x = M[0, 0] * a + M[0, 1] * b + M[0, 2] * c + M[0, 3]
        y = M[1, 0] * a + M[1, 1] * b + M[1, 2] * c + M[1, 3]
        z = M[2, 0] * a + M[2, 1] * b + M[2, 2] * c + M[2, 3]
        places[i, 0], places[i, 1], places[i, 2] = x, y, z
        vx, vy, vz = e[0] - x, e[1] - y, e[2] - z
        far = np.sqrt(vx * vx + vy * vy + vz * vz)
        vx, vy, vz = vx / far, vy / far, vz / far
        r, gx, gy, gz = sample(grid, origin, cell, x, y, z)
        t = 0.0
        while t < FRONT_STEPS * cell and (
            gx * vx + gy * vy + gz * vz <= GATE or gx * gx + gy * gy + gz * gz < KINK
        ):
            t += cell
            r, gx, gy, gz = sample(grid, origin, cell, x + t * vx, y + t * vy, z + t * vz)
        size = np.sqrt(max(gx * gx + gy * gy + gz * gz, 1e-12))
        facing = (gx * vx + gy * vy + gz * vz) / size
        distances[i] = (r - t * facing * size) / size if facing > GATE else np.nan
        normals[i, 0], normals[i, 1], normals[i, 2] = gx / size, gy / size, gz / size
    return places, distances, normals


def exact_residuals(
    body: Body, points: Array, views: Ints, Ms: Array, eyes: Array
) -> tuple[Array, Array, Array]:
    """Return the same from the triangles themselves: for walls thinner than the field's cells.

    The closest triangle that faces the camera: where the closest one looks away, the point is moved
    towards the camera by the distance to it and asked again.
    """
    from realsim.interop import import_open3d

    o3d: Any = import_open3d()
    M = Ms[views]
    places = np.einsum("nij,nj->ni", M[:, :3, :3], points) + M[:, :3, 3]
    towards = eyes[views] - places
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    asked = places.copy()
    normals = np.zeros_like(places)
    distances = np.full(len(places), np.nan)
    left = np.arange(len(places))
    for _ in range(FRONT_STEPS):
        if len(left) == 0:
            break
        answer = body.ray_scene.compute_closest_points(
            o3d.core.Tensor(asked[left].astype(np.float32))
        )
        on = answer["points"].numpy().astype(np.float64)
        n = answer["primitive_normals"].numpy().astype(np.float64)
        facing = np.sum(n * towards[left], axis=1) > GATE
        found = left[facing]
        normals[found] = n[facing]
        distances[found] = np.sum(n[facing] * (places[found] - on[facing]), axis=1)
        left, on = left[~facing], on[~facing]
        gap = np.linalg.norm(asked[left] - on, axis=1, keepdims=True)
        asked[left] += (gap + 0.25 * body.field.cell) * towards[left]
    return places, distances, normals


def thin_share(body: Body, cells: float) -> float:
    """Return the share of the surface behind which the other side is nearer than so many cells."""
    from realsim.interop import import_open3d

    o3d: Any = import_open3d()
    start = body.samples - 1e-5 * body.normals
    rays = np.concatenate([start, -body.normals], axis=1).astype(np.float32)
    t = body.ray_scene.cast_rays(o3d.core.Tensor(rays), 1)["t_hit"].numpy()
    return float(np.mean(t < cells * body.field.cell))
