"""What all views show from above: the height of the top surface over every cell of the table.

The table's own points count: where only they were measured the height is 0, the space above was
seen free, and nothing can stand there. Where nothing was measured the height is unknown.
"""

import math
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Array32, Int64, Mask
from realsim.compiled import njit
from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.geometry.point_loops import move
from realsim.records import SupportPlane
from realsim.registration.evidence import Cloud

CELL_M = 0.003
"""Edge of a cell [m]: a depth camera resolves 1-2 mm at working distance, and objects of 3 cm
still have 100 cells."""
LOW_M = -0.02
"""Points further below the plane are of other furniture or wrong [m]."""
HIGH_M = 0.5
"""Points higher above the plane are of other furniture or wrong [m]."""
REACH_M = 0.75
"""Cells lie at most so far from the middle of the points, along each axis [m]: the arm reaches
no further, and far walls must not make the grid large."""
BORDER_SHARE = 0.0005
"""Share of the points at either end of an axis that do not widen the grid: stray ones."""
PERCENTILE = 85.0
"""Percentile of a cell's heights that counts: walls put lower points into it, flying pixels
higher ones."""
JUMP_M = 0.010
"""If the top point of a cell is so much above the next one it is left out as flying [m]."""
LAYER_M = 0.004
"""The height is the mean of the points within this of the percentile [m]: of the noisy points
of a flat surface the percentile alone is one sigma too high."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class HeightGrid:
    """Heights of the top surface over the table."""

    heights: Array32
    """(X, Y) over the plane [m]; NaN = never measured."""
    origin: Array
    """(2,) corner of cell (0, 0) in the table's frame [m]."""
    cell_m: float
    """Edge of a cell [m]."""

    def cells(self, xy: Array) -> Int64:
        """Return the cells (..., 2) in which points (..., 2) of the table's frame [m] lie."""
        return np.floor((xy - self.origin) / self.cell_m).astype(np.int64)

    def centers(self) -> Array:
        """Return the middles (X, Y, 2) of the cells in the table's frame [m]."""
        index = np.moveaxis(np.indices(self.heights.shape), 0, -1)
        return self.origin + (index + 0.5) * self.cell_m


def height_grid(cloud: Cloud, plane: SupportPlane) -> HeightGrid:
    """Return the heights over the plane of all views' points, the table's among them.

    Args:
        cloud: in world; raw points or averaged ones.
        plane: what the objects stand on.

    Raises:
        DegenerateError: no point lies over the plane.
    """
    T = se3.invert(plane.T_world_table)
    p = _table_points(np.ascontiguousarray(cloud.points), T, LOW_M, HIGH_M)
    if len(p) == 0:
        raise DegenerateError(
            f"none of {len(cloud.points)} points lies between {LOW_M:g} m and "
            f"{HIGH_M:g} m over the plane. Is its normal up, and is it the objects' table?"
        )
    low, high = _bounds(p)
    shape = np.maximum(np.ceil((high - low) / CELL_M).astype(np.int64), 1)
    heights = _heights(
        p, low, (int(shape[0]), int(shape[1])), CELL_M,
        (PERCENTILE / 100, JUMP_M, LAYER_M),
    )  # fmt: skip
    heights.setflags(write=False)
    return HeightGrid(heights=heights, origin=low, cell_m=CELL_M)


def _bounds(p: Array) -> tuple[Array, Array]:
    """Return the corners (2,), (2,) of the area that points (N, 3) cover, stray ones left out."""
    rank = int(BORDER_SHARE * len(p))
    low, high, middle = np.empty(2), np.empty(2), np.empty(2)
    for k in range(2):
        part = np.partition(p[:, k], [rank, len(p) // 2, len(p) - 1 - rank])
        low[k], middle[k], high[k] = part[rank], part[len(p) // 2], part[len(p) - 1 - rank]
    low = np.maximum(low - CELL_M, middle - REACH_M)
    return low, np.minimum(high + CELL_M, middle + REACH_M)


@njit
def _table_points(points: Array, T: Array, low: float, high: float) -> Array:
    """Return the points (N, 3), moved by T, whose z lies in [low, high]."""
    out = np.empty((len(points), 3))
    n = 0
    for k in range(len(points)):
        x, y, z = move(T, points[k, 0], points[k, 1], points[k, 2])
        if low <= z <= high:
            out[n, 0], out[n, 1], out[n, 2] = x, y, z
            n += 1
    return out[:n]


@njit
def _heights(
    p: Array, origin: Array, shape: tuple[int, int], cell: float, rule: tuple[float, float, float]
) -> Array32:
    """Return the heights (X, Y) of points (N, 3); NaN where there is none.

    The points are sorted into their cells by counting.

    Args:
        p: (N, 3) in the table's frame [m].
        origin: (2,) corner of cell (0, 0) [m].
        shape: of the grid.
        cell: edge of a cell [m].
        rule: percentile / 100, jump [m], thickness of the layer [m].
    """
    columns = shape[1]
    cells = shape[0] * columns
    keys = np.empty(len(p), np.int64)
    first = np.zeros(cells + 1, np.int64)
    for k in range(len(p)):
        i = int(np.floor((p[k, 0] - origin[0]) / cell))
        j = int(np.floor((p[k, 1] - origin[1]) / cell))
        keys[k] = i * columns + j if 0 <= i < shape[0] and 0 <= j < columns else -1
        if keys[k] >= 0:
            first[keys[k] + 1] += 1
    for c in range(cells):
        first[c + 1] += first[c]
    filled = first[:-1].copy()
    sorted_z = np.empty(first[cells], np.float32)
    for k in range(len(p)):
        if keys[k] >= 0:
            sorted_z[filled[keys[k]]] = p[k, 2]
            filled[keys[k]] += 1
    out = np.full(cells, np.nan, np.float32)
    for c in range(cells):
        if first[c + 1] > first[c]:
            out[c] = _top(np.sort(sorted_z[first[c] : first[c + 1]]), rule)
    return out.reshape(shape)


@njit
def _top(z: Array32, rule: tuple[float, float, float]) -> float:
    """Return the height that the ascending heights (N,) of one cell stand for."""
    n = len(z)
    share, jump, layer = rule
    if n > 2 and z[n - 1] - z[n - 2] > jump:
        n -= 1
    top = z[max(0, int(np.ceil(share * n)) - 1)]
    total, count = 0.0, 0
    for k in range(n):
        if abs(z[k] - top) <= layer:
            total += z[k]
            count += 1
    return total / count


UNKNOWN_M = 1e3
"""Height that stands for 'never measured' [m]."""
OCCUPIED_M = 10.0
"""Height that stands for 'another object is there' [m]: higher than any object."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Maps:
    """The measured heights as the kernels read them, padded so that no template leaves them."""

    bands: Array32
    """(X, Y, 3) least and greatest height of the 3 x 3 cells around, and the cell's own [m]."""
    own: Array32
    """(X, Y, 3) three times the cell's own: for the fine comparison."""
    origin: Array
    """(2,) corner of cell (0, 0) in the table's frame [m]."""
    cell: float
    """Edge of a cell [m]."""
    pad: int
    """Cells added at each side."""
    free_m: Array
    """(X, Y) distance to the nearest cell in which something stands [m]."""


def maps_of(
    grid: HeightGrid, reach: float, taken: Mask | None, standing_m: float, step_cells: int
) -> Maps:
    """Return the heights for the kernels.

    Args:
        grid: the measured heights.
        reach: greatest distance of a template's point from its reference point [m].
        taken: (X, Y) cells that other objects explain.
        standing_m: from this height on something stands in a cell [m].
        step_cells: positions are so many cells apart.
    """
    from scipy.ndimage import distance_transform_edt, maximum_filter, minimum_filter

    pad = math.ceil(reach / grid.cell_m) + 2 * step_cells
    heights = np.where(np.isnan(grid.heights), UNKNOWN_M, grid.heights).astype(np.float32)
    if taken is not None:
        heights = np.where(taken, np.float32(OCCUPIED_M), heights)
    standing = _standing(heights, standing_m)
    low_, high_ = _box(standing, math.ceil(reach / grid.cell_m))
    heights = heights[low_[0] : high_[0], low_[1] : high_[1]]
    standing = standing[low_[0] : high_[0], low_[1] : high_[1]]
    own = np.pad(heights, pad, constant_values=UNKNOWN_M)
    real = own < OCCUPIED_M
    low = np.where(real, minimum_filter(np.where(real, own, np.inf), 3), own)
    high = np.where(real, maximum_filter(np.where(real, own, -np.inf), 3), own)
    return Maps(
        bands=np.stack([low, high, own], -1).astype(np.float32),
        own=np.stack([own, own, own], -1),
        origin=grid.origin + (low_ - pad) * grid.cell_m,
        cell=grid.cell_m,
        pad=pad,
        free_m=grid.cell_m
        * np.asarray(distance_transform_edt(np.pad(~standing, pad, constant_values=True))),
    )


def _standing(own: Array32, standing_m: float) -> Mask:
    """Return the cells (X, Y) in which something stands and in most cells around, too."""
    from scipy.ndimage import uniform_filter

    above = (own > standing_m) & (own < OCCUPIED_M)
    return above & (uniform_filter(above.astype(np.float32), 3) > 0.5)


def _box(standing: Mask, margin: int) -> tuple[Int64, Int64]:
    """Return the first and the last cell (2,), exclusive, of what stands, and a margin around."""
    low, high = np.zeros(2, np.int64), np.zeros(2, np.int64)
    for k in range(2):
        used = np.flatnonzero(standing.any(1 - k))
        if len(used):
            low[k] = max(0, int(used[0]) - margin)
            high[k] = min(standing.shape[k], int(used[-1]) + 1 + margin)
    return low, high


def near_enough(maps: Maps, points: Array32, inner_share: float) -> Mask:
    """Return the cells (X, Y) at which a template can have any score at all.

    Where the nearest thing is further away than half of the template's points are, half of them
    lie in free space.
    """
    reach = float(np.quantile(np.hypot(points[:, 0], points[:, 1]), inner_share))
    return maps.free_m <= reach + maps.cell
