"""The offset between two clocks with its sigma, from poses of a hand and of a board that moved.

A camera stamp t is the robot's time t - d. A start comes from the correlation of the turning
speeds, which need no calibration (Furrer et al., FSR 2017). Then d is one unknown more of the
least squares in X and Z (`pairs`): a change of d moves the hand along its velocity V,

    d eta / d d = -E V,        eta, E as in `pairs.noise`

and jitter of the stamps is an error of the same direction. Sigma is the larger one of that of the
least squares and of the sum of the pairs' scores with their autocorrelation (Newey & West,
Econometrica 55(3), 1987): neighbours in a stream share what the models leave.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Mask
from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim_calibration.clock.streams import (
    STEPS_PER_WINDOW,
    checked_stream,
    correlated,
    in_gap,
    interpolated,
    turning_speeds,
    velocities,
    window_of,
    without_spikes,
)
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
