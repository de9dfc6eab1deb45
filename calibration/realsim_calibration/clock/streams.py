"""Streams of stamped poses: interpolation, velocity, and a first offset from turning speeds."""

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Mask
from realsim.errors import InputError
from realsim.geometry import se3

SPEED_WINDOW_S = 0.2
"""Turning speeds are taken over this long [s]: a board's pose is off by milliradians."""
LEAST_OVERLAP = 0.25
"""Offsets are tried at which the shorter stream's moving part overlaps by this share."""
SPIKE_RATIO, SPIKE_RAD, SPIKE_ROUNDS = 8.0, 0.05, 4
"""A pose is a spike when its detour exceeds so many medians and so much [rad]."""
LEAST_POSES = 3
GAP_S = 0.5
"""Nothing is known of a hand between poses further apart than this [s] and than two periods."""
STEPS_PER_WINDOW = 10
"""Lags tried per window: the peak is as wide as the window."""


def checked_stream(times: ArrayLike, Ts: ArrayLike, name: str) -> tuple[Array, Array]:
    """Return a stream in the order of time, each time once, poses that are not finite left out.

    Raises:
        InputError: times and poses differ in number, or fewer than three are left.
    """
    times, Ts = np.asarray(times, dtype=np.float64), np.asarray(Ts, dtype=np.float64)
    if times.shape != (len(Ts),) or Ts.shape[1:] != (4, 4):
        raise InputError(
            f"clock: {name} has {times.shape} times and poses of shape {Ts.shape}; (n,) and "
            "(n, 4, 4) are needed."
        )
    known = np.isfinite(times) & np.isfinite(Ts).all(axis=(1, 2))
    order = np.unique(times[known], return_index=True)[1]
    times, Ts = times[known][order], Ts[known][order]
    if len(times) < 3:
        raise InputError(
            f"clock: {name} has {len(times)} poses with a time stamp; at least 3 are needed, and "
            "some seconds of motion are advised."
        )
    return times, Ts


def interpolated(times: Array, Ts: Array, at: Array) -> tuple[Array, Mask]:
    """Return the poses (m, 4, 4) of a stream at times (m,), and which lie inside it.

    Rotations go along the shortest turn, positions along the chord. Poses outside are those of the
    nearest end.
    """
    inside = (at >= times[0]) & (at <= times[-1])
    k = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
    share = np.clip((at - times[k]) / (times[k + 1] - times[k]), 0.0, 1.0)[:, None]
    R = Ts[k, :3, :3]
    turn = se3.log_so3(np.swapaxes(R, 1, 2) @ Ts[k + 1, :3, :3])
    t = Ts[k, :3, 3] * (1 - share) + Ts[k + 1, :3, 3] * share
    return se3.from_rt(R @ se3.exp_so3(share * turn), t), inside


def in_gap(times: Array, at: Array) -> Mask:
    """Return (m,) which times lie between two poses of a stream that are too far apart."""
    k = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
    wide = times[k + 1] - times[k] > max(GAP_S, window_of(times))
    return wide & (at > times[k]) & (at < times[k + 1])


def velocities(times: Array, Ts: Array, at: Array, window_s: float) -> Array:
    """Return the body twists (m, 6) [rad/s, m/s] over a window around times (m,)."""
    before = np.maximum(at - window_s / 2, times[0])
    after = np.minimum(at + window_s / 2, times[-1])
    step = se3.invert(interpolated(times, Ts, before)[0]) @ interpolated(times, Ts, after)[0]
    return se3.log(step) / np.maximum(after - before, 1e-9)[:, None]


def without_spikes(times: Array, Ts: Array) -> tuple[Array, Array]:
    """Return a stream without poses that turn away from both neighbours and back."""
    for _ in range(SPIKE_ROUNDS):
        R = Ts[:, :3, :3]
        step = np.linalg.norm(se3.log_so3(np.swapaxes(R[:-1], 1, 2) @ R[1:]), axis=-1)
        over = np.linalg.norm(se3.log_so3(np.swapaxes(R[:-2], 1, 2) @ R[2:]), axis=-1)
        detour = np.zeros(len(R))
        detour[1:-1] = step[:-1] + step[1:] - over
        limit = max(SPIKE_RATIO * float(np.median(detour)), SPIKE_RAD)
        # Neighbours of a spike make a detour, too: only the largest of three is one.
        around = np.pad(detour, 1)
        keep = (detour <= limit) | (detour < np.maximum(around[:-2], around[2:]))
        if keep.all() or keep.sum() < LEAST_POSES:
            break
        times, Ts = times[keep], Ts[keep]
    return times, Ts


def window_of(times: Array) -> float:
    """Return the window of velocities for a stream [s]: two frames at least."""
    return max(SPEED_WINDOW_S, 2 * float(np.median(np.diff(times))))


def turning_speeds(times: Array, Ts: Array, window_s: float) -> tuple[Array, Array]:
    """Return times (k,) and turning speeds (k,) [rad/s]: the same seen from hand and camera.

    The angle of R_i^T R_j does not depend on where camera and board are mounted.
    """
    half = window_s / 2
    at = times[(times >= times[0] + half) & (times <= times[-1] - half)]
    if len(at) < 2:
        return np.zeros(0), np.zeros(0)
    before, after = (interpolated(times, Ts, at + s)[0] for s in (-half, half))
    turn = np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]
    return at, np.linalg.norm(se3.log_so3(turn), axis=-1) / window_s


def correlated(
    robot: tuple[Array, Array], camera: tuple[Array, Array], step_s: float
) -> tuple[Array, Array]:
    """Return lags [s] and the correlation of two speed profiles at each.

    At lag d the camera's stamp t is the robot's t - d. Lags with too little overlap are left out.
    """
    (tr, wr), (tc, wc) = robot, camera
    grid_r = np.arange(tr[0], tr[-1], step_s)
    grid_c = np.arange(tc[0], tc[-1], step_s)
    a, b = np.interp(grid_r, tr, wr), np.interp(grid_c, tc, wc)
    n, m = len(a), len(b)
    least = max(3, int(LEAST_OVERLAP * min(n, m)))
    size = 1 << int(np.ceil(np.log2(n + m)))

    def cross(x: Array, y: Array) -> Array:
        """Return sum_k x[k] y[k + lag] for lags -(n - 1) .. m - 1."""
        full = np.fft.irfft(np.conj(np.fft.rfft(x, size)) * np.fft.rfft(y, size), size)
        return np.concatenate([full[size - n + 1 :], full[:m]])

    ones_a, ones_b = np.ones(n), np.ones(m)
    count = np.maximum(np.round(cross(ones_a, ones_b)), 1.0)
    sum_a, sum_b = cross(a, ones_b), cross(ones_a, b)
    var_a = cross(a * a, ones_b) - sum_a**2 / count
    var_b = cross(ones_a, b * b) - sum_b**2 / count
    least_var = 1e-6 * min(float(np.var(a)) * n, float(np.var(b)) * m) + 1e-15
    known = (count >= least) & (var_a > least_var) & (var_b > least_var)
    covariance = cross(a, b) - sum_a * sum_b / count
    value = covariance / np.sqrt(np.maximum(var_a * var_b, least_var**2))
    lags = np.arange(-(n - 1), m) * step_s + grid_c[0] - grid_r[0]
    return lags[known], value[known]
