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

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.mesh import hull_vertices, mass_properties
from realsim.records import Mesh
from realsim_sim_bridge.grasping.antipodal import RaySurface
from realsim_sim_bridge.grasping.hand import HandGeometry
from realsim_sim_bridge.grasping.pad_contacts import PadContacts, pad_contacts
from realsim_sim_bridge.grasping.wrench_hull import largest_balls

Array = NDArray[np.float64]
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
    geometry: HandGeometry | None = None,
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
    config, geometry = config or ClosureConfig(), geometry or HandGeometry()
    Ts = np.asarray(Ts_obj_grasp, dtype=np.float64).reshape(-1, 4, 4)
    openings = np.asarray(openings_m, dtype=np.float64).reshape(-1)
    if len(openings) != len(Ts):
        raise InputError(f"{len(openings)} openings for {len(Ts)} grasps; one each is needed.")
    if len(Ts):
        Ts = se3.check_rigid(Ts, "the grasps")
    center = mass_properties(mesh, 1.0).center_of_mass if center_of_mass is None else center_of_mass
    length = float(np.linalg.norm(hull_vertices(mesh.vertices) - center, axis=1).max())
    surface = RaySurface(mesh)
    axis = pad_contacts(surface, _at_depth(Ts, contact_depths_m), openings, geometry, 1, 0.0)
    needed = np.full(len(Ts), np.inf)
    needed[axis.both] = _needed_friction(axis.points[axis.both], axis.normals[axis.both])

    contacts = pad_contacts(surface, Ts, openings, geometry, config.pad_rays, config.softness_m)
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


def _at_depth(Ts: Array, depths_m: Array | None) -> Array:
    """Return the grasps (N, 4, 4), moved along their approach by depths (N,) [m]."""
    if depths_m is None:
        return Ts
    moved = Ts.copy()
    moved[:, :3, 3] += np.asarray(depths_m, dtype=np.float64)[:, None] * Ts[:, :3, 2]
    return moved


def _needed_friction(points: Array, normals: Array) -> Array:
    """Return the tangent (N,) of the greater angle of contact line and normal; inf from 90 deg."""
    line = points[:, 1] - points[:, 0]
    along = np.stack([-line, line], axis=1)
    cos = np.sum(normals * along, axis=-1)
    sin = np.linalg.norm(np.cross(normals, along), axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        tangent = np.where(cos > 0, sin / cos, np.inf)
    return tangent.max(axis=1, initial=0.0)
