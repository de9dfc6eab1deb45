"""Settings of a scene's world in PyBullet."""

import math
from dataclasses import dataclass

from realsim.errors import InputError


@dataclass(frozen=True, kw_only=True, slots=True)
class WorldConfig:
    """Settings under which a box on a table rests; each is read back from the engine."""

    friction: float = 1.0
    """Coulomb coefficient of every contact; the paper's. Bullet multiplies the two bodies', so each
    gets its square root."""
    gravity: float = 9.81
    """[m/s^2]."""
    rate_hz: float = 480.0
    """Steps per second: at 240 a 10 g part under a 2 kg one is pressed out from under it within
    2 s; at 480 it shifts by 0.2 mm."""
    iterations: int = 300
    """Solver iterations a step, which also are for stacks: weight is handed down part by part."""
    collision_margin_m: float = 0.0005
    """Bullet's skin around every hull [m], for which the hulls are drawn in (`drawn_in`): contacts
    rest within it, where normals are right, and a box still stands within 0.01 mm of its place."""
    table_reach_m: float = 2.0
    """The table ends so far beyond the outermost object [m]: only what rolls away falls off."""
    table_depth_m: float = 1.0
    """Thickness of the table [m]: deeper than anything sinks, so that it is pushed out upwards. A
    box, not Bullet's infinite plane, on which a resting box starts with 27 mm/s."""
    fat_ratio: float = 1.10
    """Convex parts of a larger share of the mesh's volume are named: they meet too early."""
    thin_ratio: float = 0.90
    """And those of a smaller share: bodies sink into each other."""

    def __post_init__(self) -> None:
        """Check what would make the physics meaningless."""
        if not (math.isfinite(self.friction) and self.friction > 0):
            raise InputError(
                f"the friction is {self.friction}; a positive Coulomb coefficient is needed (wood "
                "on wood 0.4, rubber 1). Without friction nothing stands and nothing is held."
            )
        if not (math.isfinite(self.gravity) and self.gravity > 0):
            raise InputError(f"gravity is {self.gravity} m/s^2; a positive number is needed.")
        if not (self.rate_hz >= 60 and self.iterations >= 1):
            raise InputError(
                f"{self.rate_hz} steps a second of {self.iterations} iterations are too coarse; "
                "at least 60 and 1 are needed (480, 300)."
            )
        if not (self.table_reach_m > 0 and self.table_depth_m > 0):
            raise InputError("the table needs a positive reach and thickness.")
        if self.collision_margin_m < 0:
            raise InputError("a collision margin below 0 m is none; 0 is accepted.")
