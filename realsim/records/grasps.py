"""What physics said of the grasps of one object."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records.checked_arrays import Array, frozen

STAGES = ("close", "lift", "oscillate", "pendulum")
"""The four stages of the slip test, in order."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class GraspSet:
    """The grasp candidates of one object instance and what physics said of each.

    Frame `grasp`: origin between the fingertips, z = approach, y = closing axis.
    """

    obj_id: int
    instance: int
    Ts_obj_grasp: Array
    """(N, 4, 4) grasp in object [m]."""
    widths_m: Array
    """(N,) distance of the two contacts along the closing axis [m]."""
    scores: Array
    """(N,) in [0, 1]; NaN = not tried."""
    base_scores: Array
    """(N,) 0, 0.25, 0.5, 0.75 or 1: the stage reached; NaN = not tried."""
    slip_m: Array
    """(N, 4) slip relative to the gripper in each stage [m]; NaN = not executed, inf = lost."""
    slip_rad: Array
    """(N, 4) rotation relative to the gripper in each stage [rad]; NaN, inf likewise."""
    reachable: NDArray[np.bool_]
    """(N,) whether the arm has a collision-free trajectory to closure."""
    failures: tuple[str, ...]
    """(N,) why the grasp stopped where it stopped; '' = passed all."""
    parameters: dict[str, Any] = field(default_factory=dict[str, Any])
    """Everything the scores depend on, as plain JSON values."""

    def __post_init__(self) -> None:
        """Check that all arrays speak of the same grasps and freeze them."""
        T = np.asarray(self.Ts_obj_grasp, dtype=np.float64).reshape(-1, 4, 4)
        n = len(T)
        if n:
            T = se3.check_rigid(T, f"grasps of instance {self.instance}")
        object.__setattr__(self, "Ts_obj_grasp", frozen(T, np.float64, (n, 4, 4), "Ts_obj_grasp"))
        for name in ("widths_m", "scores", "base_scores"):
            object.__setattr__(self, name, frozen(getattr(self, name), np.float64, (n,), name))
        for name in ("slip_m", "slip_rad"):
            value = np.asarray(getattr(self, name), dtype=np.float64).reshape(n, len(STAGES))
            object.__setattr__(self, name, frozen(value, np.float64, (n, len(STAGES)), name))
        object.__setattr__(self, "reachable", frozen(self.reachable, np.bool_, (n,), "reachable"))
        if len(self.failures) != n:
            raise InputError(f"{len(self.failures)} failure notes for {n} grasps.")

    def __len__(self) -> int:
        """Return the number of grasps."""
        return len(self.Ts_obj_grasp)

    @property
    def good(self) -> NDArray[np.bool_]:
        """(N,) whether the grasp is good: score >= 0.5."""
        return np.nan_to_num(self.scores, nan=-1.0) >= 0.5
