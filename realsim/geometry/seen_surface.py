"""How far measured points lie from the surface that their camera saw, and which way it faces.

The thin-wall rule: the nearest surface of a point within or behind a thin wall is often the far
side, which the camera cannot have seen. The point is moved towards the camera until a surface faces
it; what is measured is the distance of the point itself to the tangent plane there.
"""

import numpy as np

from realsim.arrays import Array, Array32, Int32
from realsim.compiled import njit
from realsim.geometry.distance_field import sample
from realsim.geometry.point_loops import move

Lattice = tuple[Array32, Array, float]
"""Grid, origin and cell of a distance field: `DistanceField.lattice`."""
Vector = tuple[float, float, float]
FRONT_STEPS = 6
"""Cells by which a point behind a thin wall is followed towards the camera that saw it: walls of up
to about 10 mm; a point deeper inside has its own surface."""
KINK = 0.64
"""Squared gradient below which a grid cell holds two surfaces (a distance has gradient 1)."""
GATE_COS = 0.05
"""Least cosine between a surface and the direction to the camera: none is seen from behind."""
EDGE_CELLS = 0.3
"""Points nearer than this to the surface are not asked whether they lie beyond an edge [cells]."""
DEEP_CELLS = 1.5
"""Cells inside of the surface at which the direction of the face is looked up."""
EDGE_COS = 0.9
"""Cosine between the directions outside and inside below which a point lies beyond an edge."""
WALL_COS = 0.2
"""Below this cosine a point lies at a thin wall, not beyond an edge."""


@njit(inline="always")
def follow_to_camera(
    lattice: Lattice, place: Vector, towards: Vector, first: tuple[float, float, float, float]
) -> tuple[float, float, float, float, float, float]:
    """Return what the field says where a surface faces the camera that saw a point.

    Args:
        lattice: the field.
        place: the point in the field's frame.
        towards: unit direction from it to the camera.
        first: `sample` at the point.

    Returns:
        distance and gradient there, how far that is towards the camera, and the gradient's
        component towards it: above GATE_COS if a surface was found. The distance of the point
        itself to the tangent plane is `distance - moved * facing`.
    """
    grid, origin, cell = lattice
    x, y, z = place
    vx, vy, vz = towards
    r, gx, gy, gz = first
    t = 0.0
    while t < FRONT_STEPS * cell and (
        gx * vx + gy * vy + gz * vz <= GATE_COS or gx * gx + gy * gy + gz * gz < KINK
    ):
        t += cell
        r, gx, gy, gz = sample(grid, origin, cell, x + t * vx, y + t * vy, z + t * vz)
    return r, gx, gy, gz, t, gx * vx + gy * vy + gz * vz


@njit(inline="always")
def beyond_edge(lattice: Lattice, place: Vector, seen: tuple[float, float, float, float]) -> bool:
    """Return whether a point off the surface has an edge, not a face, as its nearest place.

    Beyond an edge the distance says that the model is too small; short of it there is nothing to
    say that it is too large. Such a point is known by the direction inside of the surface, which is
    that of a face. The other side of a thin wall points the other way: that is no edge.

    Args:
        lattice: the field.
        place: where a surface faces the camera, in the field's frame.
        seen: `sample` there.
    """
    grid, origin, cell = lattice
    r, gx, gy, gz = seen
    if r <= EDGE_CELLS * cell:
        return False
    deep = r + DEEP_CELLS * cell
    x, y, z = place
    _, ix, iy, iz = sample(grid, origin, cell, x - deep * gx, y - deep * gy, z - deep * gz)
    size = ix * ix + iy * iy + iz * iz
    along = (gx * ix + gy * iy + gz * iz) / np.sqrt(max(size, 1e-12))
    return size > KINK and WALL_COS < along < EDGE_COS


@njit
def seen_distances(
    lattice: Lattice,
    scale: float,
    points: Array,
    views: Int32,
    cameras: tuple[Array, Array],
    without_edges: bool,
) -> tuple[Array, Array, Array]:
    """Return places (N, 3) in the body's frame, distances (N,) and normals (N, 3); NaN = unseen.

    Args:
        lattice: of the model's distance field.
        scale: size of the body's frame in the field's: a body twice as large as the model has 2.
        points: (N, 3) in camera axes, without the depth's bias [m].
        views: (N,) the view of each.
        cameras: T_body_cam (V, 4, 4) of every view, and the cameras' places (V, 3) in the body's
            frame.
        without_edges: whether points beyond an edge count as unseen (see `beyond_edge`).
    """
    grid, origin, cell = lattice
    Ms, eyes = cameras
    shrink = 1.0 / scale
    n = len(points)
    places, distances, normals = np.empty((n, 3)), np.empty(n), np.empty((n, 3))
    for i in range(n):
        M, e = Ms[views[i]], eyes[views[i]]
        x, y, z = move(M, points[i, 0], points[i, 1], points[i, 2])
        places[i, 0], places[i, 1], places[i, 2] = x, y, z
        vx, vy, vz = e[0] - x, e[1] - y, e[2] - z
        far = np.sqrt(vx * vx + vy * vy + vz * vz)
        v = vx / far, vy / far, vz / far
        x, y, z = x * shrink, y * shrink, z * shrink
        first = sample(grid, origin, cell, x, y, z)
        r, gx, gy, gz, t, facing = follow_to_camera(lattice, (x, y, z), v, first)
        size = np.sqrt(max(gx * gx + gy * gy + gz * gz, 1e-12))
        facing /= size
        seen = facing > GATE_COS
        if seen and without_edges:
            at = x + t * v[0], y + t * v[1], z + t * v[2]
            seen = not beyond_edge(lattice, at, (r, gx, gy, gz))
        distances[i] = scale * ((r - t * facing * size) / size) if seen else np.nan
        normals[i, 0], normals[i, 1], normals[i, 2] = gx / size, gy / size, gz / size
    return places, distances, normals
