"""Which views may take part: tests that need no hand-eye, and two that need only a rough one.

For right data A_ij X = X B_ij, so that the hand and the camera turn by the same angle, about axes
that one rotation maps onto each other, and slide by the same length along them, whatever X is.
Wrong conventions (inverted poses, another unit, a mis-paired list) break this for most views and
are named; a bad view breaks it for itself and is dropped. Two corrupted views left in make a joint
fit worse than no fit. Angles alone do not see inverted poses: tr(R_i^T R_j) = tr(R_i R_j^T).
"""

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim_calibration.faults.frame_fit import fit_frames, hand_side, mismatch
from realsim_calibration.fit.closed_forms import clear_of_half_turns, motions, nearest_rotation

MIN_SLIDE_M = 0.005
"""Median slide along the screw axes that makes the ratio meaningful [m]."""
MIN_TURN_DEG = 5.0
"""Pairs that turn less have no sure screw axis [deg]."""
PX_RATIO = 5.0
"""A view is dropped when its px through the closed form exceeds this many medians."""
PX_FLOOR = 3.0
"""A dropped view's px exceeds this, too [px]."""
TWIN_RATIO = 2.0
"""The mirror twin of a planar pose may stand in when its px is at most this much worse."""
FRAME_RATIO = 5.0
"""A view is dropped when its error through the fitted frames exceeds this many medians."""
FRAME_FLOOR = 4.0
"""A dropped view's error exceeds this, too, in the units of `fit_frames`: 2 deg or 4 % of the
distance to the board. Views of good real sets reach 4.1 medians where the board is small and
seen at a slant."""


def screw_ratio(Ts_base_ee: ArrayLike, Ts_cam_board: ArrayLike) -> float:
    """Return how many times further the hand slides along its screw axes than the camera does.

    The slide d = axis . t of a rigid motion is the same seen from hand and camera (Chen 1991): 1
    when both are in metres and the board has the size it is said to have; NaN when the motion
    hardly slides.
    """
    slides: list[Array] = []
    for m in motions(Ts_base_ee, Ts_cam_board):
        n = np.linalg.norm(m.turns, axis=-1)
        turned = n > np.radians(MIN_TURN_DEG)
        slide = np.abs((m.turns * m.Ts[:, :3, 3]).sum(-1)) / np.where(turned, n, 1.0)
        slides.append(np.where(turned, slide, np.nan))
    hand, cam = slides
    both = np.isfinite(hand) & np.isfinite(cam)
    if both.sum() < 3 or float(np.median(cam[both])) < MIN_SLIDE_M:
        return float("nan")
    return float(np.median(hand[both]) / np.median(cam[both]))


def rotation_mismatch_deg(Ts_base_ee: ArrayLike, Ts_cam_board: ArrayLike) -> float:
    """Return the median over pairs of |a - R b| [deg], a and b the turns of hand and camera.

    R is the rotation that maps the camera's turns onto the hand's best (Park's), fitted three times
    with the worse half of the pairs left out, so that a few bad views do not spoil it.
    """
    hand, cam = motions(Ts_base_ee, Ts_cam_board)
    a, b = hand.turns, cam.turns
    if not len(a):
        return float("nan")
    clear = clear_of_half_turns(hand, cam)
    if clear.any():
        a, b = a[clear], b[clear]
    error, use = np.zeros(len(a)), np.ones(len(a), dtype=bool)
    for _ in range(3):
        R = nearest_rotation(a[use].T @ b[use])
        error = np.linalg.norm(a - b @ R.T, axis=-1)
        use = error <= np.median(error)
    return float(np.degrees(np.median(error)))


def frame_gate(
    Ts_base_ee: Array,
    Ts_cam_board: Array,
    twins: list[Array | None],
    middle: ArrayLike,
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
        eye_in_hand: whether the camera sits in the hand.
    """
    A = hand_side(Ts_base_ee, eye_in_hand)
    fit = fit_frames(A, Ts_cam_board, middle)
    limit = max(FRAME_RATIO * fit.usual, FRAME_FLOOR)
    chosen, dropped, swapped = Ts_cam_board.copy(), dict[int, str](), list[int]()
    for k in np.flatnonzero(fit.errors > limit):
        twin = twins[k]
        if twin is not None and mismatch(fit, A[k : k + 1], twin[None])[0, 0] <= limit:
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


def px_gate(view_px: Array) -> dict[int, str]:
    """Return the views whose reprojection through a closed form is far beyond the others'."""
    limit = max(PX_RATIO * float(np.median(view_px)), PX_FLOOR)
    return {
        int(k): f"pixel gate: {view_px[k]:.1f} px through the best closed form; the limit is "
        f"{limit:.1f} px."
        for k in np.flatnonzero(~(view_px <= limit))
    }
