"""Tags against the board: which of them lie where it has them, and what it says of missed ones."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from realsim.arrays import Array, Int64, Mask, UInt8
from realsim.records import TagBoard
from realsim_calibration.detect.edges import bilinear
from realsim_calibration.detect.homography import (
    apply_homography,
    fit_homography,
    fit_trimmed,
    seen_from_front,
)
from realsim_calibration.detect.markers import FAMILY_DICTIONARY, predefined_dictionary

MIN_SHARE = 0.7
"""Least share of the tags that must agree: fewer, and the board file does not fit the picture. With
rows counted from the wrong end a skewed map can explain half of them."""
NEAR_TAGS = 4
"""Known tags that tell where a neighbour is; few, so that the lens does not bend the map."""
WRONG_SHARE = 0.1
"""Share of a code's cells, border included, that may read wrong: 6 of 64."""
WRONG_BORDER = 1
"""Cells of the outermost ring that may read white: more, and a side is covered."""
MIN_STEP = 20.0
"""Least difference between the white and the black cells [gray levels of 255]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TagLayout:
    """Which tags lie where the board has them."""

    good: Mask
    """(n,)."""
    roll: int
    """Quarter turns of the codes on the page."""
    reason: str
    """What is wrong with the others."""


def check_layout(ids: Int64, corners: Array, board: TagBoard, share: float) -> TagLayout:
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


def _agreeing(ids: Int64, corners: Array, board: TagBoard, limit: float) -> Mask:
    """Return the tags (n,) that one map of the plane explains, seen from the printed side."""
    at = {int(tag): k for k, tag in enumerate(board.ids)}
    rows = np.array([at.get(int(i), -1) for i in ids])
    known = board.corners_board[rows][..., :2].reshape(-1, 2)
    H, inside = fit_trimmed(known, corners.reshape(-1, 2), limit)
    good = inside.reshape(-1, 4).all(-1) & (rows >= 0)
    if good.any() and not seen_from_front(H, known.reshape(-1, 4, 2)[good].reshape(-1, 2)):
        good[:] = False
    return good


def _remedy(ids: Int64, corners: Array, board: TagBoard, limit: float, least: int) -> str:
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


# --- tags that the general search missed ---------------------------------------------------------
#
# Strong blur, and black squares that touch the corners, keep the search from closing an outline.
# Once two tags are known the others' places follow; their codes are read there and compared.


def read_missing_tags(
    gray: UInt8, board: TagBoard, seen: tuple[Int64, Array], missing: Int64, code: tuple[int, int]
) -> tuple[Int64, Array]:
    """Return ids (n,) and rough corners (n, 4, 2) of tags that are where the board has them.

    Args:
        gray: (H, W) image.
        board: the board.
        seen: ids (m,) of two or more tags and their corners (m, 4, 2) in the board's order [px].
        missing: ids to look for.
        code: width of the black border in modules, and quarter turns of the codes on the page.
    """
    (ids, corners), (border, roll) = seen, code
    row_of = {int(tag): row for row, tag in enumerate(board.ids)}
    known = board.corners_board[[row_of[int(i)] for i in ids]][..., :2]
    limit = np.array([gray.shape[1] - 1, gray.shape[0] - 1])
    image = gray.astype(np.float64)
    new_ids: list[int] = []
    new: list[Array] = []
    for tag in missing:
        square = board.corners_board[row_of[int(tag)]][:, :2]
        apart = np.linalg.norm(known.mean(1) - square.mean(0), axis=-1)
        near = np.argsort(apart)[:NEAR_TAGS]
        H = fit_homography(known[near].reshape(-1, 2), corners[near].reshape(-1, 2))
        quad = apply_homography(H, square)
        if not (np.all(quad > 0) and np.all(quad < limit)):
            continue
        # One code for the page: rolled corners put its own top left first.
        if _reads(image, np.roll(quad, -roll, axis=0), _code(board.family, int(tag), border)):
            new_ids.append(int(tag))
            new.append(quad)
    return np.array(new_ids, np.int64), np.array(new).reshape(-1, 4, 2)


@lru_cache(maxsize=1024)
def _code(family: str, tag: int, border: int) -> Mask:
    """Return the white cells (cells, cells) of a tag, its black border included."""
    from cv2 import aruco

    dictionary = predefined_dictionary(FAMILY_DICTIONARY[family])
    cells = int(dictionary.markerSize) + 2 * border
    drawn = aruco.generateImageMarker(dictionary, tag, cells, borderBits=border)
    return np.asarray(drawn) > 127


def _reads(image: Array, corners: Array, white: Mask) -> bool:
    """Return whether the cells within corners (4, 2) read as they should."""
    n = len(white)
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float64)
    middle = (np.arange(n) + 0.5) / n
    at = np.stack(np.meshgrid(middle, middle), -1)
    level = bilinear(image, apply_homography(fit_homography(unit, corners), at))
    low, high = np.median(level[~white]), np.median(level[white])
    if high - low < MIN_STEP:
        return False
    wrong = (level > (low + high) / 2) != white
    ring = wrong.sum() - wrong[1:-1, 1:-1].sum()
    return bool(wrong.mean() <= WRONG_SHARE and ring <= WRONG_BORDER)
