"""Tags against the board: which of them lie where it has them, and what it says of missed ones."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from realsim.arrays import Array, Int64, Mask, UInt8
from realsim.records import TagBoard
from realsim_calibration.detect.edges import bilinear
from realsim_calibration.detect.homography import (
    agreeing,
    apply_homography,
    fit_homography,
    fit_layout,
)
from realsim_calibration.targets.marker_sets import load_dictionary, tag_dictionary

NEAR_TAGS = 4
"""Known tags that tell where a neighbour is; few, so that the lens does not bend the map."""
WRONG_SHARE = 0.1
"""Share of a code's cells, border included, that may read wrong: 6 of 64."""
WRONG_BORDER = 1
"""Cells of the outermost ring that may read white: more, and a side is covered."""
MIN_STEP = 20.0
"""Least difference between the white and the black cells [gray levels of 255]."""


def check_layout(
    ids: Int64, corners: Array, board: TagBoard, share: float
) -> tuple[Mask, int, str]:
    """Return which of two or more tags (n, 4, 2) agree with the board to within `share` sides.

    Also the quarter turns of the codes on the page, and what is wrong with the other tags.
    """
    other = "top" if board.ids_from == "bottom" else "bottom"
    turned = replace(board, rows=board.columns, columns=board.rows)
    candidates = (
        (replace(board, ids_from=other), f"with ids_from='{other}'"),
        (turned, f"with {turned.rows} rows and {turned.columns} columns"),
        (replace(turned, ids_from=other), f"with {turned.rows} rows, {turned.columns} columns and "
         f"ids_from='{other}'"),
    )  # fmt: skip

    def remedy(limit: float, least: int) -> str:
        for candidate, how in candidates:
            known = _corners_of(ids, candidate)
            for roll in (0, 2, 1, 3):
                if agreeing(known, np.roll(corners, roll, axis=1), limit).sum() >= least:
                    return f"; {how} they would"
        return ""

    good, roll, better = fit_layout(_corners_of(ids, board), corners, share, remedy)
    if good.any():
        return good, roll, "does not lie where the rest of the board puts it"
    better = better or ". Are rows, columns, first id, tag size and gap right?"
    return good, roll, f"the tags do not lie as the board file says{better}"


def _corners_of(ids: Int64, board: TagBoard) -> Array:
    """Return where tags are on a board (n, 4, 2) [m]."""
    at = {int(tag): k for k, tag in enumerate(board.ids)}
    return board.corners_board[[at[int(i)] for i in ids]][..., :2]


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
    known = _corners_of(ids, board)
    limit = np.array([gray.shape[1] - 1, gray.shape[0] - 1])
    image = gray.astype(np.float64)
    new_ids: list[int] = []
    new: list[Array] = []
    for tag, square in zip(missing, _corners_of(missing, board), strict=True):
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

    dictionary = load_dictionary(tag_dictionary(family))
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
