"""Points on the objects, made quick to ask: how far are they at least, and which is within reach.

A grid of cells holds for each cell a lower bound of the distance from anywhere in it to any point:
the distance from its box to the nearest box with a point in it. Where that is not enough the points
themselves are asked, which lie sorted by cell.
"""

from typing import Any, NamedTuple

import numpy as np

from realsim.arrays import Array, Array32, Int64, Mask
from realsim.compiled import njit

CELL_M = 0.0125
"""Edge of a cell [m]: the bound is short of the distance by a cell or so."""
FAR_CELLS = 14
"""Distances are known up to so many cells (17 cm); the bound is no greater."""


class Obstacles(NamedTuple):
    """Points on objects in a grid; a tuple, so that compiled code takes it."""

    origin: Array
    """(3,) corner of the grid [m]."""
    bound_m: Array32
    """(X, Y, Z) least distance from anywhere in the cell to a point [m]."""
    starts: Int64
    """(X Y Z + 1,) first point of each cell."""
    points: Array
    """(P, 3) sorted by cell [m]."""
    instances: Int64
    """(P,) instance number of each."""
    own: Mask
    """(P,) whether the point is on the object that is to be grasped."""
    box: Array
    """(2, 3) least and greatest corner of the points [m]."""


def obstacles_of(points: Array, instances: Int64, own: Mask) -> Obstacles:
    """Return the points (P, 3) [m] of instances (P,) in a grid."""
    if len(points) == 0:
        nowhere = np.full((1, 3), 1e6)
        return obstacles_of(nowhere, np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.bool_))
    box = np.stack([points.min(axis=0), points.max(axis=0)])
    origin = box[0] - (FAR_CELLS + 0.5) * CELL_M
    shape = np.floor((box[1] - origin) / CELL_M).astype(np.int64) + FAR_CELLS + 1
    cells = np.floor((points - origin) / CELL_M).astype(np.int64)
    flat = (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]
    counts = np.bincount(flat, minlength=int(shape.prod()))
    order = np.argsort(flat, kind="stable")
    return Obstacles(
        origin=origin,
        bound_m=_bounds(counts.reshape(shape) > 0),
        starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        points=np.ascontiguousarray(points[order], dtype=np.float64),
        instances=np.ascontiguousarray(instances[order], dtype=np.int64),
        own=np.ascontiguousarray(own[order], dtype=np.bool_),
        box=box,
    )


@njit
def _bounds(occupied: Any) -> Any:
    """Return the distance (X, Y, Z) [m] from each cell's box to the nearest occupied one.

    Along an axis, boxes k cells apart have a gap of k - 1 cells; the squares add up over the axes,
    so that the least is found one axis after the other. Distances end at `FAR_CELLS`.
    """
    nx, ny, nz = occupied.shape
    squared = np.empty((nx, ny, nz), dtype=np.int32)
    for i in range(nx):
        for j in range(ny):
            gap = FAR_CELLS + 1
            for k in range(nz):
                gap = 0 if occupied[i, j, k] else gap + 1
                squared[i, j, k] = min(max(gap - 1, 0), FAR_CELLS) ** 2
            gap = FAR_CELLS + 1
            for k in range(nz - 1, -1, -1):
                gap = 0 if occupied[i, j, k] else gap + 1
                squared[i, j, k] = min(squared[i, j, k], min(max(gap - 1, 0), FAR_CELLS) ** 2)
    far = FAR_CELLS**2
    along_y = np.full((nx, ny, nz), far, dtype=np.int32)
    for i in range(nx):
        for j in range(ny):
            for other in range(max(j - FAR_CELLS, 0), min(j + FAR_CELLS + 1, ny)):
                gap = max(abs(other - j) - 1, 0) ** 2
                for k in range(nz):
                    along_y[i, j, k] = min(along_y[i, j, k], squared[i, other, k] + gap)
    squared[:] = far
    for i in range(nx):
        for other in range(max(i - FAR_CELLS, 0), min(i + FAR_CELLS + 1, nx)):
            gap = max(abs(other - i) - 1, 0) ** 2
            for j in range(ny):
                for k in range(nz):
                    squared[i, j, k] = min(squared[i, j, k], along_y[other, j, k] + gap)
    return (np.sqrt(squared) * CELL_M).astype(np.float32)


@njit
def least_distance(obstacles: Any, x: float, y: float, z: float) -> float:
    """Return a lower bound of the distance [m] from (x, y, z) to any point."""
    origin, bound, box = obstacles.origin, obstacles.bound_m, obstacles.box
    i = int(np.floor((x - origin[0]) / CELL_M))
    j = int(np.floor((y - origin[1]) / CELL_M))
    k = int(np.floor((z - origin[2]) / CELL_M))
    nx, ny, nz = bound.shape
    if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
        near = float(bound[i, j, k])
        if near < (FAR_CELLS - 1) * CELL_M:
            return near
    dx = max(box[0, 0] - x, 0.0, x - box[1, 0])
    dy = max(box[0, 1] - y, 0.0, y - box[1, 1])
    dz = max(box[0, 2] - z, 0.0, z - box[1, 2])
    outside = np.sqrt(dx * dx + dy * dy + dz * dz)
    if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
        return max(outside, (FAR_CELLS - 1) * CELL_M)
    return outside


@njit
def nearest_within(obstacles: Any, x: float, y: float, z: float, radius: float) -> Any:
    """Return the distance [m] to the nearest point within `radius` and its row, or (inf, -1)."""
    origin, starts, points = obstacles.origin, obstacles.starts, obstacles.points
    nx, ny, nz = obstacles.bound_m.shape
    i0 = max(int(np.floor((x - radius - origin[0]) / CELL_M)), 0)
    i1 = min(int(np.floor((x + radius - origin[0]) / CELL_M)), nx - 1)
    j0 = max(int(np.floor((y - radius - origin[1]) / CELL_M)), 0)
    j1 = min(int(np.floor((y + radius - origin[1]) / CELL_M)), ny - 1)
    k0 = max(int(np.floor((z - radius - origin[2]) / CELL_M)), 0)
    k1 = min(int(np.floor((z + radius - origin[2]) / CELL_M)), nz - 1)
    best, row = radius * radius, -1
    if k0 <= k1:
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                cell = (i * ny + j) * nz
                for p in range(starts[cell + k0], starts[cell + k1 + 1]):
                    dx, dy, dz = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
                    squared = dx * dx + dy * dy + dz * dz
                    if squared < best:
                        best, row = squared, p
    return (np.sqrt(best) if row >= 0 else np.inf), row
