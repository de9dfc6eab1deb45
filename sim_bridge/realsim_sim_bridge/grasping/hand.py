"""The Franka Hand: its sizes, and its boxes for collision checks.

Everything is in frame `grasp`: origin between the fingertips (Franka's tool centre point), z =
approach, y = closing axis. The hand's mounting face is at z = -0.1034 m.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.compiled import njit

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class HandGeometry:
    """Sizes of the Franka Hand."""

    max_opening_m: float = 0.080
    """Distance of the finger faces when fully open [m]; the paper's and the datasheet's."""
    finger_length_m: float = 0.050
    """Length of a finger, up from its tip [m]; the paper's."""
    tip_beyond_tcp_m: float = 0.0088
    """How far the fingers reach past the tool centre point [m]: tips are 0.1122 m from the mounting
    face (franka_description), the tool centre point 0.1034 m."""
    finger_width_m: float = 0.020
    """Width of a finger across the closing axis [m] (franka_description: 17.5 to 22 mm)."""
    finger_thickness_m: float = 0.015
    """Thickness of a finger along the closing axis [m] (franka_description: 15.2 mm at the tip)."""
    mount_z_m: float = -0.1034
    """z of the mounting face [m]: minus the tool centre point's distance of Franka's own setup."""
    palm_face_z_m: float = -0.0376
    """z of the palm's outer face [m]: the hand's body is 65.8 mm high."""
    palm_width_m: float = 0.204
    """Extent of the palm along the closing axis [m]."""
    palm_depth_m: float = 0.063
    """Extent of the palm across the closing axis [m]."""

    def boxes(self, openings_m: NDArray[np.float64] | float) -> Array:
        """Return the hand's three boxes (N, 3, 2, 3) [m]: palm, finger at -y, finger at +y.

        Args:
            openings_m: (N,) distances of the finger faces [m].
        """
        half = np.atleast_1d(np.asarray(openings_m, dtype=np.float64)) / 2.0
        outer = half + self.finger_thickness_m
        return self._boxes(half, outer)

    def swept_boxes(self, widths_m: Array, openings_m: Array) -> Array:
        """Return the boxes (N, 3, 2, 3) [m] swept while the fingers close to `widths_m` (N,)."""
        return self._boxes(widths_m / 2.0, openings_m / 2.0 + self.finger_thickness_m)

    def _boxes(self, inner: Array, outer: Array) -> Array:
        """Return palm and fingers, the fingers between |y| = inner and outer (N,)."""
        x, tip = self.finger_width_m / 2.0, self.tip_beyond_tcp_m
        boxes = np.empty((len(inner), 3, 2, 3))
        boxes[:, 0, 0] = [-self.palm_depth_m / 2, -self.palm_width_m / 2, self.mount_z_m]
        boxes[:, 0, 1] = [self.palm_depth_m / 2, self.palm_width_m / 2, self.palm_face_z_m]
        boxes[:, 1:, 0, 0], boxes[:, 1:, 1, 0] = -x, x
        boxes[:, 1:, 0, 2], boxes[:, 1:, 1, 2] = tip - self.finger_length_m, tip
        boxes[:, 1, 0, 1], boxes[:, 1, 1, 1] = -outer, -inner
        boxes[:, 2, 0, 1], boxes[:, 2, 1, 1] = inner, outer
        return boxes


# --- Whether the hand's boxes are free of points and above the table -----------------------------
# Compiled, because thousands of hands meet thousands of points.


STRIDE = 61
"""The points are looked at in steps of this (and then the rest), so that a hand that is not free is
found out early; a matter of speed alone."""


def lowest_corner(boxes: Array, Ts_table_grasp: Array) -> Array:
    """Return the least height (N,) [m] of the corners of the boxes (N, B, 2, 3) over the table."""
    up = Ts_table_grasp[:, None, 2, :3]
    least = np.minimum(boxes[:, :, 0] * up, boxes[:, :, 1] * up).sum(axis=-1)
    return least.min(axis=1) + Ts_table_grasp[:, 2, 3]


def boxes_free(
    boxes: Array, Ts_a_grasp: Array, points_a: Array, clearance_m: float
) -> NDArray[np.bool_]:
    """Return whether no point is in any box or nearer than the clearance (N,).

    Args:
        boxes: (N, B, 2, 3) least and greatest corner, grasp frame [m].
        Ts_a_grasp: (N, 4, 4).
        points_a: (P, 3) [m].
        clearance_m: the boxes are grown by this on all sides [m].
    """
    return first_point_inside(boxes, Ts_a_grasp, points_a, clearance_m) < 0


def first_point_inside(
    boxes: Array, Ts_a_grasp: Array, points_a: Array, clearance_m: float
) -> NDArray[np.int64]:
    """Return the number (N,) of a point in one of hand n's grown boxes, or -1; as `boxes_free`."""
    grown = boxes.astype(np.float64, copy=True)
    grown[:, :, 0] -= clearance_m
    grown[:, :, 1] += clearance_m
    return _search(grown, np.ascontiguousarray(Ts_a_grasp), np.ascontiguousarray(points_a))


def _search_loops(boxes: Any, Ts: Any, points: Any) -> Any:
    """Return the number of the first point found inside any box, per hand, or -1."""
    found = np.full(len(boxes), -1, dtype=np.int64)
    count = boxes.shape[1]
    for n in range(len(boxes)):
        low, high = boxes[n, 0, 0].copy(), boxes[n, 0, 1].copy()
        for b in range(1, count):
            for k in range(3):
                low[k] = min(low[k], boxes[n, b, 0, k])
                high[k] = max(high[k], boxes[n, b, 1, k])
        for first in range(STRIDE):
            if found[n] >= 0:
                break
            for p in range(first, len(points), STRIDE):
                dx = points[p, 0] - Ts[n, 0, 3]
                dy = points[p, 1] - Ts[n, 1, 3]
                dz = points[p, 2] - Ts[n, 2, 3]
                z = dx * Ts[n, 0, 2] + dy * Ts[n, 1, 2] + dz * Ts[n, 2, 2]
                if z <= low[2] or z >= high[2]:
                    continue
                x = dx * Ts[n, 0, 0] + dy * Ts[n, 1, 0] + dz * Ts[n, 2, 0]
                if x <= low[0] or x >= high[0]:
                    continue
                y = dx * Ts[n, 0, 1] + dy * Ts[n, 1, 1] + dz * Ts[n, 2, 1]
                for b in range(count):
                    box = boxes[n, b]
                    if (
                        box[0, 0] < x < box[1, 0]
                        and box[0, 1] < y < box[1, 1]
                        and box[0, 2] < z < box[1, 2]
                    ):
                        found[n] = p
                        break
                if found[n] >= 0:
                    break
    return found


_search = njit(_search_loops)
