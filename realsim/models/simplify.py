"""Fewer faces: quadric decimation that keeps a closed surface closed, and how far it is off.

Vertex clustering: the first, coarse step from millions of faces to what can be decimated.

The vertices of a grid's cell become one, their mean (Rossignac & Borrel 1993, "Multi-resolution 3D
approximations"). It costs a fiftieth of collapsing edges one by one. Faces that fall onto the same
corners cancel where they face each other, so a closed surface stays closed as a chain; where more
than two faces then meet in an edge, as sheets nearer than a cell do, the cells around it are left
as fine as they were.
"""

import math
from dataclasses import replace

import numpy as np

from realsim.arrays import Array, Int32, Int64, UInt8
from realsim.errors import DegenerateError, InputError
from realsim.geometry.mesh import decimated, sample_surface, tensor_mesh, texels
from realsim.interop import import_open3d
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


LEAST_FACES = 4
"""A tetrahedron: no closed surface has fewer."""
SECOND_CHANCES = (1.0, 1.5, 2.5)
"""Where the decimation tears a closed surface it is tried again with so many times the faces."""
CLUSTERED_FROM = 1_500_000
"""Meshes of more faces are clustered first: collapsing edges costs 15 CPU-s per million faces."""
CLUSTERED_TO = 1.5
"""Faces left by the clustering per face wanted: the decimation then chooses what it keeps."""
DEVIATION_SAMPLES = 20_000
"""Points per surface at which a deviation is measured: 1 % of the surface cannot be missed."""


def simplified(mesh: Mesh, faces: int) -> Mesh:
    """Return the mesh with about so many faces, or as it is if it has no more.

    Quadric decimation (`geometry.mesh.decimated`) on welded positions, after vertex clustering
    where the mesh has millions of faces. A closed surface stays closed: where the decimation tears
    it, it is tried again with more faces, and in the end the mesh is returned with its welded
    positions and all its faces. A texture becomes colours of the vertices, each taken from
    the closest point of the given surface, since collapsed edges leave its charts meaningless;
    colours per vertex are carried over likewise.

    Args:
        mesh: any mesh.
        faces: number of faces wanted; the result may have some more or fewer.

    Raises:
        InputError: fewer than 4 faces are asked for.
        DegenerateError: nothing is left of the surface with so few faces.
    """
    if faces < LEAST_FACES:
        raise InputError(
            f"{faces} faces are asked for; a closed surface has {LEAST_FACES} or more."
        )
    if len(mesh.faces) <= faces:
        return mesh
    topo = topology(mesh)
    bare = Mesh(vertices=topo.positions, faces=topo.faces[topo.proper])
    if len(bare.faces) > max(CLUSTERED_FROM, CLUSTERED_TO * faces):
        bare = clustered(topo, round(CLUSTERED_TO * faces)) or bare
    result = _still_closed(bare, topo, faces)
    if mesh.colors is None and mesh.texture is None:
        return result
    return replace(result, colors=colors_at(mesh, result.vertices))


def _still_closed(bare: Mesh, topo: Topology, faces: int) -> Mesh:
    """Return the mesh decimated, with more faces where it tears."""
    # About the middle and of size 1, so that the result does not depend on the unit.
    center, size = topo.positions.mean(axis=0), topo.size
    unit = Mesh(vertices=(bare.vertices - center) / size, faces=bare.faces)
    for more in SECOND_CHANCES:
        wanted = round(faces * more)
        if wanted >= len(bare.faces):
            break
        small = decimated(unit, wanted)
        if len(small.faces) < LEAST_FACES:
            raise DegenerateError(
                f"with {wanted} faces nothing is left of a mesh of {len(bare.faces)}; ask for more."
            )
        result = replace(small, vertices=small.vertices * size + center)
        if not topo.is_watertight or topology(result).is_watertight:
            return result
    return bare


def _closest(mesh: Mesh, points: Array) -> tuple[Array, Int64, Array]:
    """Return distance (N,), face (N,) and barycentric coordinates (N, 3) of the closest points."""
    o3d = import_open3d()
    center = mesh.vertices.mean(axis=0)
    size = float(np.ptp(mesh.vertices, axis=0).max())
    unit = replace(mesh, vertices=(mesh.vertices - center) / size, colors=None, uv=None)
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(tensor_mesh(unit))
    queries = np.ascontiguousarray((points - center) / size, dtype=np.float32)
    found = scene.compute_closest_points(o3d.core.Tensor(queries), nthreads=1)
    near = found["points"].numpy().astype(np.float64)
    uv = found["primitive_uvs"].numpy().astype(np.float64)
    distance = np.linalg.norm(near - (points - center) / size, axis=1) * size
    weights = np.column_stack([1.0 - uv.sum(axis=1), uv])
    return distance, found["primitive_ids"].numpy().astype(np.int64), weights


def colors_at(mesh: Mesh, points: Array) -> UInt8:
    """Return the RGB (N, 3) of the mesh's surface at the points of it closest to these (N, 3).

    Texture coordinates and colours are interpolated over the face; the texture is read at the
    nearest texel and repeats outside 0 .. 1.

    Raises:
        InputError: the mesh has neither colours nor a texture.
    """
    _, face, weights = _closest(mesh, points)
    corners = mesh.faces[face]
    if mesh.texture is not None and mesh.uv is not None:
        return texels(mesh.texture, np.einsum("nk,nkd->nd", weights, mesh.uv[corners]))
    if mesh.colors is None:
        raise InputError("the mesh has neither colours nor a texture to take colours from.")
    mean = np.einsum("nk,nkd->nd", weights, mesh.colors[corners].astype(np.float64))
    return np.clip(np.rint(mean), 0, 255).astype(np.uint8)


def deviation(
    a: Mesh,
    b: Mesh,
    *,
    quantile: float = 1.0,
    samples: int = DEVIATION_SAMPLES,
    rng: np.random.Generator | None = None,
) -> float:
    """Return how far two surfaces are apart [m]: a quantile of the distances both ways.

    Points are drawn evenly from each surface, and their distances to the other one taken; the
    greater of the two directions counts. At quantile 1 it is the Hausdorff distance, from below.

    Args:
        a: one mesh.
        b: the other.
        quantile: 1 for the greatest distance, 0.95 for that of 95 % of the points.
        samples: points per surface.
        rng: for the points; by default a generator of seed 0, so that the figure is repeatable.

    Raises:
        InputError: the quantile is not in (0, 1].
    """
    if not 0.0 < quantile <= 1.0:
        raise InputError(f"a quantile of {quantile} is not in (0, 1].")
    rng = np.random.default_rng(0) if rng is None else rng
    worst = 0.0
    for one, other in ((a, b), (b, a)):
        points, _ = sample_surface(one, samples, rng)
        worst = max(worst, float(np.quantile(_closest(other, points)[0], quantile)))
    return worst
