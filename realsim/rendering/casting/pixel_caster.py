"""What every pixel of a distorted camera sees first: exact, in double precision, on one core.

The work is done triangle by triangle (see `triangle_rays`); this file knows meshes and cameras.

Maps of the surfaces that a view sees: where on its object a pixel lies, and how it is turned.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Array32, Int32, Int64, Mask
from realsim.compiled import njit
from realsim.geometry import camera, se3
from realsim.geometry.distance_field import solid_angle_share
from realsim.geometry.point_loops import move, turn_back
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.casting.triangle_rays import cast_triangles, count_outside, project_vertices
from realsim.rendering.rays import PlacedMesh

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
    """(17,) see `triangle_rays.project_vertices`."""
    contains_camera: bool
    """Whether the camera stands inside."""
    cull: bool
    """Whether faces seen from behind can be skipped."""


@dataclass(frozen=True, eq=False, slots=True)
class Body:
    """A mesh as it is cast: vertices at the same place are one, which STL files repeat."""

    vertices: Array
    """(V, 3) [m]."""
    faces: Int32
    """(F, 3) in the mesh's own order."""
    bounds: Array
    """(2, 3) least and greatest corner [m]."""
    is_solid: bool
    """Whether it is closed and every piece of it has its faces turned outwards."""


class PixelCaster:
    """Casts the pixel rays of any view of one scene."""

    def __init__(self, placed: Sequence[PlacedMesh]) -> None:
        """Weld every mesh and find out whether it is closed: half of its faces are skipped then."""
        self.placed = tuple(placed)
        bodies: dict[int, Body] = {}
        for p in self.placed:
            if id(p.mesh) not in bodies:
                bodies[id(p.mesh)] = body_of(p.mesh)
        self.bodies = [bodies[id(p.mesh)] for p in self.placed]

    def project(
        self, number: int, intrinsics: CameraIntrinsics, T_world_cam: ArrayLike
    ) -> ProjectedMesh:
        """Return the placed mesh of this number as the camera has it."""
        T_cam_obj = se3.invert(T_world_cam) @ self.placed[number].T_world_obj
        return projected(self.bodies[number], lens_array(intrinsics), T_cam_obj)

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


def projected(body: Body, lens: Array, T_cam_obj: Array) -> ProjectedMesh:
    """Return a body at T_cam_obj (4, 4) [m] as a camera has it, given as of `lens_array`."""
    points, seen = project_vertices(body.vertices, T_cam_obj, lens)
    eye = -T_cam_obj[:3, 3] @ T_cam_obj[:3, :3]
    contains = bool(((eye > body.bounds[0]) & (eye < body.bounds[1])).all()) and (
        abs(solid_angle_share(points, body.faces)) > INSIDE_SHARE
    )
    return ProjectedMesh(
        points=points, seen=seen, faces=body.faces, lens=lens, contains_camera=contains,
        cull=body.is_solid and not contains,
    )  # fmt: skip


def may_be_seen(intrinsics: CameraIntrinsics, boxes: Array, Ts_cam_obj: Array) -> Mask:
    """Return (G,) which boxes a camera may see: all, where the lens bends the view's border.

    Args:
        intrinsics: the camera.
        boxes: (G, 8, 3) corners [m].
        Ts_cam_obj: (G, 4, 4).
    """
    i = intrinsics
    if i.is_distorted:
        return np.ones(len(boxes), np.bool_)
    x, y, z = np.moveaxis(se3.transform(Ts_cam_obj, boxes), -1, 0)
    # Outside is what lies beyond one of the planes through the border, a pixel further out.
    beyond = (
        z <= 0, x < z * (-1 - i.cx) / i.fx, x > z * (i.width - i.cx) / i.fx,
        y < z * (-1 - i.cy) / i.fy, y > z * (i.height - i.cy) / i.fy,
    )  # fmt: skip
    return ~np.any([np.all(outside, axis=-1) for outside in beyond], axis=0)


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
    mesh: ProjectedMesh, number: int, rays: Array32, buffers: Buffers, covered: Mask,
    among: Mask = NOT_WANTED,
) -> Entered:  # fmt: skip
    """Enter a mesh into the buffers and return where it is.

    Args:
        mesh: the mesh.
        number: its number among the placed ones.
        rays: (H, W, 3) the camera's ray table.
        buffers: changed.
        covered: (H, W) changed: what the mesh covers; `NOT_WANTED` = nobody asked.
        among: (H, W) the pixels that are cast; `NOT_WANTED` = all.
    """
    count, (left, right, top, bottom), bounds = cast_triangles(
        (mesh.points, mesh.seen, mesh.faces), mesh.lens, rays, number, mesh.cull, buffers, covered,
        among,
    )  # fmt: skip
    window = (slice(top, bottom + 1), slice(left, right + 1)) if count else NOWHERE
    return Entered(count, window, bounds)


def finished(buffers: Buffers) -> FirstHits:
    """Return the hits of filled buffers."""
    depth, geometry, face = buffers
    depth[geometry < 0] = 0.0
    return FirstHits(depth_m=depth, geometry=geometry, face=face)


NEAR_IMAGE = 1.1
"""The bend of the lens is bounded anew beyond this many times the image's own radius: at three
focal lengths off the axis a polynomial bends a hundred times as much as within the image."""


@camera.kept_by_camera(16)
def lens_array(intrinsics: CameraIntrinsics) -> Array:
    """Return the camera as the kernels take it; see `triangle_rays.project_vertices`."""
    i = intrinsics
    numbers = [i.fx, i.fy, i.cx, i.cy, *i.distortion, camera.turning_radius(i)]
    if not i.is_distorted:
        return np.array([*numbers, 0.0, 0.0, np.inf, 0.0])
    rays = camera.ray_table(i)[..., :2].astype(np.float64)
    radius = NEAR_IMAGE * float(np.sqrt(np.nanmax(np.sum(rays * rays, axis=-1))))
    bends = [camera.greatest_bend(i, r) for r in (radius, camera.FARTHEST_RADIUS)]
    return np.array([*numbers, bends[0], 1.0, radius * radius, bends[1]])


def body_of(mesh: Mesh) -> Body:
    """Return a mesh with its vertices welded.

    It is solid if every piece is closed and has its faces turned outwards: then a ray from outside
    always meets the front of a face first, and the backs need not be tried.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    vertices, index = np.unique(mesh.vertices, axis=0, return_inverse=True)
    faces = index.reshape(-1)[mesh.faces]
    n = len(vertices)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forth = np.sort(edges[:, 0] * n + edges[:, 1])
    back = np.sort(edges[:, 1] * n + edges[:, 0])
    solid = len(np.unique(forth)) == len(forth) and bool(np.array_equal(forth, back))
    if solid:
        joined = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
        pieces, piece = connected_components(joined, directed=False)
        a, b, c = (vertices[faces[:, k]] - vertices.mean(0) for k in range(3))
        volumes = np.einsum("ij,ij->i", a, np.cross(b, c))
        solid = bool(np.all(np.bincount(piece[faces[:, 0]], volumes, minlength=pieces) > 0))
    return Body(np.ascontiguousarray(vertices), faces.astype(np.int32), mesh.bounds, solid)


CANVAS = 1
"""Image sizes that the canvas reaches beyond each border: BOP's 3x canvas."""
BLOCK_PX = 128
"""Edge of a block of rays [px]: 16,000 rays are inverted in 10 ms."""


class CanvasRays:
    """The rays of one camera's canvas."""

    def __init__(self, intrinsics: CameraIntrinsics) -> None:
        """Reserve the table; no ray is known yet."""
        self.intrinsics = intrinsics
        self.left, self.top = -CANVAS * intrinsics.width, -CANVAS * intrinsics.height
        self.width = (2 * CANVAS + 1) * intrinsics.width
        self.height = (2 * CANVAS + 1) * intrinsics.height
        self._table = np.empty((self.height, self.width, 2), np.float32)
        self._known = np.zeros((-(-self.height // BLOCK_PX), -(-self.width // BLOCK_PX)), bool)

    def window(self, u0: int, u1: int, v0: int, v1: int) -> Array32:
        """Return the rays (h, w, 2) of the pixels u0..u1-1, v0..v1-1 of the canvas; NaN = none."""
        c0, c1, r0, r1 = u0 - self.left, u1 - self.left, v0 - self.top, v1 - self.top
        for row in range(r0 // BLOCK_PX, -(-r1 // BLOCK_PX)):
            for column in range(c0 // BLOCK_PX, -(-c1 // BLOCK_PX)):
                if not self._known[row, column]:
                    self._fill(row, column)
        return self._table[r0:r1, c0:c1]

    def _fill(self, row: int, column: int) -> None:
        rows = slice(row * BLOCK_PX, min((row + 1) * BLOCK_PX, self.height))
        columns = slice(column * BLOCK_PX, min((column + 1) * BLOCK_PX, self.width))
        v, u = np.mgrid[rows, columns]
        uv = np.stack([u + self.left, v + self.top], -1).astype(np.float64)
        xy, _ = camera.undistort(self.intrinsics, uv)
        self._table[rows, columns] = xy
        self._known[row, column] = True

    def count_beyond(self, mesh: ProjectedMesh, bounds: tuple[float, float, float, float]) -> int:
        """Return how many canvas pixels outside the image a mesh covers.

        Args:
            mesh: the mesh.
            bounds: of its picture, as of `pixel_caster.Entered`.
        """
        u_low, u_high, v_low, v_high = bounds
        if u_low > u_high:
            return 0
        i = self.intrinsics
        right, bottom = self.left + self.width, self.top + self.height
        u0, u1 = int(np.ceil(max(u_low, self.left))), int(np.floor(min(u_high, right - 1))) + 1
        v0, v1 = int(np.ceil(max(v_low, self.top))), int(np.floor(min(v_high, bottom - 1))) + 1
        if u0 >= u1 or v0 >= v1 or (u0 >= 0 and v0 >= 0 and u1 <= i.width and v1 <= i.height):
            return 0
        rays = self.window(u0, u1, v0, v1)
        placed = (mesh.points, mesh.seen, mesh.faces)
        return int(count_outside(placed, mesh.lens, rays, (u0, v0), (i.width, i.height)))


@camera.kept_by_camera(4)
def canvas_rays(intrinsics: CameraIntrinsics) -> CanvasRays:
    """Return the canvas of a camera, kept from view to view."""
    return CanvasRays(intrinsics)


@njit
def surface_maps(
    rays: Array32,
    hits: tuple[Array32, Int32, Int32],
    Ts_obj_cam: Array,
    normals: Array32,
    starts: Int64,
    labelled: Mask,
    wanted: int,
) -> Array32:
    """Return a map (H, W, 3) of the surfaces seen: 0 = object coordinates, 1 = camera normals.

    Args:
        rays: (H, W, 3).
        hits: depth (H, W), 0 = nothing [m]; placed mesh (H, W), -1 = nothing; its face (H, W).
        Ts_obj_cam: (G, 4, 4).
        normals: (F, 3) unit normals of all meshes' faces, in the meshes' frames.
        starts: (G,) number of a mesh's first face among them.
        labelled: (G,) whether the map is wanted on this mesh.
        wanted: which map.
    """
    depth, geometry, face = hits
    height, width = depth.shape
    out = np.zeros((height, width, 3), np.float32)
    for v in range(height):
        for u in range(width):
            g = geometry[v, u]
            if g < 0 or not labelled[g]:
                continue
            T = Ts_obj_cam[g]
            if wanted == 0:
                z = np.float64(depth[v, u])
                x, y = z * rays[v, u, 0], z * rays[v, u, 1]
                out[v, u, 0], out[v, u, 1], out[v, u, 2] = move(T, x, y, z)
            else:
                n = normals[starts[g] + face[v, u]]
                # R_cam_obj is the transpose of R_obj_cam.
                x, y, z = turn_back(T, n[0], n[1], n[2])
                away = x * rays[v, u, 0] + y * rays[v, u, 1] + z > 0.0
                side = -1.0 if away else 1.0
                out[v, u, 0], out[v, u, 1], out[v, u, 2] = side * x, side * y, side * z
    return out
