"""From fused distances to a closed surface: the table taken off, the underside and holes closed.

Closing is done in the volume, before there are triangles: what no camera saw through is inside.
A region behind a surface is unseen and becomes solid; so does what hides under an overhang; holes
close by themselves; and below the plane everything is outside. The zero level of such a field is
watertight by construction, and which part of it is invented is known voxel by voxel.

What every vertex rests on: how many views measured it, how well, and its colour.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.arrays import Array, Array32, Int32, Int64, Mask, UInt8
from realsim.compiled import njit
from realsim.errors import InputError
from realsim.geometry.point_loops import move, turn
from realsim.scanning.fusion.evidence import Crops, pixel_of
from realsim.scanning.fusion.result import FusionConfig, FusionFrame
from realsim.scanning.fusion.volume import Volume

SMOOTH_STEPS = 12
"""Steps of Laplacian smoothing of invented patches, whose raw shape is the staircase of voxels."""
BAND_LAYERS = 2
"""The band below the cut is no wider than any of so many layers above it."""
LEAST_TRIANGLES = 50
"""A surface of fewer triangles is noise, not an object."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Surface:
    """A closed surface in the table's frame."""

    vertices: Array
    """(V, 3) [m]."""
    faces: Int32
    """(F, 3) counter-clockwise seen from outside."""
    known: Mask
    """(V,) whether the volume around the vertex was seen on both sides of the surface."""
    below_cut: Mask
    """(V,) part of the underside or of the band that was extended down to the plane."""
    specks: int
    """Pieces that were removed."""
    cavities: int
    """Closed cavities that were filled: no camera looks into them."""


def closed_surface(volume: Volume, cut_m: float, config: FusionConfig) -> Surface:
    """Return the surface of the object that stands on z = 0.

    Args:
        volume: the fused distances in the table's frame.
        cut_m: height below which rays to the table disturb those to the object [m].
        config: settings.

    Raises:
        InputError: nothing is left.
    """
    field, unknown = _extended(volume, cut_m, config)
    field, specks, cavities = _one_piece(field, volume.cell)
    vertices, faces = _zero_level(field, volume)
    known = ~_touches(unknown, volume, vertices)
    # The layer that is copied downwards is the first above the cut.
    below = vertices[:, 2] < cut_m
    known &= ~below
    vertices = _smoothed(vertices, faces, ~known & ~below)
    return Surface(
        vertices=vertices, faces=faces, known=known, below_cut=below,
        specks=specks, cavities=cavities,
    )  # fmt: skip


def _extended(volume: Volume, cut_m: float, config: FusionConfig) -> tuple[Array32, Mask]:
    """Return the field of a solid on the plane and where (X, Y, Z) its nodes were not seen."""
    unknown = np.isnan(volume.distance)
    inside = np.float32(-config.truncation_m)
    field = np.where(unknown, inside, volume.distance)
    z = volume.origin[2] + volume.cell * np.arange(field.shape[2])
    first = min(int(np.searchsorted(z, cut_m)), field.shape[2] - 1)
    # The lowest layers flare where few rays pass between the object and the table.
    field[:, :, first] = np.max(field[:, :, first : first + BAND_LAYERS], axis=2)
    field[:, :, :first] = field[:, :, first : first + 1]
    field = np.maximum(field, (-z).astype(np.float32))
    # The box ends where nothing of the object is left: outside.
    outside = np.float32(config.truncation_m)
    for axis in range(3):
        face: list[Any] = [slice(None)] * 3
        for end in (0, -1):
            face[axis] = end
            field[tuple(face)] = outside
    return field, unknown


def _one_piece(field: Array32, cell: float) -> tuple[Array32, int, int]:
    """Return the field with only its largest solid, without cavities, and what was removed."""
    from scipy import ndimage

    labelled: Any = ndimage.label(field < 0)
    solids, count = labelled
    if count == 0:
        raise InputError(
            "no surface was found above the table: the views see through every place above it. "
            "Do the poses belong to the images?"
        )
    sizes = np.bincount(solids.ravel())[1:]
    keep = solids == 1 + int(np.argmax(sizes))
    labelled = ndimage.label(~keep)
    spaces, holes = labelled
    solid = spaces != spaces[0, 0, 0]
    margin = np.float32(0.5 * cell)
    out = np.where(solid & (field >= 0), -margin, field)
    out = np.where(~solid & (field < 0), margin, out)
    return out.astype(np.float32), count - 1, holes - 1


def _zero_level(field: Array32, volume: Volume) -> tuple[Array, Int32]:
    """Return vertices (V, 3) [m] and faces of the field's zero level, faces outward.

    Open3D's `create_isosurfaces` (flying edges) shares vertices and is closed; its coordinates are
    in nodes, the last axis first.
    """
    from realsim.geometry.mesh import to_trimesh
    from realsim.interop import import_open3d
    from realsim.records import Mesh

    o3d = import_open3d()
    # A node of exactly zero would give triangles without area.
    field = np.where(field == 0, np.float32(1e-9), field)
    raw = o3d.t.geometry.TriangleMesh.create_isosurfaces(
        o3d.core.Tensor(np.ascontiguousarray(field)), [0.0]
    )
    faces = raw.triangle.indices.numpy().astype(np.int32)
    if len(faces) < LEAST_TRIANGLES:
        raise InputError(
            f"the fused surface has only {len(faces)} triangles; is the object large enough for "
            f"voxels of {1e3 * volume.cell:.2f} mm?"
        )
    nodes = raw.vertex.positions.numpy().astype(np.float64)[:, ::-1]
    vertices = volume.origin + volume.cell * nodes
    largest = to_trimesh(Mesh(vertices=vertices, faces=faces))
    if largest.body_count > 1:
        bodies = largest.split(only_watertight=False)
        largest = max(bodies, key=lambda body: len(body.faces))
    vertices = np.asarray(largest.vertices, dtype=np.float64)
    faces = np.asarray(largest.faces, dtype=np.int32)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    if np.sum(a * np.cross(b, c)) < 0:
        faces = faces[:, ::-1].copy()
    return vertices, faces


def _touches(unknown: Mask, volume: Volume, vertices: Array) -> Mask:
    """Return which vertices (V,) lie on an edge of the grid with an end that was not seen."""
    node = (vertices - volume.origin) / volume.cell
    low = np.clip(np.floor(node + 1e-6).astype(np.int64), 0, np.array(unknown.shape) - 1)
    high = np.clip(np.ceil(node - 1e-6).astype(np.int64), 0, np.array(unknown.shape) - 1)
    return unknown[tuple(low.T)] | unknown[tuple(high.T)]


def _smoothed(vertices: Array, faces: Int32, free: Mask) -> Array:
    """Return the vertices with the free ones moved to the mean of their neighbours, repeatedly."""
    if not free.any():
        return vertices
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = edges[free[edges[:, 0]]]
    degree = np.maximum(np.bincount(edges[:, 0], minlength=len(vertices)), 1)
    out = vertices.copy()
    for _ in range(SMOOTH_STEPS):
        mean = np.stack(
            [np.bincount(edges[:, 0], out[edges[:, 1], k], len(out)) / degree for k in range(3)], -1
        )
        out[free] = mean[free]
    return out


def patch_widths(surface: Surface, patch: Mask) -> Array:
    """Return the widths (K,) [m] of the connected patches of vertices: of discs of their area."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    f = surface.faces
    n = len(surface.vertices)
    if not patch.any():
        return np.zeros(0)
    edges = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])
    edges = edges[patch[edges].all(axis=1)]
    graph = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
    labelled: Any = connected_components(graph, directed=False)
    a, b, c = np.moveaxis(surface.vertices[f], 1, 0)
    third = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    area = np.bincount(f.ravel(), np.repeat(third, 3), minlength=n)
    return np.sqrt(4 / np.pi * np.bincount(labelled[1][patch], area[patch]))


# --- what every vertex rests on ------------------------------------------------------------------


AGREE_SIGMAS = 4.0
"""A view measured a vertex if its depth there is within so many sigmas (and half a truncation)."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class VertexEvidence:
    """Per vertex, from all views."""

    views: Int32
    """(V,) number of views that measured it."""
    noise_sigma_m: Array
    """(V,) 1-sigma of the mean distance from the depth noise [m]; inf without views."""
    spread_m: Array
    """(V,) standard deviation of the views' distances along the normal [m]; 0 below two views."""
    colors: UInt8 | None
    """(V, 3) mean RGB of the views that measured it; grey where none did."""


@njit
def _look(
    view: tuple[Array32, Int64, Array],
    camera: Array,
    noise: Array,
    surface: tuple[Array, Array],
    limits: tuple[float, float, float],
    image: UInt8,
    sums: Array,
) -> None:
    """Add one view to sums (V, 8): views, sum w, sum w r, sum w r^2, sum of weights and RGB."""
    depth, corner, T = view
    points, normals = surface
    sigmas, reach, least_cos = limits
    h, w = depth.shape
    for m in range(len(points)):
        x, y, z = points[m]
        a, b, c = move(T, x, y, z)
        if c < 0.02:
            continue
        u, v = pixel_of(camera, a, b, c)
        u, v = u - corner[0], v - corner[1]
        if u < 0 or v < 0 or u >= w or v >= h or depth[v, u] <= 0.0:
            continue
        n = normals[m]
        mx, my, mz = turn(T, n[0], n[1], n[2])
        ray = np.sqrt(a * a + b * b + c * c)
        cosine = -(mx * a + my * b + mz * c) / ray
        d = depth[v, u]
        sigma = max(noise[1], noise[0] * d * d)
        r = (d - c) * ray / c * cosine
        if cosine < least_cos or abs(r) > min(reach, sigmas * sigma * cosine + 0.25 * reach):
            continue
        g = 1.0 / (sigma * sigma)
        sums[m, 0] += 1.0
        sums[m, 1] += g
        sums[m, 2] += g * r
        sums[m, 3] += g * r * r
        if image.shape[0] > 1:
            k = g * cosine * cosine
            sums[m, 4] += k
            for channel in range(3):
                sums[m, 5 + channel] += k * image[v + corner[1], u + corner[0], channel]


def vertex_evidence(
    points: Array,
    normals: Array,
    crops: Crops,
    Ts_cam_table: Array,
    frames: Sequence[FusionFrame],
    config: FusionConfig,
) -> VertexEvidence:
    """Return what the views say at the vertices of the surface.

    Args:
        points: (V, 3) in the table's frame [m].
        normals: (V, 3) outward.
        crops: the trusted depth.
        Ts_cam_table: (F, 4, 4).
        frames: for the colours.
        config: settings.
    """
    sums = np.zeros((len(points), 8))
    nothing = np.zeros((1, 1, 3), np.uint8)
    limits = (AGREE_SIGMAS, config.truncation_m, config.least_cos)
    for number, frame in enumerate(frames):
        image = nothing if frame.rgb is None else np.ascontiguousarray(frame.rgb)
        view = (
            crops.depths[number],
            crops.corners[number],
            np.ascontiguousarray(Ts_cam_table[number]),
        )
        _look(view, crops.camera, crops.noise, (points, normals), limits, image, sums)
    weight = np.maximum(sums[:, 1], 1e-12)
    mean = sums[:, 2] / weight
    spread = np.sqrt(np.maximum(sums[:, 3] / weight - mean**2, 0))
    colors = None
    if any(f.rgb is not None for f in frames):
        colored = sums[:, 4:5] > 0
        rgb = np.where(colored, sums[:, 5:] / np.maximum(sums[:, 4:5], 1e-12), 128.0)
        colors = np.clip(np.round(rgb), 0, 255).astype(np.uint8)
    return VertexEvidence(
        views=sums[:, 0].astype(np.int32),
        noise_sigma_m=np.where(sums[:, 1] > 0, 1 / np.sqrt(weight), np.inf),
        spread_m=spread,
        colors=colors,
    )
