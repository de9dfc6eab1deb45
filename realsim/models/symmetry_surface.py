"""The surface that a symmetry must map onto itself, and whether its colours follow.

How symmetries are sought and judged.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from realsim.arrays import Array, Int64
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.distance_field import DistanceField, raycasting_scene
from realsim.geometry.mesh import diameter, face_normals, sample_surface, texels
from realsim.interop import import_open3d
from realsim.records import Mesh


@dataclass(frozen=True, kw_only=True, slots=True)
class SymmetryConfig:
    """How symmetries are sought and judged; lengths are shares of the object's diameter."""

    tolerance: float = 0.01
    """Greatest distance of the moved surface from the surface [share of the diameter]: 1 %, 1.3 mm
    of a 13 cm object, what a depth camera still sees. `outliers` of the surface may exceed it."""
    greatest_tolerance: float = 0.034
    """The tolerance of a distorted mesh [share of the diameter]. A smooth shape error of 1 % RMS
    moves true symmetries of the 20 shipped parts by up to 3.3 %; the half turns of a potted meat
    can that are none are off by 3.5 %. Of a scan whose own error is known less, give less: a
    bulging cracker box is 2.4 % (6.5 mm) off its half turns, as a distorted box is."""
    noise_factor: float = 4.5
    """How distorted a mesh is, is judged from the motion (turn or mirror) that fits it best: the
    tolerance is so many times its worst distance, between the two above. An exact mesh is thus
    judged strictly, and a distorted one by its own measure. With 1 % RMS shape error a whole group
    is off by up to 4.2 times what its best motion is."""
    rms_tolerance: float = 0.012
    """Greatest RMS distance [share of the diameter]: 1 % shape error gives up to 0.85 % for one
    motion and a little more for a whole group; of the motions of the shipped parts that are no
    symmetries the nearest, a flange turned by half a bore, has 1.43 %."""
    outliers: float = 0.005
    """Share of the surface that the worst distance leaves out: spikes and gaps of a scan, and a
    small feature. A hole of 8 mm through a bowl's wall is 0.4 % of its surface and leaves it its
    axis, as BOP's bowls with their marks have theirs; one of twice the share breaks it."""
    orders: int = 24
    """Greatest order of an axis that is told from a continuous one; a gear has its teeth."""
    continuous_step_deg: float = 5.0
    """Step at which a continuous symmetry is judged [deg]; no order up to 36 hides in it."""
    directions: int = 600
    """Directions of the half sphere that are tried as axes: 6 deg apart, so every axis is within
    4 deg of one, from where the least squares converge."""
    screening_points: int = 150
    """Surface points by which directions are ranked."""
    fitting_points: int = 300
    """Surface points by which an axis is refined."""
    judging_points: int = 1500
    """Surface points by which a symmetry is judged, by exact distances."""
    near_share: float = 0.7
    """A refused motion is reported from this share of the surface on that it maps onto it."""
    near_distance: float = 0.015
    """The motion maps it onto itself within this distance [share of the diameter]: 2 mm of a 13 cm
    object."""
    near_reported: int = 8
    """Axes of refused motions that are reported: a person reads them."""
    color_difference: float = 12.0
    """Mean difference of the colours of points that a symmetry swaps from which on the texture
    breaks it [grey levels of 255], beyond what neighbouring points differ by."""
    seed: int = 0
    """Seed of the surface points."""

    def __post_init__(self) -> None:
        """Check the tolerances."""
        if not 0 < self.tolerance <= self.greatest_tolerance < 0.2:
            raise InputError(
                f"the tolerances {self.tolerance:g} and {self.greatest_tolerance:g} are shares of "
                "the diameter; 0 < tolerance <= greatest_tolerance < 0.2 is needed (0.01 and "
                "0.03). Were millimetres given?"
            )
        if self.orders < 2:
            raise InputError(
                f"orders up to {self.orders} hold no symmetry; ask for 2 or more (24)."
            )


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
    return texels(mesh.texture, at).astype(np.float64)
