"""Distances to the triangles themselves, for walls that a distance field cannot resolve."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.geometry.seen_surface import FRONT_STEPS, GATE_COS
from realsim.registration.body import Body

Array = NDArray[np.float64]
Ints = NDArray[np.int32]


def exact_residuals(
    body: Body, points: Array, views: Ints, Ms: Array, eyes: Array
) -> tuple[Array, Array, Array]:
    """Return what `seen_distances` does, from the triangles: for walls thinner than its cells.

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
        facing = np.sum(n * towards[left], axis=1) > GATE_COS
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
