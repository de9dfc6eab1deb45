"""The loads that a closed grasp bears: limit analysis of the pads' contacts.

A grasp bears a wrench if contact forces exist that balance it, each within its friction cone, while
the fingers press with the hand's force (Boyd and Wegbreit 2007, with cones of eight edges). The
pads are patches, up to nine points each, so torsion and tilting moments need no law of their own:
where the pressure goes is found with the rest. That is a linear program of seven rows; its optimum
is the safety factor, the multiple of a load that is borne. Rigid bodies and the best distribution
of pressure make it an upper bound; the eight edges are 2.6 % inside the cone to 5.4 % outside it.

Wrenches are (torque about the grasp's origin, force), in the grasp frame.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.arrays import Array, Mask
from realsim.compiled import njit
from realsim.robots.hand import Hand
from realsim_sim_bridge.grasping.antipodal import RaySurface
from realsim_sim_bridge.grasping.pad_contacts import pad_rays

EDGES = 8
"""Edges of a friction cone; the polygon has the circle's area."""
CELLS, RAYS_PER_CELL = 3, 2
"""Cells per side of a pad, each one contact at most, and rays per side of a cell."""
LENGTH_M = 0.05
"""Torques are divided by this, so that they are as large as forces [m]."""
TINY = 1e-9
PATIENCE = 60
"""Steps of the simplex method after which the rule that cannot cycle takes over (Bland 1977)."""
MOST_STEPS = 2000


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PadPatches:
    """Where closed pads touch, P = 9 points each; finger 0 is at -y of the grasp, 1 at +y."""

    points: Array
    """(N, 2, P, 3) grasp frame [m]; 0 where `there` is false."""
    normals: Array
    """(N, 2, P, 3) unit normals out of the object; 0 likewise."""
    there: Mask
    """(N, 2, P)."""

    @property
    def both(self) -> Mask:
        """(N,) whether both fingers touch."""
        return np.asarray(np.all(np.any(self.there, axis=2), axis=1))


def pad_patches(
    surface: RaySurface, Ts_obj_pads: Array, openings_m: Array, hand: Hand, softness_m: float
) -> PadPatches:
    """Return the patches of closing pads.

    Args:
        surface: the object.
        Ts_obj_pads: (N, 4, 4) axes as of `grasp`, origin between the middles of the pads [m].
        openings_m: (N,) distance of the pads before closing [m].
        hand: sizes of the pads.
        softness_m: how deep a pad gives way [m].
    """
    n, side = len(Ts_obj_pads), CELLS * RAYS_PER_CELL
    rays = pad_rays(surface, Ts_obj_pads, openings_m, hand, side, softness_m)
    cells = (n, 2, CELLS, RAYS_PER_CELL, CELLS, RAYS_PER_CELL)
    weight = rays.touched.reshape(cells).astype(np.float64)[..., None]
    count = weight.sum(axis=(3, 5))
    R = Ts_obj_pads[:, None, None, :3, :3]
    places = (rays.points - Ts_obj_pads[:, None, None, :3, 3])[..., None, :] @ R
    normals = rays.normals[..., None, :] @ R
    flat = (n, 2, CELLS * CELLS)
    found: list[Array] = []
    for values in (places, normals):
        spread = np.where(weight > 0, values.reshape(*cells, 3), 0.0)
        found.append((spread.sum(axis=(3, 5)) / np.maximum(count, 1.0)).reshape(*flat, 3))
    points, normals = found
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return PadPatches(
        points=points,
        normals=normals / np.where(length > TINY, length, 1.0),
        there=(count[..., 0].reshape(flat) > 0) & (length[..., 0] > TINY),
    )


def safety_factors(patches: PadPatches, loads: Array, friction: Array, force_n: Array) -> Array:
    """Return the safety factors (N, L): the multiples of the loads that are borne.

    0 = the fingers' squeeze alone cannot be balanced within the cones, or a pad touches nothing;
    inf = the load is zero. The factor is proportional to force over load at a given friction.

    Args:
        patches: where the pads touch.
        loads: (N, L, 6) wrenches on the object [N m, N].
        friction: (N,) Coulomb coefficients.
        force_n: (N,) force of each finger [N].
    """
    angle = 2.0 * np.pi * np.arange(EDGES) / EDGES
    # The regular polygon with the area of the unit circle.
    radius = np.sqrt(2.0 * np.pi / (EDGES * np.sin(2.0 * np.pi / EDGES)))
    corners = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    scaled = np.array(loads, dtype=np.float64)
    scaled[..., :3] /= LENGTH_M
    return _factors(
        np.ascontiguousarray(patches.points),
        np.ascontiguousarray(patches.normals),
        patches.there & patches.both[:, None, None],
        scaled,
        np.broadcast_to(np.asarray(friction, dtype=np.float64), len(scaled)).copy(),
        np.broadcast_to(np.asarray(force_n, dtype=np.float64), len(scaled)).copy(),
        corners,
    )


# --- compiled: the simplex method on a dense table -----------------------------------------------
# Rows 0 to 5 balance the wrench, row 6 has the fingers press with twice the hand's force in all;
# the last row is the objective. The columns are contact edges, then one a row that starts as the
# identity (and from then on holds the basis' inverse), then the right side.


def _pivot_loops(table: Any, basis: Any, row: Any, column: Any) -> None:
    """Bring a column into the basis."""
    table[row] /= table[row, column]
    for i in range(len(table)):
        factor = table[i, column]
        if i != row and factor != 0.0:
            for j in range(table.shape[1]):
                table[i, j] -= factor * table[row, j]
    basis[row] = column


_pivot: Any = njit(_pivot_loops)


def _minimise_loops(table: Any, basis: Any, columns: Any) -> None:
    """Go on until none of the first columns, nor the last but one, lowers the objective."""
    m, width = len(table) - 1, table.shape[1]
    for step in range(MOST_STEPS):
        enter, least = -1, -TINY
        for j in range(width - 1):
            if j < columns or j >= columns + m:
                if table[m, j] < least:
                    enter, least = j, table[m, j]
                    if step > PATIENCE:
                        break
        if enter < 0:
            return
        leave, ratio = -1, np.inf
        for i in range(m):
            a = table[i, enter]
            idle = columns <= basis[i] < columns + m
            if idle and abs(a) > TINY and table[i, width - 1] <= TINY:
                leave, ratio = i, 0.0  # what started the search must not come back
                break
            if a > TINY:
                here = table[i, width - 1] / a
                if here < ratio - 1e-12 or (
                    here < ratio + 1e-12 and leave >= 0 and basis[i] < basis[leave]
                ):
                    leave, ratio = i, here
        if leave < 0:
            table[m, width - 1] = -np.inf
            return
        _pivot(table, basis, leave, enter)


_minimise: Any = njit(_minimise_loops)


def _add_edges_loops(
    table: Any, points: Any, normals: Any, there: Any, friction: Any, corners: Any
) -> None:
    """Write the wrench of every edge of a grasp's cones into a column of its own."""
    push, u, v = np.empty(3), np.empty(3), np.empty(3)
    at = 0
    for pad in range(2):
        inward = 1.0 if pad == 0 else -1.0
        for p in range(points.shape[1]):
            if not there[pad, p]:
                continue
            a, r = normals[pad, p], points[pad, p]
            axis = np.argmin(np.abs(a))
            u[:] = -a[axis] * a
            u[axis] += 1.0
            u /= np.sqrt(np.sum(u * u))
            v = np.array(
                [a[1] * u[2] - a[2] * u[1], a[2] * u[0] - a[0] * u[2], a[0] * u[1] - a[1] * u[0]]
            )
            for e in range(len(corners)):
                for i in range(3):
                    push[i] = -a[i] + friction * (corners[e, 0] * u[i] + corners[e, 1] * v[i])
                table[0, at] = (r[1] * push[2] - r[2] * push[1]) / LENGTH_M
                table[1, at] = (r[2] * push[0] - r[0] * push[2]) / LENGTH_M
                table[2, at] = (r[0] * push[1] - r[1] * push[0]) / LENGTH_M
                table[3:6, at] = push
                table[6, at] = inward * push[1]
                at += 1


_add_edges: Any = njit(_add_edges_loops)


def _factors_loops(
    points: Any, normals: Any, there: Any, loads: Any, friction: Any, force: Any, corners: Any
) -> Any:
    """Return the factors (N, L)."""
    n, per_pad, edges, m = len(points), points.shape[2], len(corners), 7
    found = np.zeros((n, loads.shape[1]))
    columns = 2 * per_pad * edges
    table = np.zeros((m + 1, columns + m + 1))
    wide = np.zeros((m + 1, columns + m + 2))
    basis, basis_of_load = np.empty(m, np.int64), np.empty(m, np.int64)
    for k in range(n):
        if not there[k].any():
            continue
        table[:] = 0.0
        _add_edges(table, points[k], normals[k], there[k], friction[k], corners)
        # In units of the fingers' force; columns of contacts that are not there stay zero.
        table[6, columns + m] = 2.0
        for i in range(m):
            table[i, columns + i] = 1.0
            basis[i] = columns + i
        for j in range(columns):
            for i in range(m):
                table[m, j] -= table[i, j]
        table[m, columns + m] = -2.0
        _minimise(table, basis, columns)
        if table[m, columns + m] < -1e-7:
            continue
        for load in range(loads.shape[1]):
            w = loads[k, load] / force[k]
            if np.max(np.abs(w)) < 1e-12:
                found[k, load] = np.inf
                continue
            wide[:m, : columns + m] = table[:m, : columns + m]
            wide[:m, columns + m + 1] = table[:m, columns + m]
            wide[m] = 0.0
            for i in range(m):
                wide[i, columns + m] = 0.0
                for j in range(6):
                    wide[i, columns + m] += table[i, columns + j] * w[j]
            wide[m, columns + m] = -1.0
            basis_of_load[:] = basis
            _minimise(wide, basis_of_load, columns)
            found[k, load] = wide[m, columns + m + 1]
    return np.abs(found)


_factors: Any = njit(_factors_loops)
