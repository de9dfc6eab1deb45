"""Ambient light on cells of 2 x 2 pixels: gathered there, evened out, and handed to the pixels.

Light that comes from all sides changes slowly along a surface. The cells' rays are shared by a
filter that stops at edges; each pixel then takes from the cells of its own surface.
"""

import numpy as np

from realsim.arrays import Array, Array32, Int32, Rows
from realsim.compiled import njit
from realsim.rendering.embedded.sky_light import SkyArrays, map_at
from realsim.rendering.embedded.surface_table import SurfacePoints

CELL_PX = 2
"""Edge of a cell [px]."""
FILTER_SLOPE = 0.15
"""Neighbours on the same surface rise at most so much out of a cell's plane."""
LEAST_SAME = 0.02
"""A pixel whose cells lie less than this on its surface searches further away."""
SEARCH_CELLS = 2
"""So far, on either side."""


@njit(error_model="numpy")
def cell_pixels(geometry: Int32, height: int, width: int) -> Rows:
    """Return the pixel (rows * columns,) that stands for each cell: its first that meets a mesh.

    Args:
        geometry: (H * W,) placed mesh, -1 = none.
        height: of the image.
        width: of the image.
    """
    rows, columns = (height + CELL_PX - 1) // CELL_PX, (width + CELL_PX - 1) // CELL_PX
    out = np.empty(rows * columns, np.int64)
    for r in range(rows):
        for c in range(columns):
            best = r * CELL_PX * width + c * CELL_PX
            for k in range(CELL_PX * CELL_PX):
                y, x = r * CELL_PX + k // CELL_PX, c * CELL_PX + k % CELL_PX
                if y < height and x < width and geometry[y * width + x] >= 0:
                    best = y * width + x
                    break
            out[r * columns + c] = best
    return out


def taken(points: SurfacePoints, rows: Rows) -> SurfacePoints:
    """Return some points; of their material, which ambient light does not ask for, nothing."""
    none = np.zeros((0, 3), np.float32)
    return SurfacePoints(
        position=points.position[rows],
        flat=points.flat[rows],
        smooth=points.smooth[rows],
        normal=none,
        base=none,
        roughness=none[:, 0],
        metallic=none[:, 0],
        bulge=none[:, 0],
    )


@njit(inline="always", error_model="numpy")
def _same_surface(p: SurfacePoints, i: int, q: SurfacePoints, j: int, slope: float) -> float:
    """Return how far point j of q lies in the plane of point i of p and looks the same way [0, 1].

    From `slope` against the plane on it is 0.
    """
    nx, ny, nz = p.smooth[i, 0], p.smooth[i, 1], p.smooth[i, 2]
    turn = nx * q.smooth[j, 0] + ny * q.smooth[j, 1] + nz * q.smooth[j, 2]
    if turn <= 0.8:
        return 0.0
    x = q.position[j, 0] - p.position[i, 0]
    y = q.position[j, 1] - p.position[i, 1]
    z = q.position[j, 2] - p.position[i, 2]
    off = x * nx + y * ny + z * nz
    near = 1.0 - off * off / (slope * slope * (x * x + y * y + z * z) + 1e-12)
    return max(near, 0.0) * min(5.0 * turn - 4.0, 1.0)


@njit(error_model="numpy")
def edge_filtered(
    values: Array32,
    points: SurfacePoints,
    geometry: Int32,
    size: tuple[int, int],
    taps: tuple[int, int, float],
) -> Array32:
    """Return values (R * C, K) averaged along rows and then along columns, not across edges.

    A joint bilateral filter whose guides are the cells' planes and normals (Eisemann and Durand,
    SIGGRAPH 2004), applied to each axis by itself.

    Args:
        values: of the cells.
        points: what they see.
        geometry: (R * C,) placed mesh, -1 = none; such cells stay zero.
        size: rows and columns of cells.
        taps: neighbours on either side, the outermost by half; their spacing [cells]; and the
            difference of the first value at which they end.
    """
    reach, step, span = taps
    rows, columns = size
    count = values.shape[1]
    source = values
    for axis in range(2):
        target = np.zeros_like(values)
        for i in range(rows * columns):
            if geometry[i] < 0:
                continue
            y, x = i // columns, i % columns
            total = 0.0
            for k in range(-reach, reach + 1):
                u, v = (x + k * step, y) if axis == 0 else (x, y + k * step)
                if u < 0 or v < 0 or u >= columns or v >= rows:
                    continue
                j = v * columns + u
                if geometry[j] < 0:
                    continue
                w = 0.5 if abs(k) == reach else 1.0
                if k != 0:
                    differ = (source[j, 0] - source[i, 0]) / span
                    w *= max(1.0 - differ * differ, 0.0)
                    w *= _same_surface(points, i, points, j, FILTER_SLOPE)
                if w > 0:
                    total += w
                    for c in range(count):
                        target[i, c] += w * source[j, c]
            for c in range(count):
                target[i, c] /= total
        source = target
    return source


@njit(error_model="numpy")
def divide_by_whole(values: Array32) -> None:
    """Turn luminance of the open and of the whole sky (the first two values) into their ratio."""
    for i in range(len(values)):
        values[i, 0] = values[i, 0] / values[i, 1] if values[i, 1] > 0 else 1.0
        values[i, 1] = 1.0


@njit(error_model="numpy")
def spread_cells(
    sky: SkyArrays,
    cells: tuple[SurfacePoints, Int32, Array32],
    pixels: tuple[SurfacePoints, Int32],
    size: tuple[int, int],
    out: Array32,
) -> None:
    """Fill ambient light and open share (N, 4) of the pixels from the cells about them.

    Args:
        sky: the light.
        cells: what they see, their mesh, and their values (R * C, 5): open share of the sky, 1,
            radiance of neighbours.
        pixels: what they see, and their mesh (H * W,), -1 = none.
        size: height and width of the image.
        out: is filled where a mesh is met.
    """
    theirs, mesh, values = cells
    mine, geometry = pixels
    height, width = size
    rows, columns = (height + CELL_PX - 1) // CELL_PX, (width + CELL_PX - 1) // CELL_PX
    found = np.empty(4)
    for i in range(height * width):
        if geometry[i] < 0:
            continue
        y, x = i // width, i % width
        r, c = y // CELL_PX, x // CELL_PX
        total = 0.0
        found[:] = 0.0
        for k in range(4):
            # The cells' pixels are mostly their first: the next cells lie to the right and below.
            dr, dc = k // 2, k % 2
            if dr > y % CELL_PX or dc > x % CELL_PX or r + dr >= rows or c + dc >= columns:
                continue
            j = (r + dr) * columns + c + dc
            if mesh[j] == geometry[i]:
                w = _same_surface(mine, i, theirs, j, FILTER_SLOPE)
                total += w
                _add(values, j, w, found)
        if total < LEAST_SAME:
            total += _add_from_afar(cells, (mine, i, geometry[i]), (r, c, rows, columns), found)
        n = mine.normal[i]
        light = map_at(sky.irradiance, 0, n[0], n[1], n[2])
        if total <= 0:
            total, found[0] = 1.0, 1.0
        for k in range(3):
            out[i, k] = (found[0] * light[k] + found[1 + k]) / total
        out[i, 3] = found[0] / total


@njit(inline="always", error_model="numpy")
def _add(values: Array32, j: int, w: float, found: Array) -> None:
    """Add the values of cell j by the weight w."""
    found[0] += w * values[j, 0]
    found[1] += w * values[j, 2]
    found[2] += w * values[j, 3]
    found[3] += w * values[j, 4]


@njit(error_model="numpy")
def _add_from_afar(
    cells: tuple[SurfacePoints, Int32, Array32],
    pixel: tuple[SurfacePoints, int, int],
    at: tuple[int, int, int, int],
    found: Array,
) -> float:
    """Add what cells further away give to a pixel without one on its surface; return the weight.

    Any cell will do rather than none, the same mesh, direction and place first.
    """
    theirs, mesh, values = cells
    mine, i, geometry = pixel
    r, c, rows, columns = at
    total = 0.0
    for v in range(max(r - SEARCH_CELLS, 0), min(r + SEARCH_CELLS + 1, rows)):
        for u in range(max(c - SEARCH_CELLS, 0), min(c + SEARCH_CELLS + 1, columns)):
            j = v * columns + u
            if mesh[j] < 0:
                continue
            turn, d2 = 0.0, 1e-12
            for k in range(3):
                turn += mine.smooth[i, k] * theirs.smooth[j, k]
                d2 += (mine.position[i, k] - theirs.position[j, k]) ** 2
            w = 1e-6 * max(turn, 0.1) ** 8 / d2
            w *= 1.0 if mesh[j] == geometry else 1e-3
            total += w
            _add(values, j, w, found)
    return total
