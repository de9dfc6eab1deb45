"""What the depth images of a scan say: points of the object and of the table, and the outlines.

Every view keeps its own points in its own camera's axes, because the cameras are not quite where
they are said to be and the fit moves them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.arrays import Array, Array32, Mask, UInt8
from realsim.compiled import njit
from realsim.geometry import se3
from realsim.geometry.camera import project, ray_table
from realsim.geometry.clouds import voxel_mean
from realsim.geometry.depth import edge_mask
from realsim.geometry.mesh import box_corners
from realsim.geometry.point_loops import move
from realsim.records import CameraIntrinsics, SupportPlane
from realsim.registration.evidence import Cloud, DepthFrame, DepthNoise
from realsim.scanning.scale.config import ScaleConfig
from realsim.scanning.scale.table import Footprint

EDGE_M = 0.006
"""Depth span within 3 px beyond which pixels may be flying [m]; plus slope and noise."""
LEAST_HEIGHT_M = 0.003
"""What stands this far above the table, plus three sigma of the depth, is no table [m]."""
VOXEL_SHARE = 1 / 50
"""Voxel of the cloud of all views as a share of the object's size."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Rim:
    """Signed distance to the outline of the object in one image, where it was measured."""

    distance_px: Array32
    """(H, W) of the crop, negative inside [px]."""
    gap_px: Array32
    """(H, W) width of the unknown band at the nearest place of the outline [px]; 1 = none."""
    left: int
    """Column of the crop's first pixel in the image."""
    top: int
    """Row of the crop's first pixel in the image."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ScanView:
    """What one view measured."""

    index: int
    T_world_cam: Array
    """(4, 4) where the camera is said to be [m]."""
    points: Array
    """(N, 3) measured points of the object in camera axes [m]."""
    point_area_px: float
    """Pixels that each of them stands for."""
    table: Array
    """(M, 3) measured points of the table in camera axes [m]."""
    table_area_px: float
    rim: Rim
    rays: Array32
    """(R, 3) rays of z = 1 by which hypotheses are compared, camera axes."""
    depth: Array
    """(R,) measured depth along them [m]; 0 = none, or at a depth edge."""
    is_object: Mask
    """(R,) whether the object was measured there."""
    ray_area_px: float


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ScanEvidence:
    """What all views measured."""

    intrinsics: CameraIntrinsics
    views: tuple[ScanView, ...]
    plane: SupportPlane
    noise: DepthNoise
    footprint: Footprint
    cloud: Cloud
    """The object's points of all views averaged on a voxel grid, in world, as the cameras claim."""
    size_m: float
    """Greatest side of the box of the object's points [m]."""
    unseen: tuple[int, ...]
    """Numbers of the views that do not see the object."""

    @property
    def camera_numbers(self) -> Array:
        """(12,) fx fy cx cy and the eight distortion terms."""
        i = self.intrinsics
        return np.array([i.fx, i.fy, i.cx, i.cy, *i.distortion])


def gather_scan(
    intrinsics: CameraIntrinsics,
    frames: Sequence[DepthFrame],
    surface: tuple[SupportPlane, Footprint],
    noise: DepthNoise,
    config: ScaleConfig,
    progress: Callable[[int, int], None] | None = None,
) -> ScanEvidence:
    """Return what the frames say about the object of the footprint."""
    plane, footprint = surface
    views: list[ScanView] = []
    unseen: list[int] = []
    for n, frame in enumerate(frames):
        crop = _crop(intrinsics, frame, plane, footprint, noise)
        view = None if crop is None else _view(crop, frame, config)
        if view is None:
            unseen.append(frame.index)
        else:
            views.append(view)
        if progress is not None:
            progress(n + 1, len(frames))
    size = float(np.max(footprint.box[1] - footprint.box[0]))
    return ScanEvidence(
        intrinsics=intrinsics, views=tuple(views), plane=plane, noise=noise, footprint=footprint,
        cloud=_cloud(views, noise, size * VOXEL_SHARE), size_m=size, unseen=tuple(unseen),
    )  # fmt: skip


@dataclass(frozen=True, eq=False, slots=True)
class _Crop:
    """The part of one image that shows the object and the table around it."""

    left: int
    top: int
    rays: Array32
    """(H, W, 3)."""
    depth: Array32
    """(H, W) [m]; 0 = none."""
    trusted: Mask
    """(H, W) measured and not at a depth edge."""
    on_object: Mask
    """(H, W) trusted pixels of the object."""
    on_table: Mask
    """(H, W) trusted pixels of the table, or of anything else that is not the object."""
    far_table: Mask
    """(H, W) trusted pixels of the table that are used to find it."""


OBJECT, GROUND, TABLE = 1, 2, 4
"""Marks of a pixel: of the object; of what is not the object; of the table around it."""


@njit
def _marks(
    rays: Array32,
    depth: Array32,
    trusted: Mask,
    T: Array32,
    cells: tuple[Mask, Mask, Array32, float],
    limits: tuple[float, float, float],
) -> UInt8:
    """Return the marks (H, W) of every pixel.

    Args:
        rays: (H, W, 3) of z = 1.
        depth: (H, W) [m].
        trusted: (H, W); others get no mark.
        T: (4, 4) camera in the table's frame.
        cells: those of the object, those around it, and their origin (2,) and size [m].
        limits: least height of the object [m], the depth's sigma per m^2 and its least [m].
    """
    near, around, origin, size = cells
    height_m, per_m, floor_m = limits
    out = np.zeros(depth.shape, np.uint8)
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            if not trusted[i, j]:
                continue
            z = depth[i, j]
            x, y, w = rays[i, j, 0] * z, rays[i, j, 1] * z, rays[i, j, 2] * z
            px, py, height = move(T, x, y, w)
            least = height_m + 3.0 * max(floor_m, per_m * z * z)
            a, b = int(np.floor((px - origin[0]) / size)), int(np.floor((py - origin[1]) / size))
            inside = 0 <= a < near.shape[0] and 0 <= b < near.shape[1]
            if height > least:
                if inside and near[a, b]:
                    out[i, j] = OBJECT
            else:
                out[i, j] = GROUND
                if inside and around[a, b] and height > -2.0 * least:
                    out[i, j] |= TABLE
    return out


def _crop(
    intrinsics: CameraIntrinsics,
    frame: DepthFrame,
    plane: SupportPlane,
    footprint: Footprint,
    noise: DepthNoise,
) -> _Crop | None:
    """Return the part of a frame around the object, None where it is not in the image."""
    T_table_cam = se3.invert(plane.T_world_table) @ frame.T_world_cam
    box = _image_box(intrinsics, T_table_cam, footprint)
    if box is None:
        return None
    left, top, right, bottom = box
    rays = np.ascontiguousarray(ray_table(intrinsics)[top:bottom, left:right])
    z = np.ascontiguousarray(frame.depth_m[top:bottom, left:right], dtype=np.float32)
    known = (z > 0) & np.isfinite(z) & np.isfinite(rays[..., 0])
    z = np.where(known, z, np.float32(0))
    # Constants in float32: a double would make every image one.
    slope = np.float32(8.0 / min(intrinsics.fx, intrinsics.fy))
    sigma = np.maximum(np.float32(noise.floor_m), np.float32(noise.per_m) * z * z)
    jump = np.float32(EDGE_M) + slope * z + np.float32(6.0) * sigma
    trusted = known & ~edge_mask(z, jump)
    marks = _marks(
        rays, z, trusted, T_table_cam.astype(np.float32),
        (footprint.near, footprint.around, footprint.origin.astype(np.float32), footprint.cell_m),
        (LEAST_HEIGHT_M, noise.per_m, noise.floor_m),
    )  # fmt: skip
    return _Crop(
        left, top, rays, z, trusted, marks == OBJECT, (marks & GROUND) > 0, (marks & TABLE) > 0
    )


def _image_box(
    intrinsics: CameraIntrinsics, T_table_cam: Array, footprint: Footprint
) -> tuple[int, int, int, int] | None:
    """Return the image box (left, top, right, bottom) of the object and some table around it."""
    low, high = footprint.box
    margin = np.array([0.07, 0.07, 0.0])
    low, high = low - margin, high + margin + [0, 0, 0.01]
    corners_cam = se3.transform(se3.invert(T_table_cam), box_corners(low, high))
    width, height = intrinsics.width, intrinsics.height
    if corners_cam[:, 2].max() <= 0:
        return None
    if corners_cam[:, 2].min() < 0.02:
        return 0, 0, width, height
    uv = project(intrinsics, corners_cam)
    left, top = np.floor(uv.min(0)).astype(int)
    right, bottom = np.ceil(uv.max(0)).astype(int) + 1
    box = np.clip([left, top, right, bottom], 0, [width, height, width, height])
    if box[2] - box[0] < 8 or box[3] - box[1] < 8:
        return None
    return int(box[0]), int(box[1]), int(box[2]), int(box[3])


def _view(crop: _Crop, frame: DepthFrame, config: ScaleConfig) -> ScanView | None:
    """Return the samples of one view, None where it measured nothing of the object."""
    samples = config.samples
    area = int(np.count_nonzero(crop.on_object))
    if area < config.table.least_points:
        return None
    points, point_area = _sampled(crop, crop.on_object, samples.object_points)
    table, table_area = _sampled(crop, crop.far_table, samples.table_points)
    rim = _rim(crop)
    compared = rim.distance_px < np.float32(0.35 * np.sqrt(area) + 6)
    stride = max(1, int(np.sqrt(np.count_nonzero(compared) / samples.rays)))
    rows, columns = np.nonzero(compared[::stride, ::stride])
    rows, columns = rows * stride, columns * stride
    ok = np.isfinite(crop.rays[rows, columns, 0])
    rows, columns = rows[ok], columns[ok]
    depth = np.where(crop.trusted, crop.depth, np.float32(0))[rows, columns]
    return ScanView(
        index=frame.index, T_world_cam=np.array(frame.T_world_cam, dtype=np.float64),
        points=points, point_area_px=point_area, table=table, table_area_px=table_area, rim=rim,
        rays=np.ascontiguousarray(crop.rays[rows, columns]), depth=depth.astype(np.float64),
        is_object=crop.on_object[rows, columns], ray_area_px=float(stride**2),
    )  # fmt: skip


def _sampled(crop: _Crop, mask: Mask, wanted: int) -> tuple[Array, float]:
    """Return about `wanted` points of the mask on a grid of pixels, and the area of each [px]."""
    stride = max(1, int(np.sqrt(np.count_nonzero(mask) / wanted)))
    rows, columns = np.nonzero(mask[::stride, ::stride])
    rows, columns = rows * stride, columns * stride
    rays = crop.rays[rows, columns].astype(np.float64)
    return rays * crop.depth[rows, columns, None].astype(np.float64), float(stride**2)


def _rim(crop: _Crop) -> Rim:
    """Return the signed distance to the outline: midway between object and table pixels."""
    import cv2

    inside = crop.on_object.astype(np.uint8)
    outside = crop.on_table.astype(np.uint8)
    to_object = cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5)
    to_table = cv2.distanceTransform(1 - outside, cv2.DIST_L2, 5)
    body = (to_object < to_table).astype(np.uint8)
    if not body.any() or body.all():
        far = np.full(body.shape, 1e3, np.float32)
        return Rim(distance_px=far, gap_px=far.copy(), left=crop.left, top=crop.top)
    out = cv2.distanceTransform(1 - body, cv2.DIST_L2, 5)
    into = cv2.distanceTransform(body, cv2.DIST_L2, 5)
    distance = np.where(body > 0, np.float32(0.5) - into, out - np.float32(0.5))
    # The unknown band at the outline's nearest pixel, looked up by the label of that pixel.
    edge = (body > 0) & (into < 1.5)
    found: Any = cv2.distanceTransformWithLabels(
        1 - edge.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    labels = np.asarray(found[1], dtype=np.int64)
    width = (to_object + to_table)[edge]
    gaps = np.zeros(int(labels.max()) + 1, np.float32)
    gaps[labels[edge]] = width
    return Rim(
        distance_px=np.asarray(distance, np.float32), gap_px=gaps[labels], left=crop.left,
        top=crop.top,
    )  # fmt: skip


def _cloud(views: Sequence[ScanView], noise: DepthNoise, voxel: float) -> Cloud:
    """Return the object's points of all views in world, averaged per voxel and viewing octant."""
    points = [se3.transform(v.T_world_cam, v.points) for v in views]
    towards = [
        _unit(v.T_world_cam[:3, 3] - p) for v, p in zip(views, points, strict=True)
    ]  # fmt: skip
    if not points:
        nothing = np.zeros((0, 3))
        return Cloud(points=nothing, towards=nothing, sigmas=np.zeros(0))
    p, d = np.concatenate(points), np.concatenate(towards)
    sigmas = noise.sigma(np.concatenate([v.points[:, 2] for v in views]))
    octant = (d > 0) @ np.array([1, 2, 4], dtype=np.int64)
    means = voxel_mean(p, voxel, 1.0 / np.square(sigmas), d, octant)
    return Cloud(
        points=means.points, towards=_unit(means.attributes), sigmas=1.0 / np.sqrt(means.weights)
    )


def _unit(v: Array) -> Array:
    return v / np.linalg.norm(v, axis=1, keepdims=True)
