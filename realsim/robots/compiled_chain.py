"""An arm's chain in compiled code: frames of its links, poses reached, lines followed.

The same equations as `realsim.geometry.dh`, without Python between them. A frame is its upper three
rows (3, 4). Frames of n joints are (n + 2, 3, 4): DH frames 0 to n, then the tool.
"""

from typing import Any, NamedTuple

import numpy as np

from realsim.arrays import Array
from realsim.compiled import njit
from realsim.geometry.dh import DhArm
from realsim.robots.limits import LimitedArm

NEWTON_STEPS = 6
"""Most Newton steps per followed pose: 2 cm apart, the error is below 1e-9 after three."""
NEWTON_END = 1e-10
"""A pose is reached when the error [m, rad] is below this."""
SOLVED = 1e-12
"""A seed has become a solution when the error [m, rad] is below this."""
DAMPING = 1e-10
"""Keeps the step finite at a singularity, where the error then stays large [m^2]."""
LARGEST_STEP_RAD = 0.5
"""Larger Newton steps happen only near singularities, and they would change the branch."""


class ChainNumbers(NamedTuple):
    """A chain and its tool; a tuple, so that compiled code takes it."""

    theta: Array
    """(n,) [rad]."""
    d: Array
    """(n,) [m]."""
    a: Array
    """(n,) [m]."""
    cos_alpha: Array
    """(n,)."""
    sin_alpha: Array
    """(n,)."""
    T_base_0: Array
    """(4, 4) [m]."""
    T_n_tool: Array
    """(4, 4) [m]."""
    lower: Array
    """(n,) joint limits [rad]."""
    upper: Array
    """(n,) [rad]."""


def chain_numbers(chain: LimitedArm, T_ee_tool: Array | None = None) -> ChainNumbers:
    """Return a chain for compiled code, its calibration included.

    Args:
        chain: the arm.
        T_ee_tool: (4, 4) what is to reach poses, in the flange [m]; None = the flange itself.
    """
    alpha = chain.alpha + chain.delta_alpha
    T_n_tool = chain.T_n_ee if T_ee_tool is None else chain.T_n_ee @ T_ee_tool
    return ChainNumbers(
        theta=chain.theta + chain.delta_theta,
        d=chain.d + chain.delta_d,
        a=chain.a + chain.delta_a,
        cos_alpha=np.cos(alpha),
        sin_alpha=np.sin(alpha),
        T_base_0=np.array(chain.T_base_0),
        T_n_tool=np.array(T_n_tool),
        lower=np.array(chain.limits.lower),
        upper=np.array(chain.limits.upper),
    )


def in_dh_frame(arm: DhArm, link: int) -> Array:
    """Return (4, 4) link's frame of `DhArm.link_frames` in the DH frame of that number [m]."""
    if link == 0:
        from realsim.geometry import se3

        return se3.invert(arm.T_base_0)
    return np.array(arm.T_n_ee) if link == arm.joints else np.eye(4)


@njit
def frames_into(chain: Any, q: Any, T_a_base: Any, frames: Any) -> None:
    """Write T_a_link (n + 2, 3, 4) of joints q (n,) into `frames`: DH frames 0 to n, tool."""
    n = len(q)
    _product_into(T_a_base, chain.T_base_0, frames[0])
    for i in range(n):
        angle = q[i] + chain.theta[i]
        c, s, ca, sa = np.cos(angle), np.sin(angle), chain.cos_alpha[i], chain.sin_alpha[i]
        a, d = chain.a[i], chain.d[i]
        for r in range(3):
            x, y, z = frames[i, r, 0], frames[i, r, 1], frames[i, r, 2]
            along, across = c * x + s * y, c * y - s * x
            frames[i + 1, r, 0] = along
            frames[i + 1, r, 1] = ca * across + sa * z
            frames[i + 1, r, 2] = ca * z - sa * across
            frames[i + 1, r, 3] = frames[i, r, 3] + a * along + d * z
    _product_into(frames[n], chain.T_n_tool, frames[n + 1])


@njit
def _product_into(A: Any, B: Any, out: Any) -> None:
    """Write the upper rows of A @ B."""
    for r in range(3):
        for c in range(4):
            out[r, c] = A[r, 0] * B[0, c] + A[r, 1] * B[1, c] + A[r, 2] * B[2, c]
        out[r, 3] += A[r, 3]


@njit
def jacobian_into(frames: Any, J: Any) -> None:
    """Write the Jacobian (6, n), rotation first, at the tool's origin."""
    n = J.shape[1]
    for i in range(n):
        zx, zy, zz = frames[i, 0, 2], frames[i, 1, 2], frames[i, 2, 2]
        x = frames[n + 1, 0, 3] - frames[i, 0, 3]
        y = frames[n + 1, 1, 3] - frames[i, 1, 3]
        z = frames[n + 1, 2, 3] - frames[i, 2, 3]
        J[0, i], J[1, i], J[2, i] = zx, zy, zz
        J[3, i], J[4, i], J[5, i] = zy * z - zz * y, zz * x - zx * z, zx * y - zy * x


@njit
def least_motion(J: Any, twist: Any, damping: float, L: Any, joints: Any) -> None:
    """Write the least joint motion (n,) that gives the twist (6,): J^T (J J^T + damping)^-1 twist.

    L (6, 6) is room for the Cholesky factor.
    """
    n = J.shape[1]
    y = np.empty(6)
    for r in range(6):
        for c in range(r + 1):
            total = damping if r == c else 0.0
            for k in range(n):
                total += J[r, k] * J[c, k]
            for k in range(c):
                total -= L[r, k] * L[c, k]
            # Rounding may leave a singular square a hair below zero.
            L[r, c] = np.sqrt(max(total, 0.1 * damping)) if r == c else total / L[c, c]
        total = twist[r]
        for k in range(r):
            total -= L[r, k] * y[k]
        y[r] = total / L[r, r]
    for r in range(5, -1, -1):
        for k in range(r + 1, 6):
            y[r] -= L[k, r] * y[k]
        y[r] /= L[r, r]
    for i in range(n):
        joints[i] = 0.0
        for r in range(6):
            joints[i] += J[r, i] * y[r]


@njit
def gap_to(frames: Any, R: Any, x: float, y: float, z: float, gap: Any) -> float:
    """Write the twist (6,) from the tool to the pose R (3, 3), (x, y, z); return its size.

    The rotation is sin(angle) times the axis up to a right angle, where it is zero for equal
    rotations; beyond, the axis itself, so that a half turn is not taken for none.
    """
    tool = frames[len(frames) - 1]
    gap[:3] = 0.0
    trace = 0.0
    for k in range(3):
        ax, ay, az = tool[0, k], tool[1, k], tool[2, k]
        bx, by, bz = R[0, k], R[1, k], R[2, k]
        gap[0] += 0.5 * (ay * bz - az * by)
        gap[1] += 0.5 * (az * bx - ax * bz)
        gap[2] += 0.5 * (ax * by - ay * bx)
        trace += ax * bx + ay * by + az * bz
    if trace < 1.0:
        size = np.sqrt(gap[0] ** 2 + gap[1] ** 2 + gap[2] ** 2)
        if size < 1e-6:
            gap[0], size = 1.0, 1.0  # a half turn exactly: any way out of it
        angle = np.arctan2(size, (trace - 1.0) / 2.0)
        for k in range(3):
            gap[k] *= angle / size
    gap[3], gap[4], gap[5] = x - tool[0, 3], y - tool[1, 3], z - tool[2, 3]
    total = 0.0
    for k in range(6):
        total += gap[k] * gap[k]
    return np.sqrt(total)


@njit
def follow_lines(chain: Any, q: Any, Ts: Any, directions: Any, distances: Any) -> Any:
    """Follow a straight line from each configuration without changing branch.

    Args:
        chain: of `chain_numbers`; its tool follows.
        q: (B, n) joints from which to start [rad].
        Ts: (B, 4, 4) T_base_tool of the line's origin, where `distances` is zero.
        directions: (B, 3) unit vector of each line, base axes.
        distances: (W,) where on the line [m], in the order in which they are followed.

    Returns:
        joints (B, W, n), their derivatives by the distance (B, W, n) [rad/m], and the largest error
        left on each line (B,) [m, rad].
    """
    n, count = q.shape[1], len(distances)
    path, slopes = np.empty((len(q), count, n)), np.empty((len(q), count, n))
    worst = np.zeros(len(q))
    frames, J, L = np.empty((n + 2, 3, 4)), np.empty((6, n)), np.zeros((6, 6))
    gap, step, still = np.empty(6), np.empty(n), np.eye(4)
    for b in range(len(q)):
        now = q[b].copy()
        for w in range(count):
            s = distances[w]
            x = Ts[b, 0, 3] + s * directions[b, 0]
            y = Ts[b, 1, 3] + s * directions[b, 1]
            z = Ts[b, 2, 3] + s * directions[b, 2]
            error = np.inf
            for turn in range(NEWTON_STEPS + 1):
                frames_into(chain, now, still, frames)
                error = gap_to(frames, Ts[b, :3, :3], x, y, z, gap)
                jacobian_into(frames, J)
                if error < NEWTON_END or turn == NEWTON_STEPS:
                    break
                least_motion(J, gap, DAMPING, L, step)
                for i in range(n):
                    now[i] += min(max(step[i], -LARGEST_STEP_RAD), LARGEST_STEP_RAD)
            worst[b] = max(worst[b], error)
            gap[:3] = 0.0
            gap[3:] = directions[b]
            least_motion(J, gap, DAMPING, L, step)
            path[b, w], slopes[b, w] = now, step
    return path, slopes, worst


@njit
def solve_from(chain: Any, q: Any, Ts: Any, steps: int, damping: float) -> Any:
    """Move seeds onto poses by damped Newton steps inside the limits.

    Args:
        chain: of `chain_numbers`.
        q: (M, n) seeds [rad]; changed in place.
        Ts: (M, 4, 4) T_base_tool that each is to reach [m].
        steps: most steps of a seed.
        damping: of the least motion, in relation to the square of the gap that is left.

    Returns:
        (M,) whether each arrived.
    """
    n = q.shape[1]
    frames, J, L = np.empty((n + 2, 3, 4)), np.empty((6, n)), np.zeros((6, 6))
    gap, step, still = np.empty(6), np.empty(n), np.eye(4)
    arrived = np.zeros(len(q), dtype=np.bool_)
    for m in range(len(q)):
        for _ in range(steps):
            frames_into(chain, q[m], still, frames)
            error = gap_to(frames, Ts[m, :3, :3], Ts[m, 0, 3], Ts[m, 1, 3], Ts[m, 2, 3], gap)
            if error < SOLVED:
                arrived[m] = True
                break
            jacobian_into(frames, J)
            least_motion(J, gap, DAMPING + damping * min(error * error, 1.0), L, step)
            for i in range(n):
                moved = q[m, i] + min(max(step[i], -LARGEST_STEP_RAD), LARGEST_STEP_RAD)
                q[m, i] = min(max(moved, chain.lower[i]), chain.upper[i])
    return arrived
