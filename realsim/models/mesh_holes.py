"""Closing small holes with fans of triangles, colours and texture taken from the rim."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.models.mesh_topology import Array, Bools, Topology, rims


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Fillers:
    """The triangles that close the small holes of a mesh."""

    rim: NDArray[np.int32]
    """(N, 2) vertices of the mesh: each rim edge as its triangle runs along it."""
    hole: NDArray[np.int32]
    """(N,) the filled hole, 0 .. len(centers) - 1, of each rim edge."""
    centers: Array
    """(H, 3) tips of the fans [m]."""
    sizes: Array
    """(H,) sizes of the filled holes [m]."""
    left: tuple[str, ...]
    """Why the small holes that stay open do."""


def find_fillers(
    topo: Topology,
    faces: NDArray[np.int32],
    turned: Bools,
    largest: Array,
    unevenness: float,
) -> Fillers:
    """Return fans that close the holes up to a size.

    A hole is closed when its rim is one simple loop, lies near a plane, and is seen whole from the
    middle of the rim: then the fan from there neither folds nor leaves the rim's plane.

    Args:
        topo: the mesh's topology.
        faces: (F, 3) the mesh's own faces, whose vertices the fans use.
        turned: (F,) faces to be read in the opposite winding.
        largest: (F,) greatest size of a hole that is closed at this face [m].
        unevenness: greatest distance of a rim's corners from its plane, as a share of its size.
    """
    count, label, sizes = rims(topo)
    if count == 0:
        none = np.zeros((0, 2), dtype=np.int32)
        return Fillers(
            rim=none, hole=none[:, 0], centers=np.zeros((0, 3)), sizes=np.zeros(0), left=()
        )
    half = np.flatnonzero(topo.edge_uses[topo.half_edge] == 1)
    half = half[np.argsort(topo.half_edge[half])]  # the order of `label`
    face = topo.half_face[half]
    corner = half // np.count_nonzero(topo.proper)
    start, end = faces[face, corner], faces[face, (corner + 1) % 3]
    # A neighbour runs along an edge the other way; so does the triangle that closes the hole.
    rim = np.where(turned[face][:, None], np.stack([start, end], -1), np.stack([end, start], -1))
    a, b = topo.index[rim[:, 0]], topo.index[rim[:, 1]]

    small = np.ones(count, dtype=bool)
    small[label[sizes[label] > largest[face]]] = False
    degree_out = np.bincount(a, minlength=len(topo.positions))
    degree_in = np.bincount(b, minlength=len(topo.positions))
    simple = np.ones(count, dtype=bool)
    simple[label[(degree_out[a] != 1) | (degree_in[a] != 1)]] = False
    simple[label[(degree_out[b] != 1) | (degree_in[b] != 1)]] = False

    edges = np.bincount(label, minlength=count)
    p = topo.positions[a]
    center = np.stack([np.bincount(label, p[:, k], count) for k in range(3)], -1) / edges[:, None]
    doubled = np.cross(p - center[label], topo.positions[b] - center[label])
    normal = np.stack([np.bincount(label, doubled[:, k], count) for k in range(3)], -1)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal /= np.where(length > 0, length, 1.0)
    off_plane = np.zeros(count)
    np.maximum.at(off_plane, label, np.abs(np.einsum("ij,ij->i", p - center[label], normal[label])))
    even = off_plane <= unevenness * sizes
    star = np.ones(count, dtype=bool)
    star[label[np.einsum("ij,ij->i", doubled, normal[label]) <= 0]] = False

    fill = small & simple & even & star
    number = np.cumsum(fill) - 1
    chosen = fill[label]
    reasons = (
        (small & ~simple, "their rims touch or are wound both ways"),
        (small & simple & ~even, "their rims are not plane"),
        (small & simple & even & ~star, "their rims fold back"),
    )
    return Fillers(
        rim=rim[chosen],
        hole=number[label[chosen]].astype(np.int32),
        centers=center[fill],
        sizes=sizes[fill],
        left=tuple(f"{int(np.sum(which))}: {why}" for which, why in reasons if np.any(which)),
    )
