"""Top surfaces: what a cloud shows from above, what a mesh would show, and how well they agree.

The height of the top surface over the table is the one thing that 24 views of an object measure
completely. A template is the top surface of a mesh for one direction down; laid over the measured
map at a scale, a yaw and a shift it is judged in both directions: cells where the template is
right, too high (the space was seen free) or too low, and measured area that it leaves uncovered.
Without the last a small scale would win, without the free space a large one.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.arrays import Array, Int64, Mask
from realsim.compiled import njit
from realsim.errors import DegenerateError
from realsim.scanning.scale.shape import ScanShape

FILL_NEIGHBOURS = 5
"""An empty cell with so many of its 8 neighbours measured is a gap of the measurement."""
NEIGHBOURS = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))
RAY_MARGIN = 1.5
"""Rays start so many radii from the centre of the mesh: outside of it."""
RAYS = 1200
"""Rays of each template, over its box."""


LEAST_CELL_M = 0.002
"""Least edge of a cell [m]: clouds are averaged on voxels of about this size."""
COARSE_CELL_M = 0.005
"""Edge of the cells on which the object is told from leftovers of the table [m]: wider than the
gaps in a measured surface."""
CELLS = 2500
"""Cells that the box of the footprint is divided into at most."""
PERCENTILE = 85.0
"""Percentile of a cell's heights that counts: walls put lower points into it, flying pixels
higher ones."""
TOP_CELLS = 3
"""The height of the object is that of so many highest cells at least: one may be a fault."""
LEAST_ISLAND = 0.1
"""Connected areas smaller than this share of the largest are leftovers of the table."""
LEAST_CELLS = 12
"""With fewer cells there is no shape to compare."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class HeightMap:
    """Heights of the top surface over the table, on a grid."""

    heights: Array
    """(X, Y) above the table [m]; 0 = nothing there."""
    origin: Array
    """(2,) corner of cell (0, 0) in the table's frame [m]."""
    cell: float
    """Edge of a cell [m]."""
    top: float
    """Height of the object [m]."""
    area: float
    """Area of the footprint [m^2]."""
    center: Array
    """(2,) centroid of the footprint [m]."""
    spread: Array
    """(2,) standard deviations of the footprint along its main axes, greater first [m]."""
    size: float
    """Greatest of the height and the two extents of the footprint [m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Template:
    """The top surface of the inner mesh, seen against one direction."""

    R: Array
    """(3, 3) turns the direction down to -z."""
    points: Array
    """(K, 3) of the surface, in the mesh's axes, in random order: the first few stand for all."""
    area: float
    """Area of the footprint."""
    height: float
    """Height of the mesh along the direction."""
    center: Array
    """(2,) centroid of the footprint, after R."""
    spread: Array
    """(2,) standard deviations of the footprint along its main axes, greater first."""
    prior: float
    """Added to every score of this direction: 0 for a likely one, negative for a rare one."""
    name: str
    """For the report."""


def height_map(points: Array) -> HeightMap:
    """Return the map of points (N, 3) in the table's frame [m].

    Raises:
        DegenerateError: the points cover too few cells to show a shape.
    """
    above = points[points[:, 2] > 0]
    if len(above) < LEAST_CELLS:
        raise DegenerateError(
            f"{len(above)} of {len(points)} points lie above the table; at least "
            f"{LEAST_CELLS} are needed. Is the plane the object's, and its normal up?"
        )
    above = above[_of_the_object(above)]
    low, high = above[:, :2].min(0), above[:, :2].max(0)
    cell = max(LEAST_CELL_M, float(np.sqrt(np.prod(high - low) / CELLS)))
    origin = above[:, :2].min(0) - cell
    index = np.floor((above[:, :2] - origin) / cell).astype(np.int64)
    shape = index.max(0) + 2
    heights = _percentiles(index @ [shape[1], 1], above[:, 2], int(np.prod(shape)))
    heights = _without_islands(_filled(heights.reshape(shape)), LEAST_ISLAND)
    return _described(heights, origin, cell)


def make_templates(
    shape: ScanShape, rotations: Array, priors: Array, names: list[str]
) -> list[Template]:
    """Return the top surfaces of the inner mesh, seen against each -z.

    Args:
        shape: the mesh.
        rotations: (D, 3, 3); each turns a direction down to -z.
        priors: (D,) see `Template.prior`.
        names: of the directions.
    """
    still = (1.0, np.eye(3), np.zeros(3))
    grids = [_ray_grid(shape.hull @ R.T, RAY_MARGIN * shape.radius) for R in rotations]
    origins = np.concatenate([g @ R for (g, _), R in zip(grids, rotations, strict=True)])
    counts = [len(g) for g, _ in grids]
    directions = np.repeat(-rotations[:, 2], counts, axis=0).astype(np.float32)
    hit_t = np.split(shape.cast(origins, directions, *still), np.cumsum(counts)[:-1])
    rng = np.random.default_rng(0)
    found: list[Template] = []
    for R, (grid, cell), t, prior, name in zip(rotations, grids, hit_t, priors, names, strict=True):
        hits = grid[np.isfinite(t)]
        hits[:, 2] -= t[np.isfinite(t)]
        if len(hits) < 3:
            continue
        hits = hits[rng.permutation(len(hits))]
        center, spread = _center_and_spread(hits[:, :2])
        found.append(
            Template(
                R=R, points=hits @ R, area=len(hits) * cell**2,
                height=float(np.ptp(shape.hull @ R[2])), center=center, spread=spread,
                prior=float(prior), name=name,
            )
        )  # fmt: skip
    return found


def _of_the_object(above: Array) -> Mask:
    """Return which points (N, 3) stand on the largest connected areas, (N,).

    Leftovers of the table far away must not set the size of the cells.
    """
    low, high = np.percentile(above[:, :2], [1, 99], axis=0)
    reach = 1.5 * (high - low) + COARSE_CELL_M
    inside = np.all(np.abs(above[:, :2] - 0.5 * (low + high)) < reach, axis=1)
    # The box may still be metres wide; it never has more cells than this.
    cell = max(COARSE_CELL_M, float(reach.max()) / 200)
    index = np.floor((above[:, :2] - 0.5 * (low + high) + reach) / cell).astype(np.int64)
    index = np.where(inside[:, None], index, 0)
    marked = np.zeros(index.max(0) + 1)
    marked[tuple(index[inside].T)] = 1.0
    return inside & (_without_islands(marked, LEAST_ISLAND)[tuple(index.T)] > 0)


def _percentiles(keys: Int64, z: Array, n: int) -> Array:
    """Return the percentile (n,) of the heights with each key, 0 where there is none."""
    order = np.lexsort((z, keys))
    first = np.searchsorted(keys[order], np.arange(n + 1))
    counts = np.diff(first)
    rank = np.ceil(PERCENTILE / 100 * counts).astype(np.int64) - 1
    pick = np.clip(first[:-1] + rank, 0, len(z) - 1)
    return np.where(counts > 0, z[order][pick], 0.0)


def _filled(heights: Array) -> Array:
    """Return the map with gaps of the measurement filled by the median of their neighbours."""
    for _ in range(2):
        padded = np.pad(heights, 1)
        around = np.stack([np.roll(padded, shift, (0, 1))[1:-1, 1:-1] for shift in NEIGHBOURS])
        gap = (heights == 0) & (np.count_nonzero(around, axis=0) >= FILL_NEIGHBOURS)
        rows = np.sort(around[:, gap], axis=0)
        empty = np.count_nonzero(rows == 0, axis=0)
        middle = empty + (len(rows) - empty) // 2
        heights = heights.copy()
        heights[gap] = rows[middle, np.arange(rows.shape[1])]
    return heights


def _without_islands(heights: Array, least_share: float) -> Array:
    """Return the map without small areas that are not connected with the largest."""
    from scipy.ndimage import binary_dilation, label

    near = np.ones((3, 3))
    # Gaps of one cell do not part a thin object.
    marked: Any = label(binary_dilation(heights > 0, near), near)
    labels = np.where(heights > 0, marked[0], 0)
    counts = np.bincount(labels.ravel())
    counts[0] = 0
    return np.where((counts >= least_share * counts.max())[labels], heights, 0.0)


def _described(heights: Array, origin: Array, cell: float) -> HeightMap:
    """Return the map with the figures of its footprint."""
    used = np.argwhere(heights > 0)
    if len(used) < LEAST_CELLS:
        raise DegenerateError(
            f"the points above the table cover {len(used)} cells of {1e3 * cell:.1f} mm; at least "
            f"{LEAST_CELLS} are needed to compare shapes."
        )
    xy = origin + (used + 0.5) * cell
    center, spread = _center_and_spread(xy)
    z = np.sort(heights[heights > 0])
    top = float(z[-min(TOP_CELLS, len(z))])
    return HeightMap(
        heights=heights,
        origin=origin,
        cell=cell,
        top=top,
        area=len(used) * cell**2,
        center=center,
        spread=spread,
        size=max(top, float(np.ptp(xy, axis=0).max())),
    )


def _center_and_spread(xy: Array) -> tuple[Array, Array]:
    """Return the centroid (2,) and the standard deviations (2,) along the main axes."""
    center = xy.mean(0)
    values = np.linalg.eigvalsh((xy - center).T @ (xy - center) / len(xy))
    return center, np.sqrt(np.clip(values[::-1], 0, None))


def _ray_grid(turned: Array, height: float) -> tuple[Array, float]:
    """Return where rays start (N, 3) over the box of turned vertices, and the edge of a cell."""
    low, high = turned[:, :2].min(0), turned[:, :2].max(0)
    extent = np.maximum(high - low, 1e-3 * height)
    cell = float(np.sqrt(np.prod(extent) / RAYS))
    counts = np.maximum(1, np.round(extent / cell)).astype(int)
    x, y = (low[k] + (np.arange(counts[k]) + 0.5) * extent[k] / counts[k] for k in (0, 1))
    grid = np.stack([*np.meshgrid(x, y, indexing="ij"), np.full(tuple(counts), height)], -1)
    return grid.reshape(-1, 3), float(np.sqrt(np.prod(extent / counts)))


@njit(inline="always")
def _agreement(model: float, measured: float, tolerance: float, low_cost: float) -> float:
    """Return +1 where heights [m] agree, down to -1 where the space was seen free.

    Args:
        model: height of the template.
        measured: height of the map, 0 = the table.
        tolerance: up to which heights agree; from three times it on they do not at all.
        low_cost: cost of a model that is lower than the measurement.
    """
    if measured <= 0.0:
        return -min(1.0, model / tolerance)
    gap = model - measured
    if gap >= 0.0:
        return max(-1.0, min(1.0, 2.0 - gap / tolerance))
    return max(-low_cost, min(1.0, 1.0 + (1.0 + low_cost) * 0.5 * (1.0 + gap / tolerance)))


def scan_map(
    measured: HeightMap, points: Array, area: float, scales: Array, turns: Array, centers: Array,
    rule: tuple[float, float, float, float],
) -> Array:  # fmt: skip
    """Return the agreement (S, Y, H), in [-2, 1], of a template with the map.

    (sum of a f - cost * uncovered area) / the greater of both areas, a = area of one cell.

    Args:
        measured: the map.
        points: (K, 3) of the template, turned, its foot's centre at the origin.
        area: of its footprint.
        scales: (S,).
        turns: (Y, 2) cosine and sine of the yaws.
        centers: (H, 2) places of the foot's centre [m].
        rule: tolerance [m], cost of a low model, cost of uncovered area, height below which a
            model is not told from the table [m]: the floor of an open vessel.
    """
    place = (*measured.origin, measured.cell)
    footprint = (float(measured.area), float(area))
    return _scan(measured.heights, place, footprint, points, scales, turns, centers, rule)


@njit
def _scan(
    heights: Array, place: tuple[float, float, float], areas: tuple[float, float], points: Array,
    scales: Array, turns: Array, centers: Array, rule: tuple[float, float, float, float],
) -> Array:  # fmt: skip
    """Return what `scan_map` does."""
    out = np.empty((len(scales), len(turns), len(centers)))
    n = len(points)
    for s in range(len(scales)):
        share = areas[1] * scales[s] * scales[s] / n
        for y in range(len(turns)):
            c, d = scales[s] * turns[y, 0], scales[s] * turns[y, 1]
            for h in range(len(centers)):
                total, covered, counted = 0.0, 0, 0
                for k in range(n):
                    x = c * points[k, 0] - d * points[k, 1] + centers[h, 0]
                    v = d * points[k, 0] + c * points[k, 1] + centers[h, 1]
                    i = int(np.floor((x - place[0]) / place[2]))
                    j = int(np.floor((v - place[1]) / place[2]))
                    measured = 0.0
                    if 0 <= i < heights.shape[0] and 0 <= j < heights.shape[1]:
                        measured = heights[i, j]
                    z = scales[s] * points[k, 2]
                    if measured > 0.0 or z > rule[3]:
                        covered += measured > 0.0
                        counted += 1
                        total += _agreement(z, measured, rule[0], rule[1])
                uncovered = max(0.0, areas[0] - share * covered)
                out[s, y, h] = (share * total - rule[2] * uncovered) / max(
                    areas[0], share * counted
                )
    return out
