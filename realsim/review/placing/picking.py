"""What a click meets: the ray from the browser's camera against models and measured points."""

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Array32, Int32
from realsim.compiled import njit
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import Mesh

SLOPE = 3.0
"""How steeply a surface may run away from the eye [m per m across the ray]: 72 degrees. A point
beside the ray hides one on it only if it is nearer by more than that."""
CLICK_RAD = 0.006
"""Half angle of the cone in which measured points are looked for [rad]: 5 px of a 900 px canvas
with 60 degrees."""
CLICK_M = 0.002
"""Least radius of the cone [m]: the spacing of the cloud's points."""
PARALLEL = 1e-12
"""Least sine of the angle between a ray and a triangle, so to speak, that it can meet."""


def ray_on_mesh(
    origin: ArrayLike, direction: ArrayLike, mesh: Mesh, T_world_obj: ArrayLike
) -> Array | None:
    """Return the nearest point (3,) of a placed mesh on a ray, in the OBJECT's frame [m].

    Triangles count from both sides, so that open meshes can be clicked on, too (Möller and
    Trumbore 1997).

    Args:
        origin: (3,) of the ray in world [m].
        direction: (3,) in world, any length.
        mesh: the object.
        T_world_obj: (4, 4) where it stands.

    Returns:
        None if the ray passes it by.

    Raises:
        InputError: the ray has no direction, or is not finite.
    """
    o, d = _ray(origin, direction)
    T_obj_world = se3.invert(T_world_obj)
    o = T_obj_world[:3, :3] @ o + T_obj_world[:3, 3]
    d = T_obj_world[:3, :3] @ d
    low, high = mesh.bounds
    if not _meets_ball(o, d, 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))):
        return None
    t = _first_triangle(o, d, mesh.vertices, mesh.faces)
    return o + t * d if np.isfinite(t) else None


def ray_on_cloud(origin: ArrayLike, direction: ArrayLike, points: Array32) -> Array | None:
    """Return the measured point (3,) that a click on a cloud means, in world [m].

    Of the points within the cone it is the one with the least t + 3 a, t along the ray and a
    across it: on one surface, even a slanted one, that is the point nearest to the ray, and of two
    surfaces one behind the other it is on the nearer one.

    Args:
        origin: (3,) of the ray in world [m].
        direction: (3,) in world, any length.
        points: (N, 3) in world [m]; points that are not finite are passed over.

    Returns:
        None if no point lies in the cone.

    Raises:
        InputError: the ray has no direction, or the points have another shape.
    """
    o, d = _ray(origin, direction)
    p = np.asarray(points)
    if p.ndim != 2 or p.shape[1] != 3:
        raise InputError(f"the cloud has the shape {p.shape}; (N, 3) is accepted.")
    k = _in_cone(o, d, np.ascontiguousarray(p), CLICK_M, float(np.tan(CLICK_RAD)))
    return None if k < 0 else p[k].astype(np.float64)


def _ray(origin: ArrayLike, direction: ArrayLike) -> tuple[Array, Array]:
    """Return a ray's origin and unit direction (3,) each."""
    o = np.array(origin, dtype=np.float64).reshape(-1)
    d = np.array(direction, dtype=np.float64).reshape(-1)
    length = float(np.linalg.norm(d)) if d.shape == (3,) else 0.0
    if o.shape != (3,) or not np.all(np.isfinite(o)) or not (0 < length < np.inf):
        raise InputError(
            f"a ray from {o.tolist()} towards {d.tolist()} is none; a finite point and a direction "
            "of three numbers each are needed."
        )
    return o, d / length


def _meets_ball(o: Array, d: Array, center: Array, radius: float) -> bool:
    """Return whether a ray passes through a ball ahead of it."""
    to = center - o
    along = float(to @ d)
    away2 = float(to @ to)
    if away2 <= radius**2:
        return True
    return along > 0 and away2 - along**2 <= radius**2


@njit
def _first_triangle(o: Array, d: Array, vertices: Array, faces: Int32) -> float:
    """Return the parameter of the first triangle on a ray; inf = none.

    Args:
        o: (3,) origin.
        d: (3,) unit direction.
        vertices: (V, 3), read only arrays are fine.
        faces: (F, 3).
    """
    first = np.inf
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        ux, uy, uz = vertices[j, 0] - ax, vertices[j, 1] - ay, vertices[j, 2] - az
        vx, vy, vz = vertices[k, 0] - ax, vertices[k, 1] - ay, vertices[k, 2] - az
        px, py, pz = d[1] * vz - d[2] * vy, d[2] * vx - d[0] * vz, d[0] * vy - d[1] * vx
        det = ux * px + uy * py + uz * pz
        size = np.sqrt((ux * ux + uy * uy + uz * uz) * (vx * vx + vy * vy + vz * vz))
        if abs(det) <= PARALLEL * size:
            continue
        tx, ty, tz = o[0] - ax, o[1] - ay, o[2] - az
        a = (tx * px + ty * py + tz * pz) / det
        if a < 0.0 or a > 1.0:
            continue
        qx, qy, qz = ty * uz - tz * uy, tz * ux - tx * uz, tx * uy - ty * ux
        b = (d[0] * qx + d[1] * qy + d[2] * qz) / det
        if b < 0.0 or a + b > 1.0:
            continue
        t = (vx * qx + vy * qy + vz * qz) / det
        if 0.0 < t < first:
            first = t
    return first


@njit
def _in_cone(o: Array, d: Array, points: Array32, radius: float, tangent: float) -> int:
    """Return which of the points (N, 3) a ray means; -1 = none. See `ray_on_cloud`."""
    best, least = -1, np.inf
    for k in range(len(points)):
        x, y, z = points[k, 0] - o[0], points[k, 1] - o[1], points[k, 2] - o[2]
        t = x * d[0] + y * d[1] + z * d[2]
        if not t > 0.0:
            continue
        across2 = x * x + y * y + z * z - t * t
        reach = max(radius, tangent * t)
        if not across2 <= reach * reach:
            continue
        cost = t + SLOPE * np.sqrt(max(across2, 0.0))
        if cost < least:
            best, least = k, cost
    return best
