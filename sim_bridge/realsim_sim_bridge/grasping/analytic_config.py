"""How GraspNet-style labels of an object are computed."""

import math
from dataclasses import dataclass

from realsim.errors import InputError


@dataclass(frozen=True, kw_only=True, slots=True)
class AnalyticConfig:
    """Which candidates are looked at, and when one closes."""

    points: int = 200
    """Surface points at most, spread over the object; GraspNet has some 500 an object."""
    voxel_m: float = 0.005
    """Least distance of the points [m]: GraspNet's; a small object has fewer points."""
    view_step: int = 1
    """Every so many of the 300 views is looked from: 1 = all, 4 = a quarter of the time."""
    levels: tuple[float, ...] = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
    """Frictions of the labels (Fang et al. 2020, section 3.3: from 1 down to 0.1 by 0.1). The
    evaluation of graspnetAPI has others, 0.2 to 1.2, those of `ClosureConfig`."""
    max_opening_m: float = 0.08
    """How far the gripper opens [m]: the Panda's; GraspNet's gripper opens 0.1 m."""
    clearance_m: float = 0.002
    """Gap on the tighter side between finger and object before closing [m]."""
    least_width_m: float = 0.001
    """Closer contacts are the thickness of a scan's double surface [m]."""

    def __post_init__(self) -> None:
        """Name a value that cannot be.

        Raises:
            InputError: a count below 1, a length or a friction that is not positive.
        """
        for name in ("points", "view_step"):
            if getattr(self, name) < 1:
                raise InputError(f"analytic grasps: {name} is {getattr(self, name)}; 1 or more.")
        for name in ("voxel_m", "max_opening_m", "clearance_m", "least_width_m"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(
                    f"analytic grasps: {name} is {value} m; a length above 0 is needed."
                )
        if not self.levels or not all(math.isfinite(f) and 0 < f <= 2 for f in self.levels):
            raise InputError(
                f"analytic grasps: the friction levels are {self.levels}; numbers above 0, at most "
                "2, are needed."
            )
