"""What the measured depth shows in front of the scene that is not in the model: a hand, a cable.

A measurement nearer than the rendered surface can be noise, the fattened edge of a near object, a
pose that is a few millimetres off, or a thing. Only a region that is nearer than every surface
around it, wider than a fattened edge and larger than speckle is taken for a thing.
"""

from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array32, Mask
from realsim.formats.bop.labels import NO_BBOX, Bbox
from realsim.records import CameraIntrinsics
from realsim.rendering.labels import Labels
from realsim_sim_bridge.annotation.config import OccluderConfig

Window = tuple[slice, slice]
CLOSING_PX = 2
"""Holes of the measurement up to twice this width inside a thing belong to it [px]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class UnmodelledRegion:
    """Where something that is not in the model stands in front of the scene."""

    window: Window
    """Rows and columns of the image that `mask` covers; nothing was looked for elsewhere."""
    mask: Mask
    """(h, w) where it stands."""
    depth_m: Array32
    """(h, w) how far away it was measured [m], 0 = not measured."""

    def over(self, window: Window) -> Mask:
        """Return the mask over another window of the image."""
        rows, columns = window
        out = np.zeros((rows.stop - rows.start, columns.stop - columns.start), np.bool_)
        mine_rows, mine_columns = self.window
        r0, r1 = max(rows.start, mine_rows.start), min(rows.stop, mine_rows.stop)
        c0, c1 = max(columns.start, mine_columns.start), min(columns.stop, mine_columns.stop)
        if r0 < r1 and c0 < c1:
            out[r0 - rows.start : r1 - rows.start, c0 - columns.start : c1 - columns.start] = (
                self.mask[
                    r0 - mine_rows.start : r1 - mine_rows.start,
                    c0 - mine_columns.start : c1 - mine_columns.start,
                ]
            )
        return out

    def without(self, window: Window, kept: Mask) -> "UnmodelledRegion":
        """Return the region without the pixels `kept` (h, w) of a window inside it."""
        rows, columns = window
        top, left = self.window[0].start, self.window[1].start
        mask = self.mask.copy()
        mask[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] &= ~(
            kept
        )
        return UnmodelledRegion(window=self.window, mask=mask, depth_m=self.depth_m)


def unmodelled_region(
    rendered_m: Array32,
    measured_m: Array32,
    window: Window,
    intrinsics: CameraIntrinsics,
    config: OccluderConfig,
) -> UnmodelledRegion | None:
    """Return where something stands in front of the rendered scene; None = nowhere.

    Args:
        rendered_m: (H, W) exact depth of everything modelled [m], 0 = nothing.
        measured_m: (H, W) measured depth [m], 0 = none.
        window: rows and columns that hold the objects; a margin around them is looked at, too, so
            that a region is not judged by the part of it that lies on an object.
        intrinsics: the camera.
        config: when a difference is a thing.
    """
    import cv2

    if not config.is_on or not measured_m.any():
        return None
    window = _widened(window, 4 * config.edge_px + config.least_width_px, rendered_m.shape)
    measured, rendered = measured_m[window], rendered_m[window]
    if rendered.size == 0:
        return None
    per_z2 = config.noise_per_z2(intrinsics.fx)
    raw = _is_nearer(measured, rendered, config.base_m, per_z2)
    if _large_cores(raw, config) is None:  # what is asked below is more
        return None
    far = np.where(rendered > 0, rendered, np.float32(np.inf))
    around = np.ones((2 * config.edge_px + 1,) * 2, np.uint8)
    nearest = np.asarray(cv2.erode(far, around, borderType=cv2.BORDER_REPLICATE), np.float32)
    nearest[~np.isfinite(nearest)] = 0
    cores = _large_cores(_is_nearer(measured, nearest, config.base_m, per_z2), config)
    if cores is None:
        return None
    mask = _grown(cores, raw, measured == 0, config)
    return UnmodelledRegion(window=window, mask=mask, depth_m=measured)


def _widened(window: Window, margin: int, shape: tuple[int, ...]) -> Window:
    """Return the window with a margin, inside the image."""
    rows, columns = window
    if rows.stop <= rows.start or columns.stop <= columns.start:
        return slice(0, 0), slice(0, 0)
    return (
        slice(max(0, rows.start - margin), min(shape[0], rows.stop + margin)),
        slice(max(0, columns.start - margin), min(shape[1], columns.stop + margin)),
    )


def _is_nearer(measured: Array32, surface: Array32, base_m: float, per_z2: float) -> Mask:
    """Return where a measurement is nearer than the surface by more than noise explains.

    The noise is that at the surface's depth (0 = no surface), the largest that can be meant.
    """
    limit = surface * np.float32(-per_z2)
    limit += 1
    limit *= surface
    limit -= np.float32(base_m)
    return (measured > 0) & (measured < limit)


def _large_cores(clear: Mask, config: OccluderConfig) -> Mask | None:
    """Return the connected regions that are neither thin nor small; None if there are none."""
    import cv2

    side = config.least_width_px
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    opened = cv2.morphologyEx(clear.astype(np.uint8), cv2.MORPH_OPEN, disc,
                              borderType=cv2.BORDER_REPLICATE)  # fmt: skip
    count, regions, statistics, _ = cv2.connectedComponentsWithStats(opened, connectivity=8)
    areas = np.asarray(statistics)[:, cv2.CC_STAT_AREA]
    large: Mask = np.asarray(areas >= config.least_region_px, dtype=np.bool_)
    large[0] = False  # what is not a region
    if count < 2 or not large.any():
        return None
    return large[np.asarray(regions, dtype=np.int32)]


def _grown(cores: Mask, raw: Mask, unmeasured: Mask, config: OccluderConfig) -> Mask:
    """Return the cores with what belongs to them: their rims over edges, and holes inside them.

    Rims were given up to fattening and opening; they come back within as many pixels.
    """
    import cv2

    kernel = np.ones((3, 3), np.uint8)
    grown = cores.astype(np.uint8)
    allowed = raw.astype(np.uint8)
    for _ in range(config.edge_px + config.least_width_px // 2 + 1):
        grown = np.asarray(cv2.dilate(grown, kernel), np.uint8) & allowed | grown
    wide = np.ones((2 * CLOSING_PX + 1,) * 2, np.uint8)
    closed = cv2.morphologyEx(grown, cv2.MORPH_CLOSE, wide)
    return (grown > 0) | ((np.asarray(closed) > 0) & unmeasured)


# --- The masks of one object in one view, cut out: work is done on the window, not on the image --


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ObjectMasks:
    """One object's masks inside a window of the image that holds all of them."""

    window: Window
    """Rows and columns; empty where the object is out of view."""
    amodal: Mask
    """(h, w) what it would cover if it stood alone."""
    rendered: Mask
    """(h, w) what the scene's other objects and the table leave of that."""
    visible: Mask
    """(h, w) what is left where the measured depth shows something that is not in the scene."""

    @property
    def origin(self) -> tuple[int, int]:
        """Column x and row y of the window's first pixel."""
        return self.window[1].start, self.window[0].start

    def moved(self, box: Bbox) -> Bbox:
        """Return a box (x, y, w, h) of the window in the image."""
        x, y = self.origin
        return NO_BBOX if box == NO_BBOX else (box[0] + x, box[1] + y, box[2], box[3])


def object_masks(
    labels: Labels, instance: int, region: UnmodelledRegion | None = None
) -> ObjectMasks:
    """Return the masks of an object.

    Args:
        labels: the rendered labels of the view.
        instance: the object.
        region: where something that is not in the scene stands in front; None = nowhere.
    """
    window = _tight(labels.amodal[instance], labels.windows[instance])
    rendered = labels.ids[window] == instance
    visible = rendered if region is None else rendered & ~region.over(window)
    return ObjectMasks(
        window=window, amodal=labels.amodal[instance][window], rendered=rendered, visible=visible
    )


def union_of(windows: list[Window]) -> Window:
    """Return the smallest window that holds all of them; an empty one if all are empty."""
    full = [w for w in windows if w[0].stop > w[0].start and w[1].stop > w[1].start]
    if not full:
        return slice(0, 0), slice(0, 0)
    rows, columns = zip(*full, strict=True)
    return (
        slice(min(r.start for r in rows), max(r.stop for r in rows)),
        slice(min(c.start for c in columns), max(c.stop for c in columns)),
    )


def _tight(mask: Mask, window: Window) -> Window:
    """Return the part of a window in which the mask is set."""
    inside = mask[window]
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    if len(rows) == 0:
        return slice(0, 0), slice(0, 0)
    top, left = window[0].start, window[1].start
    return (
        slice(top + int(rows[0]), top + int(rows[-1]) + 1),
        slice(left + int(columns[0]), left + int(columns[-1]) + 1),
    )
