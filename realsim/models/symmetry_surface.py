"""The surface that a symmetry must map onto itself, and whether its colours follow."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from realsim.arrays import Array, Int64
from realsim.geometry import se3
from realsim.geometry.distance_field import DistanceField, raycasting_scene
from realsim.geometry.mesh import diameter, face_normals, sample_surface
from realsim.interop import import_open3d
from realsim.models.symmetry_config import SymmetryConfig
from realsim.records import Mesh

FIELD_CELLS = 40
"""Cells along the longest side of the field that screens candidates: 2.5 % of it, 0.1 CPU-s."""
DAMPING = 1e-4
"""Damping of the least squares, times the mean of the diagonal: a turn about the axis moves
nothing."""
LEAST_DAMPING = 1e-9
"""The same in absolute terms: a sphere has no gradient at all."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A normalised mesh with points on it, and its distances: fast or exact."""

    mesh: Mesh
    """Centre of area at the origin, diameter 1."""
    center: Array
    """(3,) of the original mesh's area [m]."""
    diameter_m: float
    """Diameter of the original mesh [m]."""
    points: Array
    """(N, 3) evenly spread over the surface, in random order: any first k are a sample too."""

    @cached_property
    def field(self) -> DistanceField:
        """The signed distance on a coarse grid."""
        return DistanceField.from_mesh(self.mesh, FIELD_CELLS)

    @cached_property
    def scene(self) -> Any:
        """The triangles, for exact closest points."""
        return raycasting_scene(self.mesh)

    @cached_property
    def normals(self) -> Array:
        """(F, 3) of the triangles."""
        return face_normals(self.mesh)

    def near(self, Ts: Array, count: int) -> Array:
        """Return distances (K, n) from the field of the first `count` points moved by Ts."""
        moved = se3.transform(Ts, self.points[:count])
        return np.abs(self.field.distance(moved.reshape(-1, 3))).reshape(len(Ts), -1)

    def exact(self, Ts: Array, count: int) -> Array:
        """Return exact distances (K, n) of the first `count` points moved by Ts (K, 4, 4)."""
        o3d = import_open3d()
        moved = se3.transform(Ts, self.points[:count]).reshape(-1, 3)
        query = o3d.core.Tensor(np.ascontiguousarray(moved, dtype=np.float32))
        found: Any = self.scene.compute_distance(query, 1).numpy()
        return np.asarray(found, dtype=np.float64).reshape(len(Ts), -1)

    def closest(self, points: Array) -> tuple[Array, Int64, Array]:
        """Return the closest surface points (N, 3), their faces (N,) and barycentric uv (N, 2)."""
        o3d = import_open3d()
        query = o3d.core.Tensor(np.ascontiguousarray(points, dtype=np.float32))
        found: Any = self.scene.compute_closest_points(query, 1)
        return (
            np.asarray(found["points"].numpy(), dtype=np.float64),
            np.asarray(found["primitive_ids"].numpy(), dtype=np.int64),
            np.asarray(found["primitive_uvs"].numpy(), dtype=np.float64),
        )

    def to_metres(self, Ts: Array) -> Array:
        """Return isometries (K, 4, 4) of the normalised frame as those of the mesh's own [m]."""
        out = Ts.copy()
        fixed = self.center - np.einsum("kij,j->ki", Ts[:, :3, :3], self.center)
        out[:, :3, 3] = self.diameter_m * Ts[:, :3, 3] + fixed
        return out


def surface_of(mesh: Mesh, points: int, rng: np.random.Generator) -> Surface:
    """Return the normalised surface of a mesh [m], with so many points on it."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    # About the first vertex, so that far-off meshes lose no digits.
    origin = mesh.vertices[0]
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    center = origin + np.average((a + b + c) / 3 - origin, axis=0, weights=area)
    size = diameter(mesh)
    normal = Mesh(vertices=(mesh.vertices - center) / size, faces=mesh.faces)
    sampled, _ = sample_surface(normal, points, rng)
    return Surface(mesh=normal, center=center, diameter_m=size, points=sampled)


def refinement(surface: Surface, Ts: Array, count: int, scales: tuple[float, ...]) -> Array:
    """Return the motion E (4, 4) that brings isometries (K, 4, 4) as E T E^-1 onto the surface.

    All are conjugated by one motion, so that a group stays the same group about other axes. With
    q = T p, its distance d and gradient g, a twist (w, v) of E moves q by w x q + v - A (w x p +
    v), A the linear part of T; hence the row [q x g - p x A'g, g - A'g]. Gauss-Newton with
    Tukey's weights, one step per scale.

    Args:
        surface: what they should map onto itself.
        Ts: isometries, proper or not.
        count: points used.
        scales: Tukey's cut per step [share of the diameter]; negative = by exact distances.
    """
    p, total = surface.points[:count], np.eye(4)
    for scale in scales:
        q = se3.transform(Ts, p)
        moved = q.reshape(-1, 3)
        d, g = surface.field.distance_gradient(moved) if scale > 0 else _planes(surface, moved)
        back = (g.reshape(q.shape) @ Ts[:, :3, :3]).reshape(-1, 3)
        at = np.broadcast_to(p, q.shape).reshape(-1, 3)
        J = np.concatenate([np.cross(moved, g) - np.cross(at, back), g - back], axis=1)
        weights = np.square(np.maximum(0.0, 1.0 - np.square(d / scale)))
        H = (J * weights[:, None]).T @ J
        H += np.eye(6) * (LEAST_DAMPING + DAMPING * np.trace(H) / 6)
        E = se3.exp(-np.linalg.solve(H, J.T @ (weights * d)))
        Ts, total = E @ Ts @ se3.invert(E), E @ total
    return total


def _planes(surface: Surface, q: Array) -> tuple[Array, Array]:
    """Return distances (N,) to the planes of the closest triangles, and their normals (N, 3)."""
    at, face, _ = surface.closest(q)
    normals = surface.normals[face]
    return np.einsum("ni,ni->n", q - at, normals), normals


POINTS = 600
"""Surface points whose colours are compared."""
STEP = 0.02
"""How far off the neighbours are that tell how lively the texture is [share of the diameter]: what
a symmetry may miss by."""
MOST_MOTIONS = 24
"""Motions tried; a texture that breaks a group breaks most of its elements."""


def texture_breaks(mesh: Mesh, surface: Surface, Ts: Array, config: SymmetryConfig) -> bool:
    """Return whether one of the symmetries brings other colours to the same place.

    Args:
        mesh: with colours or a texture; without, nothing can differ.
        surface: the same, normalised.
        Ts: symmetries (K, 4, 4) of the normalised frame, without the identity.
        config: the difference that counts.
    """
    if (mesh.colors is None and (mesh.texture is None or mesh.uv is None)) or not len(Ts):
        return False
    points = surface.points[:POINTS]
    here = _colors(mesh, surface, points)
    rng = np.random.default_rng(config.seed)
    step = rng.standard_normal(points.shape)
    beside = points + STEP * step / np.linalg.norm(step, axis=1, keepdims=True)
    lively = float(np.mean(np.abs(_colors(mesh, surface, beside) - here)))
    for T in Ts[:: max(1, len(Ts) // MOST_MOTIONS)]:
        there = _colors(mesh, surface, se3.transform(T, points))
        if np.mean(np.abs(there - here)) > lively + config.color_difference:
            return True
    return False


def _colors(mesh: Mesh, surface: Surface, points: Array) -> Array:
    """Return the RGB (N, 3) [0..255] of the surface points closest to some points."""
    _, face, uv = surface.closest(points)
    # Embree's barycentric coordinates belong to the second and the third corner.
    weights = np.stack([1.0 - uv.sum(axis=1), uv[:, 0], uv[:, 1]], axis=1)
    corners = mesh.faces[face]
    if mesh.colors is not None or mesh.texture is None or mesh.uv is None:
        assert mesh.colors is not None
        return np.einsum("nk,nkc->nc", weights, mesh.colors[corners].astype(np.float64))
    at = np.einsum("nk,nkc->nc", weights, mesh.uv[corners])
    height, width = mesh.texture.shape[:2]
    column = np.floor((at[:, 0] % 1.0) * width).astype(int) % width
    row = np.floor(((1.0 - at[:, 1]) % 1.0) * height).astype(int) % height
    return mesh.texture[row, column].astype(np.float64)
