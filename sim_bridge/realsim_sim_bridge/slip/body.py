"""An object as the physics engines need it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SlipBody:
    """Convex parts and matter of an object."""

    parts: tuple[Array, ...]
    """Vertices (V, 3) of each convex part, object frame [m]."""
    mass_kg: float
    center_of_mass: Array
    """(3,) object frame [m]."""
    inertia: Array
    """(3, 3) about the centre of mass, object axes [kg m^2]."""

    def principal_frame(self) -> tuple[Array, Array]:
        """Return T_obj_body (4, 4), at the centre of mass along the principal axes, and moments."""
        moments, axes = np.linalg.eigh(self.inertia)
        if np.linalg.det(axes) < 0:
            axes[:, 0] = -axes[:, 0]
        return se3.from_rt(axes, self.center_of_mass), moments

    def reach(self) -> float:
        """Return the greatest distance of a vertex from the centre of mass [m]."""
        corners = np.concatenate(self.parts) - self.center_of_mass
        return float(np.linalg.norm(corners, axis=1).max())
