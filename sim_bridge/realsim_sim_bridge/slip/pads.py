"""How the fingers touch: sphere pads, the same in every engine."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True, slots=True)
class PadModel:
    """Spheres in front of a finger's box.

    Flat pads carry their load on one corner in Bullet's solver, so that they turn like a point, and
    a mesh finger touches at two or three points in MuJoCo; six spheres share the load evenly. Their
    mean distance from the centre, 7.66 mm, is that of an evenly loaded patch of 20 x 20 mm.
    """

    sphere_radius_m: float = 0.004
    """Radius of a pad's spheres [m]."""
    protrusion_m: float = 0.0015
    """How far the spheres stand out of the finger's box [m]; at 0.3 mm the box touches too."""
    x_m: tuple[float, ...] = (-0.006, 0.006)
    """x of the spheres' centres [m]."""
    z_m: tuple[float, ...] = (-0.006, 0.0, 0.006)
    """z of the spheres' centres [m]."""
    finger_mass_kg: float = 0.1
    """Mass of a finger [kg]."""

    def centers_xz(self) -> NDArray[np.float64]:
        """Return x and z (S, 2) of the spheres' centres [m], grasp frame."""
        return np.array([[x, z] for x in self.x_m for z in self.z_m])
