"""Placed meshes as one ray-castable scene, and the rays of a distorted camera.

Rays go through integer pixel centres and have z = 1 in camera axes, so the parameter of a hit is
the depth along z. Open3D's own `create_rays_pinhole` is not used: it shoots half a pixel off and
knows no distortion.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Array32, Int32, Mask
from realsim.errors import InputError
from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.appearance import Material

GRID_M = 4.0
"""Float32 coordinates have their origin on a grid of this pitch [m]: 2 m cost 0.1 um."""
BACKGROUND = -1
"""Instance number of things that occlude but carry no label (table, board)."""


@dataclass(frozen=True, eq=False, slots=True)
class PlacedMesh:
    """A mesh and where it stands."""

    instance: int
    """0 or more: an object; -1: background that occludes but has no label (table, board)."""
    mesh: Mesh
    T_world_obj: Array
    """(4, 4) mesh in world [m]."""
    material: Material | None = None
    """Its look; None = the mesh's own texture or colours, else a paint by its instance."""

    def __post_init__(self) -> None:
        """Check the instance number and that the pose is rigid."""
        if self.instance < BACKGROUND:
            raise InputError(
                f"a placed mesh has the instance {self.instance}; objects are numbered from 0, and "
                "-1 is background."
            )
        T = se3.check_rigid(self.T_world_obj, f"T_world_obj of instance {self.instance}")
        T.setflags(write=False)
        object.__setattr__(self, "T_world_obj", T)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class HitBuffer:
    """The first thing that each of N rays meets."""

    t: Array32
    """(N,) parameter along the ray's direction; inf = nothing was met."""
    geometry: Int32
    """(N,) index of the placed mesh; -1 = nothing was met."""
    instance: Int32
    """(N,) its instance; -1 = background or nothing."""
    face: Int32
    """(N,) face of that mesh; -1 = nothing was met."""
    uv: Array32
    """(N, 2) barycentric weights of the face's second and third vertex."""
    normal: Array32
    """(N, 3) unit normal of the face in world, on the side the face's winding says."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class DepthView:
    """What each pixel of a camera sees."""

    depth_m: Array32
    """(H, W) depth along z [m]; 0 = nothing."""
    geometry: Int32
    """(H, W) index of the placed mesh; -1 = nothing."""


def scene_center(vertices_world: Sequence[Array]) -> Array:
    """Return the middle (3,) of meshes by their vertices, on a 4 m grid [m]."""
    if not vertices_world:
        return np.zeros(3)
    low = np.min([v.min(0) for v in vertices_world], axis=0)
    high = np.max([v.max(0) for v in vertices_world], axis=0)
    return GRID_M * np.round((low + high) / (2 * GRID_M))


class RayScene:
    """Placed meshes, ready to be hit by rays.

    Coordinates are kept relative to `center`, so that float32 loses nothing when the world's
    origin is far away.
    """

    def __init__(self, placed: Sequence[PlacedMesh], center: ArrayLike | None = None) -> None:
        """Build the ray-casting structure of the meshes (it is committed at the first cast).

        Args:
            placed: the meshes.
            center: (3,) where the float32 coordinates have their origin [m]; the default is the
                middle of the scene on a 4 m grid, so that an object alone and the same object in
                company are rounded alike and give the same pixels.
        """
        from realsim.interop import import_open3d

        open3d = import_open3d()
        self.placed = tuple(placed)
        world = [se3.transform(p.T_world_obj, p.mesh.vertices) for p in self.placed]
        self.center = scene_center(world) if center is None else np.array(center, np.float64)
        self._core: Any = open3d.core
        self._scene: Any = open3d.t.geometry.RaycastingScene()
        for p, v in zip(self.placed, world, strict=True):
            self._scene.add_triangles(
                self._core.Tensor((v - self.center).astype(np.float32)),
                self._core.Tensor(p.mesh.faces.astype(np.uint32)),
            )
        # The last entry answers geometry -1 (nothing).
        self._instances = np.array([*(p.instance for p in self.placed), BACKGROUND], np.int32)

    def _rays(self, origins: Array, directions: Array32) -> Any:
        """Return rays about `center` as a tensor (N, 6)."""
        rays = np.empty((len(directions), 6), np.float32)
        rays[:, :3] = origins - self.center
        rays[:, 3:] = directions
        return self._core.Tensor.from_numpy(rays)

    def first_hits(self, origins: Array, directions: Array32) -> tuple[Array32, Int32]:
        """Return t (N,), inf = nothing, and the placed mesh (N,), -1 = nothing, of rays.

        Args:
            origins: (3,) or (N, 3) in world [m].
            directions: (N, 3) in world.
        """
        if not self.placed or len(directions) == 0:
            nothing = np.full(len(directions), np.inf, np.float32)
            return nothing, np.full(len(directions), -1, np.int32)
        hits = self._scene.cast_rays(self._rays(origins, directions))
        # Open3D marks a miss by 2^32 - 1, which is -1 as int32.
        return hits["t_hit"].numpy(), hits["geometry_ids"].numpy().view(np.int32)

    def cast(self, origins: Array, directions: Array32) -> HitBuffer:
        """Return everything about what rays meet first; arguments as of `first_hits`."""
        n = len(directions)
        if not self.placed or n == 0:
            return HitBuffer(
                t=np.full(n, np.inf, np.float32),
                geometry=np.full(n, -1, np.int32),
                instance=np.full(n, BACKGROUND, np.int32),
                face=np.full(n, -1, np.int32),
                uv=np.zeros((n, 2), np.float32),
                normal=np.zeros((n, 3), np.float32),
            )
        hits = self._scene.cast_rays(self._rays(origins, directions))
        geometry = hits["geometry_ids"].numpy().view(np.int32)
        return HitBuffer(
            t=hits["t_hit"].numpy(),
            geometry=geometry,
            instance=self._instances[geometry],
            face=hits["primitive_ids"].numpy().view(np.int32),
            uv=hits["primitive_uvs"].numpy(),
            normal=hits["primitive_normals"].numpy(),
        )

    def view(
        self, intrinsics: CameraIntrinsics, T_world_cam: ArrayLike, stride: int = 1
    ) -> DepthView:
        """Return what a camera at T_world_cam (4, 4) sees at every `stride`-th pixel's centre."""
        T = np.asarray(T_world_cam, dtype=np.float64)
        rays = np.ascontiguousarray(camera.ray_table(intrinsics)[::stride, ::stride])
        t, geometry = self.first_hits(T[:3, 3], rotated(rays, T[:3, :3]).reshape(-1, 3))
        return DepthView(
            depth_m=np.where(np.isfinite(t), t, 0).reshape(rays.shape[:2]),
            geometry=geometry.reshape(rays.shape[:2]),
        )

    def occluded(self, origins: Array, directions: Array32, until: float = np.inf) -> Mask:
        """Return (N,) whether a ray meets anything up to the parameter `until` of its direction.

        The other arguments are those of `first_hits`.
        """
        if not self.placed or len(directions) == 0:
            return np.zeros(len(directions), dtype=bool)
        rays = self._rays(origins, directions)
        return self._scene.test_occlusions(rays, tfar=until).numpy()

    def shadowed(self, rays: Array32) -> Mask:
        """Return (N,) whether rays (N, 6) about `center` meet anything."""
        return self._scene.test_occlusions(self._core.Tensor.from_numpy(rays)).numpy()


def rotated(directions: Array32, R: Array) -> Array32:
    """Return directions (..., 3) turned by R (3, 3), in float32.

    Written out instead of a matrix product: a (N, 3) @ (3, 3) product wakes all BLAS threads, and
    their spinning costs more than the whole cast.
    """
    r = R.astype(np.float32)
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    out = np.empty(directions.shape, np.float32)
    for axis in range(3):
        np.multiply(x, r[axis, 0], out=out[..., axis])
        out[..., axis] += y * r[axis, 1]
        out[..., axis] += z * r[axis, 2]
    return out
