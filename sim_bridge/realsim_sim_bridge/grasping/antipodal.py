"""Antipodal pairs: two points of a surface that two fingers can press against each other.

From points on the surface rays go through the object: along the inward normal and at random inside
the friction cone. Wherever one leaves the solid (inner walls included) the two ends are a pair if
the ray is inside the friction cone there too.

The outside of a closed mesh is known from its volume's sign. Of an open one (a scan with holes, or
with triangles of either orientation) it is the side from which more rays escape.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array, Mask, Rows
from realsim.errors import InputError
from realsim.geometry.mesh import face_normals, sample_surface, tensor_mesh, welded_mesh
from realsim.geometry.mesh_shape import is_closed
from realsim.interop import import_open3d
from realsim.records import Mesh

# --- How grasp candidates are sampled and thinned ------------------------------------------------


@dataclass(frozen=True, kw_only=True, slots=True)
class CandidateConfig:
    """How candidates are sampled and thinned."""

    surface_points: int = 1000
    """Points that rays start from; the paper's."""
    rays_per_point: int = 2
    """The first along the inward normal: flat sides need it, across which a hand stands level; the
    others at random in the cone: they find what the normal misses, such as the pairs of a rim."""
    friction: float = 1.0
    """Coefficient whose cone (45 deg) the ray must be in at both ends; the paper's."""
    normal_radius_m: float = 0.0015
    """Normals are means over the surface within this [m], across no edge: a third of the finger
    pads' size, over which they feel a scan's noise as little as that. 0 = the triangles' own."""
    least_width_m: float = 0.001
    """Closest pair [m]: closer ones are the thickness of a scan's double surface."""
    width_margin_m: float = 0.002
    """How much narrower than the open hand a grasp must be [m]."""
    rotations: int = 24
    """Grasps per pair, turned evenly about the closing axis from a random first one; the public
    code has 4 of 360, of which a flat box on a table keeps 5 of 2036: most come from below."""
    contact_depths_m: tuple[float, ...] = (0.0, 0.003, 0.006)
    """Distances of the contacts from the middle of the pads, towards their tips [m], tried in this
    order. Fingers that stand back by 6 mm clear a table, and the pads (12 mm) still hold."""
    opening_margins_m: tuple[float, ...] = (0.004, 0.04)
    """Gaps left on each side of the object before closing [m], tried in this order and cut to the
    open hand; 40 mm is the open hand itself. Of 12,600 grasps of 9 parts the narrow one served
    44 %, the open hand 55 %, one of 2 mm beside them 0.2 %."""
    clearance_m: float = 0.001
    """Least distance of the hand from the grasped object [m]: the error of a good registration."""
    neighbour_clearance_m: float = 0.003
    """Least distance from other objects [m]: the public code's 2.66 mm, rounded up."""
    table_clearance_m: float = 0.002
    """Least distance from the table [m]."""
    object_points: int = 4000
    """Surface points that stand for an object where the arm, not the hand, is checked."""
    spread_m: float = 0.03
    """Distance [m] that counts as much as opposite approach directions when choosing."""

    def __post_init__(self) -> None:
        """Name a value that cannot be.

        Raises:
            InputError: a count below one, a length or friction out of range, nothing to try.
        """
        for name in ("surface_points", "rays_per_point", "rotations"):
            if getattr(self, name) < 1:
                value = getattr(self, name)
                raise InputError(f"candidates: {name} is {value}; at least 1 is needed.")
        if not (math.isfinite(self.friction) and self.friction > 0):
            raise InputError(
                f"candidates: a friction of {self.friction} has no cone; a positive one is needed."
            )
        for name in ("least_width_m", "clearance_m", "spread_m"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"candidates: {name} is {value} m; a positive length is needed.")
        if not self.contact_depths_m or not self.opening_margins_m:
            raise InputError("candidates: at least one contact depth and opening margin is needed.")
        if min(self.opening_margins_m) <= self.clearance_m:
            raise InputError(
                f"candidates: an opening margin of {min(self.opening_margins_m)} m is within the "
                f"clearance of {self.clearance_m} m, so no hand could be free."
            )


ESCAPE_RAYS = 16
"""Rays per side that ask which side of an open mesh is outside."""
ESCAPE_LEAD = 4
"""By how many more rays the back must escape before a triangle's normal is turned round; a sheet
without a back side, from which as many escape on both, keeps its normals."""
SAME_SIDE = 0.8
"""Cosine (37 deg) up to which normals are averaged: noise turns them less, an edge more."""
NORMAL_SAMPLES = 20000
"""Surface samples for averaging: 7 within 1.5 mm of a point on a mug."""
OFF_SURFACE = 1e-5
"""Share of the object's size by which rays start off the surface, so as not to meet it at once."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class AntipodalPairs:
    """Pairs of points, object frame."""

    points: Array
    """(N, 2, 3) where the ray enters and leaves [m]."""
    normals: Array
    """(N, 2, 3) outward, unit length."""
    start: Rows
    """(N,) number of the surface point that each pair starts from."""

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self.points)

    @property
    def widths_m(self) -> Array:
        """(N,) distances [m]."""
        return np.linalg.norm(self.points[:, 1] - self.points[:, 0], axis=1)


class RaySurface:
    """A mesh that rays are cast at, and that knows its outside."""

    def __init__(self, mesh: Mesh) -> None:
        o3d = import_open3d()
        self.mesh = mesh
        bare = welded_mesh(mesh)
        self.is_closed = is_closed(bare.vertices, bare.faces.astype(np.int64))
        self.orientation = _orientation(mesh) if self.is_closed else 1.0
        self.face_normals = face_normals(mesh) * self.orientation
        self.size_m = max(float(np.linalg.norm(mesh.extent)), 1e-9)
        self._tensor = o3d.core.Tensor
        self._scene: Any = o3d.t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(tensor_mesh(mesh))

    def all_hits(self, origins: Array, directions: Array) -> tuple[Rows, Array, Rows]:
        """Return every crossing: ray numbers (M,), distances (M,) [m] and triangles (M,)."""
        hits = self._scene.list_intersections(self._rays(origins, directions), nthreads=1)
        ray, t = hits["ray_ids"].numpy(), hits["t_hit"].numpy()
        return _int(ray), t.astype(np.float64), _int(hits["primitive_ids"].numpy())

    def first_hits(self, origins: Array, directions: Array) -> tuple[Array, Rows]:
        """Return the first crossing's distance (N,) [m], inf = none, and its triangle (N,)."""
        hits = self._scene.cast_rays(self._rays(origins, directions), nthreads=1)
        face = hits["primitive_ids"].numpy()
        t = hits["t_hit"].numpy().astype(np.float64)
        return t, np.where(np.isfinite(t), _int(face), -1)

    def contains(self, points: Array) -> Mask:
        """Return which points (N, 3) are inside a closed mesh; none is inside an open one."""
        if not self.is_closed:
            return np.zeros(len(points), dtype=np.bool_)
        query = self._tensor(np.ascontiguousarray(points, dtype=np.float32))
        return self._scene.compute_occupancy(query, nthreads=1, nsamples=3).numpy() > 0.5

    def outward(self, points: Array, normals: Array, rng: np.random.Generator) -> Array:
        """Return the normals (N, 3), turned round where an open mesh's outside is at their back."""
        if self.is_closed or len(points) == 0:
            return normals
        axis = np.stack([normals, -normals], axis=1)[:, :, None]
        spread = rng.normal(size=(len(points), 2, ESCAPE_RAYS, 3))
        spread /= np.linalg.norm(spread, axis=-1, keepdims=True)
        # A unit vector on a sphere about the normal's tip: cosine-weighted over the half space.
        directions = axis + 0.99 * spread
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        off = points[:, None, None] + OFF_SURFACE * self.size_m * axis
        origins = np.broadcast_to(off, directions.shape)
        t, _ = self.first_hits(origins.reshape(-1, 3), directions.reshape(-1, 3))
        escaped = np.isinf(t).reshape(len(points), 2, ESCAPE_RAYS).sum(axis=2)
        back = escaped[:, 1] >= escaped[:, 0] + ESCAPE_LEAD
        return np.where(back[:, None], -normals, normals)

    def _rays(self, origins: Array, directions: Array) -> Any:
        both = np.concatenate([origins, directions], axis=1).astype(np.float32)
        return self._tensor(both)


def antipodal_pairs(
    surface: RaySurface,
    config: CandidateConfig,
    max_width_m: float,
    rng: np.random.Generator,
    counts: dict[str, int],
) -> AntipodalPairs:
    """Return the antipodal pairs of a mesh.

    Args:
        surface: the object.
        config: how to sample.
        max_width_m: widest pair that is kept [m].
        rng: the only source of chance.
        counts: what each step took is added: exits = too_near + too_wide + outside_cone +
            antipodal_pairs; surface_points = points_without_pair + antipodal_points.
    """
    smooth = _SmoothNormals(surface, config.normal_radius_m, rng)
    points, raw = sample_surface(surface.mesh, config.surface_points, rng)
    normals = smooth.at(points, surface.outward(points, raw * surface.orientation, rng))
    start = np.tile(np.arange(len(points)), config.rays_per_point)
    random = start[len(points) :]
    rays = np.concatenate([-normals, _rays_in_cone(-normals[random], config.friction, rng)])
    ray, t, exit_normals = _exits(surface, points[start], rays, config, rng)
    exits = points[start[ray]] + t[:, None] * rays[ray]

    near, wide = t <= config.least_width_m, t > max_width_m
    within = np.nonzero(~near & ~wide)[0]
    exit_normals[within] = smooth.at(exits[within], exit_normals[within])
    limit = 1 / np.sqrt(1 + config.friction**2) - 1e-9
    cone = np.sum(exit_normals[within] * rays[ray[within]], axis=1) >= limit
    good = within[cone]
    begin = start[ray[good]]
    counts |= {
        "surface_points": len(points),
        "exits": len(t),
        "too_near": int(np.sum(near)),
        "too_wide": int(np.sum(wide & ~near)),
        "outside_cone": int(np.sum(~cone)),
        "antipodal_pairs": len(good),
        "antipodal_points": len(np.unique(begin)),
    }
    counts["points_without_pair"] = len(points) - counts["antipodal_points"]
    return AntipodalPairs(
        points=np.stack([points[begin], exits[good]], axis=1),
        normals=np.stack([normals[begin], exit_normals[good]], axis=1),
        start=begin,
    )


def _exits(
    surface: RaySurface,
    points: Array,
    rays: Array,
    config: CandidateConfig,
    rng: np.random.Generator,
) -> tuple[Rows, Array, Array]:
    """Return where rays leave the solid: ray numbers (M,), distances (M,) [m], normals (M, 3).

    Of exits closer together than `least_width_m` the last is returned: a scan's double surface, or
    a gap that no finger enters.
    """
    ray, t, face = surface.all_hits(points, rays)
    order = np.lexsort((t, ray))
    ray, t, face = ray[order], t[order], face[order]
    normals = surface.outward(points[ray] + t[:, None] * rays[ray], surface.face_normals[face], rng)
    leaves = np.sum(normals * rays[ray], axis=1) > 0
    # The ray's own start is no crossing.
    leaves &= t > OFF_SURFACE * surface.size_m
    ray, t, normals = ray[leaves], t[leaves], normals[leaves]
    last = np.ones(len(ray), dtype=np.bool_)
    last[:-1] = (ray[1:] != ray[:-1]) | (t[1:] - t[:-1] > config.least_width_m)
    return ray[last], t[last], normals[last]


def _rays_in_cone(axes: Array, friction: float, rng: np.random.Generator) -> Array:
    """Return one unit vector (N, 3), even over the cone of half angle atan(mu) about each axis."""
    cos_limit = 1.0 / np.sqrt(1.0 + friction**2)
    cos = rng.uniform(cos_limit, 1.0, len(axes))[:, None]
    around = rng.uniform(0.0, 2 * np.pi, len(axes))[:, None]
    u, v = perpendicular(axes)
    return cos * axes + np.sqrt(1 - cos**2) * (np.cos(around) * u + np.sin(around) * v)


def perpendicular(axes: Array) -> tuple[Array, Array]:
    """Return two unit vectors (N, 3) that complete each axis to a right-handed frame."""
    least = np.eye(3)[np.argmin(np.abs(axes), axis=1)]
    u: Array = np.cross(axes, least)
    u = u / np.linalg.norm(u, axis=1, keepdims=True)
    v: Array = np.cross(axes, u)
    return u, v


# --- normals -----------------------------------------------------------------------------------


def _orientation(mesh: Mesh) -> float:
    """Return -1 if the faces enclose a negative volume, that is, face inwards; else 1."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces] - mesh.vertices.mean(axis=0), 1, 0)
    return -1.0 if float(np.einsum("ij,ij->", a, np.cross(b, c))) < 0 else 1.0


class _SmoothNormals:
    """Normals averaged over a small piece of surface, across no edge."""

    def __init__(self, surface: RaySurface, radius_m: float, rng: np.random.Generator) -> None:
        from scipy.spatial import KDTree

        self._radius_m, self._surface = radius_m, surface
        points, normals = sample_surface(surface.mesh, NORMAL_SAMPLES, rng)
        self._normals = normals * surface.orientation
        self._tree: Any = KDTree(points)

    def at(self, points: Array, normals: Array) -> Array:
        """Return the means (N, 3) of the normals around points that are near to those given.

        An open mesh's samples that oppose are turned round, since its triangles may face anywhere.
        """
        if self._radius_m <= 0 or len(points) == 0:
            return normals
        found = self._tree.query_ball_point(points, self._radius_m, return_sorted=True)
        counts = np.array([len(f) for f in found], dtype=np.int64)
        owner = np.repeat(np.arange(len(points)), counts)
        rows = np.concatenate([np.zeros(0, dtype=np.int64), *found]).astype(np.int64)
        theirs = self._normals[rows]
        cos = np.sum(theirs * normals[owner], axis=1)
        if not self._surface.is_closed:
            theirs, cos = np.where(cos[:, None] < 0, -theirs, theirs), np.abs(cos)
        weight = (cos >= SAME_SIDE).astype(np.float64)
        total = normals.copy()
        for k in range(3):
            total[:, k] += np.bincount(owner, weight * theirs[:, k], minlength=len(points))
        return total / np.linalg.norm(total, axis=1, keepdims=True)


def _int(numbers: NDArray[Any]) -> Rows:
    return numbers.astype(np.int64)
