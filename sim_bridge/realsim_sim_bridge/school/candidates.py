"""Antipodal grasp candidates of one object where it stands.

From points on the surface a random ray inside the friction cone goes through the object; wherever
it leaves the surface (inner walls included) the two points are an antipodal pair if the ray is also
inside the friction cone there. Each pair gives k grasps, turned about the closing axis. The open
hand must be free of the object, its neighbours and the table; what each filter took is counted.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.geometry.mesh import sample_surface, tensor_mesh
from realsim.interop import import_open3d
from realsim.records import Mesh
from realsim_sim_bridge.school.hand import HandGeometry
from realsim_sim_bridge.school.hand_free import boxes_free, lowest_corner

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, slots=True)
class CandidateConfig:
    """How candidates are sampled and thinned."""

    surface_points: int = 1000
    """Points a ray starts from; the paper's."""
    friction: float = 1.0
    """Coefficient whose cone (45 deg) the ray must be in at both ends; the paper's."""
    least_width_m: float = 0.001
    """Closest pair [m]: closer ones are the thickness of a scan's double surface."""
    width_margin_m: float = 0.002
    """How much narrower than the open hand a grasp must be [m]."""
    rotations: int = 8
    """Grasps per pair, turned evenly about the closing axis from a random first one; the public
    code has 4, with which a flat box keeps 5 of 2036 grasps above the table."""
    opening_margin_m: float = 0.004
    """Gap left on each side of the object before closing [m]; if the hand does not fit so, it is
    tried fully open."""
    clearance_m: float = 0.001
    """Least distance of the hand from the grasped object [m], half the sampling distance of
    `object_points` on a mug."""
    neighbour_clearance_m: float = 0.003
    """Least distance from other objects [m]: the public code's 2.66 mm, rounded up."""
    table_clearance_m: float = 0.002
    """Least distance from the table [m]."""
    object_points: int = 4000
    """Surface points that stand for the object, and for each neighbour, in collision checks."""
    spread_m: float = 0.03
    """Distance [m] that counts as much as opposite approach directions when choosing."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Surroundings:
    """What else is on the table, in the table's frame."""

    points: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """(P, 3) on the surfaces of the other objects [m]."""
    instances: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(P,) instance number of each point."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Candidates:
    """Grasps that are antipodal and whose open hand is free."""

    Ts_obj_grasp: Array
    """(N, 4, 4) [m]."""
    widths_m: Array
    """(N,) distance of the contacts [m]."""
    openings_m: Array
    """(N,) distance of the finger faces before closing [m]."""
    counts: dict[str, int]
    """How many there were after each step, and what each filter took."""


def sample_candidates(
    mesh: Mesh,
    T_table_obj: Array,
    surroundings: Surroundings,
    config: CandidateConfig,
    geometry: HandGeometry,
    rng: np.random.Generator,
    limit: int,
) -> Candidates:
    """Return the grasp candidates of an object.

    Args:
        mesh: the object [m].
        T_table_obj: (4, 4) where it stands; z of the table is up.
        surroundings: the other objects.
        config: how to sample.
        geometry: the hand.
        rng: the only source of chance; the same one gives the same candidates.
        limit: candidates kept, chosen to be far apart.
    """
    counts: dict[str, int] = {"surface_points": config.surface_points}
    pairs = _antipodal_pairs(mesh, config, geometry, rng, counts)
    grasps = _turned(*pairs, config, geometry, rng)
    counts["turned"] = len(grasps.Ts)
    on_surface = sample_surface(mesh, config.object_points, rng)[0]
    points = np.concatenate([on_surface, mesh.vertices[: config.object_points]])

    free = _above_table(grasps, T_table_obj, config, geometry)
    counts["hand_in_table"] = int(np.sum(~free))
    grasps = grasps.kept(free)
    free = _free_of_object(grasps, T_table_obj, points, config, geometry)
    counts["hand_in_object"] = int(np.sum(~free))
    grasps = grasps.kept(free)
    swept = geometry.swept_boxes(grasps.widths, grasps.openings)
    Ts_table_grasp = T_table_obj @ grasps.Ts
    free = boxes_free(swept, Ts_table_grasp, surroundings.points, config.neighbour_clearance_m)
    counts["hand_in_neighbour"] = int(np.sum(~free))
    grasps = grasps.kept(free)

    counts["free"] = len(grasps.Ts)
    chosen = _spread_out(grasps.Ts, config, limit, rng)
    counts["kept"] = len(chosen)
    return Candidates(
        Ts_obj_grasp=grasps.Ts[chosen],
        widths_m=grasps.widths[chosen],
        openings_m=grasps.openings[chosen],
        counts=counts,
    )


# --- antipodal pairs ---------------------------------------------------------------------------


def _antipodal_pairs(
    mesh: Mesh,
    config: CandidateConfig,
    geometry: HandGeometry,
    rng: np.random.Generator,
    counts: dict[str, int],
) -> tuple[Array, Array, Array]:
    """Return middles (N, 3), closing axes (N, 3) and widths (N,) of antipodal pairs."""
    points, normals = sample_surface(mesh, config.surface_points, rng)
    rays = _rays_in_cone(-normals, config.friction, rng)
    start, t, exit_normal = _exits(mesh, points, rays)
    counts["exits"] = len(t)
    beyond = t > config.least_width_m
    narrow = t <= geometry.max_opening_m - config.width_margin_m
    in_cone = np.sum(exit_normal * rays[start], axis=1) >= 1 / np.sqrt(1 + config.friction**2)
    counts["not_antipodal"] = int(np.sum(~in_cone))
    counts["too_wide"] = int(np.sum(in_cone & ~narrow))
    good = beyond & narrow & in_cone
    counts["antipodal_pairs"] = int(np.sum(good))
    counts["antipodal_points"] = len(np.unique(start[good]))
    start, t = start[good], t[good]
    closing = rays[start]
    return points[start] + 0.5 * t[:, None] * closing, closing, t


def _rays_in_cone(axes: Array, friction: float, rng: np.random.Generator) -> Array:
    """Return one unit vector (N, 3), even over the cone of half angle atan(mu) about each axis."""
    cos_limit = 1.0 / np.sqrt(1.0 + friction**2)
    cos = rng.uniform(cos_limit, 1.0, len(axes))[:, None]
    around = rng.uniform(0.0, 2 * np.pi, len(axes))[:, None]
    u, v = _perpendicular(axes)
    return cos * axes + np.sqrt(1 - cos**2) * (np.cos(around) * u + np.sin(around) * v)


def _perpendicular(axes: Array) -> tuple[Array, Array]:
    """Return two unit vectors (N, 3) that complete each axis to a right-handed frame."""
    least = np.eye(3)[np.argmin(np.abs(axes), axis=1)]
    u: Array = np.cross(axes, least)
    u = u / np.linalg.norm(u, axis=1, keepdims=True)
    v: Array = np.cross(axes, u)
    return u, v


def _exits(mesh: Mesh, points: Array, rays: Array) -> tuple[NDArray[np.int64], Array, Array]:
    """Return where rays leave the solid: ray numbers (M,), distances (M,) [m], normals (M, 3)."""
    from realsim.geometry.mesh import face_normals

    o3d = import_open3d()
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(tensor_mesh(mesh))
    both = np.concatenate([points, rays], axis=1).astype(np.float32)
    hits = scene.list_intersections(o3d.core.Tensor(both), nthreads=1)
    ray = hits["ray_ids"].numpy().astype(np.int64)
    normals = face_normals(mesh)[hits["primitive_ids"].numpy().astype(np.int64)]
    outward = np.sum(normals * rays[ray], axis=1) > 0
    return ray[outward], hits["t_hit"].numpy().astype(np.float64)[outward], normals[outward]


# --- grasps ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, slots=True)
class _Grasps:
    """Grasps while they are filtered."""

    Ts: Array
    widths: Array
    openings: Array

    def kept(self, mask: Mask) -> "_Grasps":
        """Return those of the mask."""
        return _Grasps(self.Ts[mask], self.widths[mask], self.openings[mask])


def _turned(
    centers: Array,
    closing: Array,
    widths: Array,
    config: CandidateConfig,
    geometry: HandGeometry,
    rng: np.random.Generator,
) -> _Grasps:
    """Return k grasps per pair, evenly turned about its closing axis."""
    k = config.rotations
    u, v = _perpendicular(closing)
    first = rng.uniform(0.0, 2 * np.pi, (len(centers), 1))
    turn = (first + 2 * np.pi / k * np.arange(k))[..., None]
    approach = np.cos(turn) * u[:, None] + np.sin(turn) * v[:, None]
    y = np.broadcast_to(closing[:, None], approach.shape)
    R = np.stack([np.cross(y, approach), y, approach], axis=-1)
    Ts = se3.from_rt(R, centers[:, None]).reshape(-1, 4, 4)
    widths = np.repeat(widths, k)
    openings = np.minimum(widths + 2 * config.opening_margin_m, geometry.max_opening_m)
    return _Grasps(Ts, widths, openings)


def _above_table(
    grasps: _Grasps, T_table_obj: Array, config: CandidateConfig, geometry: HandGeometry
) -> Mask:
    """Return whether the open hand is above the table (N,)."""
    lowest = lowest_corner(geometry.boxes(grasps.openings), T_table_obj @ grasps.Ts)
    return lowest > config.table_clearance_m


def _free_of_object(
    grasps: _Grasps,
    T_table_obj: Array,
    points_obj: Array,
    config: CandidateConfig,
    geometry: HandGeometry,
) -> Mask:
    """Return whether the hand fits around the object (N,), fully open where it must be.

    Sets the opening of the grasps that need the full one.
    """
    boxes = geometry.boxes(grasps.openings)
    free = boxes_free(boxes, grasps.Ts, points_obj, config.clearance_m)
    rest = np.nonzero(~free)[0]
    wide = _Grasps(grasps.Ts[rest], grasps.widths[rest], np.full(len(rest), geometry.max_opening_m))
    fits = boxes_free(geometry.boxes(wide.openings), wide.Ts, points_obj, config.clearance_m)
    fits &= _above_table(wide, T_table_obj, config, geometry)
    grasps.openings[rest[fits]] = geometry.max_opening_m
    free[rest[fits]] = True
    return free


def _spread_out(
    Ts: Array, config: CandidateConfig, limit: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Return the numbers of at most `limit` grasps, each the farthest from those before.

    A grasp and its half turn about the approach are one: the closing axis enters as y y'.
    """
    if len(Ts) <= limit:
        return np.arange(len(Ts))
    y = Ts[:, :3, 1]
    axis = (y[:, :, None] * y[:, None, :]).reshape(-1, 9)
    features = np.concatenate([2.0 / config.spread_m * Ts[:, :3, 3], Ts[:, :3, 2], axis], axis=1)
    chosen = [int(rng.integers(len(Ts)))]
    nearest = np.full(len(Ts), np.inf)
    while len(chosen) < limit:
        step = np.sum((features - features[chosen[-1]]) ** 2, axis=1)
        nearest = np.minimum(nearest, step)
        chosen.append(int(np.argmax(nearest)))
    return np.sort(np.array(chosen))
