"""The Ferrari-Canny quality of two soft fingers: exact, and quick enough for every grasp.

A finger that presses with force 1 along its inward normal n at p can add friction f (|f| <= mu,
tangential) and a torsional torque t about n (|t| <= gamma): together at most |(f / mu, t / gamma)|
= 1. That ball is replaced by the double pyramid over a regular polygon of m corners with both
poles. The wrenches of a finger are then the corners of a polytope in a flat of three dimensions,
and those of the grasp (normal forces that sum to 1) the hull of both polytopes in six. The quality
is the distance of that hull's nearest facet from the origin (Ferrari and Canny 1992), 0 where the
origin is not inside.

All faces of a double pyramid are simplices, so every facet of the hull is spanned by two triangles,
or by one whole pyramid and an edge of the other: 4 m^2 + 6 m hyperplanes hold all facets. Hard
point contacts (gamma = 0) have no volume in six dimensions: the quality is 0.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.compiled import njit

Array = NDArray[np.float64]
SPANLESS = 1e-10
"""Six points whose differences have a pivot below this span no hyperplane."""
FLAT = 1e-9
"""Below this share of the wrenches' size a hull counts as flat, and a point as on a hyperplane."""


def largest_balls(
    points: Array, normals: Array, tangents: Array, friction: float, torsions: Array, edges: int
) -> Array:
    """Return the qualities (N,) of N grasps.

    Args:
        points: (N, 2, 3) contacts from the centre of mass, in characteristic lengths.
        normals: (N, 2, 3) unit normals into the object.
        tangents: (N, 3) direction that the first corner of each polygon is nearest to.
        friction: Coulomb coefficient mu.
        torsions: (N, 2) torsional limits gamma, in characteristic lengths.
        edges: m, a multiple of 4.
    """
    wrenches = finger_wrenches(points, normals, tangents, friction, torsions, edges)
    flat = np.any(torsions <= FLAT, axis=1) | (friction <= FLAT)
    triangles, lines = _double_pyramid(edges)
    basis = np.array([0, edges // 4, edges, edges + 1], dtype=np.int64)
    return np.where(flat, 0.0, _nearest_facets(wrenches, triangles, lines, basis))


def finger_wrenches(
    points: Array, normals: Array, tangents: Array, friction: float, torsions: Array, edges: int
) -> Array:
    """Return the corners (N, 2, m + 2, 6) of both wrench polytopes, torque first; poles last."""
    across = np.cross(normals, tangents[:, None])
    small = np.linalg.norm(across, axis=-1, keepdims=True) < 1e-6
    across = np.where(small, np.cross(normals, np.roll(tangents, 1, axis=-1)[:, None]), across)
    v = across / np.linalg.norm(across, axis=-1, keepdims=True)
    u = np.cross(v, normals)
    angle = 2 * np.pi / edges * np.arange(edges)[:, None]
    force = np.empty((*points.shape[:2], edges + 2, 3))
    force[..., :edges, :] = normals[:, :, None] + friction * (
        np.cos(angle) * u[:, :, None] + np.sin(angle) * v[:, :, None]
    )
    force[..., edges:, :] = normals[:, :, None]
    torque = np.cross(points[:, :, None], force)
    torque[..., edges, :] += torsions[..., None] * normals
    torque[..., edges + 1, :] -= torsions[..., None] * normals
    return np.concatenate([torque, force], axis=-1)


def _double_pyramid(edges: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the triangles (2 m, 3) and edges (3 m, 2) by the numbers of their corners."""
    a = np.arange(edges)
    b = (a + 1) % edges
    poles = [np.full(edges, edges), np.full(edges, edges + 1)]
    triangles = np.concatenate([np.stack([a, b, pole], axis=1) for pole in poles])
    lines = [np.stack([a, other], axis=1) for other in (b, *poles)]
    return triangles.astype(np.int64), np.concatenate(lines).astype(np.int64)


# --- compiled ----------------------------------------------------------------------------------


def _pivot_loops(rows: Any, order: Any, i: Any) -> Any:
    """Bring the greatest element of the rest of rows (5, 6) to (i, i); False if there is none."""
    best, pi, pk = 0.0, i, i
    for r in range(i, 5):
        for k in range(i, 6):
            if abs(rows[r, k]) > best:
                best, pi, pk = abs(rows[r, k]), r, k
    if best < SPANLESS:
        return False
    for k in range(6):
        rows[i, k], rows[pi, k] = rows[pi, k], rows[i, k]
    for r in range(5):
        rows[r, i], rows[r, pk] = rows[r, pk], rows[r, i]
    order[i], order[pk] = order[pk], order[i]
    return True


_pivot = njit(_pivot_loops)


def _hyperplane_loops(p: Any, rows: Any, normal: Any) -> Any:
    """Set the unit normal of the hyperplane through six points; False if they span less.

    Args:
        p: (6, 6) the points.
        rows: (5, 6) room to work in.
        normal: (6,) set.
    """
    order = np.arange(6)
    for i in range(5):
        for k in range(6):
            rows[i, k] = p[i + 1, k] - p[0, k]
    for i in range(5):
        if not _pivot(rows, order, i):
            return False
        for r in range(i + 1, 5):
            factor = rows[r, i] / rows[i, i]
            for k in range(i, 6):
                rows[r, k] -= factor * rows[i, k]
    normal[order[5]] = 1.0
    for i in range(4, -1, -1):
        total = rows[i, 5]
        for k in range(i + 1, 5):
            total += rows[i, k] * normal[order[k]]
        normal[order[i]] = -total / rows[i, i]
    normal /= np.sqrt(np.sum(normal * normal))
    return True


_hyperplane = njit(_hyperplane_loops)


def _facet_distance_loops(p: Any, corners: Any, rows: Any, normal: Any, scale: Any) -> Any:
    """Return the signed distance from the origin of the facet through p, inf if it is none."""
    if not _hyperplane(p, rows, normal):
        return np.inf
    offset = 0.0
    for k in range(6):
        offset += normal[k] * p[0, k]
    above = below = False
    for finger in range(2):
        for c in range(corners.shape[1]):
            d = -offset
            for k in range(6):
                d += normal[k] * corners[finger, c, k]
            above |= d > FLAT * scale
            below |= d < -FLAT * scale
            if above and below:
                return np.inf
    if not above and not below:
        return 0.0
    return -offset if above else offset


_facet_distance = njit(_facet_distance_loops)


def _nearest_facets_loops(wrenches: Any, triangles: Any, lines: Any, basis: Any) -> Any:
    """Return the distance (N,) of each hull's nearest facet, 0 if the origin is not inside."""
    nearest = np.zeros(len(wrenches))
    p, rows, normal = np.empty((6, 6)), np.empty((5, 6)), np.empty(6)
    for n in range(len(wrenches)):
        corners = wrenches[n]
        scale = np.max(np.abs(corners))
        if not np.isfinite(scale):
            continue
        least = np.inf
        for i in range(len(triangles)):
            for j in range(len(triangles)):
                for k in range(3):
                    p[k], p[3 + k] = corners[0, triangles[i, k]], corners[1, triangles[j, k]]
                least = min(least, _facet_distance(p, corners, rows, normal, scale))
        for finger in range(2):
            for k in range(4):
                p[k] = corners[finger, basis[k]]
            for i in range(len(lines)):
                for k in range(2):
                    p[4 + k] = corners[1 - finger, lines[i, k]]
                least = min(least, _facet_distance(p, corners, rows, normal, scale))
        if np.isfinite(least) and least > 0:
            nearest[n] = least
    return nearest


_nearest_facets = njit(_nearest_facets_loops)
