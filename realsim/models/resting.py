"""How an object can rest on a table: the stable poses of its convex hull, and how likely each is.

A body on a table touches it with its hull, and rolls until the height of its centre of mass has a
local minimum. Each facet of the hull is one way to lie on the table; the graph of neighbouring
facets, with the height that must be climbed to roll from one to the next, is flooded from below.
Minima that only a tiny barrier separates are one basin: the hull of a scan has thousands of tiny
facets and as many minima that mean nothing, and a cylinder of 64 facets rolls.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.arrays import Array, Int64
from realsim.compiled import njit
from realsim.errors import InputError
from realsim.geometry.mesh import hull_vertices, mass_properties
from realsim.records import Mesh

ANY_DENSITY = 1.0
"""The centre of mass of a uniform body does not depend on its density."""
BARRIER_SHARE = 0.0015
"""Rise of the centre of mass, as a share of the hull's largest extent, below which two minima are
one basin. Rolling a 64-sided disc over an edge takes 0.06 %, tipping one of 100 x 12 mm off its rim
0.36 %, turning a hexagonal nut over an edge 7 %."""
ROLLING_SHARE = 0.025
"""Facets of a basin whose centre of mass is at most this share of the largest extent higher than
its minimum represent it too. A lying tube whose mesh is bent by 2 % has two or three minima left,
while the real tube rolls."""
SPACING_DEG = 14.0
"""Representatives of one rolling basin are at least so far apart [deg]: a pose fit reaches about
half of it."""
SAME_DEG = 8.0
"""Poses of different basins nearer than this are one [deg]."""
MOST_PER_BASIN = 28
"""Representatives of one basin; of a sphere, which would need 130, the spacing is widened."""
LEAST_PROBABILITY = 0.001
"""Basins rarer than this are left out: nobody sets an object down on a knife's edge."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Resting:
    """One way in which a body rests on the plane z = 0."""

    R: Array
    """(3, 3) turns the mesh so that it stands on z = 0 (after a shift along z)."""
    probability: float
    """Chance that the body, set down quasi-statically in a random attitude, ends here: the solid
    angle of all facets that roll here, seen from the centre of mass, divided by 4 pi."""
    height: float
    """Height of the body in this pose [units of the mesh]."""
    center_height: float
    """Height of the centre of mass above the plane [units of the mesh]."""
    basin: int
    """Number of its basin: representatives of one rolling body share it."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Facets:
    """The triangles of a hull about its centre of mass."""

    points: Array
    """(H, 3) hull corners about the centre of mass."""
    normals: Array
    """(F, 3) unit, outward."""
    heights: Array
    """(F,) of the centre of mass when the facet lies on the table."""
    shares: Array
    """(F,) solid angle seen from the centre of mass / 4 pi."""
    edges: Int64
    """(E, 2) neighbouring facets."""
    barriers: Array
    """(E,) greatest height of the centre of mass while rolling from one to the other."""


def resting_orientations(mesh: Mesh) -> tuple[Resting, ...]:
    """Return the ways in which the body rests on a plane, most probable first.

    The mesh may be open or in any unit. A body that rolls (a sphere, a lying cylinder) is
    represented by several orientations of the same basin that share its probability.

    Raises:
        InputError: the mesh is flat, so it has no hull to stand on.
    """
    facets = _facets(mesh)
    extent = float(np.ptp(facets.points, axis=0).max())
    tolerance = BARRIER_SHARE * extent
    slopes = _slopes(facets)
    order = np.lexsort((-slopes, facets.barriers))
    root = _flood(facets.heights, facets.edges[order], facets.barriers[order], tolerance)
    _, basins = np.unique(root, return_inverse=True)
    share = np.bincount(basins, facets.shares)
    found: list[tuple[int, float, int]] = []
    for basin in np.flatnonzero(share >= LEAST_PROBABILITY):
        members = np.flatnonzero(basins == basin)
        chosen = _representatives(facets, members, ROLLING_SHARE * extent)
        nearest = np.argmax(facets.normals[members] @ facets.normals[chosen].T, axis=1)
        part = np.bincount(nearest, facets.shares[members], minlength=len(chosen))
        found += [(int(f), float(p), int(basin)) for f, p in zip(chosen, part, strict=True)]
    found = _merged(facets, found)
    return tuple(_resting(facets, *f) for f in sorted(found, key=lambda f: (-f[1], f[0])))


def turned_down(direction: Array) -> Array:
    """Return the smallest rotation (3, 3) that turns a unit direction (3,) to -z."""
    c = -float(direction[2])
    if c < -1 + 1e-12:  # straight up: a half turn about x
        return np.diag([1.0, -1.0, -1.0])
    # Rodrigues' formula with the axis direction x (-z) = (-dy, dx, 0).
    w = np.array([-direction[1], direction[0], 0.0])
    K = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    return np.eye(3) + K + K @ K / (1 + c)


def _facets(mesh: Mesh) -> _Facets:
    """Return the hull of a mesh as facets with their neighbours and barriers."""
    from scipy.spatial import ConvexHull, QhullError

    center = mass_properties(mesh, ANY_DENSITY).center_of_mass
    corners = hull_vertices(mesh.vertices)
    try:
        hull: Any = ConvexHull(corners - center)
        if float(hull.equations[:, 3].max()) >= 0:
            # Bodies that overlap or are partly inside out have a centre of mass that is no such
            # thing; the hull's own is the best guess.
            center = _hull_center(corners, hull)
            hull = ConvexHull(corners - center)
    except QhullError as error:
        raise InputError(
            f"the mesh is flat (extent {mesh.extent.tolist()}): it has no hull to stand on."
        ) from error
    points = corners - center
    normals: Array = hull.equations[:, :3]
    heights: Array = -hull.equations[:, 3]
    a, b, c = (points[hull.simplices[:, k]] for k in range(3))
    # Solid angle of a triangle: tan(W/2) = a.(b x c) / (abc + (a.b)c + (a.c)b + (b.c)a)
    # (van Oosterom & Strackee 1983).
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    triple = np.abs(np.einsum("fi,fi->f", a, np.cross(b, c)))
    rest = la * lb * lc
    rest += np.sum(a * b, 1) * lc + np.sum(a * c, 1) * lb + np.sum(b * c, 1) * la
    shares = 2 * np.arctan2(triple, rest) / (4 * np.pi)
    first = np.repeat(np.arange(len(normals)), 3)
    second = hull.neighbors.ravel().astype(np.int64)
    once = first < second
    # Neighbour k of a simplex lies across the edge opposite its corner k.
    sides = hull.simplices[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2)
    edges = np.stack([first, second], 1)[once]
    return _Facets(
        points=points,
        normals=normals,
        heights=heights,
        shares=shares,
        edges=edges,
        barriers=_barriers(points, normals, heights, edges, sides[once]),
    )


def _hull_center(corners: Array, hull: Any) -> Array:
    """Return the centre of mass (3,) of the solid hull."""
    inner = corners.mean(0)
    triangles = corners[hull.simplices] - inner
    volumes = np.abs(np.linalg.det(triangles))
    return inner + volumes @ triangles.sum(1) / (4 * volumes.sum())


def _barriers(points: Array, normals: Array, heights: Array, edges: Int64, sides: Int64) -> Array:
    """Return the greatest height (E,) of the centre of mass while rolling over each edge.

    While the body stands on an edge, the height is q . d, with d the down direction between the two
    normals and q the foot of the perpendicular on the edge; it is greatest, |q|, where d points
    along q, if that lies between the normals.
    """
    u, v = points[sides[:, 0]], points[sides[:, 1]]
    along = v - u
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    q = u - np.sum(u * along, 1, keepdims=True) * along
    n1, n2 = normals[edges[:, 0]], normals[edges[:, 1]]
    turn = np.cross(n1, n2)
    between = (np.sum(np.cross(n1, q) * turn, 1) > 0) & (np.sum(np.cross(q, n2) * turn, 1) > 0)
    ends = np.maximum(heights[edges[:, 0]], heights[edges[:, 1]])
    return np.where(between, np.maximum(np.linalg.norm(q, axis=1), ends), ends)


def _slopes(facets: _Facets) -> Array:
    """Return how steeply (E,) the centre of mass falls across each edge, per radian."""
    i, j = facets.edges.T
    turn = np.linalg.norm(facets.normals[i] - facets.normals[j], axis=1)
    fall = np.abs(facets.heights[i] - facets.heights[j])
    return fall / np.maximum(turn, 1e-9)


@njit
def _flood(heights: Array, edges: Int64, barriers: Array, tolerance: float) -> Int64:
    """Return the lowest facet (F,) of the basin of each facet.

    Edges are met in ascending order of their barriers; two basins stay apart if the barrier lies
    more than the tolerance above both minima.
    """
    n = len(heights)
    lowest = np.arange(n)
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        while lowest[i] != i:
            lowest[i] = lowest[lowest[i]]
            i = lowest[i]
        while lowest[j] != j:
            lowest[j] = lowest[lowest[j]]
            j = lowest[j]
        if i == j:
            continue
        if heights[i] > heights[j]:
            i, j = j, i
        if barriers[e] - heights[j] <= tolerance:
            lowest[j] = i
    for k in range(n):
        i = k
        while lowest[i] != i:
            i = lowest[i]
        lowest[k] = i
    return lowest


def _representatives(facets: _Facets, members: Int64, reach: float) -> Int64:
    """Return facets that stand for a basin: its minimum, and others as low and far enough away."""
    order = members[np.argsort(facets.heights[members], kind="stable")]
    low = order[facets.heights[order] <= facets.heights[order[0]] + reach]
    spacing = np.radians(SPACING_DEG)
    while True:
        chosen = _spaced(facets.normals[low], float(np.cos(spacing)))
        if len(chosen) <= MOST_PER_BASIN:
            return low[chosen]
        spacing *= 1.15


def _spaced(directions: Array, nearest_cos: float) -> Int64:
    """Return indices of directions, in their order, none nearer to an earlier one than allowed."""
    free = np.ones(len(directions), dtype=bool)
    chosen: list[int] = []
    while free.any():
        k = int(np.argmax(free))
        chosen.append(k)
        free &= directions @ directions[k] < nearest_cos
        free[k] = False
    return np.array(chosen, dtype=np.int64)


def _merged(facets: _Facets, found: list[tuple[int, float, int]]) -> list[tuple[int, float, int]]:
    """Return the poses (facet, probability, basin) with near ones of other basins joined."""
    limit = np.cos(np.radians(SAME_DEG))
    kept: list[tuple[int, float, int]] = []
    for facet, probability, basin in sorted(found, key=lambda f: (-f[1], f[0])):
        normal = facets.normals[facet]
        for k, (other, p, b) in enumerate(kept):
            if b != basin and normal @ facets.normals[other] > limit:
                kept[k] = (other, p + probability, b)
                break
        else:
            kept.append((facet, probability, basin))
    return kept


def _resting(facets: _Facets, facet: int, probability: float, basin: int) -> Resting:
    """Return the record of one facet on the table."""
    R = turned_down(facets.normals[facet])
    return Resting(
        R=R,
        probability=probability,
        height=float(np.ptp(facets.points @ R[2])),
        center_height=float(facets.heights[facet]),
        basin=basin,
    )
