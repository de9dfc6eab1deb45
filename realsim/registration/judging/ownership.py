"""Which object a measured point belongs to: the one whose surface is nearest, or the table."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Array32, Int32
from realsim.compiled import njit
from realsim.geometry import se3
from realsim.geometry.distance_field import sample
from realsim.geometry.point_loops import move
from realsim.records import SupportPlane
from realsim.registration.body import Body


@njit
def claim_points(
    points: Array,
    lattice: tuple[Array32, Array, float],
    T_obj_world: Array,
    bounds: tuple[Array, Array, float],
    number: int,
    taken: tuple[Array, Int32],
) -> None:
    """Give to an object the points that are nearer to it than to what has them so far.

    Args:
        points: (N, 3) in world [m].
        lattice: grid, origin and cell of the object's distance field.
        T_obj_world: (4, 4).
        bounds: the object's box (2, 3) in its own frame, its centre in world, and the radius
            beyond which it claims nothing [m].
        number: of the object.
        taken: (N,) distance to the present owner [m] and (N,) its number; both are changed.
    """
    grid, origin, cell = lattice
    best, owner = taken
    box, center, radius = bounds
    T = T_obj_world
    for m in range(len(points)):
        a, b, c = points[m, 0], points[m, 1], points[m, 2]
        near = best[m]
        if (a - center[0]) ** 2 + (b - center[1]) ** 2 + (c - center[2]) ** 2 > radius * radius:
            continue
        x, y, z = move(T, a, b, c)
        # The box is no nearer than the surface: most points need no look at the field.
        ox = max(box[0, 0] - x, x - box[1, 0], 0.0)
        oy = max(box[0, 1] - y, y - box[1, 1], 0.0)
        oz = max(box[0, 2] - z, z - box[1, 2], 0.0)
        if ox * ox + oy * oy + oz * oz >= near * near:
            continue
        d = abs(sample(grid, origin, cell, x, y, z)[0])
        if d < near:
            best[m] = d
            owner[m] = number


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Claims:
    """What is needed to say which object a point is nearest to, prepared once for all views."""

    reach_m: float
    """Points further from every surface belong to none [m]."""
    T_table_world: Array | None
    """(4, 4); the table claims points too."""
    objects: tuple[tuple[tuple[Array32, Array, float], Array, Array, Array], ...]
    """Per object: distance field, T_obj_world (4, 4), box (2, 3), its centre in world (3,)."""
    radii: tuple[float, ...]
    """Per object: radius beyond which it claims nothing [m]."""


def make_claims(
    bodies: Sequence[Body], poses: Sequence[Array], plane: SupportPlane | None, reach_m: float
) -> Claims:
    """Return the claims of the objects at their poses T_world_obj, and of the table."""
    return Claims(
        reach_m=reach_m,
        T_table_world=None if plane is None else se3.invert(plane.T_world_table),
        objects=tuple(
            (b.field.lattice, se3.invert(T), b.model.mesh.bounds, b.center(T))
            for b, T in zip(bodies, poses, strict=True)
        ),
        radii=tuple(b.radius_m + reach_m for b in bodies),
    )


def owners(claims: Claims, points: Array) -> Int32:
    """Return for points (N, 3) in world the number of the object each is nearest to; -1 = none."""
    best = np.full(len(points), claims.reach_m)
    owner = np.full(len(points), -1, dtype=np.int32)
    T = claims.T_table_world
    if T is not None:
        best = np.minimum(best, np.abs(points @ T[2, :3] + T[2, 3]))
    for k, (lattice, T_obj_world, box, center) in enumerate(claims.objects):
        bounds = (box, center, claims.radii[k])
        claim_points(points, lattice, T_obj_world, bounds, k, (best, owner))
    return owner
