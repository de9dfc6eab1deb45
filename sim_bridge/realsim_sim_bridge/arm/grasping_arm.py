"""An arm with a hand on its flange: its kinematics from the base to the grasp frame and back."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array, Mask
from realsim.geometry import se3
from realsim.robots.arm import RobotArm
from realsim.robots.compiled_chain import ChainNumbers, chain_numbers
from realsim.robots.hand import Hand
from realsim.robots.inverse import seeds_of
from realsim.robots.limits import JointLimits


@dataclass(frozen=True, eq=False, slots=True)
class GraspingArm:
    """An arm with a hand; frame `base` is the arm's, `grasp` the hand's."""

    arm: RobotArm
    hand: Hand
    numbers: ChainNumbers = field(init=False)
    """The chain with the grasp frame as its tool, for compiled code."""

    def __post_init__(self) -> None:
        """Make the numbers."""
        object.__setattr__(self, "numbers", chain_numbers(self.arm.chain, self.hand.T_ee_grasp))

    @property
    def joints(self) -> int:
        """How many joints the arm has."""
        return self.arm.joints

    @property
    def limits(self) -> JointLimits:
        """The joints' limits."""
        return self.arm.chain.limits

    @property
    def swing_joint(self) -> int:
        """Number of the joint that swings the hand, counted from 0: the first of the wrist."""
        return self.arm.wrist[0]

    def frames(self, q: ArrayLike) -> Array:
        """Return T_base_link (..., n + 2, 4, 4): base, links, and the grasp frame last.

        Args:
            q: (..., n) joint angles [rad].
        """
        links = self.arm.chain.link_frames(q)
        return np.concatenate([links, links[..., -1:, :, :] @ self.hand.T_ee_grasp], axis=-3)

    def forward(self, q: ArrayLike) -> Array:
        """Return T_base_grasp (..., 4, 4) at joint angles q (..., n) [rad]."""
        return self.arm.chain.forward(q) @ self.hand.T_ee_grasp

    def within_limits(self, q: Array, margin: float = 0.0) -> Mask:
        """Return whether all joints (..., n) keep the margin [rad] from their limits."""
        return np.all(
            (q >= self.limits.lower + margin) & (q <= self.limits.upper - margin), axis=-1
        )

    def inverse(
        self, Ts_base_grasp: Array, held_values: int, margin: float, near: Array
    ) -> tuple[NDArray[np.intp], Array]:
        """Return joint angles that reach each of the poses (N, 4, 4) exactly, within limits.

        Args:
            Ts_base_grasp: (N, 4, 4) [m].
            held_values: at how many values the free joint of a redundant arm is held.
            margin: distance kept from the joint limits [rad].
            near: (n,) of a joint's whole turns the one nearest to this is taken [rad].

        Returns:
            owner (S,), the row of each solution's pose, not decreasing, and joints (S, n) [rad].
        """
        Ts = Ts_base_grasp @ se3.invert(self.hand.T_ee_grasp)
        q, owner = seeds_of(self.arm.chain, Ts, held_values)
        low, high = self.limits.lower + margin, self.limits.upper - margin
        q = near + np.mod(q - near + np.pi, 2 * np.pi) - np.pi
        q = np.where(q < low, q + 2 * np.pi, q)
        q = np.where(q > high, q - 2 * np.pi, q)
        inside = np.all((q >= low) & (q <= high), axis=1)
        return owner[inside], q[inside]

    def swing_in_grasp(self, q: Array) -> tuple[Array, Array, Array]:
        """Return where the joint that swings the hand is, in the grasp frame, at q (N, n) [rad].

        Returns:
            its axis (N, 3), a point on it (N, 3) [m], and how far it may turn from there down and
            up (N, 2) [rad].
        """
        j, limits = self.swing_joint, self.limits
        frames = self.frames(q)
        turning = frames[..., j, :, :] @ (self.arm.chain.T_base_0 if j == 0 else np.eye(4))
        T = se3.invert(frames[..., -1, :, :]) @ turning
        left = np.stack([limits.lower[j] - q[..., j], limits.upper[j] - q[..., j]], axis=-1)
        return T[..., :3, 2], T[..., :3, 3], left

    # --- how far it reaches -----------------------------------------------------------------------
    # The shoulder is the point of the first joint's axis beside which the second's passes, the
    # wrist the point of the last but one's beside which the last's passes. Of a Panda these are
    # where axes 1 and 2 and axes 5 and 6 meet.

    @property
    def shoulder_m(self) -> float:
        """Height of the shoulder over the first joint's frame [m]."""
        return float(self.numbers.d[0])

    @property
    def wrist_reach_m(self) -> float:
        """Bound of the distance from the shoulder to the wrist [m].

        Each of the offsets between them is at right angles to the one before, whatever the angles;
        they are taken one by one or in such pairs, however they make the least.
        """
        a, d = self.numbers.a, self.numbers.d
        steps = np.abs(np.stack([a[:-2], d[1:-1]], axis=1).ravel())
        least = [0.0, float(steps[0])]
        for one, two in zip(steps[:-1].tolist(), steps[1:].tolist(), strict=True):
            least.append(min(least[-1] + two, least[-2] + float(np.hypot(one, two))))
        return least[-1]

    def wrist_distance(self, Ts_base_grasp: Array) -> Array:
        """Return the least distance (N,) [m] from the shoulder to the wrist at poses (N, 4, 4).

        The wrist lies on a circle about the last joint's axis, whatever that joint's angle. No
        inverse kinematics exists where this is more than `wrist_reach_m`.
        """
        n, chain = self.numbers, self.arm.chain
        twist = chain.alpha[-1] + chain.delta_alpha[-1]
        T_last_n = se3.from_rt(se3.exp_so3([twist, 0.0, 0.0]), [n.a[-1], 0.0, 0.0])
        Ts = Ts_base_grasp @ se3.invert(T_last_n @ n.T_n_tool)
        shoulder = se3.transform(n.T_base_0, np.array([[0.0, 0.0, n.d[0]]]))[0]
        out = Ts[:, :3, 3] - n.d[-1] * Ts[:, :3, 2] - shoulder
        along = np.sum(out * Ts[:, :3, 2], axis=1)
        across = np.sqrt(np.maximum(np.sum(out * out, axis=1) - along**2, 0.0))
        return np.hypot(along, across - abs(n.a[-2]))
