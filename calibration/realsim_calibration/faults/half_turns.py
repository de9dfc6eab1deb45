"""Boards that were read upside down: a chessboard or dot grid may look the same turned round.

A board pose read with the points numbered from the other end is T_cam_board F, F = the turn by 180
deg about the normal through the board's middle. Which of two views is turned shows in the angle of
their motion, which must be the hand's, without any hand-eye:

    angle(A_ij) = angle(F^(f_j - f_i) C_i^-1 C_j)

The pairwise answers are made consistent by the leading eigenvector of the matrix of their signs
(angular synchronisation, Singer, ACHA 30(1), 2011), which half of the views turned do not disturb.
Square grids also look the same turned by 90 deg: then the answers are the four roots of unity. All
views turned alike is no fault, so the fewer views are called turned.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import InputError
from realsim.geometry import se3

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class HalfTurnConfig:
    """How the turns are decided."""

    quarter_turns: bool = False
    """Whether 90 deg are possible too: square symmetric grids only."""
    soft_deg: float = 0.5
    """Differences of angle below this say nothing [deg]: the angle error of a planar pose."""
    sweeps: int = 5
    """Passes over the views in which each is turned once more if that fits better."""
    decisive_ratio: float = 5.0
    """The angles must fit this many times better after than before."""
    max_after_deg: float = 2.0
    """... and to this [deg], median over the pairs: right data measure 0.1 to 0.6."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class HalfTurns:
    """Which boards were read turned."""

    flips: NDArray[np.bool_]
    """(n,) whether the board was read turned."""
    quarters: NDArray[np.int64]
    """(n,) by how many quarter turns its pose must be turned to agree: 0 or 2, or 0 to 3."""
    before_deg: float
    """RMS difference of the turns of hand and camera over the pairs as given, at most 60 each."""
    after_deg: float
    """The same with the boards turned back."""
    margins_deg: Array
    """(n,) how much worse each view fits (median over its pairs) turned any other way [deg]."""
    decisive: bool
    """Whether turned boards are certain: they explain what the poses as given do not."""
    repaired: Array
    """(n, 4, 4) board poses turned back."""


def turn_board(middle_m: ArrayLike, quarters: int) -> Array:
    """Return F (4, 4): `quarters` times 90 deg about the normal through the board's middle."""
    m = np.asarray(middle_m, dtype=np.float64)
    R = se3.exp_so3(np.array([0.0, 0.0, quarters * np.pi / 2]))
    return se3.from_rt(R, m - R @ m)


def synchronise_half_turns(
    Ts_base_ee: ArrayLike,
    Ts_cam_board: ArrayLike,
    middle_m: ArrayLike,
    config: HalfTurnConfig | None = None,
) -> HalfTurns:
    """Return which boards were read turned, from the angles between the views alone.

    Args:
        Ts_base_ee: (n, 4, 4) hand poses, camera in the hand or fixed.
        Ts_cam_board: (n, 4, 4) board poses.
        middle_m: (3,) middle of the board in its own frame, in the unit of the board poses.
        config: how the turns are decided.

    Raises:
        InputError: stacks of different lengths, or fewer than three views.
    """
    config = config or HalfTurnConfig()
    A, C = np.asarray(Ts_base_ee, dtype=np.float64), np.asarray(Ts_cam_board, dtype=np.float64)
    if len(A) != len(C) or len(A) < 3:
        raise InputError(
            f"half turns: {len(A)} hand poses and {len(C)} board poses; three or more views with "
            "one of each are needed."
        )
    steps = (0, 1, 2, 3) if config.quarter_turns else (0, 2)
    off = _differences(A, C, steps)
    quarters = _synchronise(off, steps, np.radians(config.soft_deg))
    quarters = _polish(off, steps, quarters, config.sweeps)
    values, counts = np.unique(quarters, return_counts=True)
    quarters = (quarters - values[np.argmax(counts)]) % 4
    before, after = _rms(off, steps, 0 * quarters), _rms(off, steps, quarters)
    repaired = np.array(
        [T @ turn_board(middle_m, int(q)) for T, q in zip(C, quarters, strict=True)]
    )
    return HalfTurns(
        flips=quarters != 0,
        quarters=quarters,
        before_deg=before,
        after_deg=after,
        margins_deg=_margins(off, steps, quarters),
        decisive=bool(
            quarters.any()
            and after * config.decisive_ratio < before
            and after < config.max_after_deg
        ),
        repaired=repaired,
    )


def _differences(A: Array, C: Array, steps: tuple[int, ...]) -> Array:
    """Return (steps, n, n) |angle(A_ij) - angle(F^step C_i^-1 C_j)| [rad]."""
    Ra, Rc = A[:, :3, :3], C[:, :3, :3]
    hand = se3.angle(np.swapaxes(Ra, -1, -2)[:, None] @ Ra[None])
    cam = np.swapaxes(Rc, -1, -2)[:, None] @ Rc[None]
    return np.array(
        [np.abs(se3.angle(turn_board(np.zeros(3), k)[:3, :3] @ cam) - hand) for k in steps]
    )


def _synchronise(off: Array, steps: tuple[int, ...], soft: float) -> NDArray[np.int64]:
    """Return the quarter turns (n,) that the pairwise answers agree on best."""
    order = np.sort(off, axis=0)
    weight = (order[1] - order[0]) / (order[1] + order[0] + soft)
    answer = np.exp(0.5j * np.pi * np.array(steps)[off.argmin(0)]) * weight
    np.fill_diagonal(answer, 0)
    # answer_ij = phase_j / phase_i, so that conj(phase) is an eigenvector.
    hermitian = (answer + answer.conj().T) / 2
    leading = np.linalg.eigh(hermitian)[1][:, -1].conj()
    phase = leading / leading[np.argmax(np.abs(leading))]
    distance = np.abs(
        phase[:, None] - np.abs(phase)[:, None] * np.exp(0.5j * np.pi * np.array(steps))
    )
    return np.array(steps, dtype=np.int64)[distance.argmin(1)]


def _chosen(off: Array, steps: tuple[int, ...], quarters: NDArray[np.int64]) -> Array:
    """Return (n, n) the differences under these turns, NaN on the diagonal."""
    relative = (quarters[None] - quarters[:, None]) % 4
    slot = np.searchsorted(np.array(steps), relative)
    chosen = np.take_along_axis(off, slot[None], 0)[0].copy()
    np.fill_diagonal(chosen, np.nan)
    return chosen


def _polish(
    off: Array, steps: tuple[int, ...], quarters: NDArray[np.int64], sweeps: int
) -> NDArray[np.int64]:
    """Return the turns after every view was turned to where it fits best, a few times."""
    quarters = quarters.copy()
    for _ in range(sweeps):
        old = quarters.copy()
        for v in range(len(quarters)):
            quarters[v] = steps[int(np.argmin(_view_costs(off, steps, quarters, v)))]
        if np.array_equal(old, quarters):
            break
    return quarters


def _view_costs(
    off: Array, steps: tuple[int, ...], quarters: NDArray[np.int64], view: int
) -> Array:
    """Return the median difference (steps,) of a view's pairs for every way to turn it [rad]."""
    others = np.arange(len(quarters)) != view
    costs = np.empty(len(steps))
    for k, step in enumerate(steps):
        slot = np.searchsorted(np.array(steps), (step - quarters[others]) % 4)
        costs[k] = np.median(off[slot, np.flatnonzero(others), view])
    return costs


def _margins(off: Array, steps: tuple[int, ...], quarters: NDArray[np.int64]) -> Array:
    margins = np.empty(len(quarters))
    for v in range(len(quarters)):
        costs = np.sort(_view_costs(off, steps, quarters, v))
        margins[v] = np.degrees(costs[1] - costs[0])
    return margins


def _rms(off: Array, steps: tuple[int, ...], quarters: NDArray[np.int64]) -> float:
    """Return the RMS over the pairs, each at most 60 deg [deg]."""
    degrees = np.degrees(_chosen(off, steps, quarters))
    return float(np.sqrt(np.nanmean(np.minimum(degrees, 60.0) ** 2)))
