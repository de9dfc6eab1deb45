"""An arm as a chain of turning joints with limits: forward, Jacobian, every inverse.

The chain is one of standard Denavit-Hartenberg links (`realsim.geometry.dh`). Its inverse comes in
closed form where the nominal arm has one (six joints), by holding one joint at many values where
that leaves an arm with one (seven), and from a table of seeds otherwise. Whatever it came from is
then moved by Newton steps onto the chain as it is, a factory calibration included, so that the
inverse is exact for every chain.

Denavit-Hartenberg numbers of any chain of turning joints.

Every pair of neighbouring axes has a common normal, so that the transform from one joint's frame
(z is its axis) to the next one's is

    O = Tz(b) Rz(phi) Tx(a) Rx(alpha) Rz(psi) Tz(c)

The screws about z at both ends commute with the joints' own turns and join theirs. The normal may
point either way, and between parallel axes it may stand anywhere along them.
"""

import math
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array, Mask
from realsim.geometry import se3
from realsim.geometry.dh import DhArm
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


PARALLEL_RAD = 1e-6
"""Axes nearer to parallel than this count as parallel [rad]: 1 micrometre at the arm's length.
Their common normal would lie a thousand kilometres away, where 64 bits do not hold micrometres."""
RIGHT_ANGLE_RAD = 1e-5
"""Angles nearer than this to a multiple of a right angle are one: files write 1.5708."""
ROUND_M = 9
"""Digits of a length [m]: nanometres."""


class Screws(NamedTuple):
    """O = Tz(b) Rz(phi) Tx(a) Rx(alpha) Rz(psi) Tz(c)."""

    b: float
    phi: float
    a: float
    alpha: float
    psi: float
    c: float


def normals(T: Array) -> tuple[Array, bool]:
    """Return the common normal (3,) of z and T's z axis, and whether they are parallel."""
    z, axis, p = np.array([0.0, 0.0, 1.0]), T[:3, 2], T[:3, 3]
    normal = np.cross(z, axis)
    sine = float(np.linalg.norm(normal))
    if sine > PARALLEL_RAD:
        return normal / sine, False
    flat = np.array([p[0], p[1], 0.0])
    length = float(np.linalg.norm(flat))
    return (flat / length if length > PARALLEL_RAD else np.array([1.0, 0.0, 0.0])), True


def screws(T: Array, normal: Array, parallel: bool, b: float) -> Screws:
    """Return the screws of a transform (4, 4) along a common normal.

    Args:
        T: from a joint's frame to the next one's.
        normal: of `normals`, or its opposite.
        parallel: whether the axes are; then the normal stands at `b`.
        b: where along the first axis the normal of parallel axes stands [m].
    """
    z, axis, p = np.array([0.0, 0.0, 1.0]), T[:3, 2], T[:3, 3]
    alpha = math.atan2(float(np.cross(z, axis) @ normal), float(axis[2]))
    if parallel:
        alpha = 0.0 if axis[2] > 0 else math.pi
        c = (float(p[2]) - b) * float(np.sign(axis[2]))
    else:
        b, _, c = np.linalg.solve(np.stack([z, normal, axis], -1), p).tolist()
    phi = math.atan2(float(normal[1]), float(normal[0]))
    R_rest = se3.exp_so3([-alpha, 0.0, 0.0]) @ se3.exp_so3([0.0, 0.0, -phi]) @ T[:3, :3]
    psi = math.atan2(float(R_rest[1, 0]), float(R_rest[0, 0]))
    return Screws(b, phi, float(p @ normal), alpha, psi, c)


def dh_of_chain(name: str, steps: Array) -> DhArm:
    """Return the arm `steps[0] Rz(q1) steps[1] Rz(q2) ... Rz(qn) steps[n]`.

    Normals point so that the joints' zeros are moved least, and between parallel axes they stand
    where the link before ends: a UR's numbers come out as its maker writes them. Angles within
    `RIGHT_ANGLE_RAD` of right ones are right, lengths are rounded to nanometres.

    Args:
        name: the arm's.
        steps: (n + 1, 4, 4) from the base to the first joint's frame, from joint to joint, and from
            the last joint to the flange, joints at zero [m].
    """
    n = len(steps) - 1
    numbers = {key: np.zeros(n) for key in ("theta", "d", "a", "alpha")}
    T_base_0, psi, c = _beginning(steps[0])
    for i in range(n):
        T = steps[i + 1]
        normal, parallel = normals(T)
        if i == n - 1 and parallel and np.hypot(*T[:2, 3]) < PARALLEL_RAD:
            # The flange on the last axis: its x is the normal, and nothing is left over.
            found = screws(T, _flat(T[:3, 0]), True, float(T[2, 3]))
        else:
            found = min(
                (screws(T, way, parallel, -c) for way in (normal, -normal)),
                key=lambda s: abs(_wrapped(psi + s.phi + 1e-9)),
            )
        numbers["theta"][i], numbers["d"][i] = _wrapped(psi + found.phi), c + found.b
        numbers["a"][i], numbers["alpha"][i] = found.a, found.alpha
        psi, c = found.psi, found.c
    T_n_ee = se3.from_rt(se3.exp_so3([0.0, 0.0, _right(psi)]), [0.0, 0.0, round(c, ROUND_M)])
    return DhArm(
        name=name,
        a=numbers["a"].round(ROUND_M) + 0.0,
        d=numbers["d"].round(ROUND_M) + 0.0,
        alpha=np.array([_right(x) for x in numbers["alpha"]]),
        theta=np.array([_right(x) for x in numbers["theta"]]),
        T_base_0=T_base_0,
        T_n_ee=T_n_ee,
    )


def _beginning(T: Array) -> tuple[Array, float, float]:
    """Return T_base_0, and what the first joint takes over of a turn and a shift about its axis."""
    tilt = max(float(np.abs(T[:3, 2] - [0, 0, 1]).max()), float(np.abs(T[:2, 3]).max()))
    if tilt > PARALLEL_RAD:
        return np.array(T), 0.0, 0.0
    return np.eye(4), math.atan2(float(T[1, 0]), float(T[0, 0])), float(T[2, 3])


def _flat(x: Array) -> Array:
    return np.array([x[0], x[1], 0.0]) / np.hypot(x[0], x[1])


def _wrapped(angle: float) -> float:
    """Return the angle in (-pi, pi]."""
    return math.pi - (math.pi - angle) % (2 * math.pi)


def _right(angle: float) -> float:
    """Return the angle, exactly a right one's multiple if it is nearly one."""
    quarter = round(angle / (math.pi / 2))
    near = quarter * (math.pi / 2)
    return near if abs(angle - near) < RIGHT_ANGLE_RAD else angle
