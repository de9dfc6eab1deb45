"""The hand-eye of measured pose pairs: robust start, sizes of all errors, least squares.

1. frames that most pairs agree with (`fit_frames`: half of the pairs may be wrong)
2. sizes of the errors from the pairs that agree (`noise`), generalised least squares
3. pairs further off than chance allows leave, and 2 is done again, until none changes
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Int64, Mask
from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.geometry.dh import DhArm
from realsim_calibration.faults.frame_fit import FrameFit, fit_frames, hand_side
from realsim_calibration.fit.closed_forms import MIN_VIEWS, check_observable, pose_stacks
from realsim_calibration.fit.robot_error import arm_basis
from realsim_calibration.pairs.noise import (
    KINDS,
    Linear,
    Noise,
    RobotParts,
    Solved,
    distances,
    estimate_noise,
    linearise,
    solve,
)
from realsim_calibration.results import Mode

TOGETHER = (
    "Check that hand poses and camera poses belong together (order, time stamps), that T_cam_board "
    "maps target points into the camera, and whether the camera sits in the hand or stands still "
    "(--eye-to-hand)."
)


WIDTH_SHARE = 0.25
"""Share of the pairs whose error the fit of the first frames follows: half may be wrong."""
START_RATIO = 5.0
"""A pair starts inside when its error through the first frames is at most this many lower
quartiles: of half good pairs the lower quartile of all is the median of the good ones."""
CHANCE = 5e-4
"""A good pair is that far off with this probability: one of a hundred sets of 20 loses one."""
ROUNDS = 4
"""Rounds of leaving pairs out and estimating the sizes anew."""
LEAST_SHARE = 0.3
"""With fewer pairs that agree, none of it can be trusted."""
MOST_LEFT = 0.25
"""The turns left over may be this part of the hand's turns: shuffled poses leave half."""
NOISE_PAIRS = 250
"""Pairs, evenly spread, that the sizes are estimated from."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PosePairs:
    """The hand-eye of pose pairs."""

    mode: Mode
    X: Array
    """(4, 4) the camera in the hand, or in the base where it stands still [m]."""
    Z: Array
    """(4, 4) the target in the base, or in the hand [m]."""
    covariance: Array
    """(12, 12) of right twists of X, then of Z, rotation first [rad, m]."""
    used: Mask
    """(n,) which pairs agree."""
    distances: Array
    """(n,) squared distance of every pair in its own covariance: 6 on the average."""
    residuals: Array
    """(n, 6) turn [rad] and shift [m] of the board in the camera, predicted less measured."""
    noise: Noise

    @property
    def sigma_mm(self) -> float:
        """Largest 1-sigma of X's translation along any axis [mm]."""
        return float(1e3 * np.sqrt(np.linalg.eigvalsh(self.covariance[3:6, 3:6])[-1]))


def solve_pose_pairs(
    Ts_base_ee: ArrayLike,
    Ts_cam_board: ArrayLike,
    *,
    mode: Mode = "eye_in_hand",
    joints: ArrayLike | None = None,
    arm: DhArm | None = None,
) -> PosePairs:
    """Return the hand-eye of pose pairs with its covariance; pairs that do not agree are left out.

    Args:
        Ts_base_ee: (n, 4, 4) tool poses [m].
        Ts_cam_board: (n, 4, 4) the target in the camera [m].
        mode: where the camera sits.
        joints: (n, q) joint angles [rad].
        arm: the arm's kinematics; with the joints its errors are estimated, too.

    Raises:
        InputError: stacks of different lengths, values that are no poses, or too few pairs agree.
        DegenerateError: the poses do not determine the hand-eye.
    """
    A, C = checked_pairs(Ts_base_ee, Ts_cam_board)
    check_observable(hand_side(A, mode == "eye_in_hand"))
    fit = fit_frames(hand_side(A, mode == "eye_in_hand"), C, width_share=WIDTH_SHARE)
    used = start_inside(fit)
    parts = robot_parts(A, joints, arm)
    X, Z, noise = fit.X, fit.Z, None
    for turn in range(ROUNDS):
        last = turn == ROUNDS - 1
        X, Z, noise = _refined(A, C, mode, (X, Z), used, noise, parts)
        linear = linearise(A, C, X, Z, to_hand=mode == "eye_to_hand")
        far = distances(linear, noise, parts)
        inside = far <= gate_limit()
        if last or np.array_equal(inside, used):
            break
        used = inside
        require_agreement(used)
    assert noise is not None
    linear = linearise(A, C, X, Z, to_hand=mode == "eye_to_hand")
    require_explained(linear.residuals[used], A[used])
    solved = solve(rows_of(linear, used), noise, parts.at(used))
    covariance = jackknifed(solved)[:12, :12]
    return PosePairs(
        mode=mode, X=X, Z=Z, covariance=covariance, used=used,
        distances=distances(linear, noise, parts), residuals=linear.residuals, noise=noise,
    )  # fmt: skip


def jackknifed(solved: Solved) -> Array:
    """Return the covariance, widened where the pairs pull harder than the sizes say.

    The fits without one pair each say how far X and Z move (jackknife, CR3): where that is more
    than the inverse of the information, sizes taken for known or errors of another shape are why.
    """
    covariance, away = solved.covariance, solved.without()[:, :12]
    n = len(away)
    moved = (n - 1) / n * away.T @ away
    ratio = float(np.trace(np.linalg.solve(covariance[:12, :12], moved)) / 12)
    return covariance * max(ratio, 1.0)


def checked_pairs(Ts_base_ee: ArrayLike, Ts_cam_board: ArrayLike) -> tuple[Array, Array]:
    """Return the two stacks (n, 4, 4).

    Raises:
        InputError: they differ in length, or hold values that are not finite.
    """
    A, C = pose_stacks(Ts_base_ee, Ts_cam_board, "hand-eye", others="camera poses")
    bad = np.flatnonzero(~(np.isfinite(A) & np.isfinite(C)).all(axis=(1, 2)))
    if len(bad):
        raise InputError(
            f"hand-eye: {len(bad)} of {len(A)} pairs hold values that are not finite (the first is "
            f"pair {bad[0]}). Leave these pairs out."
        )
    return A, C


def start_inside(fit: FrameFit) -> Mask:
    """Return which pairs agree with the first frames.

    Raises:
        InputError: too few of them.
    """
    inside = fit.errors <= START_RATIO * max(float(np.quantile(fit.errors, 0.25)), 1e-9)
    require_agreement(inside)
    return inside


def require_agreement(inside: Mask) -> None:
    """Raise if too few pairs agree."""
    least = max(MIN_VIEWS, int(np.ceil(LEAST_SHARE * len(inside))))
    if inside.sum() < least:
        raise InputError(
            f"hand-eye: only {int(inside.sum())} of {len(inside)} pose pairs agree with one place "
            f"of the camera; at least {least} are needed. {TOGETHER}"
        )


def require_explained(residuals: Array, A: Array) -> None:
    """Raise if the turns left over are like those of the hand itself."""
    left = float(np.median(np.linalg.norm(residuals[:, :3], axis=-1)))
    middle = se3.mean_rotation(A[:, :3, :3])
    turns = float(np.median(np.linalg.norm(se3.log_so3(middle.T @ A[:, :3, :3]), axis=-1)))
    if left > MOST_LEFT * turns:
        raise InputError(
            f"hand-eye: no place of the camera explains the pose pairs: {np.degrees(left):.1f} deg "
            f"are left where the hand turns by {np.degrees(turns):.1f} deg. {TOGETHER}"
        )


def robot_parts(A: Array, joints: ArrayLike | None, arm: DhArm | None) -> RobotParts:
    """Return what the robot's error may be made of.

    Raises:
        InputError: as many joints as the arm has are not there for every pair.
    """
    if joints is None or arm is None:
        return RobotParts()
    q = np.asarray(joints, dtype=np.float64)
    if q.shape != (len(A), arm.joints):
        raise InputError(
            f"hand-eye: joint angles of shape {q.shape} were given; a {arm.name} and {len(A)} "
            f"pairs need {(len(A), arm.joints)}."
        )
    columns = arm_basis(arm, q, A, 1.0, 1.0).columns
    return RobotParts(joints=columns[..., : arm.joints], arm=columns)


def rows_of(linear: Linear, rows: Mask | Int64) -> Linear:
    """Return some pairs of a linearisation."""
    return Linear(
        residuals=linear.residuals[rows], J=linear.J[rows], E=linear.E[rows], Ts=linear.Ts[rows]
    )


def gate_limit() -> float:
    """Return the squared distance that a good pair exceeds by chance."""
    from scipy.stats import chi2

    return float(chi2.isf(CHANCE, 6))


def _refined(
    A: Array, C: Array, mode: Mode, frames: tuple[Array, Array], used: Mask, noise: Noise | None,
    parts: RobotParts,
) -> tuple[Array, Array, Noise]:  # fmt: skip
    """Return X, Z and the sizes from the pairs that are used; the camera's kind is found first."""
    X, Z = frames
    at = np.flatnonzero(used)
    few = spread(at, NOISE_PAIRS)
    to_hand = mode == "eye_to_hand"
    linear = linearise(A, C, X, Z, to_hand=to_hand)
    if noise is None:
        bare = RobotParts()
        tried = [estimate_noise(rows_of(linear, few), Noise.start(k, bare), bare) for k in KINDS]
        best = min(tried, key=lambda t: t[1])[0]
        X, Z = _stepped(linear, at, best, bare, X, Z)
        linear = linearise(A, C, X, Z, to_hand=to_hand)
        cameras = len(best.camera)
        sizes = np.concatenate([best.camera, Noise.start(best.kind, parts).sizes[cameras:]])
        noise = Noise(kind=best.kind, sizes=sizes)
    noise, _ = estimate_noise(rows_of(linear, few), noise, parts.at(few))
    for _ in range(2):
        X, Z = _stepped(linear, at, noise, parts, X, Z)
        linear = linearise(A, C, X, Z, to_hand=to_hand)
    return X, Z, noise


def spread(rows: Int64, most: int) -> Int64:
    """Return at most so many of the rows, evenly spread."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, most).round().astype(int))]


def _stepped(
    linear: Linear, at: Int64, noise: Noise, parts: RobotParts, X: Array, Z: Array
) -> tuple[Array, Array]:
    """Return X and Z after a least-squares step."""
    try:
        step = solve(rows_of(linear, at), noise, parts.at(at)).step
    except np.linalg.LinAlgError as error:
        raise DegenerateError(
            "hand-eye: these pose pairs do not determine the camera's place. Add poses that turn "
            "the hand by 20 deg or more about two different axes."
        ) from error
    return X @ se3.exp(step[:6]), Z @ se3.exp(step[6:12])
