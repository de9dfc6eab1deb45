"""Everything that is known of a mesh's surface: topology, winding, bodies, thickness.

Which side of a surface is outside: of every patch, closed or open.

Within a patch the winding of one face decides that of all. A closed patch is outward when its
signed volume is positive; inside another closed patch it is the wall of a cavity, and outward (of
the material) is towards its own inside. An open patch has no volume: its outside is the side from
which more rays reach the open air (Takayama et al. 2014, "A simple method for correcting facet
orientations in polygon meshes based on ray casting").
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.arrays import Array, Int32, Int64, Mask
from realsim.models.mesh_topology import (
    Topology,
    bodies,
    face_areas_and_volumes,
    face_pairs,
    patches,
    topology,
)
from realsim.records import Mesh

LEAST_THICKNESS_SHARE = 1e-5
"""A closed patch whose mean thickness 2 V / A is below this share of the mesh's size is a folded
sheet: the sign of its volume is noise and says nothing of its outside."""
VOTE_RAYS = 4096
"""Rays by which an open patch's outside is found: the share of free rays is known to 1 %."""
VOTE_RAYS_IN_ALL = 2_000_000
"""Bound on the rays of a mesh in thousands of pieces [-]; each piece then gets fewer."""
VOTE_DIRECTIONS = 32
"""Directions of the rays from each point, spread evenly over the sphere."""
VOTE_MARGIN = 0.02
"""A side must be freer than the other by this share of the rays; else (a plane) both are
outside, and the winding stays as it is."""
NESTING_POINTS = 16
"""Points of a patch that must all lie inside another patch: parts that only reach into each other
(a handle in a wall) are no cavities."""
START_SHARE = 1e-5
"""Distance of a ray's start from its own face, as a share of the size: beyond float32's noise."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Orientation:
    """How the faces of a mesh wind and how they should."""

    patch: Int32
    """(F,) the patch of every face, -1 where the face is not a proper one."""
    against: Mask
    """(F,) faces that wind against the rest of their patch (the smaller area of it)."""
    inward: Mask
    """(F,) faces of patches whose larger part points inwards."""
    is_one_sided: Mask
    """(N,) patches that no winding makes consistent (a Moebius band)."""
    is_closed: Mask
    """(N,) patches that bound a volume by themselves."""
    depth: Int32
    """(N,) in how many other closed patches a closed patch lies; odd: the wall of a cavity."""

    @property
    def flip(self) -> Mask:
        """(F,) faces whose winding must be turned for the surface to be outward everywhere."""
        return self.against ^ self.inward


def orientation(topo: Topology, areas: Array, volumes: Array) -> Orientation:
    """Return how the faces wind, and which of them must be turned.

    Args:
        topo: the mesh's topology.
        areas: (F,) areas of its faces [m^2].
        volumes: (F,) signed volumes of the cones from its faces to one point [m^3].
    """
    n, patch = patches(topo)
    against, one_sided = _against(topo, patch, n, areas)
    closed = _closed(topo, patch, n, against) & ~one_sided
    of = np.where(topo.proper, patch, n)
    volume = np.bincount(of, np.where(against, -volumes, volumes), n + 1)[:n]
    area = np.bincount(of, areas, n + 1)[:n]
    is_solid = closed & (2.0 * np.abs(volume) > LEAST_THICKNESS_SHARE * topo.size * area)
    several, some_open = np.count_nonzero(is_solid) > 1, not np.all(closed)
    scene = _Scene(topo) if several or some_open else None
    depth = np.zeros(n, dtype=np.int32)
    if scene is not None and several:
        depth[is_solid] = _depths(topo, scene, patch, is_solid, areas)
    inward = is_solid & ((volume < 0) ^ (depth % 2 == 1))
    if scene is not None and some_open:
        inward |= ~closed & _voted_inward(topo, scene, patch, n, areas, against)
    return Orientation(
        patch=patch,
        against=against,
        inward=np.r_[inward, False][of],
        is_one_sided=one_sided,
        is_closed=closed,
        depth=depth,
    )


def _against(topo: Topology, patch: Int32, n: int, areas: Array) -> tuple[Mask, Mask]:
    """Return which faces wind against the larger part of their patch, and one-sided patches.

    Every face stands in a graph twice, as it is and turned; a pair of faces links the copies that
    agree. A patch then falls into two components, of which the first is the one with the larger
    area as it is. Where it stays one component, no winding is consistent.
    """
    from realsim.models.mesh_topology import components

    F = len(topo.faces)
    against, one_sided = np.zeros(F, dtype=bool), np.zeros(n, dtype=bool)
    inner = topo.edge_uses == 2
    faulty = np.unique(patch[topo.half_face[(inner & (topo.edge_net != 0))[topo.half_edge]]])
    if len(faulty) == 0:
        return against, one_sided
    is_faulty = np.zeros(n + 1, dtype=bool)
    is_faulty[faulty] = True
    i, j, half = face_pairs(topo, inner)
    ours = is_faulty[patch[i]]
    i, j = i[ours].astype(np.int64), j[ours].astype(np.int64)
    turned = topo.edge_net[topo.half_edge[half[ours]]] != 0
    nodes = np.flatnonzero(is_faulty[patch] & topo.proper)
    local = np.zeros(F, dtype=np.int64)
    local[nodes] = np.arange(len(nodes))
    m, i, j = len(nodes), local[i], local[j]
    count, label = components(
        2 * m, np.r_[i, i + m], np.r_[np.where(turned, j + m, j), np.where(turned, j, j + m)]
    )
    as_is, mirrored = label[:m], label[m:]
    one_sided[patch[nodes[as_is == mirrored]]] = True
    # Of a patch's two components the one holding more area of faces as they are is kept.
    kept = np.bincount(as_is, areas[nodes], count)
    smaller = kept[as_is] < kept[mirrored]
    tie = (kept[as_is] == kept[mirrored]) & (as_is > mirrored)
    against[nodes] = (smaller | tie) & (as_is != mirrored)
    return against, one_sided


def _closed(topo: Topology, patch: Int32, n: int, against: Mask) -> Mask:
    """Return which patches are closed once consistent; other patches may touch their edges."""
    closed = np.ones(n, dtype=bool)
    uses = topo.edge_uses[topo.half_edge]
    odd = np.flatnonzero(uses != 2)
    if len(odd) == 0:
        return closed
    face = topo.half_face[odd]
    sign = np.where(against[face], -topo.half_sign[odd], topo.half_sign[odd])
    key = topo.half_edge[odd].astype(np.int64) * n + patch[face]
    keys, index = np.unique(key, return_inverse=True)
    net = np.bincount(index.reshape(-1), sign, len(keys))
    closed[keys[net != 0] % n] = False
    return closed


class _Scene:
    """Rays against the proper faces of a mesh."""

    def __init__(self, topo: Topology) -> None:
        from realsim.interop import import_open3d

        self._o3d = import_open3d()
        self.rows = np.flatnonzero(topo.proper)
        self.center, self.scale = topo.positions.mean(axis=0), topo.size
        # Scaled to 1: embree works in float32 with absolute tolerances.
        positions = ((topo.positions - self.center) / self.scale).astype(np.float32)
        faces = np.ascontiguousarray(topo.faces[self.rows], dtype=np.uint32)
        self._scene = self._o3d.t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(self._o3d.core.Tensor(positions), self._o3d.core.Tensor(faces))

    def _rays(self, starts: Array, directions: Array) -> Any:
        rays = np.concatenate([(starts - self.center) / self.scale, directions], axis=-1)
        return self._o3d.core.Tensor(np.ascontiguousarray(rays, dtype=np.float32))

    def is_free(self, starts: Array, directions: Array) -> Mask:
        """Return which rays (N,) meet nothing."""
        free = np.empty(len(starts), dtype=bool)
        step = 1 << 18
        for s in range(0, len(starts), step):
            rays = self._rays(starts[s : s + step], directions[s : s + step])
            free[s : s + step] = ~self._scene.test_occlusions(rays, nthreads=1).numpy()
        return free

    def hits(self, starts: Array, directions: Array) -> tuple[Int64, Int64]:
        """Return (ray, face) of every face that a ray meets on its way."""
        found = self._scene.list_intersections(self._rays(starts, directions), nthreads=1)
        ray = found["ray_ids"].numpy().astype(np.int64)
        return ray, self.rows[found["primitive_ids"].numpy().astype(np.int64)]


def _directions(n: int) -> Array:
    """Return n unit vectors (n, 3) spread evenly over the sphere (a Fibonacci lattice)."""
    k = np.arange(n) + 0.5
    z, angle = 1.0 - 2.0 * k / n, k * np.pi * (1.0 + np.sqrt(5.0))
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=-1)


def _spread_faces(patch: Int32, n: int, areas: Array, wanted: Mask, k: int) -> Int64:
    """Return k faces of every wanted patch, evenly by area: (number of wanted patches, k)."""
    rows = np.flatnonzero(np.r_[wanted, False][patch])
    rows = rows[np.argsort(patch[rows], kind="stable")]
    # A face without area could never be drawn: a patch of such faces would have none.
    weight = np.maximum(areas[rows], np.finfo(np.float64).tiny)
    total = np.bincount(patch[rows], weight, n)[wanted]
    count = np.bincount(patch[rows], minlength=n)[wanted]
    running = np.cumsum(weight / np.repeat(total, count))  # patch number i fills (i, i + 1)
    targets = np.arange(len(total))[:, None] + (np.arange(k) + 0.5) / k
    place = np.searchsorted(running, targets.ravel()).reshape(-1, k)
    last = np.cumsum(count)[:, None] - 1
    return rows[np.clip(place, last - count[:, None] + 1, last)]


def _centers_and_normals(topo: Topology, faces: Int64) -> tuple[Array, Array]:
    a, b, c = np.moveaxis(topo.positions[topo.faces[faces]], -2, 0)
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return (a + b + c) / 3.0, normal / np.where(length > 0, length, 1.0)


def _depths(topo: Topology, scene: _Scene, patch: Int32, is_solid: Mask, areas: Array) -> Int32:
    """Return for each solid patch in how many others it lies with all its points.

    A point is inside a closed surface where a ray from it crosses that surface an odd number of
    times; of three rays the majority decides, since a ray through an edge may count twice.
    """
    n = len(is_solid)
    faces = _spread_faces(patch, n, areas, is_solid, NESTING_POINTS)
    points, _ = _centers_and_normals(topo, faces)
    m = len(points)
    number = np.full(n + 1, -1, dtype=np.int64)
    number[:n][is_solid] = np.arange(m)
    starts = points.reshape(-1, 3)
    inside = np.zeros(0, dtype=np.int64)
    for direction in _directions(2 * 3 + 1)[1::2]:  # three generic directions, none along an axis
        ray, face = scene.hits(starts, np.broadcast_to(direction, starts.shape))
        other = number[patch[face]]
        foreign = (other >= 0) & (other != ray // NESTING_POINTS)
        keys, crossings = np.unique(ray[foreign] * m + other[foreign], return_counts=True)
        inside = np.concatenate([inside, keys[crossings % 2 == 1]])
    keys, seen = np.unique(inside, return_counts=True)
    keys = keys[seen >= 2]
    pair = (keys // m) // NESTING_POINTS * m + keys % m
    pairs, points_inside = np.unique(pair, return_counts=True)
    within = pairs[points_inside == NESTING_POINTS]
    return np.bincount(within // m, minlength=m).astype(np.int32)


def _voted_inward(
    topo: Topology, scene: _Scene, patch: Int32, n: int, areas: Array, against: Mask
) -> Mask:
    """Return which patches (N,) have the freer side at the back of their faces."""
    per_patch = min(VOTE_RAYS, VOTE_RAYS_IN_ALL // n) // VOTE_DIRECTIONS
    k = max(per_patch, 1)
    faces = _spread_faces(patch, n, areas, np.ones(n, dtype=bool), k)
    points, normals = _centers_and_normals(topo, faces)
    normals = np.where(against[faces][..., None], -normals, normals)
    front, back = np.zeros(n), np.zeros(n)
    for direction in _directions(VOTE_DIRECTIONS):
        side = np.einsum("nki,i->nk", normals, direction)
        lift = np.where(side > 0, 1.0, -1.0)[..., None] * normals * (START_SHARE * topo.size)
        starts = (points + lift).reshape(-1, 3)
        free = scene.is_free(starts, np.broadcast_to(direction, starts.shape)).reshape(n, k)
        front += np.count_nonzero(free & (side > 0), axis=1)
        back += np.count_nonzero(free & (side < 0), axis=1)
    return back > front + VOTE_MARGIN * k * VOTE_DIRECTIONS


FLAT_SHARE = 1e-4
"""A mesh thinner than this share of its size in some direction is flat: 10 um at 10 cm, less than
any scanner resolves."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Survey:
    """Everything that is known of a mesh's surface; the report is made from it."""

    mesh: Mesh
    topology: Topology
    orientation: Orientation
    areas: Array
    """(F,) [m^2]."""
    volumes: Array
    """(F,) signed volumes of the cones to one point, as the faces wind [m^3]."""
    body_count: int
    body: Int32
    """(F,) the connected piece of every face, -1 where the face is not a proper one."""
    body_areas: Array
    """(B,) [m^2]."""
    body_sizes: Array
    """(B,) twice the greatest distance of a corner from the body's mean corner [m]."""
    thickness: Array
    """(3,) extents along the principal axes, greatest first [m]."""

    def specks(self, size_share: float, area_share: float) -> Mask:
        """Return which bodies (B,) are stray specks: small, not the largest, and little in all."""
        areas, sizes = self.body_areas, self.body_sizes
        small = sizes < size_share * self.topology.size
        if self.body_count:
            small[int(np.argmax(areas))] = False
        if areas[small].sum() > area_share * areas.sum():
            small[:] = False
        return small

    @property
    def is_flat(self) -> bool:
        """Whether the mesh has no extent in some direction."""
        return bool(self.thickness[2] <= FLAT_SHARE * self.topology.size)


def survey(mesh: Mesh) -> Survey:
    """Return everything that is known of the mesh's surface."""
    topo = topology(mesh)
    areas, volumes = face_areas_and_volumes(topo)
    count, body = bodies(topo)
    proper = np.flatnonzero(topo.proper)
    label = body[proper]
    corners = np.bincount(label, minlength=count) * 3.0
    # Body by body, corners are weighted by how many faces they have: it need not be more exact.
    sums = np.stack(
        [
            sum(
                np.bincount(label, topo.positions[topo.faces[proper, i], k], count)
                for i in range(3)
            )
            for k in range(3)
        ],
        axis=-1,
    ).reshape(count, 3)
    center = sums / np.maximum(corners, 1.0)[:, None]
    sizes = np.zeros(count)
    for i in range(3):
        offset = topo.positions[topo.faces[proper, i]] - center[label]
        np.maximum.at(sizes, label, 2.0 * np.sqrt(np.einsum("ij,ij->i", offset, offset)))
    return Survey(
        mesh=mesh,
        topology=topo,
        orientation=orientation(topo, areas, volumes),
        areas=areas,
        volumes=volumes,
        body_count=count,
        body=body,
        body_areas=np.bincount(label, areas[proper], count).astype(np.float64),
        body_sizes=sizes,
        thickness=_thickness(topo.positions),
    )


def _thickness(positions: Array) -> Array:
    """Return the extents (3,) along the principal axes of the positions, greatest first."""
    centered = positions - positions.mean(axis=0)
    _, axes = np.linalg.eigh(centered.T @ centered)
    return np.sort(np.ptp(centered @ axes, axis=0))[::-1]
