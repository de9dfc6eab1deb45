"""What an object touches when it is lifted straight up: the same for all its grasps.

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
from realsim_sim_bridge.grasping.candidates import Surroundings

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
