"""Where known objects stand on a simulated table, and models as a scan's user would have them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.models.resting import Resting, resting_orientations
from realsim.models.symmetry import SymmetryConfig, find_symmetries
from realsim.records import Mesh, ObjectModel, ObjectPose
from realsim.registration.simulated_lab import TableLabConfig

Array = NDArray[np.float64]
LEAST_PROBABILITY = 0.01
"""Resting poses rarer than this are not simulated: nobody sets an object down that way."""
TRIES = 1500
"""Random places that are tried for one object: more fill no tighter disc."""
POSES_PER_PLACE = 10
"""Places that are tried before the object is turned over to another resting pose and yaw."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Scattered:
    """Objects that found room on the table."""

    objects: tuple[ObjectPose, ...]
    """Where they stand on the plane z = 0; instances are numbered in the order asked for."""
    left_out: tuple[ObjectPose, ...] = ()
    """Those that found none: id and instance count, the pose is the identity."""


def scatter_objects(
    meshes: Mapping[int, Mesh],
    wanted: Sequence[int],
    config: TableLabConfig,
    rng: np.random.Generator,
) -> Scattered:
    """Return objects put on the table z = 0 at random, so close that they nearly touch.

    Each rests in a stable pose of its hull (chosen by probability; those under 1 % are dropped),
    turned by any yaw, with the middle of its shadow in a disc about the origin. The shadows of two
    hulls are at least `config.gap_m` apart, so no two objects can touch.

    Args:
        meshes: the objects' meshes [m], by object id.
        wanted: object ids, one per instance; an id may come several times.
        config: the disc and the gap.
        rng: of poses and places.

    Raises:
        InputError: an id has no mesh.
    """
    unknown = sorted(set(wanted) - set(meshes))
    if unknown:
        raise InputError(
            f"there is no mesh for the object ids {unknown}; there are meshes for {sorted(meshes)}."
        )
    placed: list[ObjectPose] = []
    left_out: list[ObjectPose] = []
    shadows: list[Array] = []
    for instance, obj_id in enumerate(wanted):
        found = _place(meshes[obj_id], shadows, config, rng)
        if found is None:
            left_out.append(ObjectPose(obj_id=obj_id, instance=instance, T_world_obj=np.eye(4)))
            continue
        T_world_obj, shadow = found
        shadows.append(shadow)
        placed.append(ObjectPose(obj_id=obj_id, instance=instance, T_world_obj=T_world_obj))
    return Scattered(objects=tuple(placed), left_out=tuple(left_out))


def with_found_symmetries(model: ObjectModel) -> ObjectModel:
    """Return the model with the symmetries that are found in its mesh, as of a scan."""
    found = _found_symmetries(model.mesh)
    return replace(model, symmetries=found[0], symmetry_axes=found[1])


@lru_cache(maxsize=128)
def _found_symmetries(
    mesh: Mesh,
) -> tuple[Array, tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...]]:
    """Return the symmetries of a mesh; meshes are told apart by identity."""
    found = find_symmetries(mesh, SymmetryConfig())
    return found.discrete, found.axes


@lru_cache(maxsize=128)
def _resting(mesh: Mesh) -> tuple[Resting, ...]:
    """Return the likely resting poses of a mesh; meshes are told apart by identity."""
    every = resting_orientations(mesh)
    likely = tuple(r for r in every if r.probability >= LEAST_PROBABILITY)
    return likely or every[:1]


def _place(
    mesh: Mesh, shadows: Sequence[Array], config: TableLabConfig, rng: np.random.Generator
) -> tuple[Array, Array] | None:
    """Return T_world_obj (4, 4) where there is room, and the shadow (K, 2) there; else None."""
    resting = _resting(mesh)
    chances = np.array([r.probability for r in resting])
    discs = [_disc(s) for s in shadows]
    for _ in range(TRIES // POSES_PER_PLACE):
        yaw = se3.exp_so3([0.0, 0.0, rng.uniform(0, 2 * np.pi)])
        R = yaw @ resting[int(rng.choice(len(resting), p=chances / chances.sum()))].R
        turned = mesh.vertices @ R.T
        shadow = _hull(turned[:, :2])
        middle, radius = _disc(shadow)
        shape = shadow - middle
        places = (
            config.disc_m
            * np.sqrt(rng.random((POSES_PER_PLACE, 1)))
            * _circle(rng.uniform(0, 2 * np.pi, POSES_PER_PLACE))
        )
        for place in places:
            near = [
                other
                for other, (at, reach) in zip(shadows, discs, strict=True)
                if np.linalg.norm(place - at) < radius + reach + config.gap_m
            ]
            if all(_gap(shape + place, other) >= config.gap_m for other in near):
                t = np.array([*(place - middle), -turned[:, 2].min()])
                return se3.from_rt(R, t), shape + place
    return None


def _circle(angles: Array) -> Array:
    """Return points (N, 2) of the unit circle."""
    return np.stack([np.cos(angles), np.sin(angles)], -1)


def _hull(points: Array) -> Array:
    """Return the corners (K, 2) of the convex hull of points (N, 2), counter-clockwise."""
    from scipy.spatial import ConvexHull

    return points[ConvexHull(points).vertices]


def _disc(polygon: Array) -> tuple[Array, float]:
    """Return the middle (2,) of a polygon's box and the radius of the disc that holds it."""
    middle = (polygon.min(0) + polygon.max(0)) / 2
    return middle, float(np.linalg.norm(polygon - middle, axis=1).max())


def _gap(a: Array, b: Array) -> float:
    """Return by how much convex polygons (K, 2), counter-clockwise, are apart at least.

    The greatest gap between their projections on the normals of all edges: their distance, or a
    little less where two corners are nearest; negative if they overlap (separating axis theorem).
    """
    return max(_gap_over(a, b), _gap_over(b, a))


def _gap_over(a: Array, b: Array) -> float:
    """Return the greatest distance of `b` beyond an edge of `a`."""
    edges = np.roll(a, -1, axis=0) - a
    normals = np.stack([edges[:, 1], -edges[:, 0]], -1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    beyond = b @ normals.T - np.sum(a * normals, axis=1)
    return float(beyond.min(axis=0).max())
