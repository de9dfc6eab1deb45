"""The arm's chain in compiled code: frames of the links, and joints that follow a straight line.

The same equations as `panda.link_frames` and `panda.jacobian`, without Python between them. A frame
is its upper three rows (3, 4).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.compiled import njit
from realsim_sim_bridge.arm import panda

Array = NDArray[np.float64]

NEWTON_STEPS = 6
"""Most Newton steps per followed pose: 2 cm apart, the error is below 1e-9 after three."""
NEWTON_END = 1e-10
"""A pose is reached when the error [m, rad] is below this."""
DAMPING = 1e-10
"""Keeps the step finite at a singularity, where the error then stays large [m^2]."""
LARGEST_STEP_RAD = 0.5
"""Larger Newton steps happen only near singularities, and they would change the branch."""

_COS_ALPHA, _SIN_ALPHA = np.cos(panda.ALPHA), np.sin(panda.ALPHA)
_A, _D = panda.A_M.copy(), panda.D_M.copy()
_T_7_GRASP = np.linalg.inv(panda.JOINT7_GRASP)


@njit
def frames_into(q: Any, T_a_base: Any, frames: Any) -> None:
    """Write T_a_link (9, 3, 4) of joints q (7,) into `frames`: base, joints 1 to 7, grasp."""
    for r in range(3):
        for c in range(4):
            frames[0, r, c] = T_a_base[r, c]
    for i in range(7):
        cos, sin, ca, sa = np.cos(q[i]), np.sin(q[i]), _COS_ALPHA[i], _SIN_ALPHA[i]
        for r in range(3):
            x, y, z = frames[i, r, 0], frames[i, r, 1], frames[i, r, 2]
            y_turned, z_turned = ca * y + sa * z, ca * z - sa * y
            frames[i + 1, r, 0] = cos * x + sin * y_turned
            frames[i + 1, r, 1] = cos * y_turned - sin * x
            frames[i + 1, r, 2] = z_turned
            frames[i + 1, r, 3] = frames[i, r, 3] + _A[i] * x + _D[i] * z_turned
    for r in range(3):
        x, y, z = frames[7, r, 0], frames[7, r, 1], frames[7, r, 2]
        for c in range(4):
            frames[8, r, c] = x * _T_7_GRASP[0, c] + y * _T_7_GRASP[1, c] + z * _T_7_GRASP[2, c]
        frames[8, r, 3] += frames[7, r, 3]


@njit
def _jacobian_into(frames: Any, J: Any) -> None:
    """Write the Jacobian (6, 7), rotation first, at the grasp's origin."""
    for i in range(7):
        zx, zy, zz = frames[i + 1, 0, 2], frames[i + 1, 1, 2], frames[i + 1, 2, 2]
        x = frames[8, 0, 3] - frames[i + 1, 0, 3]
        y = frames[8, 1, 3] - frames[i + 1, 1, 3]
        z = frames[8, 2, 3] - frames[i + 1, 2, 3]
        J[0, i], J[1, i], J[2, i] = zx, zy, zz
        J[3, i], J[4, i], J[5, i] = zy * z - zz * y, zz * x - zx * z, zx * y - zy * x


@njit
def _least_motion(J: Any, twist: Any, L: Any, joints: Any) -> None:
    """Write the least joint motion (7,) that gives the twist (6,): J^T (J J^T + damping)^-1 twist.

    L (6, 6) is room for the Cholesky factor.
    """
    y = np.empty(6)
    for r in range(6):
        for c in range(r + 1):
            total = DAMPING if r == c else 0.0
            for k in range(7):
                total += J[r, k] * J[c, k]
            for k in range(c):
                total -= L[r, k] * L[c, k]
            # Rounding may leave a singular square a hair below zero.
            L[r, c] = np.sqrt(max(total, 0.1 * DAMPING)) if r == c else total / L[c, c]
        total = twist[r]
        for k in range(r):
            total -= L[r, k] * y[k]
        y[r] = total / L[r, r]
    for r in range(5, -1, -1):
        for k in range(r + 1, 6):
            y[r] -= L[k, r] * y[k]
        y[r] /= L[r, r]
    for i in range(7):
        joints[i] = 0.0
        for r in range(6):
            joints[i] += J[r, i] * y[r]


@njit
def _gap_to(frames: Any, R: Any, x: float, y: float, z: float, gap: Any) -> float:
    """Write the twist (6,) from the grasp frame to the pose R (3, 3), (x, y, z); return its size.

    The rotation is sin(angle) times the axis, which is zero where the rotations are equal.
    """
    gap[:3] = 0.0
    for k in range(3):
        ax, ay, az = frames[8, 0, k], frames[8, 1, k], frames[8, 2, k]
        bx, by, bz = R[0, k], R[1, k], R[2, k]
        gap[0] += 0.5 * (ay * bz - az * by)
        gap[1] += 0.5 * (az * bx - ax * bz)
        gap[2] += 0.5 * (ax * by - ay * bx)
    gap[3], gap[4], gap[5] = x - frames[8, 0, 3], y - frames[8, 1, 3], z - frames[8, 2, 3]
    total = 0.0
    for k in range(6):
        total += gap[k] * gap[k]
    return np.sqrt(total)


@njit
def follow_lines(q: Any, Ts: Any, directions: Any, distances: Any) -> Any:
    """Follow a straight line from each configuration without changing branch.

    Args:
        q: (B, 7) joints from which to start [rad].
        Ts: (B, 4, 4) T_base_grasp of the line's origin, where `distances` is zero.
        directions: (B, 3) unit vector of each line, base axes.
        distances: (W,) where on the line [m], in the order in which they are followed.

    Returns:
        joints (B, W, 7), their derivatives by the distance (B, W, 7) [rad/m], and the largest error
        left on each line (B,) [m, rad].
    """
    count = len(distances)
    path, slopes = np.empty((len(q), count, 7)), np.empty((len(q), count, 7))
    worst = np.zeros(len(q))
    frames, J, L = np.empty((9, 3, 4)), np.empty((6, 7)), np.zeros((6, 6))
    gap, step, still = np.empty(6), np.empty(7), np.eye(4)
    for b in range(len(q)):
        now = q[b].copy()
        for w in range(count):
            s = distances[w]
            x = Ts[b, 0, 3] + s * directions[b, 0]
            y = Ts[b, 1, 3] + s * directions[b, 1]
            z = Ts[b, 2, 3] + s * directions[b, 2]
            error = np.inf
            for turn in range(NEWTON_STEPS + 1):
                frames_into(now, still, frames)
                error = _gap_to(frames, Ts[b, :3, :3], x, y, z, gap)
                _jacobian_into(frames, J)
                if error < NEWTON_END or turn == NEWTON_STEPS:
                    break
                _least_motion(J, gap, L, step)
                for i in range(7):
                    now[i] += min(max(step[i], -LARGEST_STEP_RAD), LARGEST_STEP_RAD)
            worst[b] = max(worst[b], error)
            gap[:3] = 0.0
            gap[3:] = directions[b]
            _least_motion(J, gap, L, step)
            path[b, w], slopes[b, w] = now, step
    return path, slopes, worst
