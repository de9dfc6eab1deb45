"""The simulated UR5: it goes where it is told and reports what its controller believes."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import InputError
from realsim_capture_plans.arms.kinematics import JOINTS, UR5, DhChain, JointLimits
from realsim_capture_plans.devices.interfaces import ArmState

Array = NDArray[np.float64]

HOME = np.radians([0.0, -90.0, 90.0, -90.0, -90.0, 0.0])
"""(6,) where the arm stands when it is switched on: folded, the tool looking down [rad]."""


class SimulatedArm:
    """A UR5 without errors of its own knowledge: the errors are in where it really stands.

    The reported pose is the nominal forward kinematics of the commanded joints. The true flange,
    which only the lab's truth knows, is elsewhere by the errors of the chain and the repeatability.
    Time is simulated: a move lasts as long as moveJ's trapezoid of its leading joint.
    """

    def __init__(self, chain: DhChain = UR5) -> None:
        """Switch the arm on at its home position."""
        self._chain = chain
        self._joints = HOME.copy()
        self._time_s = 0.0

    @property
    def name(self) -> str:
        """Model name, a key of `kinematics.CHAINS`."""
        return self._chain.name

    @property
    def limits(self) -> JointLimits:
        """Limits of the joints."""
        return self._chain.limits

    @property
    def description(self) -> dict[str, Any]:
        """What is kept with the session."""
        return {"model": self.name, "simulated": True}

    def recover(self) -> None:
        """Do nothing: this arm never stops by itself."""

    def move(self, joints: ArrayLike, speed: float = 1.05, acceleration: float = 1.4) -> None:
        """Go to joints (6,) [rad] at the speed [rad/s] and acceleration [rad/s^2] of moveJ.

        Raises:
            InputError: the goal is not 6 finite angles within the limits; the arm has not moved.
        """
        goal = np.array(joints, dtype=np.float64)
        if goal.shape != (JOINTS,) or not np.all(np.isfinite(goal)):
            raise InputError(f"the goal is {goal.tolist()}; {JOINTS} finite angles are needed.")
        if not self.limits.contains(goal):
            bad = np.flatnonzero((goal < self.limits.lower) | (goal > self.limits.upper))
            raise InputError(
                f"the goal's joints {bad.tolist()} (counted from 0) are at "
                f"{np.degrees(goal[bad]).round(1).tolist()} deg, outside the limits "
                f"{np.degrees(self.limits.lower[bad]).round(1).tolist()} to "
                f"{np.degrees(self.limits.upper[bad]).round(1).tolist()} deg; the arm stays."
            )
        d = float(np.max(np.abs(goal - self._joints)))
        cruise = d >= speed**2 / acceleration
        self._time_s += (
            d / speed + speed / acceleration if cruise else 2 * (d / acceleration) ** 0.5
        )
        self._joints = goal

    def state(self) -> ArmState:
        """Return where the arm believes it is."""
        return ArmState(
            joints=self._joints,
            T_base_ee=self._chain.forward(self._joints),
            time_s=self._time_s,
        )
