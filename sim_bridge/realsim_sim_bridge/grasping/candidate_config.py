"""How grasp candidates are sampled and thinned."""

import math
from dataclasses import dataclass

from realsim.errors import InputError


@dataclass(frozen=True, kw_only=True, slots=True)
class CandidateConfig:
    """How candidates are sampled and thinned."""

    surface_points: int = 1000
    """Points that rays start from; the paper's."""
    rays_per_point: int = 2
    """The first along the inward normal: flat sides need it, across which a hand stands level; the
    others at random in the cone: they find what the normal misses, such as the pairs of a rim."""
    friction: float = 1.0
    """Coefficient whose cone (45 deg) the ray must be in at both ends; the paper's."""
    normal_radius_m: float = 0.0015
    """Normals are means over the surface within this [m], across no edge: a third of the finger
    pads' size, over which they feel a scan's noise as little as that. 0 = the triangles' own."""
    least_width_m: float = 0.001
    """Closest pair [m]: closer ones are the thickness of a scan's double surface."""
    width_margin_m: float = 0.002
    """How much narrower than the open hand a grasp must be [m]."""
    rotations: int = 24
    """Grasps per pair, turned evenly about the closing axis from a random first one; the public
    code has 4 of 360, of which a flat box on a table keeps 5 of 2036: most come from below."""
    contact_depths_m: tuple[float, ...] = (0.0, 0.003, 0.006)
    """Distances of the contacts from the middle of the pads, towards their tips [m], tried in this
    order. Fingers that stand back by 6 mm clear a table, and the pads (12 mm) still hold."""
    opening_margins_m: tuple[float, ...] = (0.004, 0.04)
    """Gaps left on each side of the object before closing [m], tried in this order and cut to the
    open hand; 40 mm is the open hand itself. Of 12,600 grasps of 9 parts the narrow one served
    44 %, the open hand 55 %, one of 2 mm beside them 0.2 %."""
    clearance_m: float = 0.001
    """Least distance of the hand from the grasped object [m]: the error of a good registration."""
    neighbour_clearance_m: float = 0.003
    """Least distance from other objects [m]: the public code's 2.66 mm, rounded up."""
    table_clearance_m: float = 0.002
    """Least distance from the table [m]."""
    object_points: int = 4000
    """Surface points that stand for an object where the arm, not the hand, is checked."""
    spread_m: float = 0.03
    """Distance [m] that counts as much as opposite approach directions when choosing."""

    def __post_init__(self) -> None:
        """Name a value that cannot be.

        Raises:
            InputError: a count below one, a length or friction out of range, nothing to try.
        """
        for name in ("surface_points", "rays_per_point", "rotations"):
            if getattr(self, name) < 1:
                value = getattr(self, name)
                raise InputError(f"candidates: {name} is {value}; at least 1 is needed.")
        if not (math.isfinite(self.friction) and self.friction > 0):
            raise InputError(
                f"candidates: a friction of {self.friction} has no cone; a positive one is needed."
            )
        for name in ("least_width_m", "clearance_m", "spread_m"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"candidates: {name} is {value} m; a positive length is needed.")
        if not self.contact_depths_m or not self.opening_margins_m:
            raise InputError("candidates: at least one contact depth and opening margin is needed.")
        if min(self.opening_margins_m) <= self.clearance_m:
            raise InputError(
                f"candidates: an opening margin of {min(self.opening_margins_m)} m is within the "
                f"clearance of {self.clearance_m} m, so no hand could be free."
            )
