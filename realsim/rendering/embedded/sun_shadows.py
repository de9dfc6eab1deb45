"""Which points a far sun reaches: shadows tested point by point, in the order of the triangles.

Seen along the sun's rays everything is a flat picture, and a point is in shadow if a triangle
covers it there and lies nearer to the sun. The points are sorted into cells, so that a triangle is
tested against few (Aila and Laine, "Alias-free shadow maps", 2004). Nothing is sampled: the outcome
is that of one ray for each point, at a fraction of its cost, and no structure is built for bodies
that move. What happens to a point does not depend on the others.
"""

from typing import NamedTuple

import numpy as np

from realsim.arrays import Array, Array32, Int32, Int64, Mask
from realsim.compiled import njit

POINTS_A_CELL = 1.5
"""Points of a cell, on average, where they are many."""
FEWEST_CELLS = 25_000.0
"""Few points lie in clusters, such as along edges: without so many cells a few would hold all."""
MOST_CELLS = 4096
"""Cells along one side, at most."""
BLOCK = 16
"""Points that a processor tests at once; blocks of x, y and z of so many follow one another."""

Lines = tuple[float, float, float, float, float, float, float, float, float, float, float, float]


class SortedPoints(NamedTuple):
    """Points in the sun's frame, sorted into cells."""

    points: Array32
    """(3, M) those that can be lit, cell by cell: along both axes, towards the sun [m]."""
    order: Int32
    """(M,) their numbers."""
    first: Int32
    """(R * C + 1,) where each cell begins; those of a row follow one another."""
    lowest: Array32
    """(R,) the point of each row that is farthest from the sun [m]."""
    grid: Array
    """(5,) first edge along both axes [m], cells per metre, rows, columns."""


class SunBodies(NamedTuple):
    """Meshes as the sun sees them, one after another."""

    vertices: Array
    """(V, 3) in the sun's frame [m]."""
    faces: Int32
    """(F, 3)."""
    first_face: Int64
    """(G + 1,) first face of each mesh."""
    is_solid: Mask
    """(G,) whether it is closed and its faces look outwards: those towards the sun are enough."""


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
    edge = np.sqrt(wide * high / max(count / POINTS_A_CELL, FEWEST_CELLS))
    a_metre = 1.0 / max(edge, max(wide, high) / MOST_CELLS)
    columns, rows = int(wide * a_metre) + 1, int(high * a_metre) + 1
    cells = np.full(len(points), -1, np.int32)
    first = np.zeros(rows * columns + 1, np.int32)
    lowest = np.full(rows, np.inf, np.float32)
    for i in range(len(points)):
        if np.isnan(points[i, 0]):
            continue
        row = int((points[i, 1] - low_b) * a_metre)
        cells[i] = row * columns + int((points[i, 0] - low_a) * a_metre)
        first[cells[i]] += 1
        lowest[row] = min(lowest[row], points[i, 2])
    for c in range(rows * columns):
        first[c + 1] += first[c]
    order = np.empty(count, np.int32)
    kept = np.empty((3, count), np.float32)
    for i in range(len(points) - 1, -1, -1):
        if cells[i] >= 0:
            first[cells[i]] -= 1
            m = first[cells[i]]
            order[m] = i
            kept[0, m], kept[1, m], kept[2, m] = points[i]
    grid = np.array([low_a, low_b, a_metre, float(rows), float(columns)])
    return SortedPoints(kept, order, first, lowest, grid)


@njit(allocates=False)
def _cover(blocks: Array32, first: int, last: int, lines: Lines) -> None:
    """Put z to inf for the points of blocks first..last that lie under a triangle.

    `lines` are g, h, e of its sides and of its height, g x + h y + e; without branches and with
    places that cannot be negative, the inner loop is one instruction for a block.
    """
    fa, pa, qa, fb, pb, qb, fc, pc, qc, fz, pz, qz = lines
    for block in range(first, last + 1):
        at = np.uint64(block * 3 * BLOCK)
        for n in range(BLOCK):
            m = at + np.uint64(n)
            x, y, z = blocks[m], blocks[m + np.uint64(BLOCK)], blocks[m + np.uint64(2 * BLOCK)]
            inside = (fa * x + pa * y + qa >= 0.0) & (fb * x + pb * y + qb >= 0.0)
            inside = inside & (fc * x + pc * y + qc >= 0.0) & (fz * x + pz * y + qz > z)
            blocks[m + np.uint64(2 * BLOCK)] = np.float32(np.inf) if inside else z


@njit(error_model="numpy")
def cast_shadows(sorted_points: SortedPoints, bodies: SunBodies, numbers: Int64, lit: Mask) -> None:
    """Clear `lit` (N,) where one of the meshes `numbers` lies between a point and the sun."""
    points, order, first, lowest, grid = sorted_points
    vertices, faces, first_face, is_solid = bodies
    low_a, low_b, a_metre, rows, columns = grid[0], grid[1], grid[2], int(grid[3]), int(grid[4])
    blocks = np.full((len(order) // BLOCK + 1) * 3 * BLOCK, np.float32(np.inf), np.float32)
    for m in range(len(order)):
        at = m // BLOCK * 3 * BLOCK + m % BLOCK
        blocks[at], blocks[at + BLOCK] = points[0, m], points[1, m]
        if lit[order[m]]:  # nothing is above what is in shadow already
            blocks[at + 2 * BLOCK] = points[2, m]
    for number in numbers:
        for f in range(first_face[number], first_face[number + 1]):
            i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
            ax, ay, bx, by = vertices[i, 0], vertices[i, 1], vertices[j, 0], vertices[j, 1]
            cx, cy, cz = vertices[k, 0], vertices[k, 1], vertices[k, 2]
            az, bz = vertices[i, 2], vertices[j, 2]
            turn = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
            if turn == 0.0 or (is_solid[number] and turn < 0.0):
                continue
            x0, x1, y0, y1 = min(ax, bx, cx), max(ax, bx, cx), min(ay, by, cy), max(ay, by, cy)
            first_x, last_x = (x0 - low_a) * a_metre, (x1 - low_a) * a_metre
            first_y, last_y = (y0 - low_b) * a_metre, (y1 - low_b) * a_metre
            if last_x < 0.0 or last_y < 0.0 or first_x >= columns or first_y >= rows:
                continue
            left, right = int(max(first_x, 0.0)), int(min(last_x, columns - 1.0))
            low, high = int(max(first_y, 0.0)), int(min(last_y, rows - 1.0))
            top, s = max(az, bz, cz), 1.0 if turn > 0.0 else -1.0
            # The sides as lines g x + h y + e, positive inside: two triangles have the one that
            # they share with opposite signs, so that no point slips through. Then the plane.
            ga, ha, ea = s * (by - cy), s * (cx - bx), s * (bx * cy - by * cx)
            gb, hb, eb = s * (cy - ay), s * (ax - cx), s * (cx * ay - cy * ax)
            gc, hc, ec = s * (ay - by), s * (bx - ax), s * (ax * by - ay * bx)
            u, v = (bz - az) / turn, (cz - az) / turn
            gz, hz = u * (cy - ay) - v * (by - ay), v * (bx - ax) - u * (cx - ax)
            ez = az - gz * ax - hz * ay
            lines = (ga, ha, ea, gb, hb, eb, gc, hc, ec, gz, hz, ez)
            for row in range(low, high + 1):
                if top <= lowest[row]:
                    continue
                start, stop = first[row * columns + left], first[row * columns + right + 1]
                if start < stop:
                    _cover(blocks, start // BLOCK, (stop - 1) // BLOCK, lines)
    for m in range(len(order)):
        lit[order[m]] = blocks[m // BLOCK * 3 * BLOCK + m % BLOCK + 2 * BLOCK] < np.inf
