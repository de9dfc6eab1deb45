"""Exact labels: which object each pixel of the raw, distorted image sees, and how deep.

Every pixel ray is cast against every mesh, so the visible instance, the depth, and the amodal mask
of an object (what it would cover if it stood alone) come out of one pass.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Array32, Int32, Int64, Mask
from realsim.errors import InputError
from realsim.geometry import camera, mesh_shape, se3
from realsim.records import CameraIntrinsics
from realsim.rendering.casting import pixel_caster
from realsim.rendering.casting.pixel_caster import surface_maps
from realsim.rendering.rays import BACKGROUND, HitBuffer, PlacedMesh, RayScene

__all__ = ["HitBuffer", "LabelRenderer", "Labels", "PlacedMesh"]

COORDINATES, NORMALS = 0, 1
"""The maps of `surface_maps`."""


@dataclass(frozen=True, eq=False, slots=True)
class _Surfaces:
    """What the maps of a view are made from."""

    rays: Array32
    Ts_obj_cam: Array
    normals: Array32
    starts: Int64
    is_object: Mask


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Labels:
    """The labels of one view."""

    ids: Int32
    """(H, W) instance seen; -1 = no object (background or nothing)."""
    depth_m: Array32
    """(H, W) depth along z of the first surface, background included [m]; 0 = nothing."""
    amodal: dict[int, Mask]
    """(H, W) per instance: the pixels it would cover if it stood alone."""
    windows: dict[int, tuple[slice, slice]]
    """Rows and columns of the image that hold an instance's amodal mask; empty slices where it is
    out of view. Work on a mask is done there, not on the whole image."""
    px_count_all: dict[int, int]
    """Amodal pixels per instance, also beyond the border: up to one image size to each side (BOP's
    3x canvas), where the lens model can be inverted."""
    px_count_visib: dict[int, int]
    """Visible pixels per instance."""
    geometry: Int32
    """(H, W) number of the placed mesh seen; -1 = nothing."""
    face: Int32
    """(H, W) its face; -1 = nothing."""
    unknown: Mask
    """(H, W) pixels whose ray does not exist: the lens model cannot be inverted there. They carry
    no label and no depth."""
    camera_inside: tuple[int, ...] = ()
    """Instances that the camera stands inside of: what it sees of them are their inner walls."""
    surfaces: _Surfaces = field(repr=False)
    """What the maps are made from."""
    visible_fraction: dict[int, float] = field(init=False)
    """px_count_visib / px_count_all per instance; 0 where the object is out of view."""

    def __post_init__(self) -> None:
        """Divide the visible by all pixels."""
        fraction = {
            i: self.px_count_visib[i] / n if n else 0.0 for i, n in self.px_count_all.items()
        }
        object.__setattr__(self, "visible_fraction", fraction)

    def visible(self, instance: int) -> Mask:
        """Return (H, W) where this instance is seen.

        Raises:
            InputError: the scene has no such instance.
        """
        if instance not in self.px_count_all:
            names = ", ".join(str(i) for i in self.px_count_all) or "no objects"
            raise InputError(f"instance {instance} is not among these labels; they have: {names}.")
        mask = np.zeros(self.ids.shape, dtype=bool)
        window = self.windows[instance]
        mask[window] = self.ids[window] == instance
        return mask

    def object_coordinates(self) -> Array32:
        """Return (H, W, 3) where on its object each pixel lies, in the object's frame [m].

        Zeros where no object is seen.
        """
        return self._map(COORDINATES, self.surfaces.is_object)

    def normals(self) -> Array32:
        """Return (H, W, 3) the unit normal of the surface seen, in camera axes, towards the eye.

        Zeros where nothing is seen. It is the normal of the flat face, background included.
        """
        return self._map(NORMALS, np.ones_like(self.surfaces.is_object))

    def _map(self, which: int, on: Mask) -> Array32:
        s = self.surfaces
        hits = (self.depth_m, self.geometry, self.face)
        return surface_maps(s.rays, hits, s.Ts_obj_cam, s.normals, s.starts, on, which)


class LabelRenderer:
    """Renders the labels of one scene from any view."""

    def __init__(self, placed: Sequence[PlacedMesh]) -> None:
        """Prepare the scene.

        Raises:
            InputError: two objects carry the same instance number.
        """
        self.placed = tuple(placed)
        instances = [p.instance for p in self.placed if p.instance != BACKGROUND]
        if len(set(instances)) != len(instances):
            raise InputError(f"two placed meshes share an instance number: {sorted(instances)}.")
        self._caster = pixel_caster.PixelCaster(self.placed)
        # The last entry answers geometry -1 (nothing).
        self._instances = np.array([*(p.instance for p in self.placed), BACKGROUND], np.int32)
        counts = [len(p.mesh.faces) for p in self.placed]
        self._starts = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64)
        normals = [mesh_shape.face_normals(p.mesh) for p in self.placed]
        self._normals = np.concatenate([np.zeros((0, 3)), *normals]).astype(np.float32)
        self._scene: RayScene | None = None

    def cast_rays(self, rays: ArrayLike) -> HitBuffer:
        """Return what rays (N, 6), origin and direction in world [m], meet first."""
        if self._scene is None:  # only sight lines need it, not the pixels
            self._scene = RayScene(self.placed)
        rays = np.asarray(rays)
        return self._scene.cast(rays[:, :3].astype(np.float64), rays[:, 3:].astype(np.float32))

    def render(self, intrinsics: CameraIntrinsics, T_world_cam: ArrayLike) -> Labels:
        """Return the labels of a view.

        Args:
            intrinsics: the raw (distorted) camera.
            T_world_cam: (4, 4) camera in world [m].
        """
        T = se3.check_rigid(T_world_cam, "T_world_cam")
        rays = camera.ray_table(intrinsics)
        canvas = pixel_caster.canvas_rays(intrinsics)
        shape = rays.shape[:2]
        buffers = pixel_caster.empty_buffers(rays)
        amodal: dict[int, Mask] = {}
        windows: dict[int, tuple[slice, slice]] = {}
        count_all: dict[int, int] = {}
        inside: list[int] = []
        for number, p in enumerate(self.placed):
            mesh = self._caster.project(number, intrinsics, T)
            covered = np.zeros(shape if p.instance != BACKGROUND else (0, 0), np.bool_)
            entered = pixel_caster.enter(mesh, number, rays, buffers, covered)
            if p.instance == BACKGROUND:
                continue
            amodal[p.instance], windows[p.instance] = covered, entered.window
            count_all[p.instance] = entered.count + canvas.count_beyond(mesh, entered.bounds)
            if mesh.contains_camera:
                inside.append(p.instance)
        hits = pixel_caster.finished(buffers)
        seen = np.bincount(hits.geometry.ravel() + 1, minlength=len(self.placed) + 1)[1:]
        T_cam_world = se3.invert(T)
        return Labels(
            ids=self._instances[hits.geometry],
            depth_m=hits.depth_m,
            amodal=amodal,
            windows=windows,
            px_count_all=count_all,
            px_count_visib={
                p.instance: int(seen[k])
                for k, p in enumerate(self.placed)
                if p.instance != BACKGROUND
            },
            geometry=hits.geometry,
            face=hits.face,
            unknown=np.isnan(rays[..., 0]),
            camera_inside=tuple(inside),
            surfaces=_Surfaces(
                rays,
                np.array([se3.invert(T_cam_world @ p.T_world_obj) for p in self.placed]).reshape(
                    -1, 4, 4
                ),
                self._normals,
                self._starts,
                self._instances[:-1] != BACKGROUND,
            ),
        )
