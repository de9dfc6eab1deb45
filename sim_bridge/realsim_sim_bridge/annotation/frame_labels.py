"""What one frame shows of one object: pose, boxes, pixel counts, and does the depth agree.

Boxes and counts follow BOP's `scene_gt_info`: x, y, w, h in whole pixels with w = x_max - x_min;
-1 -1 -1 -1 where nothing of the object is seen; the silhouette's box also beyond the border.

The maps of one view as files: instances, exact depth, object coordinates, normals.

Depth and normals are those of the model, also where something that is not in it stands in front;
instances and coordinates are set where the object is visible.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim import images
from realsim.arrays import Array, Array32, Counts, Int32, Int64, Mask
from realsim.compiled import njit
from realsim.formats import label_maps
from realsim.formats.bop.labels import NO_BBOX, Bbox, bbox_of, gt_info_entry, rle_of
from realsim.geometry import camera, se3
from realsim.geometry.mesh import box_mesh
from realsim.geometry.point_loops import turn_back
from realsim.images.png import encode_window
from realsim.records import CameraIntrinsics, Mesh, ObjectPose
from realsim.rendering.labels import Labels
from realsim_sim_bridge.annotation.config import OccluderConfig
from realsim_sim_bridge.annotation.unmodelled import ObjectMasks, Window, union_of

Finding = Literal["none", "occluder", "pose or occluder"]


@dataclass(frozen=True, kw_only=True, slots=True)
class DepthAgreement:
    """How the measured depth compares with the rendered one inside the rendered visible mask."""

    measured: float
    """Share of the visible pixels that have a measurement; NaN = no visible pixel."""
    agree: float
    """Share of the measured within the tolerance; NaN = none is measured."""
    nearer: float
    """Share of the measured where something nearer was measured: an occluder nobody modelled."""
    farther: float
    """Share of the measured where the measurement looks through the object: the pose is off."""
    bias_m: float
    """Median of measured - rendered over the agreeing pixels [m]; NaN = none."""


@dataclass(frozen=True, kw_only=True, slots=True)
class UnknownOccluder:
    """What stands in front of one object and is not in the scene."""

    px: int
    """Pixels of the rendered visible mask that it covers."""
    share: float
    """The same as a share of the rendered visible mask; 0 where that is empty."""
    gap_m: float
    """Median of rendered - measured depth there [m]; NaN = none."""
    finding: Finding
    """'pose or occluder' where so much disagrees that the pose or the depth may be wrong."""
    is_removed: bool
    """Whether the pixels were taken out of the visible mask."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FrameLabel:
    """One object in one frame."""

    T_cam_obj: Array
    """(4, 4) object in camera [m]."""
    info: dict[str, Any]
    """BOP's entry of scene_gt_info: bbox_obj, bbox_visib, px_count_all, px_count_valid,
    px_count_visib [px] and visib_fract."""
    corners_px: Array
    """(8, 2) corners of the object's own box in the image, also beyond it; x varies slowest, z
    fastest; NaN = behind the camera."""
    visible_rle: dict[str, Any]
    """The visible mask as COCO's run lengths."""
    agreement: DepthAgreement
    unknown: UnknownOccluder


def silhouette_box(
    inside: Bbox, count_inside: int, px_count_all: int, intrinsics: CameraIntrinsics,
    points_obj: ArrayLike, T_cam_obj: ArrayLike,
) -> Bbox:  # fmt: skip
    """Return the box of an object's whole silhouette, also beyond the border of the image.

    Inside the image it is the box of the amodal mask. A silhouette that goes on beyond the border
    (`px_count_all` counts more pixels than the mask) is bounded by its projected vertices there,
    within BOP's canvas of one image size to each side.

    Args:
        inside: box of the silhouette inside the image.
        count_inside: its pixels inside the image.
        px_count_all: its pixels, also beyond the border.
        intrinsics: the camera.
        points_obj: (V, 3) the mesh's vertices [m].
        T_cam_obj: (4, 4) object in camera [m].
    """
    if px_count_all in (0, count_inside):
        return inside
    p = se3.transform(T_cam_obj, points_obj)
    uv = camera.project(intrinsics, p[p[:, 2] > 0])
    w, h = intrinsics.width, intrinsics.height
    low = np.clip(np.ceil(uv.min(0)), [-w, -h], [2 * w - 1, 2 * h - 1])
    high = np.clip(np.floor(uv.max(0)), [-w, -h], [2 * w - 1, 2 * h - 1])
    if inside != NO_BBOX:
        low = np.minimum(low, inside[:2])
        high = np.maximum(high, np.add(inside[:2], inside[2:]))
    x, y = int(low[0]), int(low[1])
    return x, y, max(0, int(high[0]) - x), max(0, int(high[1]) - y)


def depth_agreement(
    visible: Mask, rendered_m: Array32, measured_m: Array32, tolerance_m: float
) -> DepthAgreement:
    """Return how measured and rendered depth (H, W) [m] agree inside a mask (H, W)."""
    measured, rendered = measured_m[visible], rendered_m[visible]
    known = measured > 0
    error = measured[known] - rendered[known]
    nan = float("nan")
    share_measured = float(np.mean(known)) if len(known) else nan
    if len(error) == 0:
        return DepthAgreement(
            measured=share_measured, agree=nan, nearer=nan, farther=nan, bias_m=nan
        )
    close = np.abs(error) <= tolerance_m
    return DepthAgreement(
        measured=share_measured,
        agree=float(np.mean(close)),
        nearer=float(np.mean(error < -tolerance_m)),
        farther=float(np.mean(error > tolerance_m)),
        bias_m=float(np.median(error[close])) if np.any(close) else nan,
    )


def unknown_occluder(
    masks: ObjectMasks,
    rendered_m: Array32,
    measured_m: Array32,
    agreement: DepthAgreement,
    config: OccluderConfig,
) -> UnknownOccluder:
    """Return what an object's masks lost to something that is not in the scene, and how sure.

    Args:
        masks: the object's masks; `visible` lacks what was found in front of it.
        rendered_m: (h, w) rendered depth in the masks' window [m].
        measured_m: (h, w) measured depth there [m], 0 = none.
        agreement: of the same object.
        config: when it may as well be the pose.
    """
    covered = masks.rendered & ~masks.visible
    px, whole = int(np.count_nonzero(covered)), int(np.count_nonzero(masks.rendered))
    if px == 0:
        return UnknownOccluder(px=0, share=0.0, gap_m=float("nan"), finding="none", is_removed=True)
    known = covered & (measured_m > 0)
    gap = float(np.median(rendered_m[known] - measured_m[known])) if known.any() else float("nan")
    measured = max(1.0, agreement.measured * whole)
    nearer, farther = np.count_nonzero(known) / measured, float(np.nan_to_num(agreement.farther))
    is_suspect = nearer + farther > config.suspect_share
    is_suspect |= farther > max(config.suspect_farther, nearer)
    return UnknownOccluder(
        px=px,
        share=px / whole,
        gap_m=gap,
        finding="pose or occluder" if is_suspect else "occluder",
        is_removed=bool(not is_suspect or gap >= config.certain_gap_m),
    )


def object_info(
    masks: ObjectMasks,
    px_count_all: int,
    depth: NDArray[Any],
    pose: tuple[CameraIntrinsics, Mesh, ArrayLike],
) -> dict[str, Any]:
    """Return BOP's entry of scene_gt_info of one object, its silhouette also beyond the border.

    Args:
        masks: its masks in this frame.
        px_count_all: pixels of its silhouette, also beyond the border.
        depth: (H, W) measured depth in any unit, 0 = none.
        pose: the camera, its mesh and T_cam_obj (4, 4) [m].
    """
    intrinsics, mesh, T_cam_obj = pose
    inside = int(np.count_nonzero(masks.amodal))
    box = silhouette_box(
        masks.moved(bbox_of(masks.amodal)), inside, px_count_all, intrinsics, mesh.vertices,
        T_cam_obj,
    )  # fmt: skip
    info = gt_info_entry(
        masks.amodal, masks.visible, depth[masks.window], px_count_all=px_count_all, bbox_obj=box
    )
    info["bbox_visib"] = list(masks.moved(bbox_of(masks.visible)))
    return info


def label_object(
    placed: ObjectPose,
    mesh: tuple[Mesh, Array],
    masks: ObjectMasks,
    labels: Labels,
    depth_m: Array32,
    camera_pose: tuple[CameraIntrinsics, ArrayLike],
    evidence: tuple[DepthAgreement, UnknownOccluder],
) -> FrameLabel:
    """Return the label of one object in one frame.

    Args:
        placed: where the object stands.
        mesh: its mesh and the mesh's box (2, 3) [m], which is the same in every frame.
        masks: its masks in this frame.
        labels: the rendered labels of the view.
        depth_m: (H, W) measured depth [m], 0 = none.
        camera_pose: the camera, and T_world_cam (4, 4) [m].
        evidence: how the measured depth agrees, and what hides it that is not in the scene.
    """
    (intrinsics, T_world_cam), (agreement, unknown) = camera_pose, evidence
    shape, bounds = mesh
    corners = box_mesh(*bounds).vertices
    T_cam_obj = se3.invert(T_world_cam) @ placed.T_world_obj
    info = object_info(
        masks, labels.px_count_all[placed.instance], depth_m, (intrinsics, shape, T_cam_obj)
    )
    return FrameLabel(
        T_cam_obj=T_cam_obj,
        info=info,
        corners_px=camera.project(intrinsics, se3.transform(T_cam_obj, corners)),
        visible_rle=rle_of(masks.visible, origin=masks.origin, shape=labels.ids.shape),
        agreement=agreement,
        unknown=unknown,
    )


Masks = Sequence[tuple[int, ObjectMasks]]


def map_path(name: str, view: int) -> str:
    """Return where a map of a view is, relative to the session."""
    return f"labels/{name}/{view:06d}.png"


def map_files(
    wanted: Sequence[str],
    view: int,
    labels: Labels,
    masks: Masks,
    boxes: Array,
    depth_unit_m: float,
) -> dict[str, bytes]:
    """Return the maps wanted of a view, by path.

    Args:
        wanted: names of maps.
        view: number of the view.
        labels: its rendered labels.
        masks: (instance, masks) of its objects.
        boxes: (G, 2, 3) least and greatest corner of every placed mesh [m]: coordinates run over
            them.
        depth_unit_m: metres per count of the depth.
    """
    size = (labels.ids.shape[1], labels.ids.shape[0])
    files: dict[str, bytes] = {}
    window = union_of([m.window for _, m in masks])
    ids = _instances(masks, window)
    if "instance" in wanted:
        counts = label_maps.instance_counts(ids)
        files[map_path("instance", view)] = encode_window(counts, _origin(window), size)
    if "depth" in wanted:
        counts = images.depth_counts(labels.depth_m, depth_unit_m)
        files[map_path("depth", view)] = images.png_bytes(counts)
    if "coordinates" in wanted:
        counts = coordinate_counts(labels, window, ids >= 0, boxes)
        files[map_path("coordinates", view)] = encode_window(counts, _origin(window), size)
    if "normals" in wanted:
        counts = normal_counts(labels)
        files[map_path("normals", view)] = encode_window(counts, (0, 0), size)
    return files


def _origin(window: Window) -> tuple[int, int]:
    return window[1].start, window[0].start


def _shape(window: Window) -> tuple[int, int]:
    return window[0].stop - window[0].start, window[1].stop - window[1].start


def _inner(window: Window, outer: Window) -> Window:
    """Return a window of the image as a window of another one that holds it."""
    top, left = outer[0].start, outer[1].start
    return (
        slice(window[0].start - top, window[0].stop - top),
        slice(window[1].start - left, window[1].stop - left),
    )


def _instances(masks: Masks, window: Window) -> Int32:
    """Return the instances (h, w) visible in a window that holds all masks, -1 = none."""
    ids = np.full(_shape(window), label_maps.NO_OBJECT, np.int32)
    for instance, m in masks:
        if m.visible.size:
            ids[_inner(m.window, window)][m.visible] = instance
    return ids


# --- Coordinate and normal maps as 16-bit counts, in one walk over the pixels each ---------------
# Codes of `label_maps` for `Labels.object_coordinates()` and `Labels.normals()`, without the maps
# of float32 in between: those are twice as large, and allocating them costs as much as filling
# them.


FULL = np.float32(label_maps.FULL)


def coordinate_counts(
    labels: Labels, window: tuple[slice, slice], seen: Mask, boxes: Array
) -> Counts:
    """Return the object coordinates of a window as counts (h, w, 3) over each object's box.

    Args:
        labels: the rendered labels of the view.
        window: rows and columns.
        seen: (h, w) pixels of the window that show an object.
        boxes: (G, 2, 3) least and greatest corner of every placed mesh [m].
    """
    low = boxes[:, 0].astype(np.float32)
    extent = boxes[:, 1].astype(np.float32) - low
    scale = np.where(extent > 0, FULL / np.where(extent > 0, extent, 1), 0).astype(np.float32)
    s = labels.surfaces
    return _coordinates(
        s.rays[window], labels.depth_m[window], labels.geometry[window], s.Ts_obj_cam, seen,
        low, scale,
    )  # fmt: skip


@njit
def _coordinates(
    rays: Array32,
    depth: Array32,
    geometry: Int32,
    Ts_obj_cam: Array,
    seen: Mask,
    low: Array32,
    scale: Array32,
) -> Counts:
    """Return the counts (h, w, 3) of what is seen, 0 0 0 elsewhere."""
    height, width = seen.shape
    out = np.zeros((height, width, 3), np.uint16)
    for v in range(height):
        for u in range(width):
            g = geometry[v, u]
            if not seen[v, u] or g < 0:
                continue
            z = np.float64(depth[v, u])
            x, y = z * rays[v, u, 0], z * rays[v, u, 1]
            is_zero = True
            for k in range(3):
                T = Ts_obj_cam[g]
                at = np.float32(T[k, 0] * x + T[k, 1] * y + T[k, 2] * z + T[k, 3])
                count = np.rint((at - low[g, k]) * scale[g, k])
                count = min(max(count, np.float32(0)), FULL)
                out[v, u, k] = np.uint16(count)
                is_zero &= count == 0
            if is_zero:  # 0 0 0 says that there is no object
                out[v, u, 0] = out[v, u, 1] = out[v, u, 2] = 1
    return out


def normal_counts(labels: Labels) -> Counts:
    """Return the normals of a view as counts (H, W, 3), background included."""
    s = labels.surfaces
    return _normals(s.rays, labels.geometry, labels.face, s.Ts_obj_cam, s.normals, s.starts)


@njit
def _normals(
    rays: Array32, geometry: Int32, face: Int32, Ts_obj_cam: Array, normals: Array32, starts: Int64
) -> Counts:
    """Return the counts (H, W, 3) of the faces' normals towards the eye, 0 0 0 where nothing is."""
    height, width = geometry.shape
    out = np.zeros((height, width, 3), np.uint16)
    half = np.float32(label_maps.FULL / 2)
    middle = np.float32(label_maps.FULL / 2 + 0.5)  # the half, cut off by the conversion, rounds
    last = np.int64(-1)
    x = y = z = 0.0
    for v in range(height):
        for u in range(width):
            g = geometry[v, u]
            if g < 0:
                continue
            number = starts[g] + face[v, u]
            if number != last:  # neighbours mostly lie on the same face
                last = number
                T, n = Ts_obj_cam[g], normals[number]
                # R_cam_obj is the transpose of R_obj_cam.
                x, y, z = turn_back(T, n[0], n[1], n[2])
            away = x * rays[v, u, 0] + y * rays[v, u, 1] + z > 0.0
            side = -1.0 if away else 1.0
            a, b, c = np.float32(side * x), np.float32(side * y), np.float32(side * z)
            if a == 0 and b == 0 and c == 0:  # a face without area has no normal
                continue
            out[v, u, 0] = np.uint16(min(max(a * half + middle, np.float32(0)), FULL))
            out[v, u, 1] = np.uint16(min(max(b * half + middle, np.float32(0)), FULL))
            out[v, u, 2] = np.uint16(min(max(c * half + middle, np.float32(0)), FULL))
    return out
