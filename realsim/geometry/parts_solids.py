"""Small constructors of closed triangle surfaces: prisms, bodies of revolution, swept tubes.

Every constructor returns loose triangles (F, 3, 3) [m], counter-clockwise seen from outside. Pieces
that meet share the very same corner coordinates, so that `weld` closes them into a watertight
surface without any boolean operation.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array
from realsim.errors import DegenerateError, InputError

WELD_M = 1e-9
"""Corners nearer than this are one vertex [m]: a thousandth of the tightest tolerance here."""
BAND_M = 2e-4
"""Half width of the transition between two painted bands [m]: sharp in a photograph."""
ON_LINE_M2 = 1e-13
"""Twice the area of a triangle that counts as flat [m^2]: 0.1 um over a millimetre."""


def circle(radius: float, n: int, center: tuple[float, float] = (0.0, 0.0)) -> Array:
    """Return the n corners (n, 2) [m] of a regular polygon, counter-clockwise, first on +x."""
    t = 2 * np.pi * np.arange(n) / n
    return np.stack([np.cos(t), np.sin(t)], -1) * radius + center


def rectangle(width: float, height: float) -> Array:
    """Return the corners (4, 2) [m] of a rectangle about the origin, counter-clockwise."""
    return np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]]) * [width / 2, height / 2]


def polygon_area(ring: ArrayLike) -> float:
    """Return the signed area [m^2] of a ring (N, 2), positive if counter-clockwise."""
    p = np.asarray(ring, dtype=np.float64)
    x, y = p.T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2)


def inset(ring: ArrayLike, distance: float) -> Array:
    """Return a ring (N, 2) whose every edge is moved to its left by `distance` [m] (mitred).

    A counter-clockwise outline shrinks, a clockwise hole widens: both retreat into the material.
    """
    p = np.asarray(ring, dtype=np.float64)
    edge = np.roll(p, -1, axis=0) - p
    normal = np.stack([-edge[:, 1], edge[:, 0]], -1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    before = np.roll(normal, 1, axis=0)
    # The mitre m satisfies m.n = m.n' = distance for both edges' normals.
    mitre = (before + normal) / (1 + np.sum(before * normal, axis=1, keepdims=True))
    return p + distance * mitre


def _cross(a: Array, b: Array, c: Array) -> Array:
    """Return twice the signed area [m^2] of triangles a b c, broadcast over (..., 2)."""
    u, v = b - a, c - a
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def _bridge(points: Array, loop: list[int], hole: list[int], rest: list[list[int]]) -> list[int]:
    """Return the loop with a hole cut open into it along a segment that crosses nothing."""
    start = max(range(len(hole)), key=lambda k: (points[hole[k], 0], points[hole[k], 1]))
    m = points[hole[start]]
    edges = [(ring[k], ring[(k + 1) % len(ring)]) for ring in [loop, hole, *rest]
             for k in range(len(ring))]  # fmt: skip
    a, b = points[[e[0] for e in edges]], points[[e[1] for e in edges]]
    order = np.argsort(np.linalg.norm(points[loop] - m, axis=1))
    for k in order:
        p = points[loop[k]]
        before, after = points[loop[k - 1]], points[loop[(k + 1) % len(loop)]]
        left, right = _cross(before, p, m) > 0, _cross(p, after, m) > 0
        convex = _cross(before, p, after) > 0
        if not ((left and right) if convex else (left or right)):
            continue
        crosses = (_cross(m, p, a) * _cross(m, p, b) < 0) & (_cross(a, b, m) * _cross(a, b, p) < 0)
        if not crosses.any():
            turned = hole[start:] + hole[: start + 1]
            return loop[: k + 1] + turned + loop[k:]
    raise DegenerateError("a hole cannot be joined to the outline: does it lie outside of it?")


def _first_ear(points: Array, loop: list[int]) -> int:
    """Return the place in the loop of the corner whose removal leaves the best triangle."""
    p = points[loop]
    before, after = np.roll(p, 1, axis=0), np.roll(p, -1, axis=0)
    area = _cross(before, p, after)
    longest = np.maximum(np.linalg.norm(after - before, axis=1), 1e-12)
    for k in np.argsort(-area / longest**2):
        if area[k] <= ON_LINE_M2:
            break
        a, b, c = before[k], p[k], after[k]
        inside = (
            (_cross(a, b, p) > -ON_LINE_M2)
            & (_cross(b, c, p) > -ON_LINE_M2)
            & (_cross(c, a, p) > -ON_LINE_M2)
        )
        corner = (np.stack([np.abs(p - q).max(1) for q in (a, b, c)]) < WELD_M).any(0)
        if not (inside & ~corner).any():
            return int(k)
    flat = np.flatnonzero(np.abs(area) <= ON_LINE_M2)
    if len(flat):
        return int(flat[0])
    raise DegenerateError("the outline crosses itself, so it cannot be cut into triangles.")


def triangulate(
    outline: ArrayLike, holes: Sequence[ArrayLike] = ()
) -> tuple[Array, NDArray[np.intp]]:
    """Return a flat region cut into triangles by ear clipping; holes are bridged first.

    Args:
        outline: (N, 2) counter-clockwise outer ring [m].
        holes: clockwise rings (M, 2) inside it [m].

    Returns:
        points (P, 2) [m], which are the rings one after the other, and triangles (T, 3) of point
        numbers, counter-clockwise.

    Raises:
        InputError: a ring runs the wrong way round.
        DegenerateError: a ring crosses itself or another one.
    """
    rings = [np.asarray(r, dtype=np.float64) for r in (outline, *holes)]
    if polygon_area(rings[0]) <= 0 or any(polygon_area(r) >= 0 for r in rings[1:]):
        raise InputError("the outline must run counter-clockwise and every hole clockwise.")
    points = np.concatenate(rings)
    starts = np.cumsum([0, *(len(r) for r in rings)])
    loops = [list(range(int(a), int(b))) for a, b in pairwise(starts)]
    loop, waiting = loops[0], loops[1:]
    # The hole that reaches furthest to the right is joined first: nothing lies in its way.
    waiting.sort(key=lambda ring: -points[ring, 0].max())
    while waiting:
        hole = waiting.pop(0)
        loop = _bridge(points, loop, hole, waiting)
    triangles: list[tuple[int, int, int]] = []
    while len(loop) > 3:
        k = _first_ear(points, loop)
        triangles.append((loop[k - 1], loop[k], loop[(k + 1) % len(loop)]))
        loop.pop(k)
    triangles.append((loop[0], loop[1], loop[2]))
    return points, np.array(triangles, dtype=np.intp)


def cap(outline: ArrayLike, holes: Sequence[ArrayLike], z: float, up: bool) -> Array:
    """Return the flat face (F, 3, 3) [m] of a region at height z, facing up or down."""
    points, triangles = triangulate(outline, holes)
    corners = np.concatenate([points, np.full((len(points), 1), z)], 1)[triangles]
    return corners if up else corners[:, ::-1]


def wall(lower: ArrayLike, z0: float, upper: ArrayLike, z1: float) -> Array:
    """Return the band (F, 3, 3) [m] between two rings (N, 2) at heights z0 < z1.

    Around a counter-clockwise ring it faces outward, around a clockwise one (a hole) inward.
    """
    a = np.asarray(lower, dtype=np.float64)
    b = np.asarray(upper, dtype=np.float64)
    A = np.concatenate([a, np.full((len(a), 1), z0)], 1)
    B = np.concatenate([b, np.full((len(b), 1), z1)], 1)
    return join(A, B)


def join(A: Array, B: Array) -> Array:
    """Return the band (2N, 3, 3) between closed rings A and B (N, 3) of matching corners."""
    A1, B1 = np.roll(A, -1, axis=0), np.roll(B, -1, axis=0)
    return np.concatenate([np.stack([A, A1, B1], 1), np.stack([A, B1, B], 1)])


def extrude(
    outline: ArrayLike,
    z0: float,
    z1: float,
    holes: Sequence[ArrayLike] = (),
    *,
    chamfer: float = 0.0,
    bands: Sequence[float] = (),
) -> Array:
    """Return a closed prism (F, 3, 3) [m].

    Args:
        outline: (N, 2) counter-clockwise [m].
        z0: lower face [m].
        z1: upper face [m].
        holes: clockwise rings (M, 2), through all of it [m].
        chamfer: 45-degree bevel of all rims [m].
        bands: heights at which the paint changes; rings are added there [m].
    """
    rings = [np.asarray(r, dtype=np.float64) for r in (outline, *holes)]
    small = [inset(r, chamfer) if chamfer > 0 else r for r in rings]
    levels = {z0 + chamfer, z1 - chamfer, *(z + s * BAND_M for z in bands for s in (-1, 1))}
    heights = sorted(levels)
    pieces = [cap(small[0], small[1:], z0, up=False), cap(small[0], small[1:], z1, up=True)]
    for ring, rim in zip(rings, small, strict=True):
        if chamfer > 0:
            pieces += [wall(rim, z0, ring, heights[0]), wall(ring, heights[-1], rim, z1)]
        pieces += [wall(ring, a, ring, b) for a, b in pairwise(heights)]
    return np.concatenate(pieces)


def cut_profile(profile: ArrayLike, bands: Sequence[float]) -> Array:
    """Return a profile (N, 2) of r, z with corners added where it crosses the heights `bands`."""
    p = np.asarray(profile, dtype=np.float64)
    levels = np.array([z + s * BAND_M for z in bands for s in (-1, 1)])
    out = [p[0]]
    for a, b in pairwise(p):
        rise = b[1] - a[1]
        if rise != 0:
            t = np.sort((levels - a[1]) / rise)
            out += [a + (b - a) * s for s in t if 1e-6 < s < 1 - 1e-6]
        out.append(b)
    return np.array(out)


def revolve(profile: ArrayLike, segments: int = 96) -> Array:
    """Return the body (F, 3, 3) [m] that a profile sweeps about the z axis.

    Args:
        profile: (N, 2) r >= 0 and z [m]. It either starts and ends on the axis (r = 0) or ends at
            its own first point (a ring). The material lies to its left.
        segments: facets around the axis.

    Raises:
        InputError: the profile leaves the half plane or is not closed.
    """
    p = np.asarray(profile, dtype=np.float64)
    ring = bool(np.all(np.abs(p[0] - p[-1]) < WELD_M))
    if np.any(p[:, 0] < 0) or not (ring or (p[0, 0] == 0 and p[-1, 0] == 0)):
        raise InputError("a profile has r >= 0 and starts and ends on the axis, or is a ring.")
    unit = circle(1.0, segments)
    loops = [np.concatenate([unit * r, np.full((segments, 1), z)], 1) for r, z in p]
    if ring:
        loops[-1] = loops[0]
    triangles = np.concatenate([join(a, b) for a, b in pairwise(loops)])
    u, v, w = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    flat = (
        (np.abs(u - v).max(1) < WELD_M)
        | (np.abs(v - w).max(1) < WELD_M)
        | (np.abs(w - u).max(1) < WELD_M)
    )
    return triangles[~flat]


def arc(center: tuple[float, float], radius: float, t0: float, t1: float, n: int) -> Array:
    """Return n + 1 points (n + 1, 2) [m] of a circular arc from t0 to t1 [rad]."""
    t = np.linspace(t0, t1, n + 1)
    return np.stack([np.cos(t), np.sin(t)], -1) * radius + center


def sweep(rings: Sequence[Array]) -> Array:
    """Return the tube (F, 3, 3) through matching closed rings (K, 3) [m], open at both ends."""
    return np.concatenate([join(a, b) for a, b in pairwise(rings)])


def weld(pieces: Sequence[Array]) -> tuple[Array, NDArray[np.int32]]:
    """Return vertices (V, 3) [m] and faces (F, 3) of loose triangles whose equal corners are one.

    Raises:
        DegenerateError: the pieces leave a gap: an edge is not shared by exactly two faces that
            run along it in opposite directions.
    """
    triangles = np.concatenate(list(pieces))
    corners = triangles.reshape(-1, 3)
    keys = np.round(corners / WELD_M).astype(np.int64)
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    faces = inverse.reshape(-1, 3).astype(np.int32)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    forward = edges[:, 0] * len(first) + edges[:, 1]
    backward = edges[:, 1] * len(first) + edges[:, 0]
    if len(np.unique(forward)) != len(forward) or not np.array_equal(
        np.sort(forward), np.sort(backward)
    ):
        open_edges = len(np.setdiff1d(forward, backward))
        raise DegenerateError(f"the pieces do not close: {open_edges} edges have no partner.")
    return corners[first], faces
