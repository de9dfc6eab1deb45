"""The UR arm as a chain of standard Denavit-Hartenberg links: forward, Jacobian, every inverse.

    T_(i-1)_i = Rz(q_i + theta_i) Tz(d_i) Tx(a_i) Rx(alpha_i)

Frame `base` is the controller's base (ROS `base_link` is turned by 180 deg about z against it);
frame `ee` is DH frame 6, the bare tool flange with z out of it (ROS `tool0`). Joints in rad, in
the order base, shoulder, elbow, wrist 1, 2, 3.

A factory calibration ADDS small deltas to the nominal numbers (the controller's calibration.conf),
after which the analytic inverse does not hold any more: it then only seeds a Newton solve on the
chain as it is, so that the inverse is exact for every chain.
"""

from dataclasses import dataclass, fields, replace
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.dh import JOINTS, UR5_ARM, UR5E_ARM, DhArm, checked_row, jacobian_of

Array = NDArray[np.float64]
NEWTON_STEPS = 25
"""Quadratic convergence takes 3-5 from a calibration delta; more only at singular poses."""
POSE_TOLERANCE = 1e-10
"""Norm of the residual twist [rad, m] at which a solution counts as exact."""
SAME_SOLUTION_RAD = 1e-5
"""Two solutions that are nearer than this in every joint are the same branch."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class JointLimits:
    """How far and how fast each joint may go."""

    lower: Array
    """(6,) least joint angle [rad]."""
    upper: Array
    """(6,) greatest joint angle [rad]."""
    speed: Array
    """(6,) greatest joint speed [rad/s]."""
    acceleration: Array
    """(6,) greatest joint acceleration [rad/s^2]."""

    def __post_init__(self) -> None:
        """Check the order of the limits and freeze the arrays."""
        for name in ("lower", "upper", "speed", "acceleration"):
            row = checked_row(getattr(self, name), f"joint limits: {name}")
            object.__setattr__(self, name, row)
        if np.any(self.lower >= self.upper):
            raise InputError("joint limits: every lower limit must be below its upper limit.")
        if np.any(self.speed <= 0) or np.any(self.acceleration <= 0):
            raise InputError("joint limits: speeds and accelerations must be positive.")

    def contains(self, joints: ArrayLike) -> NDArray[np.bool_]:
        """Return (...) whether joints (..., 6) [rad] are inside the limits."""
        q = np.asarray(joints, dtype=np.float64)
        return np.all((q >= self.lower) & (q <= self.upper), axis=-1)


UR_LIMITS = JointLimits(
    # One whole turn each way, but the elbow half (Universal Robots' ur_description).
    lower=np.array([-2.0, -2.0, -1.0, -2.0, -2.0, -2.0]) * np.pi,
    upper=np.array([2.0, 2.0, 1.0, 2.0, 2.0, 2.0]) * np.pi,
    # Datasheet 180 deg/s. The acceleration is not published; moveJ's usual 1.4 rad/s^2 stands here.
    speed=np.full(JOINTS, np.pi),
    acceleration=np.full(JOINTS, 1.4),
)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class DhChain(DhArm):
    """An arm that can also be asked backwards, with its limits."""

    limits: JointLimits = UR_LIMITS

    @classmethod
    def of(cls, arm: DhArm, limits: JointLimits = UR_LIMITS) -> "DhChain":
        """Return the chain of an arm."""
        numbers = {f.name: getattr(arm, f.name) for f in fields(DhArm)}
        return cls(**numbers, limits=limits)

    def nominal(self) -> "DhChain":
        """Return the chain without its calibration."""
        zero = np.zeros(JOINTS)
        return replace(self, delta_a=zero, delta_d=zero, delta_alpha=zero, delta_theta=zero)

    def sigma_min(self, joints: ArrayLike) -> Array:
        """Return the least singular value (...) of the Jacobian (rad and m taken as they are)."""
        sigma = np.linalg.svd(self.jacobian(joints), compute_uv=False)[..., -1]
        return np.asarray(sigma, dtype=np.float64)

    def inverse(self, T_base_ee: ArrayLike) -> Array:
        """Return every joint vector (K, 6) [rad] within the limits that reaches the pose (4, 4).

        K is 0 where the pose is out of reach. Branches come with all their whole turns.
        """
        q, _ = self.inverse_branches(np.asarray(T_base_ee, dtype=np.float64)[None])
        return self.whole_turns(q)

    def inverse_branches(self, Ts_base_ee: ArrayLike) -> tuple[Array, NDArray[np.intp]]:
        """Return the branches (at most 8 a pose, angles in (-pi, pi]) that reach each pose.

        Args:
            Ts_base_ee: (N, 4, 4) poses.

        Returns:
            joints (M, 6) [rad] and the number (M,) of the pose that each reaches.
        """
        Ts = np.asarray(Ts_base_ee, dtype=np.float64)
        found = _analytic(tuple(self.alpha), tuple(self.a), tuple(self.d)).IK_batched(list(Ts))
        seeds: list[Array] = []
        owner: list[int] = []
        for i, solution in enumerate(found):
            for q, is_least_squares in zip(solution.Q, solution.is_LS, strict=True):
                if not is_least_squares:
                    seeds.append(np.asarray(q, dtype=np.float64))
                    owner.append(i)
        if not seeds:
            return np.zeros((0, JOINTS)), np.zeros(0, dtype=np.intp)
        of = np.array(owner, dtype=np.intp)
        q, converged = self.refine(np.stack(seeds) - self.theta, Ts[of])
        q = np.pi - np.mod(np.pi - q, 2 * np.pi)  # into (-pi, pi]
        keep = converged & ~_repeated(q, of)
        return q[keep], of[keep]

    def refine(self, joints: ArrayLike, Ts_base_ee: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Return joints (M, 6) moved by Newton steps onto poses (M, 4, 4), and which arrived."""
        q = np.array(joints, dtype=np.float64)
        T = np.asarray(Ts_base_ee, dtype=np.float64)
        frames = self.link_frames(q)
        error = se3.log(se3.invert(frames[:, JOINTS]) @ T)
        for _ in range(NEWTON_STEPS):
            todo = np.linalg.norm(error, axis=-1) > POSE_TOLERANCE
            if not np.any(todo):
                break
            # The pseudo-inverse with a cut keeps a singular wrist from leaping away.
            step = np.linalg.pinv(jacobian_of(frames[todo]), rcond=1e-6) @ error[todo, :, None]
            q[todo] += np.clip(step[..., 0], -0.2, 0.2)
            frames[todo] = self.link_frames(q[todo])
            error[todo] = se3.log(se3.invert(frames[todo, JOINTS]) @ T[todo])
        return q, np.linalg.norm(error, axis=-1) <= POSE_TOLERANCE

    def whole_turns(self, joints: ArrayLike) -> Array:
        """Return joints (M, 6) with every combination of whole turns inside the limits (K, 6)."""
        rows: list[Array] = []
        for q in np.asarray(joints, dtype=np.float64):
            choices = [
                [v for v in (x - 2 * np.pi, x, x + 2 * np.pi) if low <= v <= high]
                for x, low, high in zip(q, self.limits.lower, self.limits.upper, strict=True)
            ]
            rows.append(np.array(list(product(*choices)), dtype=np.float64).reshape(-1, JOINTS))
        return np.concatenate(rows) if rows else np.zeros((0, JOINTS))


@lru_cache(maxsize=8)
def _analytic(alpha: tuple[float, ...], a: tuple[float, ...], d: tuple[float, ...]) -> Any:
    """Return EAIK's analytic solver of a nominal chain.

    Raises:
        InputError: the numbers do not have a structure that can be solved in closed form.
    """
    from eaik.IK_DH import DhRobot

    robot = DhRobot(np.array(alpha), np.array(a), np.array(d))
    if not robot.hasKnownDecomposition():
        raise InputError(
            f"a chain with alpha {alpha}, a {a}, d {d} has no closed-form inverse. Give the "
            "nominal numbers as a, d, alpha and what a calibration adds as delta_a, delta_d, ..."
        )
    return robot


def _repeated(q: Array, owner: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return (M,) whether an earlier solution of the same pose is the same branch."""
    repeated = np.zeros(len(q), dtype=bool)
    for lag in range(1, 8):
        if len(q) <= lag:
            break
        gap = np.abs(np.exp(1j * q[lag:]) - np.exp(1j * q[:-lag])).max(-1)
        repeated[lag:] |= (owner[lag:] == owner[:-lag]) & (gap < SAME_SOLUTION_RAD)
    return repeated


UR5 = DhChain.of(UR5_ARM)
"""UR5 of the CB3 series, nominal."""
UR5E = DhChain.of(UR5E_ARM)
"""UR5e, nominal. Its flange is 64 mm off a UR5's at the same joints: never swap them."""

CHAINS = {chain.name: chain for chain in (UR5, UR5E)}
