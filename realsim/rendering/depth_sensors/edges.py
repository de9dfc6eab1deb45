"""What a depth camera loses at edges and at the border, from frames of which nothing else is known.

The scene is the frame's own depth, its holes filled by what likely stands there. What shadows do
not explain beside its edges is the edges' loss.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Array32, Mask
from realsim.records import CameraIntrinsics
from realsim.rendering.depth_sensors.loss import half_occluded
from realsim.rendering.depth_sensors.model import DepthSensorModel, depth_edges
from realsim.rendering.depth_sensors.plane_faults import Estimate

REACH_PX = 24
"""A hole that is wider by more than this than the shadow beside it hides something unknown [px]."""
NEAR_PX = 5
"""Holes this near to a depth edge are the edge's [px]."""
LEAST_EDGE_PX, LEAST_ROWS, MOST_SPREAD = 2000, 100, 0.15
"""Pixels at depth edges, and rows with a lost band at the left, that say something; and the
greatest spread between frames of what edges lose."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FilledView:
    """A frame of which nothing is known but its own depth."""

    disparity: Array32
    """(H, W) with the holes filled [px]; 0 = nothing is known."""
    hole: Mask
    """(H, W) what was not measured."""
    judged: Mask
    """(H, W) where what stands there is likely."""


def filled(depth_m: Array32, intrinsics: CameraIntrinsics, model: DepthSensorModel) -> FilledView:
    """Return a frame with its holes filled, row by row, by the farther of the sides.

    Behind a thing's edge the background goes on, so the hole beside it is the background's. A hole
    that is wider than the thing's shadow explains, by REACH_PX, hides something unknown: too near,
    too smooth, too fast.

    Args:
        depth_m: (H, W) measured depth [m], 0 = none.
        intrinsics: the camera.
        model: for the baseline and the range.
    """
    import cv2

    z = np.where((depth_m >= model.min_z_m) & (depth_m <= model.max_z_m), depth_m, 0)
    fB = np.float32(intrinsics.fx * model.baseline_m)
    d = np.where(z > 0, fB / np.where(z > 0, z, 1), 0).astype(np.float32)
    rows, width = np.arange(d.shape[0])[:, None], d.shape[1]
    u = np.arange(width)
    before = np.maximum.accumulate(np.where(d > 0, u, -1), axis=1)
    after = np.minimum.accumulate(np.where(d > 0, u, width)[:, ::-1], axis=1)[:, ::-1]
    left = np.where(before >= 0, d[rows, np.maximum(before, 0)], 0)
    right = np.where(after < width, d[rows, np.minimum(after, width - 1)], 0)
    inside = (left > 0) & (right > 0)
    far = np.where(inside, np.minimum(left, right), np.maximum(left, right))
    # To the left of a thing its shadow is as wide as the disparity jumps; of the border, too.
    shadow = np.where(after < width, np.maximum(right - left, 0), 0)
    judged = (far > 0) & (after - before - 1 <= shadow + REACH_PX)
    # The median takes out specks and notches, which are the measurement's, not the scene's.
    scene = np.asarray(cv2.medianBlur(np.where(d > 0, d, far), 5), np.float32)
    return FilledView(disparity=scene, hole=d == 0, judged=(judged | (d > 0)) & (scene > 0))


def edges_of(
    depths_m: Sequence[Array32], intrinsics: CameraIntrinsics, model: DepthSensorModel
) -> dict[str, Estimate]:
    """Return what share edges lose, and how much wider than the disparity the lost border is.

    Args:
        depths_m: (H, W) measured depth [m] of anything, 0 = none.
        intrinsics: the camera.
        model: for baseline, range, eyes and what counts as an edge.
    """
    views = [filled(np.asarray(d, np.float32), intrinsics, model) for d in depths_m]
    margins = [_margins(v) for v in views]
    wide = np.concatenate(margins)
    border = Estimate(
        max(0.0, float(wide.mean())) if len(wide) else 0.0,
        max(0.5, float(np.std([m.mean() for m in margins if len(m)]))) if len(wide) else np.inf,
        len(wide) >= LEAST_ROWS,
        "" if len(wide) >= LEAST_ROWS else "no row of the frames begins at the border.",
    )
    least = model.border_margin_px if not border.determined else border.value
    lost, at = np.array([_at_edges(v, model, least) for v in views], np.float64).T
    share = min(float(lost.sum() / max(at.sum(), 1)), 1.0)
    spread = float(np.sqrt(np.sum(np.square(lost - share * at))) / max(at.sum(), 1))
    if at.sum() < LEAST_EDGE_PX or spread > MOST_SPREAD:
        note = (
            f"{int(at.sum())} pixels lie at depth edges ({LEAST_EDGE_PX} say something), and what "
            f"is lost there differs by {spread:.2f} between frames ({MOST_SPREAD:g} is accepted): "
            "other causes lose more there."
        )
        kept = Estimate(model.edge_dropout, np.inf, False, note)
        return {"border_margin_px": border, "edge_dropout": kept}
    return {
        "border_margin_px": border,
        "edge_dropout": Estimate(share, max(0.02, spread), True),
        "edge_flying": Estimate(min(model.edge_flying, 1 - share), np.inf, True),
    }


def _margins(view: FilledView) -> Array:
    """Return by how much the lost band at the left is wider than the disparity [px], by row."""
    first = np.argmax(~view.hole, axis=1)
    rows = np.flatnonzero((first > 0) & view.judged[:, 0])
    return first[rows] - view.disparity[rows, first[rows]].astype(float)


def _at_edges(view: FilledView, model: DepthSensorModel, margin_px: float) -> tuple[int, int]:
    """Return how many pixels edges lose, and how many lie at them, without shadows and border."""
    first = model.eye_offset_m / model.baseline_m
    shadow = half_occluded(
        view.disparity, second_eye=1 + first, first_eye=first, border_margin_px=margin_px
    )
    seen = view.judged & ~shadow
    at, near = (
        depth_edges(view.disparity, view.disparity > 0, width, model.edge_jump_px)[0]
        for width in (model.edge_width_px, NEAR_PX)
    )
    return int((seen & view.hole & near).sum()), int((seen & at).sum())
