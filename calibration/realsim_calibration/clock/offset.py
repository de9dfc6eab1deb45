"""The offset between two clocks with its sigma, from poses of a hand and of a board that moved.

A camera stamp t is the robot's time t - d. A start comes from the correlation of the turning
speeds, which need no calibration (Furrer et al., FSR 2017). Then d is one unknown more of the
least squares in X and Z (`pairs`): a change of d moves the hand along its velocity V,

    d eta / d d = -E V,        eta, E as in `pairs.noise`

and jitter of the stamps is an error of the same direction. Sigma is the larger one of that of the
least squares and of the sum of the pairs' scores with their autocorrelation (Newey & West,
Econometrica 55(3), 1987): neighbours in a stream share what the models leave.

Streams of stamped poses: interpolation, velocity, and a first offset from turning speeds.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Mask
from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim_calibration.faults.frame_fit import fit_frames, hand_side
from realsim_calibration.pairs.noise import (
    Noise,
    RobotParts,
    Solved,
    distances,
    estimate_noise,
    linearise,
    solve,
)
from realsim_calibration.pairs.solve import (
    NOISE_PAIRS,
    ROUNDS,
    WIDTH_SHARE,
    gate_limit,
    jackknifed,
    require_agreement,
    require_explained,
    rows_of,
    spread,
    start_inside,
)
from realsim_calibration.results import Mode

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


NO_OFFSET = (
    "The streams are of different recordings, the offset is larger than the recording, or the "
    "motion repeats itself. Record a motion that does not repeat, or give the offset "
    "(--clock-offset SECONDS)."
)
STARTS_S = 1.0
"""Clocks further apart were never set to the same time [s]."""
NOISE_STEPS = (0, 1, 3)
"""Steps of the least squares before which the sizes are estimated anew."""


LEAST_CORRELATION = 0.5
"""Turning speeds of the same motion correlate better: 0.8 and more at 5 mrad of noise."""
DISTINCT = 0.02
"""No other lag, a window away, may come that close to the best correlation."""
LEAST_SPEED = 0.02
"""Turning speed whose changes tell the time [rad/s], RMS about its mean."""
LEAST_PAIRS = 8
"""Fewest frames in the time that both streams cover."""
STEPS = 8
"""Steps of the least squares: four are usual."""
SETTLED = 0.02
"""A step of this part of sigma ends them."""
START_PAIRS = 120
"""Frames, evenly spread, that the first frames X and Z are found from."""
MATTERS = 0.3
"""An offset matters when what it moves the board by exceeds this part of the pairs' scatter."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ClockOffset:
    """The offset of the camera's clock against the robot's."""

    offset_s: float
    """d: a frame stamped t was taken at t - d of the robot's clock [s]."""
    sigma_s: float
    """Its 1-sigma [s]."""
    jitter_s: float
    """Size of the stamps' jitter [s]."""
    moved_mm: float
    """RMS of what the offset moves the board by in the camera [mm]."""
    scatter_mm: float
    """RMS scatter of the board's place that is left [mm]."""
    matters: bool
    """Whether calibration without it would be worse."""
    mode: Mode
    X: Array
    """(4, 4) the camera in the hand (or base) that belongs to it [m]."""
    Z: Array
    """(4, 4) the board in the base (or hand) [m]."""
    covariance: Array
    """(12, 12) of right twists of X and Z, the offset's doubt included [rad, m]."""
    used: Mask
    """(n,) frames, in the order of time, that agree."""

    @property
    def sentence(self) -> str:
        """Return the offset in words."""
        if abs(self.offset_s) > STARTS_S:
            return (
                f"the camera's clock is {self.offset_s:+.6f} s off the robot's (+-"
                f"{1e3 * self.sigma_s:.2f} ms): the clocks start at different times."
            )
        told = "it matters" if self.matters else "too small to matter"
        return (
            f"the camera's clock is {1e3 * self.offset_s:+.2f} +-{1e3 * self.sigma_s:.2f} ms off "
            f"the robot's ({told}: it moves the board by {self.moved_mm:.2f} mm, the pairs scatter "
            f"by {self.scatter_mm:.2f} mm)."
        )


def estimate_clock_offset(
    robot_times: ArrayLike,
    Ts_base_ee: ArrayLike,
    camera_times: ArrayLike,
    Ts_cam_board: ArrayLike,
    *,
    mode: Mode = "eye_in_hand",
) -> ClockOffset:
    """Return the offset of the camera's clock, with X and Z.

    Args:
        robot_times: (n,) by the robot's clock [s].
        Ts_base_ee: (n, 4, 4) tool poses [m].
        camera_times: (m,) by the camera's clock [s].
        Ts_cam_board: (m, 4, 4) the board in the camera [m]; NaN where it was not seen.
        mode: where the camera sits.

    Raises:
        InputError: no motion, no lag at which the motions agree, or hardly any time in common.
        DegenerateError: the motion does not determine the hand-eye.
    """
    tr, A = checked_stream(np.asarray(robot_times), np.asarray(Ts_base_ee), "the robot's stream")
    tc, C = checked_stream(
        np.asarray(camera_times), np.asarray(Ts_cam_board), "the camera's stream"
    )
    # Stamps of 1.7e9 s leave a quarter of a microsecond: times from the middle keep all digits.
    zero = tr[0], tc[0]
    tr, tc = tr - zero[0], tc - zero[1]
    fit = _Fit(tr, A, tc, C, zero[1] - zero[0], mode)
    return fit.run(first_offset(tr, A, tc, C))


def first_offset(tr: Array, A: Array, tc: Array, C: Array) -> float:
    """Return the lag at which the turning speeds agree best [s].

    Raises:
        InputError: no motion, or no lag stands out.
    """
    window = max(window_of(tr), window_of(tc))
    robot = turning_speeds(*without_spikes(tr, A), window)
    camera = turning_speeds(*without_spikes(tc, C), window)
    for name, (t, w) in (("robot", robot), ("camera", camera)):
        if len(t) < LEAST_PAIRS or float(np.std(w)) < LEAST_SPEED:
            spread = float(np.std(w)) if len(w) else 0.0
            raise InputError(
                f"clock: the {name}'s stream shows no motion that tells the time: its turning "
                f"speed changes by {np.degrees(spread):.2f} deg/s over {len(t)} poses; "
                f"{np.degrees(LEAST_SPEED):.1f} deg/s or more are needed. Record while the "
                "hand turns and pauses, or give the offset (--clock-offset SECONDS, or off)."
            )
    lags, value = correlated(robot, camera, window / STEPS_PER_WINDOW)
    if not len(lags):
        raise InputError(
            f"clock: the streams ({tr[-1] - tr[0]:.1f} s and {tc[-1] - tc[0]:.1f} s) are too short "
            "to be compared. Record longer."
        )
    best = int(np.argmax(value))
    away = np.abs(lags - lags[best]) > 2 * window
    rival = float(value[away].max()) if away.any() else -1.0
    if value[best] < LEAST_CORRELATION or rival > value[best] - DISTINCT:
        raise InputError(
            f"clock: the turns of hand and camera agree at no offset (best correlation "
            f"{value[best]:.2f} at {lags[best]:+.2f} s from the beginnings of both, next best "
            f"{rival:.2f}). {NO_OFFSET}"
        )
    k = np.clip(best, 1, len(value) - 2)
    left, mid, right = value[k - 1 : k + 2]
    bend = left - 2 * mid + right
    shift = 0.5 * (left - right) / bend if bend < 0 else 0.0
    return float(lags[k] + np.clip(shift, -1, 1) * (lags[k] - lags[k - 1]))


class _Fit:
    """The least squares in X, Z and the offset."""

    def __init__(
        self, tr: Array, A: Array, tc: Array, C: Array, apart: float, mode: Mode,
    ) -> None:  # fmt: skip
        self.apart = apart  # how much later the camera's zero is than the robot's, by their stamps
        self.tr, self.A, self.tc, self.C = tr, A, tc, C
        self.mode: Mode = mode
        self.window = window_of(tr)

    def _hand(self, offset: float) -> tuple[Array, Array, Mask]:
        """Return the hand (m, 4, 4) at the frames, its velocity (m, 6), and where it is known."""
        at = self.tc - offset
        Ts, inside = interpolated(self.tr, self.A, at)
        inside &= ~in_gap(self.tr, at)
        return Ts, velocities(self.tr, self.A, at, self.window), inside

    def run(self, offset: float) -> ClockOffset:
        """Return the offset from a start."""
        Ts, _, inside = self._hand(offset)
        if inside.sum() < LEAST_PAIRS:
            raise InputError(
                f"clock: at the best offset only {int(inside.sum())} frames lie in the time that "
                f"both streams cover; at least {LEAST_PAIRS} are needed. Record both longer."
            )
        few = spread(np.flatnonzero(inside), START_PAIRS)
        frames = fit_frames(
            hand_side(Ts[few], self.mode == "eye_in_hand"), self.C[few], width_share=WIDTH_SHARE
        )
        start_inside(frames)
        used, noise = inside.copy(), Noise.start("axes", RobotParts(velocity=np.zeros((1, 6))))
        X, Z, offset, noise, solved = self._solved(frames.X, frames.Z, offset, used, noise)
        for _ in range(ROUNDS):
            Ts, V, inside = self._hand(offset)
            linear = linearise(Ts, self.C, X, Z, to_hand=self.mode == "eye_to_hand")
            agree = inside & (distances(linear, noise, RobotParts(velocity=V)) <= gate_limit())
            require_agreement(agree[inside])
            if np.array_equal(agree, used):
                break
            used = agree
            X, Z, offset, noise, solved = self._solved(X, Z, offset, used, noise)
        return self._result(X, Z, offset, used, noise, solved)

    def _solved(
        self, X: Array, Z: Array, offset: float, used: Mask, noise: Noise
    ) -> tuple[Array, Array, float, Noise, Solved]:
        """Return the least squares over the frames that are used."""
        rows = np.flatnonzero(used)
        solved: Solved | None = None
        few = spread(np.arange(len(rows)), NOISE_PAIRS)
        for k in range(STEPS):
            Ts, V, _ = self._hand(offset)
            velocity = V[rows]
            parts = RobotParts(velocity=velocity)
            linear = linearise(Ts[rows], self.C[rows], X, Z, to_hand=self.mode == "eye_to_hand")
            extra = -(linear.E @ velocity[..., None])
            if k in NOISE_STEPS:
                noise, _ = estimate_noise(rows_of(linear, few), noise, parts.at(few), extra[few])
            try:
                solved = solve(linear, noise, parts, extra)
            except np.linalg.LinAlgError as error:
                raise DegenerateError(
                    "clock: this motion does not determine camera and offset. Turn the hand about "
                    "two different axes while recording."
                ) from error
            step = solved.step
            X, Z = X @ se3.exp(step[:6]), Z @ se3.exp(step[6:12])
            offset += float(step[12])
            sigma = float(np.sqrt(solved.covariance[12, 12]))
            if k > 3 and abs(step[12]) < SETTLED * sigma:
                break
        assert solved is not None
        return X, Z, offset, noise, solved

    def _result(
        self, X: Array, Z: Array, offset: float, used: Mask, noise: Noise, solved: Solved
    ) -> ClockOffset:
        inverse = jackknifed(solved)
        factor = max(1.0, autocorrelation_factor(solved.scores @ inverse[:, 12]))
        Ts, V, _ = self._hand(offset)
        linear = linearise(Ts[used], self.C[used], X, Z, to_hand=self.mode == "eye_to_hand")
        try:
            require_explained(linear.residuals, Ts[used])
        except InputError as error:
            raise InputError(
                f"clock: hand and camera agree at no offset: {NO_OFFSET} ({error})"
            ) from error
        whole = offset + self.apart
        moved = (linear.E @ V[used][..., None])[:, 3:, 0] * whole
        scatter = float(1e3 * np.sqrt(np.mean(np.sum(linear.residuals[:, 3:] ** 2, -1))))
        moved_mm = float(1e3 * np.sqrt(np.mean(np.sum(moved**2, -1))))
        return ClockOffset(
            offset_s=whole, sigma_s=float(np.sqrt(inverse[12, 12] * factor)),
            jitter_s=float(noise.sizes[-1]), moved_mm=moved_mm,
            scatter_mm=scatter, matters=moved_mm > MATTERS * scatter, mode=self.mode,
            X=X, Z=Z, covariance=inverse[:12, :12], used=used,
        )  # fmt: skip


def autocorrelation_factor(scores: Array) -> float:
    """Return the variance of a sum of neighbours (n,) over that of independent ones.

    Bartlett's weights up to 4 (n / 100)^(2/9) neighbours (Newey & West 1994).
    """
    x = scores - scores.mean()
    n, own = len(x), max(float(x @ x), 1e-300)
    reach = int(4 * (n / 100) ** (2 / 9))
    shares = [(1 - k / (reach + 1)) * float(x[k:] @ x[:-k]) / own for k in range(1, reach + 1)]
    return 1.0 + 2.0 * float(np.sum(shares))
