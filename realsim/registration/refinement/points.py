"""Which measured point belongs to which object, or to the table."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.arrays import Array, Array32, Int32, Int64, Mask
from realsim.compiled import njit
from realsim.geometry import se3
from realsim.geometry.distance_field import sample
from realsim.geometry.point_loops import move
from realsim.geometry.seen_surface import FRONT_STEPS, GATE_COS
from realsim.registration.body import Body
from realsim.registration.evidence import DepthNoise
from realsim.registration.refinement.config import PointConfig
from realsim.registration.refinement.equations import State
from realsim.registration.views import ViewPoints

NOBODY, TABLE = -1, -2


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class AllPoints:
    """The points of all views in one piece."""

    points: Array32
    """(N, 3) in their camera's axes, as measured [m]."""
    views: Int32
    """(N,) which view (its place in the list)."""
    area_px: Array
    """(V,) pixels that each point of a view stands for."""
    noise: tuple[Array, Array]
    """(V,) of every view's camera: noise per m [1/m] and least sigma_z [m]."""

    def sigma(self, z: Array, views: Int32) -> Array:
        """Return the 1-sigma (N,) of depths z (N,) [m] that views (N,) measured."""
        per_m, floor = self.noise
        return np.maximum(floor[views], per_m[views] * np.square(z))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Owned:
    """The points of one body that take part."""

    points: Array
    """(N, 3) in their camera's axes, as measured [m]."""
    views: Int32
    """(N,)."""
    area_px: Array
    """(N,) pixels that each stands for, those left out for it included."""


def join_views(views: Sequence[ViewPoints], noise: DepthNoise) -> AllPoints:
    """Return the points of all views in one piece; the noise is that of the camera in the hand."""
    each = [v.noise(noise) for v in views]
    return AllPoints(
        points=np.concatenate([v.points for v in views]),
        views=np.repeat(np.arange(len(views), dtype=np.int32), [len(v.points) for v in views]),
        area_px=np.array([v.area_px for v in views]),
        noise=(np.array([n.per_m for n in each]), np.array([n.floor_m for n in each])),
    )


@njit(inline="always")
def _square_gap(points: Array32, i: int, centers: Array, k: int) -> float:
    """Return the square of the distance between a point and a centre."""
    p, c = points[i], centers[k]
    x, y, z = p[0] - c[0], p[1] - c[1], p[2] - c[2]
    return x * x + y * y + z * z


@njit
def _sorted_in(
    points: Array32,
    views: Int32,
    cameras: Array,
    bias: tuple[Array, Array],
    spheres: tuple[Array, Array, Array],
) -> tuple[Array32, Mask, Int32, Int64]:
    """Return points in world, which are around a body, and each body's candidates.

    Args:
        points: (N, 3) as measured, in camera axes.
        views: (N,).
        cameras: (V, 4, 4).
        bias: scale and offset of the inverse depth in every view (V,).
        spheres: centres (K, 3), square of the reach (K,), and square of the table's (K,).

    Returns:
        Corrected points (N, 3) in world, flags (N,), and the candidates' numbers body after body
        with where each body's begin (K + 1,).
    """
    scales, offsets = bias
    centers, reach, margin = spheres
    bodies = len(centers)
    out = np.empty((len(points), 3), np.float32)
    around = np.zeros(len(points), np.bool_)
    begin = np.zeros(bodies + 1, np.int64)
    for i in range(len(points)):
        C = cameras[views[i]]
        f = 1.0 / (scales[views[i]] + offsets[views[i]] * points[i, 2])
        a, b, c = f * points[i, 0], f * points[i, 1], f * points[i, 2]
        out[i, 0], out[i, 1], out[i, 2] = move(C, a, b, c)
        for k in range(bodies):
            d = _square_gap(out, i, centers, k)
            if d < reach[k]:
                begin[k + 1] += 1
            if d < margin[k]:
                around[i] = True
    for k in range(bodies):
        begin[k + 1] += begin[k]
    at = begin[:-1].copy()
    index = np.empty(begin[-1], np.int32)
    for i in range(len(points)):
        if not around[i]:
            continue
        for k in range(bodies):
            if _square_gap(out, i, centers, k) < reach[k]:
                index[at[k]] = i
                at[k] += 1
    return out, around, index, begin


@njit
def _claim(
    lattice: tuple[Array32, Array, float],
    world: Array32,
    index: Int32,
    T_obj_world: Array,
    number: int,
    nearest: tuple[Array32, Int32],
) -> None:
    """Give a body the points that are nearer to it than to those before.

    Args:
        lattice: grid, origin and cell of its distance field.
        world: (N, 3).
        index: which of them are asked.
        T_obj_world: (4, 4).
        number: of the body.
        nearest: distance (N,) and owner (N,) so far; both are changed.
    """
    grid, origin, cell = lattice
    distance, owner = nearest
    T = T_obj_world
    for i in index:
        x, y, z = move(T, world[i, 0], world[i, 1], world[i, 2])
        d, _, _, _ = sample(grid, origin, cell, x, y, z)
        if abs(d) < distance[i]:
            distance[i], owner[i] = abs(d), number


def assign_views(
    points: AllPoints,
    bodies: Sequence[Body],
    state: State,
    cameras: Array,
    config: PointConfig,
    share: float = 1.0,
    flat: Sequence[int] = (),
) -> tuple[list[Owned], Owned, list[Owned]]:
    """Return the points of every body, those of the table, and all around the flat bodies.

    Args:
        points: of all views.
        bodies: the objects.
        state: where they, the table and the depth's bias stand.
        cameras: (V, 4, 4) as they stand now.
        config: settings.
        share: of the points that the configuration allows.
        flat: numbers of the flat bodies.
    """
    poses, T_world_table = list(state.poses), state.T_world_table
    bias = (state.scales(), state.offsets())
    centers = np.array([b.center(T) for b, T in zip(bodies, poses, strict=True)]).reshape(-1, 3)
    radii = np.array([b.radius_m for b in bodies])
    spheres = (
        centers, np.square(radii + config.reach_m), np.square(radii + config.table_margin_m)
    )  # fmt: skip
    world, around, index, begin = _sorted_in(points.points, points.views, cameras, bias, spheres)
    distance = np.full(len(world), config.reach_m, np.float32)
    owner = np.full(len(world), NOBODY, np.int32)
    for k, (body, T) in enumerate(zip(bodies, poses, strict=True)):
        f, mine = body.field, index[begin[k] : begin[k + 1]]
        _claim((f.grid, f.origin, f.cell), world, mine, se3.invert(T), k, (distance, owner))
    most = int(share * config.points_per_object)
    near: list[Owned] = []
    for k in flat:
        mine = index[begin[k] : begin[k + 1]]
        near.append(_thinned(points, mine[(owner[mine] == k) | (owner[mine] == NOBODY)], most))
    table = np.zeros(len(world), dtype=bool)
    if T_world_table is not None:
        row = se3.invert(T_world_table)[2].astype(np.float32)
        some = np.flatnonzero(around)
        height = np.abs(world[some] @ row[:3] + row[3])
        slack = 3.0 * points.sigma(points.points[some, 2].astype(np.float64), points.views[some])
        free = owner[some] == NOBODY
        table[some[free & (height < config.table_reach_m + slack)]] = True
        feet = _feet(bodies, poses, row, config)[owner[some]]
        owner[some[height < feet]] = NOBODY
    own = [_thinned(points, np.flatnonzero(owner == k), most) for k in range(len(bodies))]
    most = int(share * config.table_points_per_view * len(cameras))
    return own, _thinned(points, np.flatnonzero(table), most), near


def _feet(bodies: Sequence[Body], poses: Sequence[Array], up: Array32, c: PointConfig) -> Array:
    """Return how high over the table every body's points begin (K + 1,) [m]; nobody's last.

    Were it the same for all, a plate of 3 mm would keep only the noise over it and be set too high.
    """
    tops = [
        np.ptp(b.model.mesh.vertices @ (T[:3, :3].T @ up[:3]))
        for b, T in zip(bodies, poses, strict=True)
    ]
    return np.append(np.minimum(c.foot_m, c.foot_share * np.array(tops)), 0.0)


def _thinned(points: AllPoints, index: Int32 | Int64, most: int) -> Owned:
    """Return the points of these numbers, every so many of them."""
    every = max(1, -(-len(index) // most))
    index = index[::every]
    views = points.views[index]
    return Owned(
        points=points.points[index].astype(np.float64), views=views,
        area_px=every * points.area_px[views],
    )  # fmt: skip


def exact_residuals(
    body: Body, points: Array, views: Int32, Ms: Array, eyes: Array
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
