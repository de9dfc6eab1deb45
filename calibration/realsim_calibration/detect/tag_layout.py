"""Do decoded tags lie where the board has them? One map of the plane must explain them all."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from realsim.records import TagBoard
from realsim_calibration.detect.homography import fit_trimmed, seen_from_front

Array = NDArray[np.float64]
MIN_SHARE = 0.7
"""Least share of the tags that must agree: fewer, and the board file does not fit the picture. With
rows counted from the wrong end a skewed map can explain half of them."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TagLayout:
    """Which tags lie where the board has them."""

    good: NDArray[np.bool_]
    """(n,)."""
    roll: int
    """Quarter turns of the codes on the page."""
    reason: str
    """What is wrong with the others."""


def check_layout(
    ids: NDArray[np.int64], corners: Array, board: TagBoard, share: float
) -> TagLayout:
    """Return which of two or more tags (n, 4, 2) agree with the board to within `share` sides."""
    side = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=-1)
    limit = share * float(np.median(side))
    least = max(2, int(np.ceil(MIN_SHARE * len(ids))))
    for roll in (0, 2, 1, 3):
        good = _agreeing(ids, np.roll(corners, roll, axis=1), board, limit)
        if good.sum() < least:
            continue
        better = ""
        if not good.all():
            better = _remedy(ids, corners, board, limit, int(good.sum()) + 1)
        if not better.startswith(";"):
            reason = "does not lie where the rest of the board puts it"
            return TagLayout(good=good, roll=roll, reason=reason)
    reason = "the tags do not lie as the board file says" + _remedy(
        ids, corners, board, limit, least
    )
    return TagLayout(good=np.zeros(len(ids), dtype=bool), roll=0, reason=reason)


def _agreeing(
    ids: NDArray[np.int64], corners: Array, board: TagBoard, limit: float
) -> NDArray[np.bool_]:
    """Return the tags (n,) that one map of the plane explains, seen from the printed side."""
    at = {int(tag): k for k, tag in enumerate(board.ids)}
    rows = np.array([at.get(int(i), -1) for i in ids])
    known = board.corners_board[rows][..., :2].reshape(-1, 2)
    H, inside = fit_trimmed(known, corners.reshape(-1, 2), limit)
    good = inside.reshape(-1, 4).all(-1) & (rows >= 0)
    if good.any() and not seen_from_front(H, known.reshape(-1, 4, 2)[good].reshape(-1, 2)):
        good[:] = False
    return good


def _remedy(
    ids: NDArray[np.int64], corners: Array, board: TagBoard, limit: float, least: int
) -> str:
    """Return how they do lie, where a usual mistake explains it."""
    other = "top" if board.ids_from == "bottom" else "bottom"
    turned = replace(board, rows=board.columns, columns=board.rows)
    candidates = (
        (replace(board, ids_from=other), f"with ids_from='{other}'"),
        (turned, f"with {turned.rows} rows and {turned.columns} columns"),
        (replace(turned, ids_from=other), f"with {turned.rows} rows, {turned.columns} columns and "
         f"ids_from='{other}'"),
    )  # fmt: skip
    for candidate, how in candidates:
        for roll in (0, 2, 1, 3):
            good = _agreeing(ids, np.roll(corners, roll, axis=1), candidate, limit)
            if good.sum() >= least:
                return f"; {how} they would"
    return ". Are rows, columns, first id, tag size and gap right?"
