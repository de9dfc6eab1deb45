"""Whether the hand's boxes are free of points and above the table.

Compiled, because thousands of hands meet thousands of points.
"""

from typing import Any

import numpy as np

from realsim.arrays import Array, Int64, Mask
from realsim.compiled import njit

OUTWARDS = np.array([[-1.0], [1.0]])
"""Ways in which the least and the greatest corner of a box move when it grows."""
STRIDE = 61
"""The points are looked at in steps of this (and then the rest), so that a hand that is not free is
found out early; a matter of speed alone."""


def lowest_corner(boxes: Array, Ts_table_grasp: Array) -> Array:
    """Return the least height (N,) [m] of the corners of the boxes (N, B, 2, 3) over the table."""
    up = Ts_table_grasp[:, None, 2, :3]
    least = np.minimum(boxes[:, :, 0] * up, boxes[:, :, 1] * up).sum(axis=-1)
    return least.min(axis=1) + Ts_table_grasp[:, 2, 3]


def boxes_free(boxes: Array, Ts_a_grasp: Array, points_a: Array, clearance_m: float) -> Mask:
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
) -> Int64:
    """Return the number (N,) of a point in one of hand n's grown boxes, or -1; as `boxes_free`."""
    grown = boxes + clearance_m * OUTWARDS
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
