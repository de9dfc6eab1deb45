"""What the review shows, as plain arrays: fused cloud, thumbnails, grippers, order of the objects.

Nothing here knows of the browser.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import InputError
from realsim.geometry import clouds, depth, se3
from realsim.records import CameraIntrinsics, GraspSet, ObjectPose, View
from realsim.rendering import overlay
from realsim.store import SessionStore

Array = NDArray[np.float64]
Rgb = NDArray[np.uint8]
VERDICT_ORDER = ("rejected", "doubtful", "unchecked", "accepted")
"""Worst first."""
LOOK_NEARER = 0.8
"""Distance of the first look, as a share of the cameras' own."""
LOOK_DOWN_RAD = 0.6
"""Angle under which the first look sees the table [rad]."""
SAMPLES_PER_POINT = 4
"""Depth samples fused per point shown: on overlapping views about as many fall into one voxel."""


@dataclass(frozen=True, kw_only=True, slots=True)
class GripperDrawing:
    """Size of the drawn gripper; the fingers' distance is the grasp's own width."""

    finger_m: float = 0.035
    """Length of the fingers [m]; about that of a two-finger gripper's pads."""
    stem_m: float = 0.03
    """Length of the line behind the fingers that shows the approach [m]."""


def worst_first(objects: Sequence[ObjectPose]) -> list[ObjectPose]:
    """Return the objects, worst verdict first, then by the smallest agreement with the depth."""

    def badness(placed: ObjectPose) -> tuple[int, float, int]:
        agree = placed.checks.get("agree", 0.0)
        return VERDICT_ORDER.index(placed.verdict), agree, placed.instance

    return sorted(objects, key=badness)


def spread(views: Sequence[View], most: int) -> list[View]:
    """Return at most `most` of the views, evenly spread over their order."""
    if len(views) <= most:
        return list(views)
    return [views[k] for k in np.linspace(0, len(views) - 1, most).round().astype(int)]


def placed_views(store: SessionStore) -> list[View]:
    """Return the views whose camera is known.

    Raises:
        InputError: none is.
    """
    views = [v for v in store.session.views if v.T_world_cam is not None]
    if not views:
        raise InputError(
            f"no view of session '{store.session.name}' has a camera pose; calibrate first."
        )
    return views


@dataclass(frozen=True, eq=False, slots=True)
class Region:
    """The ball of world that is looked at."""

    center: Array
    """(3,) [m]."""
    radius_m: float

    def holds(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Return (N,) which points (N, 3) [m] are inside."""
        offset = np.asarray(points, dtype=np.float64) - self.center
        return np.sum(offset * offset, axis=-1) <= self.radius_m**2


def region_of(objects: Sequence[ObjectPose], views: Sequence[View], margin_m: float) -> Region:
    """Return the region about the objects; without objects, about where the cameras look.

    Args:
        objects: the objects.
        views: views with a camera pose.
        margin_m: how far beyond the outermost object's origin it reaches [m].
    """
    if objects:
        origins = np.array([o.T_world_obj[:3, 3] for o in objects])
        center = origins.mean(0)
        return Region(center, float(np.linalg.norm(origins - center, axis=1).max()) + margin_m)
    Ts = np.array([v.T_world_cam for v in views])
    # The point nearest to all optical axes, in the least-squares sense.
    across = np.eye(3) - Ts[:, :3, 2, None] * Ts[:, None, :3, 2]
    A, b = across.sum(0), (across @ Ts[:, :3, 3:4]).sum(0)[:, 0]
    center = np.linalg.lstsq(A, b, rcond=None)[0]
    distance = float(np.median(np.linalg.norm(Ts[:, :3, 3] - center, axis=1)))
    return Region(center, distance)


def first_look(region: Region, views: Sequence[View], up: Array) -> tuple[Array, Array]:
    """Return where a new browser's camera stands and what it looks at, (3,) and (3,) [m].

    It stands where the cameras stand, on the side of the first one, but nearer, so that no frustum
    is in the way.

    Args:
        region: what to look at.
        views: views with a camera pose.
        up: (3,) unit vector out of the table, in world.
    """
    Ts = np.array([v.T_world_cam for v in views])
    offset = Ts[0, :3, 3] - region.center
    horizontal = offset - up * (up @ offset)
    length = float(np.linalg.norm(horizontal))
    side = horizontal / length if length > 1e-6 else np.linalg.svd(up[None])[2][1]
    distance = LOOK_NEARER * float(np.median(np.linalg.norm(Ts[:, :3, 3] - region.center, axis=1)))
    direction = np.cos(LOOK_DOWN_RAD) * side + np.sin(LOOK_DOWN_RAD) * up
    return region.center + distance * direction, region.center


def strided(intrinsics: CameraIntrinsics, stride: int) -> CameraIntrinsics:
    """Return the camera of an image's every `stride`-th row and column; exact, lens included."""
    return CameraIntrinsics(
        width=-(-intrinsics.width // stride),
        height=-(-intrinsics.height // stride),
        fx=intrinsics.fx / stride,
        fy=intrinsics.fy / stride,
        cx=intrinsics.cx / stride,
        cy=intrinsics.cy / stride,
        distortion=intrinsics.distortion,
    )


def fused_cloud(
    store: SessionStore, views: Sequence[View], voxel_m: float, most: int, region: "Region"
) -> tuple[NDArray[np.float32], Rgb]:
    """Return the measured depth of several views as one coloured cloud in world.

    Every view gives an even share of about `SAMPLES_PER_POINT` times as many samples as points are
    wanted, so that the time does not grow with the number of views.

    Args:
        store: the session.
        views: views with a camera pose and depth.
        voxel_m: points are averaged in voxels of this edge [m].
        most: no more points than this are returned; those seen most often stay.
        region: points outside are left out.

    Returns:
        points (N, 3) [m] and colours (N, 3).
    """
    intrinsics = store.session.intrinsics
    pixels = intrinsics.width * intrinsics.height
    share = SAMPLES_PER_POINT * most / max(1, len(views))
    stride = max(1, round(float(np.sqrt(pixels / share))))
    small = strided(intrinsics, stride)
    parts: list[Array] = [np.zeros((0, 3))]
    colors: list[Array] = [np.zeros((0, 3))]
    for view in views:
        depth_m = np.ascontiguousarray(store.depth_m(view.index)[::stride, ::stride])
        points, at = depth.points_from_depth(depth_m, small)
        points = se3.transform(np.asarray(view.T_world_cam), points)
        near = region.holds(points)
        rgb = store.rgb(view.index)[::stride, ::stride]
        parts.append(points[near])
        colors.append(rgb[at[near, 1], at[near, 0]].astype(np.float64))
    fused = clouds.voxel_mean(np.concatenate(parts), voxel_m, None, np.concatenate(colors))
    keep = np.argsort(-fused.counts, kind="stable")[:most]
    points32 = fused.points[keep].astype(np.float32)
    return points32, np.rint(fused.attributes[keep]).astype(np.uint8)


def thumbnail(rgb: Rgb, width_px: int) -> Rgb:
    """Return the photograph (H, W, 3) scaled down to a width [px]."""
    import cv2

    height = max(1, round(rgb.shape[0] * width_px / rgb.shape[1]))
    small = cv2.resize(rgb, (width_px, height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8)


def score_rgb(scores: ArrayLike) -> Rgb:
    """Return the colours (N, 3) of scores (N,): those of the pictures, grey = not tried."""
    colors = [overlay.score_color(float(s)) for s in np.asarray(scores, dtype=np.float64)]
    return np.array(colors, dtype=np.uint8).reshape(-1, 3)


def linear_rgb(rgb: Rgb) -> Rgb:
    """Return sRGB colours as linear light, 8 bit: what the browser takes line colours for."""
    c = rgb.astype(np.float64) / 255.0
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return np.rint(255.0 * linear).astype(np.uint8)


def gripper_segments(Ts_x_grasp: ArrayLike, widths_m: ArrayLike, drawing: GripperDrawing) -> Array:
    """Return grippers as line segments (N, 4, 2, 3) in frame x [m]: two fingers, palm, stem."""
    T = np.asarray(Ts_x_grasp, dtype=np.float64).reshape(-1, 4, 4)
    half = np.asarray(widths_m, dtype=np.float64) / 2
    n, zero = len(T), np.zeros(len(T))
    back, stem = np.full(n, -drawing.finger_m), np.full(n, -drawing.finger_m - drawing.stem_m)
    left, left_palm = np.stack([zero, -half, zero], -1), np.stack([zero, -half, back], -1)
    right, right_palm = np.stack([zero, half, zero], -1), np.stack([zero, half, back], -1)
    palm, tail = np.stack([zero, zero, back], -1), np.stack([zero, zero, stem], -1)
    lines = np.stack(
        [left, left_palm, right, right_palm, left_palm, right_palm, palm, tail], axis=1
    )
    return se3.transform(T, lines).reshape(n, 4, 2, 3)


def chosen_grasps(
    grasps: GraspSet, min_score: float, reachable_only: bool, most: int
) -> NDArray[np.int64]:
    """Return the numbers of the grasps that pass the filters, evenly spread over the scores.

    Grasps that were not tried pass a minimum of 0 only. If more than `most` pass, every k-th in
    the order of the scores is shown, so that good and bad ones stay in proportion.
    """
    passes = np.nan_to_num(grasps.scores, nan=0.0) >= min_score
    if reachable_only:
        passes &= grasps.reachable
    found = np.flatnonzero(passes)
    if len(found) <= most:
        return found
    ranked = found[np.argsort(-np.nan_to_num(grasps.scores[found], nan=-1.0), kind="stable")]
    return ranked[np.linspace(0, len(ranked) - 1, most).round().astype(int)]
