"""Exact labels: which object each pixel of the raw, distorted image sees, and how deep.

One cast of all pixel rays gives the visible instances and the z-depth. The amodal mask of an
object (what it would cover if it stood alone) adds to its visible pixels those where something
nearer was met and a ray against the object alone hits.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import InputError
from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics
from realsim.rendering.rays import (
    BACKGROUND,
    HitBuffer,
    PlacedMesh,
    RayScene,
    rotated,
)

__all__ = ["HitBuffer", "LabelRenderer", "Labels", "PlacedMesh"]

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
CANVAS = 1
"""Image sizes that the canvas of px_count_all reaches beyond each border: BOP's 3x canvas."""
NEAREST_M = 1e-6
"""Depth [m] in front of which a vertex counts as behind the camera."""
BLOCK_PX = 1 << 18
"""Canvas pixels handled at a time, which bounds the memory of an object that fills the view."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Labels:
    """The labels of one view."""

    ids: NDArray[np.int32]
    """(H, W) instance seen; -1 = no object (background or nothing)."""
    depth_m: Array32
    """(H, W) depth along z of the first surface, background included [m]; 0 = nothing."""
    amodal: dict[int, Mask]
    """(H, W) per instance: the pixels it would cover if it stood alone."""
    px_count_all: dict[int, int]
    """Amodal pixels per instance, also beyond the border: up to one image size to each side (BOP's
    3x canvas), where the lens model can be inverted."""
    px_count_visib: dict[int, int]
    """Visible pixels per instance."""
    geometry: NDArray[np.int32]
    """(H, W) number of the placed mesh seen; -1 = nothing."""
    face: NDArray[np.int32]
    """(H, W) its face; -1 = nothing."""
    unknown: Mask
    """(H, W) pixels whose ray does not exist: the lens model cannot be inverted there. They carry
    no label and no depth."""
    camera_inside: tuple[int, ...] = ()
    """Instances that the camera stands inside of: what it sees of them are their inner walls."""
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
        return self.ids == instance


@dataclass(frozen=True, eq=False, slots=True)
class _Box:
    """Bounds of an object in ideal normalised image coordinates (x/z, y/z) and in depth."""

    low: Array
    """(2,) least x/z and y/z."""
    high: Array
    """(2,) greatest x/z and y/z."""
    z_max: float
    """Depth of the farthest vertex [m]."""


class LabelRenderer:
    """Renders the labels of one scene from any view."""

    def __init__(self, placed: Sequence[PlacedMesh]) -> None:
        """Prepare the scene and every object alone.

        Raises:
            InputError: two objects carry the same instance number.
        """
        self.placed = tuple(placed)
        instances = [p.instance for p in self.placed if p.instance != BACKGROUND]
        if len(set(instances)) != len(instances):
            raise InputError(f"two placed meshes share an instance number: {sorted(instances)}.")
        self._scene = RayScene(self.placed)
        self._instances = np.array([*(p.instance for p in self.placed), BACKGROUND], np.int32)
        self._alone = {
            p.instance: RayScene([p], self._scene.center)
            for p in self.placed
            if p.instance != BACKGROUND
        }

    def cast_rays(self, rays: ArrayLike) -> HitBuffer:
        """Return what rays (N, 6), origin and direction in world [m], meet first."""
        rays = np.asarray(rays)
        return self._scene.cast(rays[:, :3].astype(np.float64), rays[:, 3:].astype(np.float32))

    def render(self, intrinsics: CameraIntrinsics, T_world_cam: ArrayLike) -> Labels:
        """Return the labels of a view.

        Args:
            intrinsics: the raw (distorted) camera.
            T_world_cam: (4, 4) camera in world [m].
        """
        T = se3.check_rigid(T_world_cam, "T_world_cam")
        table = camera.ray_table(intrinsics)
        directions = rotated(table, T[:3, :3])
        depth, geometry = self._first(directions.reshape(-1, 3), T[:3, 3])
        geometry = geometry.reshape(table.shape[:2])
        depth_m = depth.reshape(table.shape[:2])
        ids = self._instances[geometry]

        amodal: dict[int, Mask] = {}
        count_all: dict[int, int] = {}
        count_visible: dict[int, int] = {}
        for p in self.placed:
            if p.instance == BACKGROUND:
                continue
            visible = ids == p.instance
            box = _ideal_box(p, T)
            mask = visible.copy()
            beyond = 0
            if box is not None:
                window = _window(intrinsics, box)
                _add_hidden(mask[window], self._alone[p.instance], box, T, depth_m[window],
                            table[window], directions[window])  # fmt: skip
                beyond = _count_beyond(intrinsics, self._alone[p.instance], box, T)
            amodal[p.instance] = mask
            count_all[p.instance] = int(np.count_nonzero(mask)) + beyond
            count_visible[p.instance] = int(np.count_nonzero(visible))
        face = self._scene.cast(T[:3, 3], directions.reshape(-1, 3)).face.reshape(ids.shape)
        return Labels(ids=ids, depth_m=depth_m, amodal=amodal, px_count_all=count_all,
                      px_count_visib=count_visible, geometry=geometry, face=face,
                      unknown=np.isnan(table[..., 0]))  # fmt: skip

    def _first(self, directions: Array32, eye: Array) -> tuple[Array32, NDArray[np.int32]]:
        """Return depth (N,), 0 = nothing, and placed mesh (N,), -1 = nothing, of pixel rays."""
        known = np.isfinite(directions[:, 0])
        all_known = bool(known.all())
        cast = directions if all_known else directions[known]
        t, hit = self._scene.first_hits(eye, cast)
        t = np.where(np.isfinite(t), t, np.float32(0))
        if all_known:
            return t, hit
        depth = np.zeros(len(directions), np.float32)
        geometry = np.full(len(directions), -1, np.int32)
        depth[known], geometry[known] = t, hit
        return depth, geometry


def _ideal_box(placed: PlacedMesh, T_world_cam: Array) -> _Box | None:
    """Return the bounds of an object before distortion; None if all of it is behind the camera."""
    T_cam_obj = se3.invert(T_world_cam) @ placed.T_world_obj
    points = se3.transform(T_cam_obj, placed.mesh.vertices)
    z = points[:, 2]
    if z.max() <= NEAREST_M:
        return None
    if z.min() <= NEAREST_M:  # it reaches behind the camera: its picture has no bounds
        return _Box(np.full(2, -np.inf), np.full(2, np.inf), float(z.max()))
    xy = points[:, :2] / z[:, None]
    # float32 rays: one part in 1e6 of slack keeps the silhouette's own pixels inside.
    return _Box(xy.min(0) - 1e-5, xy.max(0) + 1e-5, float(z.max()))


@lru_cache(maxsize=8)
def _table_ranges(key: tuple[float, ...]) -> tuple[Array32, Array32, Array32, Array32]:
    """Return least and greatest ideal x of every column, and least and greatest y of every row."""
    table = camera.ray_table(_camera_of(key))
    x, y = table[..., 0], table[..., 1]
    x_low, x_high = np.where(np.isnan(x), np.inf, x), np.where(np.isnan(x), -np.inf, x)
    y_low, y_high = np.where(np.isnan(y), np.inf, y), np.where(np.isnan(y), -np.inf, y)
    return x_low.min(0), x_high.max(0), y_low.min(1), y_high.max(1)


def _key(i: CameraIntrinsics) -> tuple[float, ...]:
    """Return a hashable key of a camera."""
    return (i.width, i.height, i.fx, i.fy, i.cx, i.cy, *i.distortion.tolist())


def _camera_of(key: tuple[float, ...]) -> CameraIntrinsics:
    """Return the camera of a key."""
    return CameraIntrinsics(
        width=int(key[0]), height=int(key[1]), fx=key[2], fy=key[3], cx=key[4], cy=key[5],
        distortion=np.array(key[6:]),
    )  # fmt: skip


def _window(intrinsics: CameraIntrinsics, box: _Box) -> tuple[slice, slice]:
    """Return rows and columns of the image that can hold rays inside the box."""
    x_low, x_high, y_low, y_high = _table_ranges(_key(intrinsics))
    columns = np.flatnonzero((x_high >= box.low[0]) & (x_low <= box.high[0]))
    rows = np.flatnonzero((y_high >= box.low[1]) & (y_low <= box.high[1]))
    if len(columns) == 0 or len(rows) == 0:
        return slice(0, 0), slice(0, 0)
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def _add_hidden(
    mask: Mask,
    alone: RayScene,
    box: _Box,
    T_world_cam: Array,
    depth_m: Array32,
    table: Array32,
    directions: Array32,
) -> None:
    """Add to a window of an object's visible mask the pixels where something else hides it."""
    # It can be hidden only where something was met, and met before the object's farthest vertex.
    candidate = ~mask & (depth_m > 0) & (depth_m <= box.z_max * (1 + 1e-5))
    candidate &= _inside(table, box)
    rows, columns = np.nonzero(candidate)
    hit = alone.occluded(T_world_cam[:3, 3], directions[rows, columns])
    mask[rows[hit], columns[hit]] = True


def _inside(table: Array32, box: _Box) -> Mask:
    """Return where the rays (..., 3) pass through the box; False where the ray is NaN."""
    x, y = table[..., 0], table[..., 1]
    low, high = box.low, box.high
    return (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])


@lru_cache(maxsize=8)
def _turning_radius(coefficients: tuple[float, ...]) -> float:
    """Return the ideal radius where the radial distortion stops growing; inf if it never does."""
    r = np.linspace(0.0, 10.0, 20001)
    x = np.stack([r, np.zeros_like(r)], -1)
    d = np.array(coefficients)
    d[[2, 3]] = 0.0  # the tangential terms are small and have no single turning radius
    rd = camera.distort(d, x)[:, 0]
    falling = np.flatnonzero((np.diff(rd) <= 0) | ~np.isfinite(np.diff(rd)))
    return float(r[falling[0]]) if len(falling) else float("inf")


def _canvas_window(intrinsics: CameraIntrinsics, box: _Box) -> tuple[int, int, int, int] | None:
    """Return u0, u1, v0, v1 (ends excluded) of the canvas pixels that can see into the box."""
    i = intrinsics
    u_range, v_range = (-CANVAS * i.width, (CANVAS + 1) * i.width), (
        -CANVAS * i.height, (CANVAS + 1) * i.height)  # fmt: skip
    if np.all(np.isfinite(box.low)) and np.all(np.isfinite(box.high)):
        # A grid over the box, drawn into the disc where the lens model is one to one.
        reach = _turning_radius(tuple(i.distortion.tolist()))
        x = np.linspace(box.low[0], box.high[0], 33)
        y = np.linspace(box.low[1], box.high[1], 33)
        xy = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
        r = np.linalg.norm(xy, axis=1)
        xy = xy * np.minimum(1.0, reach / np.maximum(r, 1e-12))[:, None]
        uv = camera.distort(i.distortion, xy) * [i.fx, i.fy] + [i.cx, i.cy]
        # The samples miss the extreme of a curved side by well under a hundredth of its length.
        slack = 2.0 + 0.01 * np.ptp(uv, axis=0)
        low, high = np.floor(uv.min(0) - slack), np.ceil(uv.max(0) + slack) + 1
        u_range = (max(u_range[0], int(low[0])), min(u_range[1], int(high[0])))
        v_range = (max(v_range[0], int(low[1])), min(v_range[1], int(high[1])))
    if u_range[0] >= u_range[1] or v_range[0] >= v_range[1]:
        return None
    return (*u_range, *v_range)


def _count_beyond(
    intrinsics: CameraIntrinsics, alone: RayScene, box: _Box, T_world_cam: Array
) -> int:
    """Return how many canvas pixels outside the image see the object standing alone."""
    i = intrinsics
    window = _canvas_window(i, box)
    if window is None:
        return 0
    u0, u1, v0, v1 = window
    if u0 >= 0 and v0 >= 0 and u1 <= i.width and v1 <= i.height:
        return 0
    reach = _turning_radius(tuple(i.distortion.tolist()))
    u = np.arange(u0, u1)
    step = max(1, BLOCK_PX // len(u))
    count = 0
    for first in range(v0, v1, step):
        v = np.arange(first, min(first + step, v1))
        uu, vv = np.meshgrid(u, v)
        outside = (uu < 0) | (uu >= i.width) | (vv < 0) | (vv >= i.height)
        uv = np.stack([uu[outside], vv[outside]], -1).astype(np.float64)
        xy, valid = camera.undistort(i, uv)
        xy = xy[valid & (np.sum(xy * xy, axis=-1) < reach * reach)]
        rays = np.concatenate([xy, np.ones((len(xy), 1))], -1).astype(np.float32)
        rays = rays[_inside(rays, box)]
        directions = rotated(rays, T_world_cam[:3, :3])
        count += int(np.count_nonzero(alone.occluded(T_world_cam[:3, 3], directions)))
    return count
