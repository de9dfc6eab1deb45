"""What else stands on the table: surfaces that the hand and the arm must keep clear of."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array, Int64, Mask, Rows
from realsim.compiled import njit
from realsim.geometry import se3
from realsim.geometry.mesh import sample_surface
from realsim.records import Mesh
from realsim_sim_bridge.grasping.hand_free import OUTWARDS, boxes_free

# --- Which hands meet a surface: the hand's boxes against all triangles of a mesh, exactly -------
# The triangles hang in a tree of bounding boxes. A hand goes down only those branches whose boxes
# touch one of its own, and its boxes are compared with the triangles at the ends by the separating
# axis theorem: no piece of a triangle that is inside a box goes unnoticed, however thin the
# triangle.


LEAF = 4
"""Triangles at the end of a branch; a matter of speed alone."""
PROBES = 500
"""Triangles that find hands deep inside a surface at a tenth of the tree's cost."""
CELLS = 1 << 16
"""Cells per axis of the curve along which triangles are sorted."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SurfaceTree:
    """Triangles in a complete binary tree; node i has the children 2 i + 1 and 2 i + 2."""

    triangles: Array
    """(T, 3, 3) in the order of the leaves [m]; the last one is repeated to fill them."""
    numbers: Rows
    """(T,) which triangle of the input each is."""
    centers: Array
    """(M, 3) of the nodes' bounding boxes [m]."""
    halves: Array
    """(M, 3) half their sizes [m]."""


def surface_tree(triangles: Array) -> SurfaceTree | None:
    """Return the tree of triangles (T, 3, 3) [m], or None of no triangles.

    A point is a triangle with three equal corners.
    """
    if len(triangles) == 0:
        return None
    order = _along_curve(triangles.mean(axis=1))
    leaves = 1
    while leaves * LEAF < len(order):
        leaves *= 2
    order = np.concatenate([order, np.repeat(order[-1], leaves * LEAF - len(order))])
    sorted_triangles = np.ascontiguousarray(triangles[order], dtype=np.float64)
    corners = sorted_triangles.reshape(leaves, -1, 3)
    low, high = [corners.min(axis=1)], [corners.max(axis=1)]
    while len(low[0]) > 1:
        low.insert(0, np.minimum(low[0][::2], low[0][1::2]))
        high.insert(0, np.maximum(high[0][::2], high[0][1::2]))
    least, greatest = np.concatenate(low), np.concatenate(high)
    return SurfaceTree(
        triangles=sorted_triangles,
        numbers=order,
        centers=0.5 * (least + greatest),
        halves=0.5 * (greatest - least),
    )


def _along_curve(points: Array) -> Rows:
    """Return the order of points (T, 3) along Morton's curve: neighbours come close together."""
    low = points.min(axis=0)
    size = max(float((points.max(axis=0) - low).max()), 1e-12)
    cell = np.minimum((points - low) / size * CELLS, CELLS - 1).astype(np.uint64)
    code = np.zeros(len(points), dtype=np.uint64)
    for axis in range(3):
        code |= _spread_bits(cell[:, axis]) << np.uint64(axis)
    return np.argsort(code, kind="stable").astype(np.int64)


def _spread_bits(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return 16-bit numbers with two zeros after each bit."""
    steps = ((16, 0x0000FF0000FF), (8, 0x00F00F00F00F), (4, 0x0C30C30C30C3), (2, 0x249249249249))
    x = x & np.uint64(0xFFFF)
    for shift, mask in steps:
        x = (x | (x << np.uint64(shift))) & np.uint64(mask)
    return x


def first_triangle_inside(
    boxes: Array, Ts_a_grasp: Array, tree: SurfaceTree | None, clearance_m: float
) -> Rows:
    """Return the number (N,) of a triangle that reaches into hand n's grown boxes, or -1.

    Args:
        boxes: (N, B, 2, 3) least and greatest corner, grasp frame [m].
        Ts_a_grasp: (N, 4, 4), in the frame of the triangles.
        tree: the triangles.
        clearance_m: the boxes are grown by this on all sides [m]; touching is not inside.
    """
    if tree is None or len(boxes) == 0:
        return np.full(len(boxes), -1, dtype=np.int64)
    grown = boxes + clearance_m * OUTWARDS
    Ts = np.ascontiguousarray(Ts_a_grasp, dtype=np.float64)
    return _search(grown, Ts, tree.centers, tree.halves, tree.triangles, tree.numbers)


def hands_free(
    boxes: Array, Ts_a_grasp: Array, tree: SurfaceTree | None, clearance_m: float
) -> Mask:
    """Return whether no triangle reaches into any grown box (N,); as `first_triangle_inside`.

    Hands with the middle of a probe triangle inside are not free; the tree is asked for the others.
    """
    if tree is None:
        return np.ones(len(boxes), dtype=np.bool_)
    probes = tree.triangles[:: max(1, len(tree.triangles) // PROBES)].mean(axis=1)
    free = boxes_free(boxes, Ts_a_grasp, probes, clearance_m)
    free[free] = first_triangle_inside(boxes[free], Ts_a_grasp[free], tree, clearance_m) < 0
    return free


# --- compiled ----------------------------------------------------------------------------------


def _triangle_meets_box_loops(a: Any, b: Any, c: Any, half: Any) -> Any:
    """Return whether a triangle enters the open box |x| < half (Akenine-Moller 2001).

    An axis on which both only touch separates them. Axes of no length separate nothing.
    """
    for k in range(3):
        if min(a[k], b[k], c[k]) >= half[k] or max(a[k], b[k], c[k]) <= -half[k]:
            return False
    e = np.empty((3, 3))
    for k in range(3):
        e[0, k], e[1, k], e[2, k] = b[k] - a[k], c[k] - b[k], a[k] - c[k]
    # The triangle's plane.
    nx = e[0, 1] * e[1, 2] - e[0, 2] * e[1, 1]
    ny = e[0, 2] * e[1, 0] - e[0, 0] * e[1, 2]
    nz = e[0, 0] * e[1, 1] - e[0, 1] * e[1, 0]
    reach = half[0] * abs(nx) + half[1] * abs(ny) + half[2] * abs(nz)
    if abs(nx * a[0] + ny * a[1] + nz * a[2]) > reach:
        return False
    # Cross products of the edges and the box's axes.
    for i in range(3):
        for k in range(3):
            p, q = (k + 1) % 3, (k + 2) % 3
            # axis = e_k x edge: components p and q alone.
            up, uq = -e[i, q], e[i, p]
            pa = up * a[p] + uq * a[q]
            pb = up * b[p] + uq * b[q]
            pc = up * c[p] + uq * c[q]
            reach = half[p] * abs(up) + half[q] * abs(uq)
            if min(pa, pb, pc) > reach or max(pa, pb, pc) < -reach:
                return False
    return True


_triangle_meets_box = njit(_triangle_meets_box_loops)


def _leaf_hit_loops(boxes: Any, R: Any, t: Any, triangles: Any, start: Any) -> Any:
    """Return which triangle of a leaf reaches into any of a hand's boxes, or -1."""
    local, half = np.empty((3, 3)), np.empty(3)
    for i in range(start, start + LEAF):
        for m in range(len(boxes)):
            for k in range(3):
                middle = 0.5 * (boxes[m, 0, k] + boxes[m, 1, k])
                half[k] = 0.5 * (boxes[m, 1, k] - boxes[m, 0, k])
                for j in range(3):
                    local[j, k] = (
                        R[0, k] * (triangles[i, j, 0] - t[0])
                        + R[1, k] * (triangles[i, j, 1] - t[1])
                        + R[2, k] * (triangles[i, j, 2] - t[2])
                        - middle
                    )
            if _triangle_meets_box(local[0], local[1], local[2], half):
                return i
    return -1


_leaf_hit = njit(_leaf_hit_loops)


def _near_loops(boxes: Any, R: Any, t: Any, center: Any, halves: Any) -> Any:
    """Return whether a bounding box, bounded again along the hand's axes, touches any box."""
    low, high = np.empty(3), np.empty(3)
    x, y, z = center[0] - t[0], center[1] - t[1], center[2] - t[2]
    for k in range(3):
        middle = R[0, k] * x + R[1, k] * y + R[2, k] * z
        half = abs(R[0, k]) * halves[0] + abs(R[1, k]) * halves[1] + abs(R[2, k]) * halves[2]
        low[k], high[k] = middle - half, middle + half
    for m in range(len(boxes)):
        if (
            low[0] <= boxes[m, 1, 0]
            and high[0] >= boxes[m, 0, 0]
            and low[1] <= boxes[m, 1, 1]
            and high[1] >= boxes[m, 0, 1]
            and low[2] <= boxes[m, 1, 2]
            and high[2] >= boxes[m, 0, 2]
        ):
            return True
    return False


_near = njit(_near_loops)


def _search_loops(
    boxes: Any, Ts: Any, centers: Any, halves: Any, triangles: Any, numbers: Any
) -> Any:
    """Return the number of the first triangle found inside any box, per hand, or -1."""
    found = np.full(len(boxes), -1, dtype=np.int64)
    first_leaf = len(centers) // 2
    stack = np.empty(128, dtype=np.int64)
    last = 0
    for n in range(len(boxes)):
        R, t = Ts[n, :3, :3], Ts[n, :3, 3]
        # Hands come in turns about one axis: what stopped the last one often stops the next.
        hit = _leaf_hit(boxes[n], R, t, triangles, last)
        stack[0], top = 0, 1
        while top > 0 and hit < 0:
            top -= 1
            node = stack[top]
            if not _near(boxes[n], R, t, centers[node], halves[node]):
                continue
            if node < first_leaf:
                stack[top], stack[top + 1] = 2 * node + 1, 2 * node + 2
                top += 2
                continue
            hit = _leaf_hit(boxes[n], R, t, triangles, (node - first_leaf) * LEAF)
        if hit >= 0:
            found[n] = numbers[hit]
            last = hit // LEAF * LEAF
    return found


_search = njit(_search_loops)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Surroundings:
    """Surfaces in the table's frame, as points and, where the meshes are at hand, as triangles.

    Points can miss what is thinner than their distance; triangles miss nothing.
    """

    points: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """(P, 3) on the surfaces [m]."""
    instances: Int64 = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(P,) instance number of each point."""
    triangles: Array = field(default_factory=lambda: np.zeros((0, 3, 3)))
    """(T, 3, 3) [m]; of instances that have some, all."""
    triangle_instances: Int64 = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(T,) instance number of each triangle."""

    def tree(self) -> tuple[SurfaceTree | None, Int64]:
        """Return the tree of all surfaces, and the instance (T,) of each of its numbers.

        Points are in it where their instance has no triangles.
        """
        bare = ~np.isin(self.instances, self.triangle_instances)
        points = np.repeat(self.points[bare][:, None], 3, axis=1)
        triangles = np.concatenate([self.triangles, points])
        instances = np.concatenate([self.triangle_instances, self.instances[bare]])
        return surface_tree(triangles), instances

    def near(self, center: Array, radius_m: float) -> "Surroundings":
        """Return what may lie within a sphere about `center` (3,) [m]."""
        point = np.linalg.norm(self.points - center, axis=1) <= radius_m
        low, high = self.triangles.min(axis=1), self.triangles.max(axis=1)
        gap = np.maximum(np.maximum(low - center, center - high), 0.0)
        triangle = np.linalg.norm(gap, axis=1) <= radius_m
        return Surroundings(
            points=self.points[point],
            instances=self.instances[point],
            triangles=self.triangles[triangle],
            triangle_instances=self.triangle_instances[triangle],
        )


def standing_object(mesh: Mesh, T_table_obj: Array, instance: int, count: int) -> Surroundings:
    """Return the surface of an object where it stands.

    Args:
        mesh: the object [m].
        T_table_obj: (4, 4).
        instance: its number; also the seed of its points.
        count: points spread over its surface; its vertices (at most as many) come on top.
    """
    points = sample_surface(mesh, count, np.random.default_rng(instance))[0]
    points = np.concatenate([points, mesh.vertices[:count]])
    triangles = se3.transform(T_table_obj, mesh.vertices)[mesh.faces]
    return Surroundings(
        points=se3.transform(T_table_obj, points),
        instances=np.full(len(points), instance, dtype=np.int64),
        triangles=triangles,
        triangle_instances=np.full(len(triangles), instance, dtype=np.int64),
    )


def together(surfaces: Sequence[Surroundings]) -> Surroundings:
    """Return all surfaces as one."""
    all_of = [Surroundings(), *surfaces]
    return Surroundings(
        points=np.concatenate([s.points for s in all_of]),
        instances=np.concatenate([s.instances for s in all_of]),
        triangles=np.concatenate([s.triangles for s in all_of]),
        triangle_instances=np.concatenate([s.triangle_instances for s in all_of]),
    )
