"""The mesh as the scale fit sees it: distance field, rays, patches of surface and outlines."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import DegenerateError
from realsim.geometry.distance_field import DistanceField, raycasting_scene
from realsim.geometry.mesh import decimated, face_normals, hull_vertices, sample_surface
from realsim.records import Mesh
from realsim.scanning.scale.config import ScaleConfig
from realsim.scanning.scale.shape_error import SurfacePatches, make_patches

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
INNER_EXTENT = 0.1
"""Greatest side of the mesh inside of the fit [m]: numbers near those of real objects, so that a
mesh in inches or in units of its own is solved alike."""
SURFACE_SAMPLES = 1500
"""Points of the surface that free space and patches are judged at."""
FLAT_SHARE = 1e-3
"""A mesh thinner than this share of its length has no inside."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ScanShape:
    """A mesh about the centre of its box, its greatest side `INNER_EXTENT`."""

    mesh: Mesh
    unit: float
    """Inner length of one unit of the given mesh: scale_given = scale_inner * unit."""
    center: Array
    """(3,) centre of the given mesh's box, in its own units."""
    field: DistanceField
    ray_scene: Any
    samples: Array
    """(S, 3) points spread evenly over the surface."""
    normals: Array
    """(S, 3) outward."""
    patches: SurfacePatches
    edges: NDArray[np.int64]
    """(E, 2) vertices of every edge with two faces."""
    edge_normals: Array
    """(E, 2, 3) normals of its two faces."""
    hull: Array
    """(H, 3) corners of the convex hull: what can touch the table."""
    radius: float
    """Half of the box's diagonal."""

    @property
    def vertices(self) -> Array:
        """(V, 3)."""
        return self.mesh.vertices

    def cast(self, origins: Array, directions: Array32, s: float, R: Array, t: Array) -> Array32:
        """Return the parameter (N,) at which world rays first meet the mesh; inf = never.

        Args:
            origins: (3,) or (N, 3) in world [m].
            directions: (N, 3) in world.
            s: scale of the inner mesh.
            R: (3, 3) its rotation.
            t: (3,) its centre in world [m].
        """
        from realsim.interop import import_open3d

        o3d = import_open3d()
        rays = np.empty((len(directions), 6), dtype=np.float32)
        rays[:, :3] = (origins - t) @ R / s
        rays[:, 3:] = (directions @ R.astype(np.float32)) / np.float32(s)
        hits = self.ray_scene.cast_rays(o3d.core.Tensor(rays), 1)
        return np.asarray(hits["t_hit"].numpy())


def make_shape(mesh: Mesh, config: ScaleConfig) -> ScanShape:
    """Return the shape of a mesh of any size.

    Raises:
        DegenerateError: the mesh is flat or has no extent.
    """
    extent = mesh.extent
    largest = float(extent.max())
    if not largest > 0 or float(np.sort(extent)[1]) < FLAT_SHARE * largest:
        raise DegenerateError(
            f"the mesh is a line or a point (extent {extent.tolist()}); a solid object is needed."
        )
    unit = INNER_EXTENT / largest
    center = mesh.bounds.mean(0)
    inner = _welded(mesh, center, unit)
    inner = decimated(inner, config.fit_faces)
    samples, normals = sample_surface(inner, SURFACE_SAMPLES, np.random.default_rng(0))
    edges, edge_normals = _two_faced_edges(inner)
    return ScanShape(
        mesh=inner, unit=unit, center=center,
        field=DistanceField.from_mesh(inner, config.field_cells),
        ray_scene=raycasting_scene(inner), samples=samples, normals=normals,
        patches=make_patches(
            samples, normals, config.shape.patches, config.shape.normal_share * INNER_EXTENT
        ), edges=edges, edge_normals=edge_normals,
        hull=hull_vertices(inner.vertices),
        radius=float(0.5 * np.linalg.norm(inner.extent)),
    )  # fmt: skip


def _welded(mesh: Mesh, center: Array, unit: float) -> Mesh:
    from realsim.geometry.mesh_shape import welded_mesh

    bare = welded_mesh(mesh)
    # Faces that are there twice would leave their edges out of every outline.
    _, first = np.unique(np.sort(bare.faces, axis=1), axis=0, return_index=True)
    faces = bare.faces[np.sort(first)]
    return Mesh(vertices=(bare.vertices - center) * unit, faces=faces)


def mirrored(shape: ScanShape) -> ScanShape:
    """Return the shape of the mirror image (x negated), about the same centre."""
    flip = np.array([-1.0, 1.0, 1.0])
    mesh = Mesh(vertices=shape.vertices * flip, faces=shape.mesh.faces[:, ::-1])
    field = shape.field
    end = field.origin[0] + field.cell * (field.grid.shape[0] - 1)
    return replace(
        shape,
        mesh=mesh,
        field=DistanceField(
            grid=np.ascontiguousarray(field.grid[::-1]),
            origin=np.array([-end, field.origin[1], field.origin[2]]),
            cell=field.cell,
        ),
        ray_scene=raycasting_scene(mesh),
        samples=shape.samples * flip,
        normals=shape.normals * flip,
        edge_normals=shape.edge_normals * flip,
        hull=shape.hull * flip,
    )


def _two_faced_edges(mesh: Mesh) -> tuple[NDArray[np.int64], Array]:
    """Return the edges (E, 2) that two faces share, and those faces' normals (E, 2, 3)."""
    f = mesh.faces.astype(np.int64)
    edges = np.sort(np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]]), axis=1)
    owner = np.tile(np.arange(len(f)), 3)
    key = edges[:, 0] * len(mesh.vertices) + edges[:, 1]
    order = np.argsort(key, kind="stable")
    key, owner = key[order], owner[order]
    first = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))
    count = np.diff(np.append(first, len(key)))
    pairs = first[count == 2]
    normals = face_normals(mesh)
    two = np.stack([normals[owner[pairs]], normals[owner[pairs + 1]]], axis=1)
    return edges[order][pairs], two


@dataclass(frozen=True, eq=False, slots=True)
class Outline:
    """Points on the model's outline as one camera would see it."""

    points: Array
    """(N, 3) in the inner mesh's axes."""
    normals: Array
    """(N, 3) of the surface there, outward, unit."""


def outline(
    shape: ScanShape,
    pose: tuple[float, Array, Array],
    T_world_cam: Array,
    focal_px: float,
    wanted: int,
) -> Outline:
    """Return points of the model's outline against the background in one view.

    Edges between a face that looks at the camera and one that does not, evenly by their length;
    of these the ones that a ray just inside meets, and a ray just outside misses.

    Args:
        shape: the mesh.
        pose: scale, R (3, 3) and t (3,) of the inner mesh in world.
        T_world_cam: (4, 4).
        focal_px: [px], for the width of "just".
        wanted: points before the test; about half of them stay.
    """
    s, R, t = pose
    eye = (T_world_cam[:3, 3] - t) @ R / s
    a = shape.vertices[shape.edges[:, 0]]
    to_eye = eye - a
    facing = np.einsum("ekc,ec->ek", shape.edge_normals, to_eye) > 0
    border = np.flatnonzero(facing[:, 0] != facing[:, 1])
    if len(border) == 0:
        return Outline(np.zeros((0, 3)), np.zeros((0, 3)))
    a = a[border]
    b = shape.vertices[shape.edges[border, 1]]
    length = np.linalg.norm(b - a, axis=1)
    total = np.cumsum(length)
    at = (np.arange(wanted) + 0.5) / wanted * total[-1]
    e = np.searchsorted(total, at)
    part = ((total[e] - at) / np.maximum(length[e], 1e-12))[:, None]
    points = part * a[e] + (1 - part) * b[e]
    normal = shape.edge_normals[border[e]].sum(1)
    R_cam = T_world_cam[:3, :3]
    points_cam = (points * s @ R.T + t - T_world_cam[:3, 3]) @ R_cam
    out_cam = normal @ R.T @ R_cam
    z = points_cam[:, 2]
    # The direction out of the outline in the image is that of the normal, less its share along
    # the viewing ray.
    ray = points_cam / z[:, None]
    flat = out_cam[:, :2] - ray[:, :2] * out_cam[:, 2:]
    size = np.linalg.norm(flat, axis=1)
    ok = (size > 1e-9) & (z > 0.02)
    points, normal, ray = points[ok], normal[ok], ray[ok]
    flat = flat[ok] / size[ok, None]
    step = 1.5 / focal_px
    z = z[ok]
    outer, inner = ray.copy(), ray.copy()
    outer[:, :2] += step * flat
    inner[:, :2] -= step * flat
    both = np.concatenate([outer, inner]).astype(np.float32) @ R_cam.T.astype(np.float32)
    hit = shape.cast(T_world_cam[:3, 3], both, s, R, t)
    n = len(points)
    # What the inner ray meets may lie a little behind the edge on a round body, not far behind.
    seen = np.isfinite(hit[n:]) & (np.abs(hit[n:] - z) < 0.25 * s * INNER_EXTENT)
    keep = ~np.isfinite(hit[:n]) & seen
    normal = normal[keep] / np.linalg.norm(normal[keep], axis=1, keepdims=True)
    return Outline(points[keep], normal)
