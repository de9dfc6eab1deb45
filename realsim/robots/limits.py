"""How far and how fast the joints of an arm may go."""

from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Mask
from realsim.errors import InputError
from realsim.geometry.dh import DhArm, checked_row


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class JointLimits:
    """How far and how fast each joint may go."""

    lower: Array
    """(n,) least joint angle [rad]."""
    upper: Array
    """(n,) greatest joint angle [rad]."""
    speed: Array
    """(n,) greatest joint speed [rad/s]."""
    acceleration: Array
    """(n,) greatest joint acceleration [rad/s^2]."""

    def __post_init__(self) -> None:
        """Check the order of the limits and freeze the arrays."""
        n = len(checked_row(self.lower, "joint limits: lower"))
        for name in ("lower", "upper", "speed", "acceleration"):
            row = checked_row(getattr(self, name), f"joint limits: {name}", n)
            object.__setattr__(self, name, row)
        if np.any(self.lower >= self.upper):
            raise InputError("joint limits: every lower limit must be below its upper limit.")
        if np.any(self.speed <= 0) or np.any(self.acceleration <= 0):
            raise InputError("joint limits: speeds and accelerations must be positive.")

    def contains(self, joints: ArrayLike) -> Mask:
        """Return (...) whether joints (..., n) [rad] are inside the limits."""
        q = np.asarray(joints, dtype=np.float64)
        return np.all((q >= self.lower) & (q <= self.upper), axis=-1)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LimitedArm(DhArm):
    """An arm with the limits of its joints."""

    limits: JointLimits

    @classmethod
    def of(cls, arm: DhArm, limits: JointLimits) -> Self:
        """Return an arm with limits.

        Raises:
            InputError: the limits are those of another number of joints.
        """
        numbers = {f.name: getattr(arm, f.name) for f in fields(DhArm)}
        return cls(**numbers, limits=limits)

    def __post_init__(self) -> None:
        """Check that limits and numbers are of as many joints."""
        super(LimitedArm, self).__post_init__()
        if len(self.limits.lower) != self.joints:
            raise InputError(
                f"{self.name}: limits of {len(self.limits.lower)} joints, numbers of {self.joints}."
            )

    def nominal(self) -> Self:
        """Return the arm without its calibration."""
        zero = np.zeros(self.joints)
        return replace(self, delta_a=zero, delta_d=zero, delta_alpha=zero, delta_theta=zero)
