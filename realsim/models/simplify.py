"""Fewer faces: quadric decimation that keeps a closed surface closed, and how far it is off."""

from dataclasses import replace

import numpy as np

from realsim.arrays import Array, Int64, UInt8
from realsim.errors import DegenerateError, InputError
from realsim.geometry.mesh import decimated, sample_surface, tensor_mesh, texels
from realsim.interop import import_open3d
from realsim.models.mesh_clustering import clustered
from realsim.models.mesh_topology import Topology, topology
from realsim.records import Mesh

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
