"""Convex parts as closed meshes, one a collision shape."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import InputError
from realsim.formats.robot_scenes.placed_scene import RigidBody
from realsim.records import Mesh

Array = NDArray[np.float64]


def convex_part(points: ArrayLike, name: str) -> Mesh:
    """Return the hull of points (V, 3) [m] as a mesh, its faces outward.

    Raises:
        InputError: the points are flat: engines need a volume (MuJoCo four corners and more).
    """
    from scipy.spatial import ConvexHull, QhullError

    points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
    try:
        hull: Any = ConvexHull(points)
    except (QhullError, ValueError) as error:
        raise InputError(
            f"{name} ({len(points)} points) is flat: it has no volume that could be collided with. "
            "Leave it out."
        ) from error
    corners: NDArray[np.int64] = np.sort(hull.vertices)
    number = np.full(len(points), -1)
    number[corners] = np.arange(len(corners))
    faces = number[hull.simplices]
    at = points[corners]
    a, b, c = np.moveaxis(at[faces], 1, 0)
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return Mesh(vertices=at, faces=faces.astype(np.int32))


def collision_parts(body: RigidBody) -> tuple[Mesh, ...]:
    """Return the convex meshes that collide for a body.

    Raises:
        InputError: the mesh is flat.
    """
    if body.parts is not None:
        return body.parts
    return (convex_part(body.model.mesh.vertices, f"the mesh of '{body.model.name}'"),)
