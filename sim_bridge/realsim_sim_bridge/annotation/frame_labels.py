"""What one frame shows of one object: pose, boxes, pixel counts, and does the depth agree.

Boxes and counts follow BOP's `scene_gt_info`: x, y, w, h in whole pixels with w = x_max - x_min;
-1 -1 -1 -1 where nothing of the object is seen; the silhouette's box also beyond the border.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array, Array32, Mask
from realsim.formats.bop.labels import NO_BBOX, Bbox, bbox_of, gt_info_entry, rle_of
from realsim.geometry import camera, se3
from realsim.geometry.mesh import box_mesh
from realsim.records import CameraIntrinsics, Mesh, ObjectPose
from realsim.rendering.labels import Labels
from realsim_sim_bridge.annotation.config import OccluderConfig
from realsim_sim_bridge.annotation.unmodelled import ObjectMasks

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
