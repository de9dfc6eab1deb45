"""Which views may take part: tests that need no hand-eye, and two that need only a rough one.

For right data A_ij X = X B_ij, so that the hand and the camera turn by the same angle, about axes
that one rotation maps onto each other, and slide by the same length along them, whatever X is.
Wrong conventions (inverted poses, another unit, a mis-paired list) break this for most views and
are named; a bad view breaks it for itself and is dropped. Two corrupted views left in make a joint
fit worse than no fit. Angles alone do not see inverted poses: tr(R_i^T R_j) = tr(R_i R_j^T).
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import InputError, UnitError
from realsim.geometry import se3
from realsim.records import TagBoard
from realsim_calibration.faults.frame_fit import FitConfig, fit_frames, hand_side, mismatch
from realsim_calibration.fit.closed_forms import HALF_TURN, motions, nearest_rotation

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class GateConfig:
    """When a view, or the whole set of poses, is refused."""

    angle_ratio: float = 4.0
    """A view is dropped when its median angle difference exceeds this many medians of all."""
    angle_floor_deg: float = 0.2
    """... and this angle [deg]: the angle error of a good planar pose."""
    max_median_deg: float = 3.0
    """Median rotation mismatch beyond which the convention is wrong [deg]: right ones measure
    0.1 to 1, wrong ones 20 and more."""
    max_scale_ratio: float = 1.5
    """Largest ratio of the hand's and the camera's screw slides; beyond it a unit is wrong."""
    min_slide_m: float = 0.005
    """Median slide along the screw axes that makes the ratio meaningful [m]."""
    min_turn_deg: float = 5.0
    """Pairs that turn less have no sure screw axis [deg]."""
    px_ratio: float = 5.0
    """A view is dropped when its px through the closed form exceeds this many medians."""
    px_floor: float = 3.0
    """... and this error [px]."""
    twin_ratio: float = 2.0
    """The mirror twin of a planar pose may stand in when its px is at most this much worse."""
    frame_ratio: float = 5.0
    """A view is dropped when its error through the fitted frames exceeds this many medians ..."""
    frame_floor: float = 4.0
    """... and this, in units of `FitConfig`: 2 deg or 4 % of the distance to the board. Views of
    good real sets reach 4.1 medians where the board is small and seen at a slant."""
    fit: FitConfig = field(default_factory=FitConfig)


def angle_differences(Ts_base_ee: ArrayLike, Ts_cam_board: ArrayLike) -> Array:
    """Return | angle(A_ij) - angle(B_ij) | (N, N) [rad], NaN on the diagonal."""
    m = motions(Ts_base_ee, Ts_cam_board)
    n = len(np.asarray(Ts_base_ee))
    difference = np.full((n, n), np.nan)
    i, j = m.pairs.T
    difference[i, j] = difference[j, i] = np.abs(se3.angle(m.Ts_hand) - se3.angle(m.Ts_cam))
    return difference


def screw_ratio(Ts_base_ee: ArrayLike, Ts_cam_board: ArrayLike, config: GateConfig) -> float:
    """Return how many times further the hand slides along its screw axes than the camera does.

    The slide d = axis . t of a rigid motion is the same seen from hand and camera (Chen 1991): 1
    when both are in metres and the board has the size it is said to have; NaN when the motion
    hardly slides.
    """
    m = motions(Ts_base_ee, Ts_cam_board)
    slides: list[Array] = []
    for T in (m.Ts_hand, m.Ts_cam):
        w = se3.log_so3(T[:, :3, :3])
        n = np.linalg.norm(w, axis=-1)
        turned = n > np.radians(config.min_turn_deg)
        axis = w / np.where(turned, n, 1.0)[:, None]
        slides.append(np.where(turned, np.abs((axis * T[:, :3, 3]).sum(-1)), np.nan))
    hand, cam = slides
    both = np.isfinite(hand) & np.isfinite(cam)
    if both.sum() < 3 or float(np.median(cam[both])) < config.min_slide_m:
        return float("nan")
    return float(np.median(hand[both]) / np.median(cam[both]))


def rotation_mismatch_deg(Ts_base_ee: ArrayLike, Ts_cam_board: ArrayLike) -> float:
    """Return the median over pairs of |a - R b| [deg], a and b the turns of hand and camera.

    R is the rotation that maps the camera's turns onto the hand's best (Park's), fitted three times
    with the worse half of the pairs left out, so that a few bad views do not spoil it.
    """
    m = motions(Ts_base_ee, Ts_cam_board)
    if not len(m.pairs):
        return float("nan")
    a, b = se3.log_so3(m.Ts_hand[:, :3, :3]), se3.log_so3(m.Ts_cam[:, :3, :3])
    both = np.maximum(np.linalg.norm(a, axis=-1), np.linalg.norm(b, axis=-1)) < HALF_TURN
    if both.any():
        a, b = a[both], b[both]
    error, use = np.zeros(len(a)), np.ones(len(a), dtype=bool)
    for _ in range(3):
        R = nearest_rotation(a[use].T @ b[use])
        error = np.linalg.norm(a - b @ R.T, axis=-1)
        use = error <= np.median(error)
    return float(np.degrees(np.median(error)))


def check_conventions(
    Ts_base_ee: Array, Ts_cam_board: Array, board: TagBoard, config: GateConfig
) -> tuple[float, float]:
    """Return the rotation mismatch [deg] and the screw ratio of sound data.

    Raises:
        InputError: hand and camera do not turn alike; says which reading would fit.
        UnitError: they turn alike but slide by different lengths.
    """
    given = rotation_mismatch_deg(Ts_base_ee, Ts_cam_board)
    if given > config.max_median_deg:
        raise InputError(_wrong_convention(given, Ts_base_ee, Ts_cam_board, config))
    ratio = screw_ratio(Ts_base_ee, Ts_cam_board, config)
    if np.isfinite(ratio) and not 1 / config.max_scale_ratio < ratio < config.max_scale_ratio:
        raise UnitError(
            f"hand-eye: hand and camera turn alike (median mismatch {given:.2f} deg), but the "
            f"hand slides {ratio:.4g} times as far as the camera; 1 is expected. {_unit(ratio)} or "
            f"is the tag's edge {1e3 * board.tag_size_m * ratio:.4g} mm instead of "
            f"{1e3 * board.tag_size_m:.4g} mm?"
        )
    return given, ratio


def _wrong_convention(
    given: float, Ts_base_ee: Array, Ts_cam_board: Array, config: GateConfig
) -> str:
    """Return what was tried to make the poses fit, what it gave, and what to do."""
    inverted = se3.invert(Ts_base_ee)
    tried = {
        "as given": given,
        "inverted": rotation_mismatch_deg(inverted, Ts_cam_board),
        "paired with the image before": rotation_mismatch_deg(Ts_base_ee[1:], Ts_cam_board[:-1]),
        "paired with the image after": rotation_mismatch_deg(Ts_base_ee[:-1], Ts_cam_board[1:]),
        "inverted and paired with the image before": rotation_mismatch_deg(
            inverted[1:], Ts_cam_board[:-1]
        ),
        "inverted and paired with the image after": rotation_mismatch_deg(
            inverted[:-1], Ts_cam_board[1:]
        ),
    }
    evidence = "; ".join(f"{name} {value:.2f} deg" for name, value in tried.items())
    best = min(tried, key=lambda name: tried[name])
    if tried[best] > config.max_median_deg:
        advice = (
            "None of these readings fits: check the rotation's format (rotation vector, Euler "
            "order, quaternion order, degrees) and that images and poses belong together."
        )
    else:
        advice = f"They fit when {best}: give them so."
        if best.startswith("inverted"):
            advice += (
                " T_base_ee must map tool points into the base; a camera that stands still and "
                "sees the board in the hand also looks like this."
            )
    return (
        "hand-eye: hand and camera do not turn alike. Median mismatch of their turns with the hand "
        f"poses {evidence}; at most {config.max_median_deg:g} deg is accepted. {advice} "
        "Millimetres are not the cause: turns have no length."
    )


def _unit(ratio: float) -> str:
    if 300 < ratio < 3000:
        return "Are the hand poses in millimetres (divide their translations by 1000),"
    if 1 / 3000 < ratio < 1 / 300:
        return "Is the board given in millimetres,"
    return "Is a unit wrong,"


def angle_gate(
    Ts_base_ee: Array,
    Ts_cam_board: Array,
    twins: list[Array | None],
    config: GateConfig,
) -> tuple[Array, dict[int, str], list[int]]:
    """Return the board poses, the views to drop with the reason, and the views whose twin is used.

    Args:
        Ts_base_ee: (N, 4, 4) hand poses [m].
        Ts_cam_board: (N, 4, 4) board poses [m].
        twins: per view the mirror solution where it fits the image almost as well, else None.
        config: the gate.
    """
    difference = angle_differences(Ts_base_ee, Ts_cam_board)
    usual = float(np.nanmedian(difference))
    limit = max(config.angle_ratio * usual, float(np.radians(config.angle_floor_deg)))
    views = np.nanmedian(difference, axis=1)
    chosen, dropped, swapped = Ts_cam_board.copy(), dict[int, str](), list[int]()
    for k in np.flatnonzero(views > limit):
        twin = twins[k]
        if twin is not None:
            trial = Ts_cam_board.copy()
            trial[k] = twin
            if np.nanmedian(angle_differences(Ts_base_ee, trial)[k]) <= limit:
                chosen[k] = twin
                swapped.append(int(k))
                continue
        dropped[int(k)] = (
            f"angle gate: it turns {np.degrees(views[k]):.2f} deg (median over the other views) "
            f"differently from the hand; the limit is {np.degrees(limit):.2f} deg. Image and hand "
            "pose do not belong together, or the hand moved during the exposure."
        )
    return chosen, dropped, swapped


def frame_gate(
    Ts_base_ee: Array,
    Ts_cam_board: Array,
    twins: list[Array | None],
    middle: ArrayLike,
    config: GateConfig,
    *,
    eye_in_hand: bool = True,
) -> tuple[Array, dict[int, str], list[int]]:
    """Return the board poses, the views to drop with the reason, and the views whose twin is used.

    The frames X and Z are fitted robustly, rotations and translations together, and every view is
    judged by both errors: where the hand moves without turning the angles see nothing, and the
    place of the board must tell.

    Args:
        Ts_base_ee: (n, 4, 4) hand poses [m].
        Ts_cam_board: (n, 4, 4) board poses [m].
        twins: per view the mirror solution where it fits the image almost as well, else None.
        middle: (3,) the board's middle in its frame [m].
        config: the gate.
        eye_in_hand: whether the camera sits in the hand.
    """
    A = hand_side(Ts_base_ee, eye_in_hand)
    fit = fit_frames(A, Ts_cam_board, middle, config.fit)
    limit = max(config.frame_ratio * fit.usual, config.frame_floor)
    chosen, dropped, swapped = Ts_cam_board.copy(), dict[int, str](), list[int]()
    for k in np.flatnonzero(fit.errors > limit):
        twin = twins[k]
        if twin is not None and mismatch(fit, A[k : k + 1], twin[None], config.fit)[0, 0] <= limit:
            chosen[k] = twin
            swapped.append(int(k))
            continue
        dropped[int(k)] = (
            f"frame gate: its board is {1e3 * fit.slips[k]:.1f} mm and "
            f"{np.degrees(fit.angles[k]):.2f} deg from where the other views put it (they scatter "
            f"by {fit.usual_mm:.1f} mm and {fit.usual_deg:.2f} deg). Image and hand pose do not "
            "belong together, the board's pose is wrong, or the hand moved during the exposure."
        )
    return chosen, dropped, swapped


def px_gate(view_px: Array, config: GateConfig) -> dict[int, str]:
    """Return the views whose reprojection through a closed form is far beyond the others'."""
    limit = max(config.px_ratio * float(np.median(view_px)), config.px_floor)
    return {
        int(k): f"pixel gate: {view_px[k]:.1f} px through the best closed form; the limit is "
        f"{limit:.1f} px."
        for k in np.flatnonzero(~(view_px <= limit))
    }
