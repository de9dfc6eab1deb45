"""Analytic quality of grasps, to be compared with what physics says of them.

Three measures, named as in `realsim.records.MEASURES`:

- ferrari_canny: radius of the largest ball in the hull of the wrenches that two soft fingers with
  normal forces of sum 1 exert, where their pads touch first; torques about the centre of mass, in
  units of the farthest point's distance from it. Hard point contacts would all have 0: nothing
  holds a turn about their line.
- closure_friction: the smallest of GraspNet's friction levels at which the line between two point
  contacts is inside both friction cones (Nguyen 1988; graspnetAPI's label); inf = at none. The
  contacts are where the closing axis meets the object, as in Dex-Net, on which GraspNet builds.
- dexnet_closure: 1 if it is so at the configured friction, as Dex-Net tests it; else 0.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.arrays import Array, Int64
from realsim.compiled import njit
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.mesh import hull_vertices, mass_properties
from realsim.records import Mesh
from realsim.robots.hand import Hand, along_approach, find_hand
from realsim_sim_bridge.grasping.antipodal import RaySurface
from realsim_sim_bridge.grasping.pad_contacts import PadContacts, pad_contacts, pad_heights

# --- The Ferrari-Canny quality of two soft fingers: exact, and quick enough for every grasp ------
# A finger that presses with force 1 along its inward normal n at p can add friction f (|f| <= mu,
# tangential) and a torsional torque t about n (|t| <= gamma): together at most |(f / mu, t /
# gamma)| = 1. That ball is replaced by the double pyramid over a regular polygon of m corners with
# both poles. The wrenches of a finger are then the corners of a polytope in a flat of three
# dimensions, and those of the grasp (normal forces that sum to 1) the hull of both polytopes in
# six. The quality is the distance of that hull's nearest facet from the origin (Ferrari and Canny
# 1992), 0 where the origin is not inside.
#
# All faces of a double pyramid are simplices, so every facet of the hull is spanned by two
# triangles, or by one whole pyramid and an edge of the other: 4 m^2 + 6 m hyperplanes hold all
# facets. Hard point contacts (gamma = 0) have no volume in six dimensions: the quality is 0.


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


def _double_pyramid(edges: int) -> tuple[Int64, Int64]:
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


ROUNDING = 1e-6
"""A friction so little [1] above a level still counts as the level: rays have single precision."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ClosureConfig:
    """What the analytic measures assume."""

    friction: float = 1.0
    """Coulomb coefficient of ferrari_canny and dexnet_closure; the paper's."""
    levels: tuple[float, ...] = (0.2, 0.4, 0.6, 0.8, 1.0, 1.2)
    """Frictions tried for closure_friction; those of graspnetAPI."""
    cone_edges: int = 8
    """Corners of the polygon in place of a cone's circle, a multiple of 4: its inscribed circle is
    92 % of the true one."""
    pad_rays: int = 7
    """Rays per side of a pad, 2.9 mm apart."""
    softness_m: float = 0.0005
    """How deep a rubber pad gives way [m]; what it meets so deep bears torsion."""

    def __post_init__(self) -> None:
        """Name a value that cannot be.

        Raises:
            InputError: a friction that is not positive, or a polygon that is not a multiple of 4.
        """
        for value in (self.friction, *self.levels):
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"force closure: a friction of {value} has no cone; give one > 0.")
        if self.cone_edges < 4 or self.cone_edges % 4:
            raise InputError(
                f"force closure: a cone of {self.cone_edges} edges is not a multiple of 4; try 8."
            )
        if self.pad_rays < 1 or not self.softness_m >= 0:
            raise InputError(
                f"force closure: {self.pad_rays} rays and a softness of {self.softness_m} m; at "
                "least one ray and a softness that is not negative are needed."
            )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Closure:
    """The analytic quality of N grasps; where a finger touches nothing: 0, inf and 0."""

    ferrari_canny: Array
    """(N,) [1]; torques in units of the farthest point's distance from the centre of mass."""
    closure_friction: Array
    """(N,) smallest level of friction that closes; inf = none."""
    dexnet_closure: Array
    """(N,) 1 = force closure at the configured friction, 0 = none."""
    needed_friction: Array
    """(N,) smallest friction that closes, between the levels; inf = none does."""
    contacts: PadContacts
    """Where the pads touch: the contacts of ferrari_canny."""
    axis_contacts: PadContacts
    """Where the closing axis meets the object: those of the other measures."""

    def measures(self) -> dict[str, Array]:
        """Return the columns for a grasp set, by the names of `realsim.records.MEASURES`."""
        return {
            "ferrari_canny": self.ferrari_canny,
            "closure_friction": self.closure_friction,
            "dexnet_closure": self.dexnet_closure,
        }


def force_closure(
    mesh: Mesh,
    Ts_obj_grasp: Array,
    openings_m: Array,
    config: ClosureConfig | None = None,
    geometry: Hand | None = None,
    center_of_mass: Array | None = None,
    *,
    contact_depths_m: Array | None = None,
) -> Closure:
    """Return the analytic quality of grasps.

    Args:
        mesh: the object [m].
        Ts_obj_grasp: (N, 4, 4) [m].
        openings_m: (N,) distance of the finger faces before closing [m].
        config: what is assumed.
        geometry: the hand.
        center_of_mass: (3,) object frame [m]; None = the mesh's at even density.
        contact_depths_m: (N,) z of the closing axis in the grasp frame [m], as of `Candidates`;
            None = in the middle of the pads.

    Raises:
        InputError: the mesh has no volume, or the numbers of grasps and openings differ.
    """
    config, geometry = config or ClosureConfig(), geometry or find_hand()
    Ts = np.asarray(Ts_obj_grasp, dtype=np.float64).reshape(-1, 4, 4)
    openings = np.asarray(openings_m, dtype=np.float64).reshape(-1)
    if len(openings) != len(Ts):
        raise InputError(f"{len(openings)} openings for {len(Ts)} grasps; one each is needed.")
    if len(Ts):
        Ts = se3.check_rigid(Ts, "the grasps")
    center = mass_properties(mesh, 1.0).center_of_mass if center_of_mass is None else center_of_mass
    length = float(np.linalg.norm(hull_vertices(mesh.vertices) - center, axis=1).max())
    surface = RaySurface(mesh)
    if contact_depths_m is None:
        heights = pad_heights(surface, Ts, openings, geometry)
        axis = pad_contacts(surface, along_approach(Ts, heights), openings, geometry, 1, 0.0)
    else:
        at_depth = along_approach(Ts, contact_depths_m)
        axis = pad_contacts(surface, at_depth, openings, geometry, 1, 0.0)
        widths = np.linalg.norm(axis.points[:, 1] - axis.points[:, 0], axis=-1)
        heights = geometry.z_pad(np.where(axis.both, widths, openings))
    needed = np.full(len(Ts), np.inf)
    needed[axis.both] = _needed_friction(axis.points[axis.both], axis.normals[axis.both])

    pads = along_approach(Ts, heights)
    contacts = pad_contacts(surface, pads, openings, geometry, config.pad_rays, config.softness_m)
    both = contacts.both
    quality = np.zeros(len(Ts))
    quality[both] = largest_balls(
        (contacts.points[both] - center) / length,
        -contacts.normals[both],
        # The approach direction: it turns with the grasp, so that the quality does not change.
        Ts[both, :3, 2],
        config.friction,
        config.friction * contacts.levers_m[both] / length,
        config.cone_edges,
    )
    levels = np.array([*sorted(config.levels), np.inf])
    return Closure(
        ferrari_canny=quality,
        closure_friction=levels[np.searchsorted(levels[:-1], needed - ROUNDING)],
        dexnet_closure=(needed - ROUNDING <= config.friction).astype(np.float64),
        needed_friction=needed,
        contacts=contacts,
        axis_contacts=axis,
    )


def _needed_friction(points: Array, normals: Array) -> Array:
    """Return the tangent (N,) of the greater angle of contact line and normal; inf from 90 deg."""
    line = points[:, 1] - points[:, 0]
    along = np.stack([-line, line], axis=1)
    cos = np.sum(normals * along, axis=-1)
    sin = np.linalg.norm(np.cross(normals, along), axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        tangent = np.where(cos > 0, sin / cos, np.inf)
    return tangent.max(axis=1, initial=0.0)
