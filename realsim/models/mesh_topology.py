"""How the faces of a mesh hang together: welded positions, edges, rims of holes, bodies.

A texture splits a surface into charts, so a position may stand in a mesh several times. Everything
here is about positions: which faces meet along which edge, and in which sense they run along it.
The mesh itself is left as it is.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array, Int32, Int64, Mask
from realsim.records import Mesh

FOLD_AREA_SHARE = 0.01
"""Faces back to back with at most this share of the area are folds, which bound nothing and go
unseen; more of them are sheets that the mesh's author meant."""
RIM_WELD_SHARE = 1e-6
"""Vertices on a rim that are nearer than this share of the mesh's size are one position: exporters
round the two sides of a texture seam differently. Float32 keeps 7 digits, so less is noise."""
_PRIMES = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)
"""Odd multipliers that spread three coordinates over 64 bits (xxHash's)."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Topology:
    """The faces of a mesh over its distinct positions, and the edges between them."""

    positions: Array
    """(P, 3) distinct positions that a face uses [m]."""
    index: Int32
    """(V,) the position of every vertex of the mesh; -1 where no face uses the vertex."""
    faces: Int32
    """(F, 3) position numbers: row i belongs to row i of the mesh's faces. May have collapsed
    and repeated rows, see `proper`."""
    collapsed: Mask
    """(F,) faces with fewer than three distinct positions."""
    repeated: Mask
    """(F,) faces on the same three positions as an earlier one, which stands for both."""
    folded: Mask
    """(F,) faces back to back with another one in an otherwise simple surface: folds without
    volume, as decimation leaves them. Without both, the surface is closed as before."""
    two_sided: Mask
    """(F,) faces back to back with another one where much of the mesh is so: a double-sided sheet,
    of which one side stands for both."""
    proper: Mask
    """(F,) all others. Edges, patches and bodies are those of the proper faces."""
    size: float
    """Twice the greatest distance of a position from their mean [m]: the extent of the mesh, but
    the same however it is turned."""
    half_edge: Int32
    """(H,) number of the edge of every half edge of a proper face."""
    half_face: Int32
    """(H,) the face it belongs to."""
    half_sign: NDArray[np.int8]
    """(H,) +1 where the face runs along the edge from the lower position number to the higher."""
    edge_uses: Int32
    """(E,) number of faces at the edge: 1 on a rim, 2 inside a surface."""
    edge_net: Int32
    """(E,) sum of the signs: 0 where the faces run in opposite directions."""
    edge_ends: Int32
    """(E, 2) position numbers, the lower first."""

    @property
    def is_watertight(self) -> bool:
        """Whether every edge has two faces that run along it in opposite directions."""
        return bool(len(self.edge_uses)) and bool(
            np.all(self.edge_uses == 2) and np.all(self.edge_net == 0)
        )


def equal_rows(rows: NDArray[Any]) -> tuple[Int64, Int64]:
    """Return the first row of every kind (G,), in order, and the kind of every row (N,).

    Rows (N, K) of numbers of 8 bytes or less are compared bit by bit, 0 and -0 being the same.
    They are sorted by a 64-bit hash, five times as fast as sorting the rows; that no two kinds
    share a hash is checked.
    """
    if len(rows) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    if rows.dtype.kind == "f":
        rows = rows.astype(np.float64) + 0.0  # -0.0 becomes 0.0
        bits = np.ascontiguousarray(rows).view(np.uint64)
    else:
        bits = np.ascontiguousarray(rows, dtype=np.int64).view(np.uint64)
    key = np.zeros(len(bits), dtype=np.uint64)
    for k in range(bits.shape[1]):
        key ^= bits[:, k]
        key *= _PRIMES[k % len(_PRIMES)]
        key ^= key >> np.uint64(29)
    order = np.argsort(key)
    key = key[order]
    is_new = np.r_[True, key[1:] != key[:-1]]
    same = np.flatnonzero(~is_new)
    if np.any(bits[order[same]] != bits[order[same - 1]]):  # two kinds share a hash
        _, first, kind = np.unique(bits, axis=0, return_index=True, return_inverse=True)
        kind = kind.reshape(-1)
    else:
        kind = np.empty(len(bits), dtype=np.int64)
        kind[order] = np.cumsum(is_new) - 1
        starts = np.flatnonzero(is_new)
        # argsort is not stable, so the first of a kind is its least number.
        first = np.minimum.reduceat(order, starts)
    by_first = np.argsort(first)
    rank = np.empty(len(first), dtype=np.int64)
    rank[by_first] = np.arange(len(first))
    return first[by_first], rank[kind]


def topology(mesh: Mesh) -> Topology:
    """Return how the faces of the mesh hang together over its positions.

    Equal positions are one. On rims, positions nearer than `RIM_WELD_SHARE` of the size are one,
    too: elsewhere the surface is closed already, and nothing is gained by moving it.
    """
    used = np.zeros(len(mesh.vertices), dtype=bool)
    used[mesh.faces.ravel()] = True
    numbers = np.flatnonzero(used)
    first, kind = equal_rows(mesh.vertices[numbers])
    index = np.full(len(mesh.vertices), -1, dtype=np.int32)
    index[numbers] = kind
    positions = mesh.vertices[numbers[first]]
    size = 2.0 * float(np.sqrt(np.square(positions - positions.mean(axis=0)).sum(axis=1).max()))
    faces = index[mesh.faces]
    edges = _edges(positions, faces)
    merged = _merged_rims(positions, edges, RIM_WELD_SHARE * size)
    if merged is not None:
        keep, new_index = merged
        positions = positions[keep]
        index[numbers] = new_index[index[numbers]]
        faces = index[mesh.faces]
        edges = _edges(positions, faces)
    return Topology(positions=positions, index=index, faces=faces, size=size, **edges)


def open_edges(mesh: Mesh) -> int:
    """Return how many edges have one face only; 0 = the surface is closed."""
    return int(np.count_nonzero(topology(mesh).edge_uses == 1))


def _edges(positions: Array, faces: Int32) -> dict[str, Any]:
    """Return proper faces, half edges and edges of faces (F, 3) over positions (P, 3)."""
    n = len(positions)
    improper = _improper(positions, faces)
    proper = ~(improper["collapsed"] | improper["repeated"] | improper["folded"])
    rows = np.flatnonzero(proper).astype(np.int32)
    # Half edge h belongs to face rows[h % len(rows)] and starts at corner h // len(rows).
    start = np.concatenate([faces[rows, k] for k in (0, 1, 2)])
    end = np.concatenate([faces[rows, k] for k in (1, 2, 0)])
    sign = np.where(start < end, 1, -1).astype(np.int8)
    key = np.minimum(start, end).astype(np.int64) * n + np.maximum(start, end)
    del start, end
    order = np.argsort(key)
    key = key[order]
    is_new = np.r_[True, key[1:] != key[:-1]] if len(key) else np.zeros(0, dtype=bool)
    starts = np.flatnonzero(is_new)
    half_edge = np.empty(len(key), dtype=np.int32)
    half_edge[order] = np.cumsum(is_new) - 1
    ends = np.stack([key[starts] // n, key[starts] % n], axis=-1).astype(np.int32)
    uses = np.diff(np.r_[starts, len(key)]).astype(np.int32)
    empty = np.zeros(0, dtype=np.int32)
    net = np.add.reduceat(sign[order], starts, dtype=np.int32) if len(starts) else empty
    return {
        **improper,
        "proper": proper,
        "half_edge": half_edge,
        "half_face": np.tile(rows, 3),
        "half_sign": sign,
        "edge_uses": uses,
        "edge_net": net,
        "edge_ends": ends,
    }


def _improper(positions: Array, faces: Int32) -> dict[str, Mask]:
    """Return which faces are collapsed, repeated, folded and two-sided."""
    a, b, c = faces.T
    collapsed = (a == b) | (b == c) | (c == a)
    # Of the three steps a-b, b-c, c-a two go up in one winding, and one in the other.
    rises = (a < b).astype(np.int8) + (b < c) + (c < a)
    first, kind = equal_rows(np.sort(faces, axis=1))
    repeated = (first[kind] != np.arange(len(faces))) & ~collapsed
    folded = two_sided = np.zeros(len(faces), dtype=bool)
    if np.any(repeated):
        net = np.bincount(kind, np.where(rises == 2, 1, -1), len(first))
        back_to_back = (net[kind] == 0) & ~collapsed
        areas = face_areas(positions, faces)
        if areas[back_to_back].sum() <= FOLD_AREA_SHARE * areas.sum():
            folded, repeated = back_to_back, repeated & ~back_to_back
        else:
            two_sided = back_to_back
    return {"collapsed": collapsed, "repeated": repeated, "folded": folded, "two_sided": two_sided}


def _merged_rims(
    positions: Array, edges: dict[str, Any], distance: float
) -> tuple[Int64, Int64] | None:
    """Return which positions stay and the new number of each, or None if no rims touch."""
    rim = np.unique(edges["edge_ends"][edges["edge_uses"] == 1])
    if len(rim) < 2 or not distance > 0:
        return None
    from scipy.spatial import KDTree

    pairs = KDTree(positions[rim]).query_pairs(distance, output_type="ndarray")
    if len(pairs) == 0:
        return None
    _, label = components(len(positions), rim[pairs[:, 0]], rim[pairs[:, 1]])
    first, new_index = equal_rows(label[:, None])
    return first, new_index


def components(n: int, i: NDArray[Any], j: NDArray[Any]) -> tuple[int, Int32]:
    """Return how many components n nodes with the links i-j have, and the one of each node."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    graph = coo_matrix((np.ones(len(i), dtype=np.int8), (i, j)), shape=(n, n))
    count, label = connected_components(graph.tocsr(), directed=False)
    return int(count), label.astype(np.int32)


def face_pairs(topo: Topology, edges: Mask) -> tuple[Int32, Int32, Int64]:
    """Return pairs of faces that share one of the marked edges, and the half edges of the first.

    An edge of k faces gives k - 1 pairs, which is enough to link them.
    """
    halves = np.flatnonzero(edges[topo.half_edge])
    halves = halves[np.argsort(topo.half_edge[halves], kind="stable")]
    edge = topo.half_edge[halves]
    follows = np.flatnonzero(edge[1:] == edge[:-1])
    left, right = halves[follows], halves[follows + 1]
    return topo.half_face[left], topo.half_face[right], left


def bodies(topo: Topology) -> tuple[int, Int32]:
    """Return the number of connected pieces of surface and the one of every face (F,).

    Faces that share an edge, however many they are, belong together; a common corner alone does
    not join. Collapsed faces belong to none: -1.
    """
    return _labelled(topo, topo.edge_uses >= 2)


def patches(topo: Topology) -> tuple[int, Int32]:
    """Return the number of patches and the patch of every face (F,); -1 for collapsed faces.

    A patch hangs together across edges of exactly two faces: within it the winding of one face
    decides that of all.
    """
    return _labelled(topo, topo.edge_uses == 2)


def _labelled(topo: Topology, edges: Mask) -> tuple[int, Int32]:
    i, j, _ = face_pairs(topo, edges)
    _, label = components(len(topo.faces), i, j)
    out = np.full(len(label), -1, dtype=np.int32)
    _, kind = equal_rows(label[topo.proper][:, None])
    out[topo.proper] = kind
    return int(kind.max(initial=-1)) + 1, out


def face_areas(positions: Array, faces: Int32) -> Array:
    """Return the area (F,) of every face [m^2]."""
    a, b, c = np.moveaxis(positions[faces], 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def face_areas_and_volumes(topo: Topology) -> tuple[Array, Array]:
    """Return area (F,) [m^2] and signed volume (F,) [m^3] of the cone to the mean position."""
    origin = topo.positions.mean(axis=0)
    areas = np.empty(len(topo.faces))
    volumes = np.empty(len(topo.faces))
    step = 1 << 18  # in pieces: a mesh of millions of faces needs no gigabytes
    for s in range(0, len(topo.faces), step):
        corners = topo.positions[topo.faces[s : s + step]] - origin
        a, b, c = np.moveaxis(corners, 1, 0)
        cross = np.cross(b - a, c - a)
        areas[s : s + step] = 0.5 * np.sqrt(np.einsum("ij,ij->i", cross, cross))
        volumes[s : s + step] = np.einsum("ij,ij->i", a, cross) / 6.0
    return areas, volumes


def rims(topo: Topology) -> tuple[int, Int32, Array]:
    """Return the number of holes, the hole of every rim edge, and the size (N,) of each [m].

    Rim edges in the order of the edges; a hole's size is twice the greatest distance of its
    corners from their mean. Holes that touch in a corner count as one.
    """
    ends = topo.edge_ends[topo.edge_uses == 1]
    if len(ends) == 0:
        return 0, np.zeros(0, dtype=np.int32), np.zeros(0)
    corners, local = np.unique(ends, return_inverse=True)
    local = local.reshape(-1, 2)
    count, label = components(len(corners), local[:, 0], local[:, 1])
    points = topo.positions[corners]
    share = np.bincount(label, minlength=count)
    center = np.stack([np.bincount(label, points[:, k], count) / share for k in range(3)], axis=-1)
    sizes = np.zeros(count)
    np.maximum.at(sizes, label, 2.0 * np.linalg.norm(points - center[label], axis=1))
    return count, label[local[:, 0]], sizes
