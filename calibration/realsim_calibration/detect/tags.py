"""Find the AprilTags of a board in an image, with corners to a few hundredths of a pixel.

OpenCV's detector finds and decodes the quads; their corners are then measured anew from the edges
(`edges`). Corners run clockwise from the top left of the tag as printed, as in
`TagBoard.corners_board`, and integer pixels are pixel centres (the AprilTag libraries are half a
pixel off that in both axes).

Tags against the board: which of them lie where it has them, and what it says of missed ones.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from realsim.arrays import Array, Int64, Mask, UInt8
from realsim.errors import InputError
from realsim.records import CameraIntrinsics, TagBoard
from realsim.records.targets import TAG_CELLS
from realsim_calibration.detect.edges import CORNER_CUT_PX, RefinedQuads, bilinear, refine_quads
from realsim_calibration.detect.homography import (
    agreeing,
    apply_homography,
    fit_homography,
    fit_layout,
)
from realsim_calibration.detect.images import gray_image
from realsim_calibration.detect.markers import TWO_BOARDS, decode_markers, several_boards
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


WEAK_FAMILIES = ("tag16h5",)
"""Families whose codes turn up by chance in any picture: one tag of a board proves nothing."""
MAX_BLUR_PX = 2.0
"""Largest sigma of the edges' blur [px]: the profiles reach 3.5 px, beyond it they see no
plateau and corners drift by half a pixel."""
SQUARE_CUT_PX = 4.0
"""Stretch at the ends of a side that is not sampled where a black square touches the tag's
corner [px]: twice a strong blur and more."""
SQUARE_MOVE_SHARE = 0.08
"""Furthest that refinement may move a corner there, in tag sides: the rough outline runs on
into the square, by less than a module."""
GUIDED_ROUNDS = 3
"""How often tags are looked for beside those found: every round reaches further out."""
LAYOUT_SHARE = 0.5
"""Furthest that a corner may lie from where the rest of the board puts it, in tag sides; a
strong lens bends a board by 0.2, a wrong tag is off by more than one."""
MIN_SIDE_PX = 16.0
"""Shortest side [px]: below two pixels per module the border no longer separates the edge
from the pattern."""
MIN_CONTRAST = 25.0
"""Least step across an edge [gray levels of 255]; noise of 4 levels then stays under 0.2 px."""
MAX_RESIDUAL_PX = 0.35
"""Largest scatter of edge points about the lines [px]: beyond it the side is bent or
covered."""
MIN_INLIER_SHARE = 0.5
"""Least share of the profiles that must carry each side."""
MAX_MOVE_PX = 3.0
"""Furthest that refinement may move a corner [px]; more means it found another edge."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TagDetections:
    """The tags seen in one image, sorted by id."""

    ids: Int64
    """(n,) tag ids, ascending."""
    corners_px: Array
    """(n, 4, 2) corners, clockwise from the top left as printed [px]."""
    corner_sd_px: Array
    """(n,) predicted 1-sigma of a corner [px]."""
    rejected: tuple[tuple[int, str], ...] = ()
    """(tag id, reason) of every decoded tag that was not used."""

    def __post_init__(self) -> None:
        """Sort by id, check shapes, freeze."""
        ids = np.array(self.ids, dtype=np.int64).ravel()
        corners = np.array(self.corners_px, dtype=np.float64).reshape(-1, 4, 2)
        if len(ids) != len(corners):
            raise InputError(f"tag detections: {len(ids)} ids for {len(corners)} tags.")
        if len(set(ids.tolist())) != len(ids):
            raise InputError("tag detections: a tag id occurs twice in one image.")
        if not np.all(np.isfinite(corners)):
            raise InputError("tag detections: a corner is not a finite number.")
        sd = np.array(self.corner_sd_px, dtype=np.float64)
        if sd.shape != ids.shape:
            raise InputError(f"tag detections: {sd.shape} sigmas for {len(ids)} tags.")
        order = np.argsort(ids)
        for name, value in (("ids", ids), ("corners_px", corners), ("corner_sd_px", sd)):
            ordered = value[order]
            ordered.setflags(write=False)
            object.__setattr__(self, name, ordered)

    def __len__(self) -> int:
        """Return the number of tags."""
        return len(self.ids)


def detect_tags(
    rgb: UInt8, board: TagBoard, *, intrinsics: CameraIntrinsics | None = None
) -> TagDetections:
    """Return the board's tags in an image.

    Args:
        rgb: (H, W, 3) or gray (H, W) image, uint8.
        board: which ids belong to the board, and how wide the white gap is.
        intrinsics: with them, edges are fitted as the bent curves that the lens makes of them.

    Raises:
        InputError: the image is not 8 bit, or not (H, W) or (H, W, 3).
    """
    gray = gray_image(rgb)
    ids, corners, border = _decode(gray, board)
    rejected: list[tuple[int, str]] = []
    ours = np.isin(ids, board.ids)
    rejected += [(int(i), "not a tag of this board") for i in np.unique(ids[~ours])]
    # The same id decoded twice is two boards or a mirror image: neither can be trusted.
    values, counts = np.unique(ids, return_counts=True)
    twice = np.isin(ids, values[counts > 1])
    rejected += [(int(i), "seen more than once") for i in np.unique(ids[twice & ours])]
    if several_boards(ids[ours]):
        return _no_tags([*rejected, *((int(i), TWO_BOARDS) for i in np.unique(ids[ours & ~twice]))])
    missing = np.setdiff1d(board.ids, ids[twice])
    keep = ours & ~twice
    seen = (ids[keep], corners[keep])
    ids, corners, misplaced, roll = _on_board(*seen, board)
    rejected += misplaced
    found = _measured(gray, ids, corners, border, (board, intrinsics))
    # What was found says where the rest must be; what is found there helps the next round.
    for _ in range(GUIDED_ROUNDS if board.rows * board.columns > 1 else 0):
        left = np.setdiff1d(missing, [*found.ids, *(i for i, _ in found.rejected)])
        if len(found) < 2 or not len(left):
            break
        code = (border, roll)
        more = read_missing_tags(gray, board, (found.ids, found.corners_px), left, code)
        if not len(more[0]):
            break
        found = _both(found, _measured(gray, *more, border, (board, intrinsics)))
    told = [(i, r) for i, r in rejected if i not in found.ids]
    return replace(found, rejected=tuple(sorted({*told, *found.rejected})))


def _no_tags(rejected: list[tuple[int, str]]) -> TagDetections:
    return TagDetections(
        ids=np.zeros(0, np.int64), corners_px=np.zeros((0, 4, 2)), corner_sd_px=np.zeros(0),
        rejected=tuple(sorted(rejected)),
    )  # fmt: skip


def _measured(
    gray: UInt8,
    ids: Int64,
    corners: Array,
    border: int,
    how: tuple[TagBoard, CameraIntrinsics | None],
) -> TagDetections:
    """Return those of the tags (n,) with rough corners (n, 4, 2) that can be measured well."""
    board, intrinsics = how
    if not len(ids):
        return _no_tags([])
    clear = (border / (TAG_CELLS[board.family] + 2 * (border - 1)), board.gap_m / board.tag_size_m)
    cut_px, most_px = CORNER_CUT_PX, MAX_MOVE_PX
    if board.corner_squares:
        cut_px = max(cut_px, SQUARE_CUT_PX)
        side = float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)))
        most_px = max(MAX_MOVE_PX, SQUARE_MOVE_SHARE * side)
    refined = refine_quads(gray, corners, clear, intrinsics, cut_px)
    reasons = [_fault(refined, corners, k, gray.shape, most_px) for k in range(len(ids))]
    good = np.array([not r for r in reasons], dtype=bool)
    return TagDetections(
        ids=ids[good],
        corners_px=refined.corners_px[good],
        corner_sd_px=refined.corner_sd_px[good],
        rejected=tuple((int(i), r) for i, r in zip(ids, reasons, strict=True) if r),
    )


def _both(a: TagDetections, b: TagDetections) -> TagDetections:
    """Return the tags of both."""
    return TagDetections(
        ids=np.concatenate([a.ids, b.ids]),
        corners_px=np.concatenate([a.corners_px, b.corners_px]),
        corner_sd_px=np.concatenate([a.corner_sd_px, b.corner_sd_px]),
        rejected=a.rejected + b.rejected,
    )


def _decode(gray: UInt8, board: TagBoard) -> tuple[Int64, Array, int]:
    """Return ids, quads (n, 4, 2) and the width of the black border in modules."""
    name = tag_dictionary(board.family)
    ids, corners = decode_markers(gray, name, touching=board.corner_squares)
    seen = int(np.isin(ids, board.ids).sum())
    if board.corner_squares and 2 * seen < len(board.ids):
        # Kalibr prints its tags with a border of two modules.
        wide = decode_markers(gray, name, touching=True, border=2)
        if np.isin(wide[0], board.ids).sum() > seen:
            return *wide, 2
    return ids, corners, 1


def _on_board(
    ids: Int64, corners: Array, board: TagBoard
) -> tuple[Int64, Array, list[tuple[int, str]], int]:
    """Return the tags on the board, corners in its order, others' faults, the codes' turns."""
    if len(ids) == 1 and board.rows * board.columns > 1 and board.family in WEAK_FAMILIES:
        return ids[:0], corners[:0], [(int(ids[0]), f"one {board.family} alone may be chance")], 0
    if len(ids) < 2:
        return ids, corners, [], 0
    good, roll, reason = check_layout(ids, corners, board, LAYOUT_SHARE)
    bad = [(int(i), reason) for i in ids[~good]]
    return ids[good], np.roll(corners[good], roll, axis=1), bad, roll


def _fault(
    refined: RefinedQuads, start: Array, k: int, shape: tuple[int, ...], most_px: float
) -> str:
    """Return why tag k cannot be used, '' where it can."""
    corners = refined.corners_px[k]
    side = float(np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=-1).min())
    moved = float(np.linalg.norm(corners - start[k], axis=-1).max())
    contrast, share = float(refined.contrast[k]), float(refined.inlier_share[k])
    residual = float(refined.residual_px[k])
    inside = bool(corners.min() >= 0 and np.all(corners.max(0) <= [shape[1] - 1, shape[0] - 1]))
    # Written as "is it good", so that a NaN is a fault. The first fault is the one that is told.
    checks = (
        (side >= MIN_SIDE_PX,
         f"too small: its shortest side is {side:.1f} px (at least {MIN_SIDE_PX:g})"),
        (contrast >= MIN_CONTRAST,
         f"low contrast: {contrast:.0f} levels (at least {MIN_CONTRAST:g})"),
        (float(refined.sharpness_px[k]) <= MAX_BLUR_PX,
         f"out of focus: edges are blurred by {refined.sharpness_px[k]:.1f} px (at most "
         f"{MAX_BLUR_PX:g})"),
        (share >= MIN_INLIER_SHARE,
         f"edge covered or broken: {share:.0%} of a side's profiles fit"),
        (residual <= MAX_RESIDUAL_PX,
         f"residual: edges scatter by {residual:.2f} px (at most {MAX_RESIDUAL_PX:g})"),
        (moved <= most_px,
         f"residual: the refined corners lie {moved:.1f} px from the detected ones"),
        (inside, "cut by the image border"),
    )  # fmt: skip
    return next((reason for good, reason in checks if not good), "")
