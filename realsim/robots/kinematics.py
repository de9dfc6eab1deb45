"""An arm as a chain of turning joints with limits: forward, Jacobian, every inverse.

The chain is one of standard Denavit-Hartenberg links (`realsim.geometry.dh`). Its inverse comes in
closed form where the nominal arm has one (six joints), by holding one joint at many values where
that leaves an arm with one (seven), and from a table of seeds otherwise. Whatever it came from is
then moved by Newton steps onto the chain as it is, a factory calibration included, so that the
inverse is exact for every chain.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array, Mask
from realsim.geometry import se3
from realsim.robots import inverse
from realsim.robots.limits import LimitedArm

NEWTON_STEPS = 25
"""Quadratic convergence takes 3-5 from a calibration delta; more only at singular poses."""
POSE_TOLERANCE = 1e-10
"""Norm of the residual twist [rad, m] at which a solution counts as exact."""
NEAR_LIMIT_RAD = 0.1
"""A nominal arm's solution farther outside the limits than this is no calibrated arm's [rad]."""
SAME_SOLUTION_RAD = 1e-5
"""Two solutions that are nearer than this in every joint are the same branch."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class DhChain(LimitedArm):
    """An arm that can also be asked backwards."""

    def sigma_min(self, joints: ArrayLike) -> Array:
        """Return the least singular value (...) of the Jacobian (rad and m taken as they are)."""
        sigma = np.linalg.svd(self.jacobian(joints), compute_uv=False)[..., -1]
        return np.asarray(sigma, dtype=np.float64)

    def inverse(self, T_base_ee: ArrayLike) -> Array:
        """Return every joint vector (K, n) [rad] within the limits that reaches the pose (4, 4).

        K is 0 where the pose is out of reach. Branches come with all their whole turns.
        """
        q, _ = self.inverse_branches(np.asarray(T_base_ee, dtype=np.float64)[None])
        return self.whole_turns(q)

    def inverse_branches(self, Ts_base_ee: ArrayLike) -> tuple[Array, NDArray[np.intp]]:
        """Return the branches inside the limits that reach each pose, whole turns left out.

        Six joints with a closed form have all their branches, at most 8 or 16 a pose. Others have
        those that `realsim.robots.inverse` finds: of seven joints, samples of each branch's family.

        Args:
            Ts_base_ee: (N, 4, 4) poses.

        Returns:
            joints (M, n) [rad] and the number (M,) of the pose that each reaches.
        """
        Ts = np.asarray(Ts_base_ee, dtype=np.float64)
        q, of = self._exact(*inverse.seeds_of(self, Ts), Ts)
        missed = np.setdiff1d(np.arange(len(Ts)), of)
        if len(missed) and inverse.is_sampled(self):
            more, which = self._exact(*inverse.seeds_from_table(self, Ts[missed]), Ts[missed])
            q, of = np.concatenate([q, more]), np.concatenate([of, missed[which]])
            order = np.argsort(of, kind="stable")
            q, of = q[order], of[order]
        return q, of

    def _exact(
        self, seeds: Array, of: NDArray[np.intp], Ts: Array
    ) -> tuple[Array, NDArray[np.intp]]:
        """Return seeds (M, n) of poses `of` moved onto them, those inside the limits, each once."""
        q = self._turned_inside(np.pi - np.mod(np.pi - seeds, 2 * np.pi))  # into (-pi, pi]
        limits = self.limits
        inside = (q > limits.lower - NEAR_LIMIT_RAD) & (q < limits.upper + NEAR_LIMIT_RAD)
        near = np.all(inside, axis=-1)
        q, of = q[near], of[near]
        if not len(q):
            return q, of
        q, converged = self.refine(q, Ts[of])
        q = self._turned_inside(np.pi - np.mod(np.pi - q, 2 * np.pi))
        keep = converged & limits.contains(q) & ~_repeated(q, of)
        return q[keep], of[keep]

    def _turned_inside(self, q: Array) -> Array:
        """Return joints (M, n) with single whole turns added where only that is inside limits."""
        low, high = self.limits.lower, self.limits.upper
        q = np.where((q < low) & (q + 2 * np.pi <= high), q + 2 * np.pi, q)
        return np.where((q > high) & (q - 2 * np.pi >= low), q - 2 * np.pi, q)

    def refine(self, joints: ArrayLike, Ts_base_ee: ArrayLike) -> tuple[Array, Mask]:
        """Return joints (M, n) moved by Newton steps onto poses (M, 4, 4), and which arrived."""
        q = np.array(joints, dtype=np.float64)
        T = np.asarray(Ts_base_ee, dtype=np.float64)
        frames = self.link_frames(q)
        error = se3.log(se3.invert(frames[:, -1]) @ T)
        for _ in range(NEWTON_STEPS):
            todo = np.linalg.norm(error, axis=-1) > POSE_TOLERANCE
            if not np.any(todo):
                break
            # The pseudo-inverse with a cut keeps a singular wrist from leaping away.
            step = np.linalg.pinv(self.jacobian_of(frames[todo]), rcond=1e-6) @ error[todo, :, None]
            q[todo] += np.clip(step[..., 0], -0.2, 0.2)
            frames[todo] = self.link_frames(q[todo])
            error[todo] = se3.log(se3.invert(frames[todo, -1]) @ T[todo])
        return q, np.linalg.norm(error, axis=-1) <= POSE_TOLERANCE

    def whole_turns(self, joints: ArrayLike) -> Array:
        """Return joints (M, n) with every combination of whole turns inside the limits (K, n)."""
        rows: list[Array] = []
        for q in np.asarray(joints, dtype=np.float64):
            choices = [
                [v for v in (x - 2 * np.pi, x, x + 2 * np.pi) if low <= v <= high]
                for x, low, high in zip(q, self.limits.lower, self.limits.upper, strict=True)
            ]
            rows.append(
                np.array(list(product(*choices)), dtype=np.float64).reshape(-1, self.joints)
            )
        return np.concatenate(rows) if rows else np.zeros((0, self.joints))


def _repeated(q: Array, owner: NDArray[np.intp]) -> Mask:
    """Return (M,) whether an earlier solution of the same pose is the same branch."""
    repeated = np.zeros(len(q), dtype=bool)
    for lag in range(1, 8):
        if len(q) <= lag:
            break
        gap = np.abs(np.exp(1j * q[lag:]) - np.exp(1j * q[:-lag])).max(-1)
        repeated[lag:] |= (owner[lag:] == owner[:-lag]) & (gap < SAME_SOLUTION_RAD)
    return repeated
