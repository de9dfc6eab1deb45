"""The measured heights as the template matching reads them: cropped, padded, with their bands."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from realsim.registration.search.height_grid import HeightGrid

if TYPE_CHECKING:
    from realsim.registration.search.matching import MatchConfig

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
Ints = NDArray[np.int64]
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


def maps_of(grid: HeightGrid, reach: float, taken: Mask | None, config: "MatchConfig") -> Maps:
    """Return the heights for the kernels."""
    from scipy.ndimage import distance_transform_edt, maximum_filter, minimum_filter

    pad = math.ceil(reach / grid.cell_m) + 2 * config.step_cells
    heights = np.where(np.isnan(grid.heights), UNKNOWN_M, grid.heights).astype(np.float32)
    if taken is not None:
        heights = np.where(taken, np.float32(OCCUPIED_M), heights)
    standing = _standing(heights, config)
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


def _standing(own: Array32, config: "MatchConfig") -> Mask:
    """Return the cells (X, Y) in which something stands and in most cells around, too."""
    from scipy.ndimage import uniform_filter

    above = (own > config.standing_m) & (own < OCCUPIED_M)
    return above & (uniform_filter(above.astype(np.float32), 3) > 0.5)


def _box(standing: Mask, margin: int) -> tuple[Ints, Ints]:
    """Return the first and the last cell (2,), exclusive, of what stands, and a margin around."""
    low, high = np.zeros(2, np.int64), np.zeros(2, np.int64)
    for k in range(2):
        used = np.flatnonzero(standing.any(1 - k))
        if len(used):
            low[k] = max(0, int(used[0]) - margin)
            high[k] = min(standing.shape[k], int(used[-1]) + 1 + margin)
    return low, high


def near_enough(maps: Maps, points: Array32, config: "MatchConfig") -> Mask:
    """Return the cells (X, Y) at which a template can have any score at all.

    Where the nearest thing is further away than half of the template's points are, half of them
    lie in free space.
    """
    reach = float(np.quantile(np.hypot(points[:, 0], points[:, 1]), config.inner_share))
    return maps.free_m <= reach + maps.cell
