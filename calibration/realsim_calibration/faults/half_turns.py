"""Boards that were read upside down: a chessboard or dot grid may look the same turned round.

A board pose read with the points numbered from the other end is T_cam_board F, F = the turn by 180
deg about the normal through the board's middle. Which of two views is turned shows in the angle of
their motion, which must be the hand's, without any hand-eye:

    angle(A_ij) = angle(F^(f_j - f_i) C_i^-1 C_j)

The pairwise answers are made consistent by the leading eigenvector of the matrix of their signs
(angular synchronisation, Singer, ACHA 30(1), 2011), which half of the views turned do not disturb.
All views turned alike is no fault, so the fewer views are called turned.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Mask
from realsim.geometry import se3
from realsim_calibration.fit.closed_forms import MIN_VIEWS, pose_stacks

SOFT_DEG = 0.5
"""Differences of angle below this say nothing [deg]: the angle error of a planar pose."""
SWEEPS = 5
"""Passes over the views in which each is turned once more if that fits better."""
DECISIVE_RATIO = 5.0
"""The angles must fit this many times better after than before."""
MAX_AFTER_DEG = 2.0
"""Median angle over the pairs to which they must fit [deg]: right data measure 0.1 to 0.6."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class HalfTurns:
    """Which boards were read turned."""

    flips: Mask
    """(n,) whether the board was read turned."""
    before_deg: float
    """RMS difference of the turns of hand and camera over the pairs as given, at most 60 each."""
    after_deg: float
    """The same with the boards turned back."""
    decisive: bool
    """Whether turned boards are certain: they explain what the poses as given do not."""
    repaired: Array
    """(n, 4, 4) board poses turned back."""


def half_turn(middle_m: ArrayLike) -> Array:
    """Return F (4, 4): the turn by 180 deg about the normal through the board's middle."""
    R = np.diag([-1.0, -1.0, 1.0])
    m = np.asarray(middle_m, dtype=np.float64)
    return se3.from_rt(R, m - R @ m)


def synchronise_half_turns(
    Ts_base_ee: ArrayLike, Ts_cam_board: ArrayLike, middle_m: ArrayLike
) -> HalfTurns:
    """Return which boards were read turned, from the angles between the views alone.

    Args:
        Ts_base_ee: (n, 4, 4) hand poses, camera in the hand or fixed.
        Ts_cam_board: (n, 4, 4) board poses.
        middle_m: (3,) middle of the board in its own frame, in the unit of the board poses.

    Raises:
        InputError: stacks of different lengths, or fewer than three views.
    """
    A, C = pose_stacks(Ts_base_ee, Ts_cam_board, "half turns", least=MIN_VIEWS)
    off = _differences(A, C)
    flips = _polish(off, _synchronise(off, np.radians(SOFT_DEG)), SWEEPS)
    if 2 * flips.sum() > len(flips):
        flips = ~flips
    before, after = _rms(off, np.zeros_like(flips)), _rms(off, flips)
    sure = flips.any() and after * DECISIVE_RATIO < before
    return HalfTurns(
        flips=flips, before_deg=before, after_deg=after,
        decisive=bool(sure and after < MAX_AFTER_DEG),
        repaired=np.where(flips[:, None, None], C @ half_turn(middle_m), C),
    )  # fmt: skip


def _differences(A: Array, C: Array) -> Array:
    """Return (2, n, n) |angle(A_ij) - angle(F^k C_i^-1 C_j)| [rad], k = 0, 1.

    tr(R^T S) is the product of the two as vectors.
    """
    turned = (C @ half_turn(np.zeros(3)))[:, :3, :3].reshape(-1, 9)
    Ra, Rc = A[:, :3, :3].reshape(-1, 9), C[:, :3, :3].reshape(-1, 9)
    hand, same, other = (
        np.arccos(np.clip((left @ right.T - 1) / 2, -1, 1))
        for left, right in ((Ra, Ra), (Rc, Rc), (turned, Rc))
    )
    return np.abs(np.stack([same, other]) - hand)


def _synchronise(off: Array, soft: float) -> Mask:
    """Return the turns (n,) that the pairwise answers agree on best."""
    answer = (off[1] - off[0]) / (off[1] + off[0] + soft)
    np.fill_diagonal(answer, 0)
    leading = np.linalg.eigh(answer)[1][:, -1]
    return leading * leading[np.argmax(np.abs(leading))] < 0


def _polish(off: Array, flips: Mask, sweeps: int) -> Mask:
    """Return the turns after every view was turned to where it fits best, a few times."""
    flips = flips.copy()
    others = ~np.eye(len(flips), dtype=bool)
    for _ in range(sweeps):
        old = flips.copy()
        for v in range(len(flips)):
            apart = flips[others[v]].astype(int)
            row = off[:, v, others[v]]
            as_is, turned = (np.median(np.where(apart == k, row[0], row[1])) for k in (0, 1))
            flips[v] = turned < as_is
        if np.array_equal(old, flips):
            break
    return flips


def _rms(off: Array, flips: Mask) -> float:
    """Return the RMS over the pairs under these turns, each at most 60 deg [deg]."""
    degrees = np.degrees(np.where(flips[None] == flips[:, None], off[0], off[1]))
    degrees = degrees[~np.eye(len(flips), dtype=bool)]
    return float(np.sqrt(np.mean(np.minimum(degrees, 60.0) ** 2)))
