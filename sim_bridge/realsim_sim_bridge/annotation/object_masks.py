"""The masks of one object in one view, cut out: work is done on the window, not on the image."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.formats.bop.labels import NO_BBOX, Bbox
from realsim.rendering.labels import Labels
from realsim_sim_bridge.annotation.unmodelled import UnmodelledRegion

Mask = NDArray[np.bool_]
Window = tuple[slice, slice]


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
        window=window,
        amodal=labels.amodal[instance][window],
        rendered=rendered,
        visible=visible,
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
