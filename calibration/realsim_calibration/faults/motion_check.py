"""Do the views determine the camera's place? Sentences for people about motion that does not.

The frames of A_i X C_i = Z are linearised at the fitted ones; with the errors that a good robot and
a good board pose have, the inverse of the normal matrix says how well X can be known at best, along
the camera's own axes. What it says is explained by what is missing in the motion: roll, a second
axis, distance, places in the image.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.geometry import se3
from realsim_calibration.faults.frame_fit import FrameFit, fit_frames, hand_side, linearise
from realsim_calibration.fit.closed_forms import MIN_VIEWS, pose_stacks, principal_turns, relative

UNSEEN = 1e-8
"""Information below this, in 1 / degree^2 or 1 / mm^2, is none: 1-sigma 10 m."""
UNKNOWN_MM = 1e3
"""A 1-sigma beyond this is written "not known at all" [mm]."""
OPTICAL = 0.98
"""An axis is the optical one where its z is at least this."""
EXPECTED_MM = 1.0
"""Error of the board's place in a view, 1-sigma per axis [mm]: robot and board pose."""
EXPECTED_DEG = 0.1
"""Error of its angle, 1-sigma per axis [deg]."""
RATIO_SD = 0.003
"""How well the board's size is known, relative: printers are off by this much."""
LEAST_TURN_DEG = 2.0
"""RMS turn about an axis below which the hand does not turn about it [deg]."""
SMALL_TURN_DEG = 10.0
"""RMS turn about the second axis below which the turns are called small [deg]."""
LEAST_ROLL_DEG = 60.0
"""Range of roll about the optical axis that is advised [deg]."""
LEAST_SPREAD = 0.1
"""Spread of the board's middle over the views, as the tangent of the angle off the axis, below
which it always stands in the same place of the image: a tenth of the focal length."""
SAME_POSE_MM = 0.5
"""Poses nearer than this add nothing to each other [mm]."""
SAME_POSE_DEG = 0.1
"""The same for the angle [deg]."""
BAD_MM = 2.0
"""A 1-sigma of the camera's place beyond this is worth a sentence [mm]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class MotionCheck:
    """What the motion of a session can determine."""

    turns_deg: Array
    """(3,) RMS turn of the pairs of views about the principal axes, descending [deg]."""
    sd_mm: Array
    """(3,) best possible 1-sigma of the camera's place along the camera's x, y, z [mm]."""
    sentences: tuple[str, ...]
    """What is missing, with its consequence and what to do; empty where nothing is."""


def check_motion(
    Ts_base_ee: ArrayLike,
    Ts_cam_board: ArrayLike,
    middle: ArrayLike = (0.0, 0.0, 0.0),
    *,
    eye_in_hand: bool = True,
) -> MotionCheck:
    """Return what the motion determines, and what is missing in it.

    Args:
        Ts_base_ee: (n, 4, 4) hand poses of right conventions [m].
        Ts_cam_board: (n, 4, 4) board poses [m].
        middle: (3,) the board's middle in its frame [m].
        eye_in_hand: whether the camera sits in the hand.

    Raises:
        InputError: fewer than three views, or stacks of different lengths.
    """
    T, C = pose_stacks(Ts_base_ee, Ts_cam_board, "motion", least=MIN_VIEWS)
    m = np.asarray(middle, dtype=np.float64)
    rms, axes = principal_turns(relative(se3.invert(C)).turns)
    turns, axes = np.degrees(rms), axes.T
    fit = fit_frames(hand_side(T, eye_in_hand), C, m)
    sd_mm = _best_sd(hand_side(T, eye_in_hand), C, m, fit)
    roll = roll_range_deg(C)
    found = [
        *_turn_sentences(turns, axes, roll, sd_mm),
        *_place_sentences(C, m),
        *_identical_sentences(_identical(T), len(T)),
    ]
    return MotionCheck(turns_deg=turns, sd_mm=sd_mm, sentences=tuple(found))


def _best_sd(A: Array, C: Array, m: Array, fit: FrameFit) -> Array:
    """Return the 1-sigma (3,) of X along the camera's axes [mm]; infinite = unknown."""
    q = C[:, :3, :3] @ m + C[:, :3, 3]
    s = fit.length_ratio
    z = fit.Z[:3, 3] + s * fit.Z[:3, :3] @ m
    given = (A, C[:, :3, :3], q, fit.X[:3, :3], fit.Z[:3, :3], fit.X[:3, 3], z)
    J, _ = linearise(*(np.ascontiguousarray(v) for v in given), s=s)
    sd = np.array([np.radians(EXPECTED_DEG)] * 3 + [s * 1e-3 * EXPECTED_MM] * 3)
    Jw = (J / sd[:, None]).reshape(-1, 13)
    H = Jw.T @ Jw
    H[12, 12] += 1.0 / (s * RATIO_SD) ** 2
    # In units of the expected errors a direction without information is a null vector.
    unit = np.array([np.radians(1.0)] * 6 + [1e-3 * s] * 6 + [s * RATIO_SD])
    values, vectors = np.linalg.eigh(H * unit[:, None] * unit)
    inverse = vectors @ np.diag(1.0 / np.maximum(values, UNSEEN)) @ vectors.T
    covariance = inverse * unit[:, None] * unit
    Rx = fit.X[:3, :3]
    return 1e3 * (np.sqrt(np.diag(Rx.T @ covariance[6:9, 6:9] @ Rx)) / s)


def roll_range_deg(Ts_cam_board: Array) -> float:
    """Return the range of camera roll about the optical axis [deg] over board poses (n, 4, 4)."""
    return range_deg(np.degrees(np.arctan2(Ts_cam_board[:, 1, 0], Ts_cam_board[:, 0, 0])))


def range_deg(angles_deg: ArrayLike) -> float:
    """Return the range of angles round the circle [deg]: 360 less the largest gap."""
    turned = np.sort(np.asarray(angles_deg) % 360.0)
    return float(360.0 - np.diff(np.append(turned, turned[0] + 360.0)).max())


def _identical(T: Array) -> tuple[tuple[int, int], ...]:
    i, j = np.triu_indices(len(T), 1)
    step = relative(T)
    near = np.linalg.norm(step.Ts[:, :3, 3], axis=-1) < 1e-3 * SAME_POSE_MM
    near &= np.linalg.norm(step.turns, axis=-1) < np.radians(SAME_POSE_DEG)
    return tuple((int(a), int(b)) for a, b in zip(i[near], j[near], strict=True))


def _place(axis: str, sd: float) -> str:
    if sd > UNKNOWN_MM:
        return f"the camera's place along its {axis} is not known at all"
    return f"the camera's place along its {axis} can be known to +-{sd:.1f} mm only"


def _turn_sentences(turns: Array, axes: Array, roll: float, sd_mm: Array) -> list[str]:
    """Return what is missing in the turns."""
    worst = int(np.argmax(sd_mm))
    consequence = _place("xyz"[worst], float(sd_mm[worst]))
    if turns[0] < LEAST_TURN_DEG:
        return [
            f"The hand moves without turning (RMS {turns[0]:.2f} deg): {consequence}. Add views "
            "that tilt it by 20 deg or more about two axes and roll it about the optical axis."
        ]
    if turns[1] < LEAST_TURN_DEG:
        axis = axes[0] * np.sign(axes[0][np.argmax(np.abs(axes[0]))])
        text = ", ".join(f"{v:.2f}" for v in axis)
        name = "its optical axis" if axis[2] > OPTICAL else f"one axis, [{text}] of the camera,"
        return [
            f"The hand turns about {name} only (RMS {turns[0]:.1f} deg; {turns[1]:.2f} about the "
            f"next): {consequence}. Add views that tilt it by 20 deg or more about another axis."
        ]
    found: list[str] = []
    if turns[1] < SMALL_TURN_DEG:
        found.append(
            f"The turns are small (RMS {turns[0]:.1f} and {turns[1]:.1f} deg about two axes): "
            f"{consequence}. Turn the hand by 20 to 45 deg."
        )
    if roll < LEAST_ROLL_DEG:
        found.append(
            f"There is little roll about the optical axis (range {roll:.0f} deg): "
            f"{consequence}. Roll the hand by {LEAST_ROLL_DEG:g} deg or more between views."
        )
    if not found and sd_mm[worst] > BAD_MM:
        found.append(f"With these views {consequence}. Add views, from other distances too.")
    return found


def _place_sentences(C: Array, m: Array) -> list[str]:
    """Return whether the board always stands in the same place of the image."""
    q = C[:, :3, :3] @ m + C[:, :3, 3]
    seen = q[:, :2] / np.maximum(q[:, 2:], 1e-9)
    spread = float(np.max(np.ptp(seen, axis=0)))
    if spread >= LEAST_SPREAD:
        return []
    return [
        f"The board is always in the same place of the image (its middle moves by {spread:.3f} "
        "focal lengths): errors of the lens there go into the camera's place. Let the board reach "
        "the corners of the image too."
    ]


def _identical_sentences(identical: tuple[tuple[int, int], ...], n: int) -> list[str]:
    if not identical:
        return []
    rows = sorted({row for pair in identical for row in pair})
    text = ", ".join(str(r) for r in rows[:12]) + ("..." if len(rows) > 12 else "")
    return [
        f"{len(rows)} of {n} views repeat a hand pose (rows {text}): they add images, not motion. "
        "Move the hand between views."
    ]
