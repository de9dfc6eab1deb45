"""What every pixel of a distorted camera sees first: exact, in double precision, on one core.

The work is done triangle by triangle (see `triangle_rays`); this file knows meshes and cameras.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.geometry import camera, mesh_shape, se3
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.rays import PlacedMesh
from realsim.rendering.triangle_rays import cast_triangles, project_vertices, solid_angle_share

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Int32 = NDArray[np.int32]
Mask = NDArray[np.bool_]
NOT_WANTED = np.zeros((0, 0), np.bool_)
"""In place of a mask that nobody asked for."""
INSIDE_SHARE = 0.5
"""Share of the sphere about the camera from which it stands inside a mesh: 1 in a closed one, and
in one with holes as much as is closed."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FirstHits:
    """What the pixels of a view see first."""

    depth_m: Array32
    """(H, W) depth along z [m]; 0 = nothing."""
    geometry: Int32
    """(H, W) number of the placed mesh; -1 = nothing."""
    face: Int32
    """(H, W) face of that mesh; -1 = nothing."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ProjectedMesh:
    """A placed mesh as one camera has it."""

    points: Array
    """(V, 3) vertices in the camera [m]."""
    seen: Array
    """(V, 4) their pixels u, v and ideal x/z, y/z; u and v are NaN behind the camera and outside
    what the lens model maps."""
    faces: Int32
    """(F, 3)."""
    lens: Array
    """(15,) see `triangle_rays.project_vertices`."""
    contains_camera: bool
    """Whether the camera stands inside."""
    cull: bool
    """Whether faces seen from behind can be skipped."""


class PixelCaster:
    """Casts the pixel rays of any view of one scene."""

    def __init__(self, placed: Sequence[PlacedMesh]) -> None:
        """Find out of every mesh whether it is closed: half of its faces can be skipped then."""
        self.placed = tuple(placed)
        solid: dict[int, bool] = {}
        for p in self.placed:
            if id(p.mesh) not in solid:
                solid[id(p.mesh)] = is_solid(p.mesh)
        self._solid = [solid[id(p.mesh)] for p in self.placed]

    def project(
        self, number: int, intrinsics: CameraIntrinsics, T_world_cam: ArrayLike
    ) -> ProjectedMesh:
        """Return the placed mesh of this number as the camera has it."""
        p = self.placed[number]
        T_cam_obj = se3.invert(T_world_cam) @ p.T_world_obj
        lens = lens_array(intrinsics)
        points, seen = project_vertices(p.mesh.vertices, T_cam_obj, lens)
        eye = se3.invert(T_cam_obj)[:3, 3]
        low, high = p.mesh.bounds
        contains = bool(np.all(eye > low) and np.all(eye < high)) and (
            abs(solid_angle_share(points, p.mesh.faces)) > INSIDE_SHARE
        )
        return ProjectedMesh(
            points=points, seen=seen, faces=p.mesh.faces, lens=lens, contains_camera=contains,
            cull=self._solid[number] and not contains,
        )  # fmt: skip

    def cast(self, intrinsics: CameraIntrinsics, T_world_cam: ArrayLike) -> FirstHits:
        """Return what the pixels see first.

        Args:
            intrinsics: the raw (distorted) camera.
            T_world_cam: (4, 4) camera in world [m].
        """
        T = se3.check_rigid(T_world_cam, "T_world_cam")
        rays = camera.ray_table(intrinsics)
        buffers = empty_buffers(rays)
        for number in range(len(self.placed)):
            enter(self.project(number, intrinsics, T), number, rays, buffers, NOT_WANTED)
        return finished(buffers)


@dataclass(frozen=True, slots=True)
class Entered:
    """Where a mesh is in a view."""

    count: int
    """Pixels of the image that it covers."""
    window: tuple[slice, slice]
    """Rows and columns that hold them."""
    bounds: tuple[float, float, float, float]
    """Least and greatest u, least and greatest v of its picture, also beyond the border [px];
    least > greatest = it has none."""


NOWHERE = (slice(0, 0), slice(0, 0))
Buffers = tuple[Array32, Int32, Int32]
"""Depth (inf = nothing), placed mesh and face of every pixel while a view is being cast."""


def empty_buffers(rays: Array32) -> Buffers:
    """Return the buffers of a view in which nothing has been met yet."""
    shape = rays.shape[:2]
    return (
        np.full(shape, np.inf, np.float32),
        np.full(shape, -1, np.int32),
        np.full(shape, -1, np.int32),
    )


def enter(
    mesh: ProjectedMesh, number: int, rays: Array32, buffers: Buffers, covered: Mask
) -> Entered:
    """Enter a mesh into the buffers and return where it is.

    Args:
        mesh: the mesh.
        number: its number among the placed ones.
        rays: (H, W, 3) the camera's ray table.
        buffers: changed.
        covered: (H, W) changed: what the mesh covers; `NOT_WANTED` = nobody asked.
    """
    count, (left, right, top, bottom), bounds = cast_triangles(
        (mesh.points, mesh.seen, mesh.faces), mesh.lens, rays, number, mesh.cull, buffers, covered
    )
    window = (slice(top, bottom + 1), slice(left, right + 1)) if count else NOWHERE
    return Entered(count, window, bounds)


def finished(buffers: Buffers) -> FirstHits:
    """Return the hits of filled buffers."""
    depth, geometry, face = buffers
    depth[geometry < 0] = 0.0
    return FirstHits(depth_m=depth, geometry=geometry, face=face)


def lens_array(intrinsics: CameraIntrinsics) -> Array:
    """Return the camera as the kernels take it; see `triangle_rays.project_vertices`."""
    i = intrinsics
    reach, bend = camera.turning_radius(i), camera.greatest_bend(i) if i.is_distorted else 0.0
    numbers = [i.fx, i.fy, i.cx, i.cy, *i.distortion, reach, bend, float(i.is_distorted)]
    return np.array(numbers, dtype=np.float64)


def is_solid(mesh: Mesh) -> bool:
    """Return whether every piece of a mesh is closed and has its faces turned outwards.

    Of such a mesh a ray from outside always meets the front of a face first, so that the backs
    need not be tried.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    vertices, faces = mesh_shape.welded(mesh)
    if len(faces) != len(mesh.faces):
        return False
    n = len(vertices)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forth = np.sort(edges[:, 0] * n + edges[:, 1])
    back = np.sort(edges[:, 1] * n + edges[:, 0])
    if len(np.unique(forth)) != len(forth) or not np.array_equal(forth, back):
        return False
    joined = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
    pieces, piece = connected_components(joined, directed=False)
    a, b, c = (vertices[faces[:, k]] - vertices.mean(0) for k in range(3))
    volumes = np.bincount(
        piece[faces[:, 0]], np.einsum("ij,ij->i", a, np.cross(b, c)), minlength=pieces
    )
    return bool(np.all(volumes > 0))
