"""What one real frame shows of one object: pose, boxes, pixel counts, and does the depth agree.

Boxes and counts follow BOP's `scene_gt_info`: x, y, w, h in whole pixels with w = x_max - x_min;
-1 -1 -1 -1 where nothing of the object is seen; the silhouette's box also beyond the border.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.formats.bop_labels import NO_BBOX, Bbox, bbox_of, gt_info_entry, rle_of
from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics, Mesh, ObjectPose
from realsim.rendering.labels import Labels

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, slots=True)
class DepthAgreement:
    """How the measured depth compares with the rendered one inside the visible mask."""

    measured: float
    """Share of the visible pixels that have a measurement; NaN = no visible pixel."""
    agree: float
    """Of these, the share within the tolerance; NaN = none is measured."""
    nearer: float
    """Of these, the share where something nearer was measured: an occluder nobody modelled."""
    farther: float
    """Of these, the share where the measurement looks through the object: the pose is off."""
    bias_m: float
    """Median of measured - rendered over the agreeing pixels [m]; NaN = none."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FrameLabel:
    """One object in one frame."""

    obj_id: int
    instance: int
    T_cam_obj: Array
    """(4, 4) object in camera [m]."""
    info: dict[str, Any]
    """BOP's entry of scene_gt_info: bbox_obj, bbox_visib, px_count_all, px_count_valid,
    px_count_visib [px] and visib_fract."""
    visible_rle: dict[str, Any]
    """The visible mask as COCO's run lengths."""
    agreement: DepthAgreement


def silhouette_box(
    amodal: Mask, px_count_all: int, intrinsics: CameraIntrinsics, points_cam: ArrayLike
) -> Bbox:
    """Return the box of an object's whole silhouette, also beyond the border of the image.

    Inside the image it is the box of the amodal mask. A silhouette that goes on beyond the border
    (`px_count_all` counts more pixels than the mask) is bounded by its projected vertices there,
    within BOP's canvas of one image size to each side.

    Args:
        amodal: (H, W) the silhouette inside the image.
        px_count_all: pixels of the silhouette, also beyond the border.
        intrinsics: the camera.
        points_cam: (V, 3) the mesh's vertices in the camera [m].
    """
    inside = bbox_of(amodal)
    if px_count_all == 0 or px_count_all == int(np.count_nonzero(amodal)):
        return inside
    p = np.asarray(points_cam, dtype=np.float64)
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
    visible: Mask,
    rendered_m: NDArray[np.float32],
    measured_m: NDArray[np.float32],
    tolerance_m: float,
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


def label_object(
    placed: ObjectPose,
    mesh: Mesh,
    labels: Labels,
    depth_m: NDArray[np.float32],
    intrinsics: CameraIntrinsics,
    T_world_cam: ArrayLike,
    tolerance_m: float,
) -> FrameLabel:
    """Return the label of one object in one frame.

    Args:
        placed: where the object stands.
        mesh: its mesh.
        labels: the rendered labels of the view.
        depth_m: (H, W) measured depth [m], 0 = none.
        intrinsics: the camera.
        T_world_cam: (4, 4) camera in world [m].
        tolerance_m: up to which difference measured and rendered depth agree [m].
    """
    T_cam_obj = se3.invert(T_world_cam) @ placed.T_world_obj
    i = placed.instance
    visible, amodal = labels.visible(i), labels.amodal[i]
    count_all = labels.px_count_all[i]
    points_cam = se3.transform(T_cam_obj, mesh.vertices)
    box = silhouette_box(amodal, count_all, intrinsics, points_cam)
    return FrameLabel(
        obj_id=placed.obj_id,
        instance=i,
        T_cam_obj=T_cam_obj,
        info=gt_info_entry(amodal, visible, depth_m, px_count_all=count_all, bbox_obj=box),
        visible_rle=rle_of(visible),
        agreement=depth_agreement(visible, labels.depth_m, depth_m, tolerance_m),
    )
