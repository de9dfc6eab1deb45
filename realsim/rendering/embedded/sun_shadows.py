"""Which points a far sun reaches: shadows tested point by point, in the order of the triangles.

Seen along the sun's rays everything is a flat picture, and a point is in shadow if a triangle
covers it there and lies nearer to the sun. The points are sorted into cells, so that a triangle is
tested against few (Aila and Laine, "Alias-free shadow maps", 2004). Nothing is sampled: the outcome
is that of one ray for each point, at a fraction of its cost, and no structure is built for bodies
that move.
"""

from typing import NamedTuple

import numpy as np

from realsim.arrays import Array, Array32, Int32, Int64, Mask
from realsim.compiled import njit

POINTS_A_CELL = 2.0
"""Points of a cell, on average."""
MOST_CELLS = 1024
"""Cells along one side, at most."""


class SortedPoints(NamedTuple):
    """Points in the sun's frame, sorted into cells."""

    points: Array32
    """(N, 3) along the picture's two axes, and towards the sun [m]."""
    order: Int64
    """(M,) numbers of the points that can be lit, cell by cell."""
    first: Int64
    """(R * C + 1,) where each cell begins in `order`."""
    lowest: Array32
    """(R * C,) the point of each cell that is farthest from the sun [m]."""
    grid: Array
    """(5,) first edge along both axes [m], edge of a cell [m], rows, columns."""


@njit(error_model="numpy")
def sort_points(points: Array32) -> SortedPoints:
    """Return points (N, 3) in the sun's frame sorted into cells; rows of NaN are left out."""
    low_a = low_b = np.inf
    high_a = high_b = -np.inf
    count = 0
    for i in range(len(points)):
        if np.isnan(points[i, 0]):
            continue
        count += 1
        a, b = points[i, 0], points[i, 1]
        low_a, high_a, low_b, high_b = min(low_a, a), max(high_a, a), min(low_b, b), max(high_b, b)
    if count == 0:
        low_a, high_a, low_b, high_b = 0.0, 1.0, 0.0, 1.0
    wide, high = max(high_a - low_a, 1e-9), max(high_b - low_b, 1e-9)
    edge = np.sqrt(wide * high * POINTS_A_CELL / max(count, 1))
    edge = max(edge, max(wide, high) / MOST_CELLS)
    columns, rows = int(wide / edge) + 1, int(high / edge) + 1
    cells = np.full(len(points), -1, np.int64)
    first = np.zeros(rows * columns + 1, np.int64)
    lowest = np.full(rows * columns, np.inf, np.float32)
    for i in range(len(points)):
        if np.isnan(points[i, 0]):
            continue
        c = int((points[i, 1] - low_b) / edge) * columns + int((points[i, 0] - low_a) / edge)
        cells[i] = c
        first[c + 1] += 1
        lowest[c] = min(lowest[c], points[i, 2])
    for c in range(rows * columns):
        first[c + 1] += first[c]
    order = np.empty(count, np.int64)
    filled = first[:-1].copy()
    for i in range(len(points)):
        if cells[i] >= 0:
            order[filled[cells[i]]] = i
            filled[cells[i]] += 1
    grid = np.array([low_a, low_b, edge, float(rows), float(columns)])
    return SortedPoints(points, order, first, lowest, grid)


@njit(error_model="numpy")
def cast_shadows(
    sorted_points: SortedPoints, mesh: tuple[Array, Int32], solid: bool, lit: Mask
) -> None:
    """Clear `lit` (N,) where a mesh lies between a point and the sun.

    Args:
        sorted_points: the points.
        mesh: vertices (V, 3) in the sun's frame [m] and faces (F, 3).
        solid: whether it is closed and its faces look outwards: those towards the sun are enough.
        lit: is changed.
    """
    points, order, first, lowest, grid = sorted_points
    vertices, faces = mesh
    rows, columns, a_cell = int(grid[3]), int(grid[4]), 1.0 / grid[2]
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, bx, by = vertices[i, 0], vertices[i, 1], vertices[j, 0], vertices[j, 1]
        cx, cy = vertices[k, 0], vertices[k, 1]
        turn = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if turn == 0.0 or (solid and turn < 0.0):
            continue
        first_x, last_x = (min(ax, bx, cx) - grid[0]) * a_cell, (max(ax, bx, cx) - grid[0]) * a_cell
        first_y, last_y = (min(ay, by, cy) - grid[1]) * a_cell, (max(ay, by, cy) - grid[1]) * a_cell
        if last_x < 0.0 or last_y < 0.0 or first_x >= columns or first_y >= rows:
            continue
        left, right = int(max(first_x, 0.0)), int(min(last_x, columns - 1.0))
        low, high = int(max(first_y, 0.0)), int(min(last_y, rows - 1.0))
        az, bz, cz = vertices[i, 2], vertices[j, 2], vertices[k, 2]
        top = max(az, bz, cz)
        s = 1.0 if turn > 0.0 else -1.0
        for row in range(low, high + 1):
            for column in range(left, right + 1):
                cell = row * columns + column
                if top <= lowest[cell]:
                    continue
                for m in range(first[cell], first[cell + 1]):
                    p = order[m]
                    if not lit[p] or points[p, 2] >= top:
                        continue
                    x, y = float(points[p, 0]), float(points[p, 1])
                    wa = s * ((bx - x) * (cy - y) - (by - y) * (cx - x))
                    wb = s * ((cx - x) * (ay - y) - (cy - y) * (ax - x))
                    wc = s * ((ax - x) * (by - y) - (ay - y) * (bx - x))
                    if wa < 0.0 or wb < 0.0 or wc < 0.0:
                        continue
                    total = wa + wb + wc
                    if wa * az + wb * bz + wc * cz > total * points[p, 2]:
                        lit[p] = False
