"""What the hand meets on a straight move: its boxes swept along a line, exactly.

A box that moves along a line without turning meets a point if, and only if, the point's own line
backwards enters the box within the move's length: three pairs of planes decide (the slab test of
Kay & Kajiya 1986). Nothing is stepped over.
"""

from typing import Any

import numpy as np

from realsim.arrays import Array, Int64
from realsim.compiled import njit
from realsim_sim_bridge.arm.obstacles import CELL_M, Obstacles
from realsim_sim_bridge.grasping.hand_free import OUTWARDS


def first_touched(
    boxes: Array,
    Ts_table_grasp: Array,
    moves: Array,
    obstacles: Obstacles,
    clearance_m: float,
    *,
    own_too: bool,
) -> Int64:
    """Return the instance of an object (N,) that a hand's moving boxes touch, or -1.

    Args:
        boxes: (N, B, 2, 3) least and greatest corner, grasp frame [m].
        Ts_table_grasp: (N, 4, 4) where the move starts.
        moves: (N, 3) the whole move, table axes [m].
        obstacles: points, table frame.
        clearance_m: the boxes are grown by this on all sides [m].
        own_too: whether points on the object that is grasped count.
    """
    return _search(
        boxes + clearance_m * OUTWARDS,
        np.ascontiguousarray(Ts_table_grasp, dtype=np.float64),
        np.ascontiguousarray(moves, dtype=np.float64),
        obstacles,
        own_too,
    )


@njit
def _meets(box: Any, x: Any, move: Any) -> bool:
    """Return whether x - s move is inside the box (2, 3) for an s from 0 to 1."""
    first, last = 0.0, 1.0
    for k in range(3):
        if abs(move[k]) < 1e-12:
            if x[k] <= box[0, k] or x[k] >= box[1, k]:
                return False
            continue
        a, b = (x[k] - box[1, k]) / move[k], (x[k] - box[0, k]) / move[k]
        first, last = max(first, min(a, b)), min(last, max(a, b))
        if first > last:
            return False
    return True


@njit
def _extent(box: Any, T: Any, move: Any, low: Any, high: Any) -> None:
    """Write the corners of the moving box's extent in the table's frame."""
    for r in range(3):
        low[r], high[r] = T[r, 3] + min(move[r], 0.0), T[r, 3] + max(move[r], 0.0)
        for k in range(3):
            a, b = T[r, k] * box[0, k], T[r, k] * box[1, k]
            low[r] += min(a, b)
            high[r] += max(a, b)


@njit
def _touched(box: Any, T: Any, move: Any, obstacles: Any, own_too: bool, room: Any) -> int:
    """Return the instance of an object that one moving box touches, or -1."""
    low, high, x, turned = room
    _extent(box, T, move, low, high)
    for k in range(3):
        turned[k] = T[0, k] * move[0] + T[1, k] * move[1] + T[2, k] * move[2]
    origin, starts, points = obstacles.origin, obstacles.starts, obstacles.points
    nx, ny, nz = obstacles.bound_m.shape
    i0 = max(int(np.floor((low[0] - origin[0]) / CELL_M)), 0)
    i1 = min(int(np.floor((high[0] - origin[0]) / CELL_M)), nx - 1)
    j0 = max(int(np.floor((low[1] - origin[1]) / CELL_M)), 0)
    j1 = min(int(np.floor((high[1] - origin[1]) / CELL_M)), ny - 1)
    k0 = max(int(np.floor((low[2] - origin[2]) / CELL_M)), 0)
    k1 = min(int(np.floor((high[2] - origin[2]) / CELL_M)), nz - 1)
    if k0 > k1:
        return -1
    for i in range(i0, i1 + 1):
        for j in range(j0, j1 + 1):
            cell = (i * ny + j) * nz
            for p in range(starts[cell + k0], starts[cell + k1 + 1]):
                if obstacles.own[p] and not own_too:
                    continue
                dx, dy, dz = points[p, 0] - T[0, 3], points[p, 1] - T[1, 3], points[p, 2] - T[2, 3]
                for k in range(3):
                    x[k] = dx * T[0, k] + dy * T[1, k] + dz * T[2, k]
                if _meets(box, x, turned):
                    return obstacles.instances[p]
    return -1


@njit
def _search(boxes: Any, Ts: Any, moves: Any, obstacles: Any, own_too: bool) -> Any:
    """Return the instance that each hand (N,) touches first, or -1."""
    found = np.full(len(boxes), -1, dtype=np.int64)
    room = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for n in range(len(boxes)):
        for b in range(boxes.shape[1]):
            found[n] = _touched(boxes[n, b], Ts[n], moves[n], obstacles, own_too, room)
            if found[n] >= 0:
                break
    return found
