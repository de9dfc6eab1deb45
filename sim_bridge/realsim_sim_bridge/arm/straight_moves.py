"""What the hand meets on a straight move: its boxes swept along a line, exactly.

A box that moves along a line without turning meets a point if, and only if, the point's own line
backwards enters the box within the move's length: three pairs of planes decide (the slab test of
Kay & Kajiya 1986). Nothing is stepped over.

What an object touches when it is lifted straight up: the same for all its grasps.

Objects are points on their surfaces. A neighbour's point is in the way if it stands above a point
of the object, nearer to its vertical line than the clearance and within the lift's height. Objects
that stand or lean together are nearer than that from the beginning, and sliding along each other is
no obstacle: of such a neighbour a point is in the way only if the object lies beneath it on all
sides, that is in each of eight directions around it.
"""

from typing import Any

import numpy as np

from realsim.arrays import Array, Int64
from realsim.compiled import njit
from realsim_sim_bridge.arm.obstacles import CELL_M, Obstacles
from realsim_sim_bridge.grasping.candidates import Surroundings
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


SECTORS = 8
"""Directions around a neighbour's point. Where all hold points of the object, the point is at least
0.7 clearances inside its outline: the nearest wall is seen at no more than 45 deg."""


def touched_when_lifted(
    obj: Surroundings, neighbours: Surroundings, lift_m: float, clearance_m: float
) -> int | None:
    """Return the instance of a neighbour that the object touches while it is lifted, or None.

    Args:
        obj: points on the object, table frame.
        neighbours: points on the others.
        lift_m: how far straight up it is lifted [m].
        clearance_m: distance that must be kept sideways [m]; about the points' spacing, or the
            lifted object slips between them.
    """
    if len(obj.points) == 0 or len(neighbours.points) == 0:
        return None
    low, high = obj.points.min(axis=0), obj.points.max(axis=0)
    low, high = low - clearance_m, high + clearance_m
    high[2] += lift_m
    near = np.all((neighbours.points > low) & (neighbours.points < high), axis=1)
    points, instances = neighbours.points[near], neighbours.instances[near]
    grid = _column_grid(obj.points, clearance_m)
    above, beneath, gap = _look_up(points, *grid, lift_m, clearance_m)
    for instance in np.unique(instances).tolist():
        mine = instances == instance
        stands_apart = gap[mine].min() >= clearance_m
        blocked = above[mine] if stands_apart else beneath[mine] == 2**SECTORS - 1
        if blocked.any():
            return int(instance)
    return None


def _column_grid(points: Array, size_m: float) -> tuple[Array, Int64, Array, float]:
    """Return the points sorted by square columns, the columns' starts, their origin and size."""
    # A clearance far below the points' spacing would make more columns than there are points.
    extent = np.ptp(points[:, :2], axis=0)
    size = max(size_m, float(extent.max()) / 500)
    origin = points[:, :2].min(axis=0) - 2.5 * size
    shape = np.floor((points[:, :2].max(axis=0) - origin) / size).astype(np.int64) + 4
    cells = np.floor((points[:, :2] - origin) / size).astype(np.int64)
    flat = cells[:, 0] * shape[1] + cells[:, 1]
    order = np.argsort(flat, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(flat, minlength=int(shape.prod())))])
    table = starts.astype(np.int64).copy()
    table = np.concatenate([shape, table])
    return np.ascontiguousarray(points[order]), table, origin, size


def _look_up_loops(
    neighbours: Any, points: Any, table: Any, origin: Any, size: float, lift: float, clear: float
) -> Any:
    """Return for each neighbour's point (M,): in the way, sectors beneath it (bits), distance [m].

    The distance is to the nearest of the object's points in the columns around, or infinite.
    """
    above = np.zeros(len(neighbours), dtype=np.bool_)
    sectors = np.zeros(len(neighbours), dtype=np.int64)
    gap = np.full(len(neighbours), np.inf)
    nx, ny = table[0], table[1]
    for m in range(len(neighbours)):
        i = int(np.floor((neighbours[m, 0] - origin[0]) / size))
        j = int(np.floor((neighbours[m, 1] - origin[1]) / size))
        for a in range(max(i - 2, 0), min(i + 3, nx)):
            for b in range(max(j - 2, 0), min(j + 3, ny)):
                cell = 2 + a * ny + b
                for p in range(table[cell], table[cell + 1]):
                    dx, dy = points[p, 0] - neighbours[m, 0], points[p, 1] - neighbours[m, 1]
                    rise = neighbours[m, 2] - points[p, 2]
                    across = np.sqrt(dx * dx + dy * dy)
                    gap[m] = min(gap[m], np.sqrt(across * across + rise * rise))
                    if rise <= 0.0 or rise > lift + clear or across > 2 * clear:
                        continue
                    above[m] |= across < clear
                    if across >= clear:
                        sector = int((np.arctan2(dy, dx) + np.pi) / (2 * np.pi) * 8) % 8
                        sectors[m] |= 1 << sector
    return above, sectors, gap


_look_up = njit(_look_up_loops)
