"""How far open fingers can be moved together before they come near the object.

A finger that closes through free air costs as many steps as one that presses. What counts is the
object's surface inside the boxes that the fingers sweep; surface outside of an open finger (the
other side of a mug's wall) does not.
"""

from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from realsim.arrays import Array
from realsim.compiled import njit
from realsim.geometry import se3
from realsim.robots.hand import Hand

CLEARANCE_M = 0.004
"""Distance that is left between a finger's face and the object [m]: 20 steps at 0.1 m/s, in which
the finger is at its speed again."""


def surface_triangles(parts: tuple[Array, ...]) -> Array:
    """Return the triangles (T, 3, 3) of the convex hulls of parts (V, 3) [m]."""
    return np.concatenate([part[ConvexHull(part).simplices] for part in parts])


def advanced_fingers(
    triangles_obj: Array, Ts_obj_grasp: Array, openings_m: Array, geometry: Hand
) -> Array:
    """Return the distance (K,) of each finger's face from the middle after the approach [m].

    Never more than half the opening. Where nothing is between the fingers they stay open.

    Args:
        triangles_obj: (T, 3, 3) the object's surface [m].
        Ts_obj_grasp: (K, 4, 4) grasps [m].
        openings_m: (K,) distances of the finger faces [m].
        geometry: sizes of the fingers.
    """
    # All that the finger at +y sweeps: of an arc more than at any one opening.
    zero, widest = np.zeros(1), np.array([geometry.max_opening_m])
    count = len(geometry.finger_boxes)
    swept = geometry.swept_boxes(zero, widest)[0, -geometry.side_boxes :][:count]
    finger = np.stack([swept[:, 0].min(axis=0), swept[:, 1].max(axis=0)])
    halves = np.asarray(openings_m, dtype=np.float64) / 2.0
    Ts_grasp_obj = np.ascontiguousarray(se3.invert(Ts_obj_grasp))
    extents = _extents(np.ascontiguousarray(triangles_obj), Ts_grasp_obj, finger, halves)
    return np.where(extents < 0, halves, np.minimum(halves, extents + CLEARANCE_M))


def _extents_loops(triangles: Any, Ts: Any, finger: Any, halves: Any) -> Any:
    """Return the greatest |y| of the surface inside the sweep (K,); -1 where there is none.

    Each triangle is cut by the sweep's six planes (Sutherland and Hodgman 1974).
    """
    extents = np.full(len(Ts), -1.0)
    polygon, kept = np.empty((9, 3)), np.empty((9, 3))
    low, high = np.empty(3), np.empty(3)
    for k in range(len(Ts)):
        T = Ts[k]
        low[:], high[:] = finger[0], finger[1]
        low[1], high[1] = -halves[k], halves[k]
        for i in range(len(triangles)):
            outside = False
            for axis in range(3):
                for j in range(3):
                    p = triangles[i, j]
                    polygon[j, axis] = (
                        T[axis, 0] * p[0] + T[axis, 1] * p[1] + T[axis, 2] * p[2] + T[axis, 3]
                    )
                least = min(polygon[0, axis], polygon[1, axis], polygon[2, axis])
                most = max(polygon[0, axis], polygon[1, axis], polygon[2, axis])
                if most < low[axis] or least > high[axis]:
                    outside = True
                    break
            if outside:
                continue
            n = 3
            for axis in range(3):
                for side in range(2):
                    sign = 1.0 if side == 0 else -1.0
                    bound = low[axis] if side == 0 else high[axis]
                    m = 0
                    for j in range(n):
                        here, there = polygon[j], polygon[(j + 1) % n]
                        a, b = sign * (here[axis] - bound), sign * (there[axis] - bound)
                        if a >= 0:
                            kept[m] = here
                            m += 1
                        if (a > 0 and b < 0) or (a < 0 and b > 0):
                            kept[m] = here + a / (a - b) * (there - here)
                            m += 1
                    n = m
                    polygon[:n] = kept[:n]
            for j in range(n):
                extents[k] = max(extents[k], abs(polygon[j, 1]))
    return extents


_extents: Any = njit(_extents_loops)
