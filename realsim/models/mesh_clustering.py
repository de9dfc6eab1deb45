"""Vertex clustering: the first, coarse step from millions of faces to what can be decimated.

The vertices of a grid's cell become one, their mean (Rossignac & Borrel 1993, "Multi-resolution 3D
approximations"). It costs a fiftieth of collapsing edges one by one. Faces that fall onto the same
corners cancel where they face each other, so a closed surface stays closed as a chain; where more
than two faces then meet in an edge, as sheets nearer than a cell do, the cells around it are left
as fine as they were.
"""

import math

import numpy as np

from realsim.arrays import Array, Int32, Int64
from realsim.models.mesh_topology import Topology, equal_rows, face_areas_and_volumes, topology
from realsim.records import Mesh

GREATEST_CELL_SHARE = 0.002
"""Cells are at most this share of the mesh's size [-]: 0.2 mm at 10 cm, so that what is lost is
less than a depth camera resolves, however few faces are wanted."""
LEAST_SHARE = 0.8
"""Cells are made smaller until so large a share of the wanted faces is left [-]."""
ATTEMPTS = 4
"""Smaller cells tried; unevenly spread faces need more than one."""
MENDING_ROUNDS = 6
"""Times that cells around bad edges are given their own vertices back."""


def clustered(
    topo: Topology, faces: int, greatest_cell_share: float = GREATEST_CELL_SHARE
) -> Mesh | None:
    """Return the surface with about so many faces, or more; None if it could not be kept closed.

    Args:
        topo: of the mesh; its proper faces are taken.
        faces: wanted.
        greatest_cell_share: largest cell, as a share of the mesh's size.
    """
    area = float(face_areas_and_volumes(topo)[0].sum())
    given = topo.faces[topo.proper]
    # A triangulation has two faces per vertex, and a cell of the grid takes a vertex.
    cell = min(math.sqrt(2.0 * area / faces), greatest_cell_share * topo.size)
    index = _cells(topo.positions, cell)
    found = _surface(index, given)
    for _ in range(ATTEMPTS):
        if len(found) >= LEAST_SHARE * faces:
            break
        cell *= math.sqrt(max(len(found), 1) / faces)
        index = _cells(topo.positions, cell)
        found = _surface(index, given)
    return _mended(topo, index, found, given)


def _cells(points: Array, cell: float) -> Int32:
    """Return the number (N,) of the occupied cell of every point."""
    at = ((points - points.min(axis=0)) / cell).astype(np.int64)
    most = at.max(axis=0) + 1
    key = (at[:, 0] * most[1] + at[:, 1]) * most[2] + at[:, 2]
    return equal_rows(key[:, None])[1].astype(np.int32)


def _surface(index: Int32, faces: Int32) -> Int32:
    """Return the faces over clusters; of those on the same three, only what does not cancel."""
    moved = index[faces]
    a, b, c = moved.T
    moved = moved[(a != b) & (b != c) & (c != a)]
    a, b, c = moved.T
    # Of the three steps a-b, b-c, c-a two go up in one winding, and one in the other.
    sign = np.where((a < b).astype(np.int8) + (b < c) + (c < a) == 2, 1, -1)
    first, kind = equal_rows(np.sort(moved, axis=1))
    net = np.bincount(kind, sign, len(first))
    keep = (net[kind] * sign > 0) & (_first_of(kind, sign) == np.arange(len(kind)))
    return moved[keep]


def _first_of(kind: Int64, sign: Int64) -> Int64:
    """Return for every row the first row of the same kind and sign (N,)."""
    both = 2 * kind + (sign > 0)
    first = np.full(int(both.max(initial=-1)) + 1, len(both), dtype=np.int64)
    # Written backwards, so that the least row of a kind is what stays.
    first[both[::-1]] = np.arange(len(both))[::-1]
    return first[both]


def _mended(topo: Topology, index: Int32, faces: Int32, given: Int32) -> Mesh | None:
    """Return the clustered mesh, its bad places as fine as before; None if some stay bad."""
    for _ in range(MENDING_ROUNDS):
        mesh = Mesh(vertices=_means(topo.positions, index), faces=faces)
        if not topo.is_watertight:
            return mesh
        found = topology(mesh)
        if found.is_watertight and bool(np.all(found.proper)):
            return mesh
        bad = (found.edge_uses != 2) | (found.edge_net != 0)
        ends = np.flatnonzero(np.isin(found.index, found.edge_ends[bad]))
        improper = mesh.faces[~found.proper]
        is_bad = np.zeros(int(index.max()) + 1, dtype=bool)
        is_bad[ends] = True
        is_bad[improper.ravel()] = True
        # And the cells next to them: what falls together may do so just beside the edge.
        is_bad[faces[np.any(is_bad[faces], axis=1)].ravel()] = True
        own = np.flatnonzero(is_bad[index])
        index = index.copy()
        index[own] = len(is_bad) + np.arange(len(own))
        index = equal_rows(index[:, None])[1].astype(np.int32)
        faces = _surface(index, given)
    return None


def _means(points: Array, index: Int32) -> Array:
    """Return the mean (K, 3) of the points of every cluster."""
    count = np.bincount(index)
    return np.stack([np.bincount(index, points[:, k]) / count for k in range(3)], axis=-1)
