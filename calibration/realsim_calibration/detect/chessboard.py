"""Find a whole chessboard: OpenCV says which corners, the saddles say where."""

import numpy as np

from realsim.arrays import Array, Mask, UInt8
from realsim.records import CameraIntrinsics
from realsim.records.targets import Chessboard
from realsim_calibration.detect.edges import bilinear
from realsim_calibration.detect.images import gray_image, no_points, size_of
from realsim_calibration.detect.saddles import Saddles, grid_arms, refine_saddles
from realsim_calibration.views import TargetDetection

MIN_PART = (3, 3)
"""Least part of a chessboard that OpenCV looks for, in inner corners."""
SLOW_SEARCH_PX = 1000
"""Larger pictures are shrunk before the search that takes long on clutter."""
LINE_SHARE = 0.6
"""Share of a line that must be corners for it to be part of a chessboard."""
SEARCH_PX = 1600
"""Larger images are searched at this width or height first; corners are always measured in the
full image."""
MIN_SHARE = 0.7
"""Least share of the corners that must be measurable; fewer mean glare or a wrong grid."""
TWIN_SQUARE_PX = 28.0
"""For that search the picture is halved until squares like those found are narrower; OpenCV
finds squares of 8 px, so a twin may stand 1.7 times as far away at least."""


def find_chessboard(
    rgb: UInt8, board: Chessboard, *, intrinsics: CameraIntrinsics | None = None
) -> TargetDetection:
    """Return the inner corners of a chessboard that is seen as a whole.

    The first corner is next to a black outer square where the colours tell the ends apart;
    otherwise x runs along the image's x as closely as the board allows.

    Raises:
        InputError: the image is not 8 bit.
    """
    gray = gray_image(rgb)
    grid, fault = _whole(gray, board)
    if grid is None:
        return no_points(gray, fault)
    found = _measured(gray, grid, intrinsics)
    lost = _lost_line(found.good.reshape(grid.shape[:2]))
    exact = _classic(gray, board) if lost else None
    if exact is not None:
        found = _measured(gray, exact, intrinsics)
        lost = _lost_line(found.good.reshape(exact.shape[:2]))
    faults = tuple(f"corner {k}: {f}" for k, f in enumerate(found.faults) if f)
    if lost:
        return no_points(gray, lost, *faults[:3])
    if found.good.mean() < MIN_SHARE:
        share = f"{int(found.good.sum())} of {len(found.good)} corners could be measured"
        return no_points(gray, share, *faults[:3])
    return TargetDetection(
        point_ids=np.flatnonzero(found.good),
        uv=found.uv[found.good],
        sd_px=found.sd_px[found.good],
        image_size=size_of(gray),
        rejected=faults,
    )


def _measured(gray: UInt8, grid: Array, intrinsics: CameraIntrinsics | None) -> Saddles:
    """Return the corners of a grid, numbered and measured."""
    grid, dark = number_corners(gray, grid)
    r, c = np.divmod(np.arange(grid.shape[0] * grid.shape[1]), grid.shape[1])
    return refine_saddles(
        gray,
        grid.reshape(-1, 2),
        grid_arms(grid).reshape(-1, 4, 2),
        ((r + c) % 2 == 0) == dark,
        1.0,
        intrinsics,
    )


def _lost_line(good: Mask) -> str:
    """Return what to say of an outer line without any corner; empty where there is none.

    OpenCV's newer search may miss a line and make one up on the other side, in the margin: then
    every corner has a wrong number.
    """
    for name, line in (("first row", good[0]), ("last row", good[-1]),
                       ("first column", good[:, 0]), ("last column", good[:, -1])):  # fmt: skip
        if not line.any():
            return f"no corner of the {name} could be measured: is the board cut off or covered?"
    return ""


def _whole(gray: UInt8, board: Chessboard) -> tuple[Array | None, str]:
    """Return the corners (rows, columns, 2) in an order of the right shape, or what is wrong."""
    shapes = {(board.rows, board.columns), (board.columns, board.rows)}
    grid = largest_chessboard(gray, SEARCH_PX)
    if grid is not None and grid.shape[:2] not in shapes and not _fits_in(grid, board):
        grid = _without_clutter(gray, grid)
    if grid is None or (grid.shape[:2] not in shapes and _fits_in(grid, board)):
        # A plain search of the exact size finds a few that the other does not.
        exact = _classic(gray, board)
        if exact is None:
            return None, _partly(grid, board)
        if _goes_on(gray, exact):
            return None, (
                f"the chessboard in the picture is larger than {board.columns}x{board.rows} inner "
                "corners: correct rows and columns"
            )
        grid = exact
    if grid.shape[:2] not in shapes:
        return None, (
            f"the picture shows a chessboard of {max(grid.shape[:2])}x{min(grid.shape[:2])} inner "
            f"corners, not of {board.columns}x{board.rows}: correct rows and columns"
        )
    # Search once more beside the board found: of two equal boards neither can be trusted.
    other = largest_chessboard(*_for_twins(_covered(gray, grid), grid))
    if other is not None and other.shape[:2] in shapes:
        return None, "two equal chessboards are in view: cover one"
    if grid.shape[:2] != (board.rows, board.columns):
        grid = grid.transpose(1, 0, 2)
    return grid, ""


def _fits_in(grid: Array, board: Chessboard) -> bool:
    """Return whether the grid may be a part of the board."""
    small, large = sorted(grid.shape[:2]), sorted((board.rows, board.columns))
    return small[0] <= large[0] and small[1] <= large[1]


def _partly(grid: Array | None, board: Chessboard) -> str:
    """Return what was found of a board that is not whole."""
    total = board.rows * board.columns
    if grid is None:
        return (
            f"no chessboard of {board.columns}x{board.rows} inner corners was recognised (0 of "
            f"{total}): too small, too oblique, cut off, or covered?"
        )
    r, c = grid.shape[:2]
    return (
        f"{r * c} of {total} inner corners ({c}x{r} of {board.columns}x{board.rows}) were "
        "recognised: a chessboard must be seen whole, with its white margin, free of glare"
    )


def largest_chessboard(gray: UInt8, search_px: int) -> Array | None:
    """Return the corners (r, c, 2) of the largest chessboard in view [px], whatever its size."""
    import cv2

    for small, scale in _sizes(gray, search_px):
        ok, corners, meta = cv2.findChessboardCornersSBWithMeta(
            small, MIN_PART, cv2.CALIB_CB_LARGER
        )
        if ok:
            grid = np.asarray(corners, dtype=np.float64).reshape(*np.asarray(meta).shape[:2], 2)
            return (grid + 0.5) * scale - 0.5
    return None


def _classic(gray: UInt8, board: Chessboard) -> Array | None:
    """Return the corners (rows, columns, 2) as the older search of one exact size finds them.

    OpenCV's fast check counts squares at one threshold of the whole picture: a dark board in a
    bright room does not pass it. So the search is made without it, too, in a picture that is small
    enough, because clutter costs it seconds.
    """
    import cv2

    usual = cv2.CALIB_CB_ADAPTIVE_THRESH + cv2.CALIB_CB_NORMALIZE_IMAGE
    small, scale = _sizes(gray, SLOW_SEARCH_PX)[0]
    for image, pixel, flags in (
        (gray, 1.0, usual + cv2.CALIB_CB_FAST_CHECK),
        (small, scale, usual),
    ):
        ok, corners = cv2.findChessboardCorners(image, (board.columns, board.rows), flags=flags)
        if ok:
            grid = np.asarray(corners, dtype=np.float64).reshape(board.rows, board.columns, 2)
            return (grid + 0.5) * pixel - 0.5
    return None


def _sizes(gray: UInt8, search_px: float) -> list[tuple[UInt8, float]]:
    """Return the image shrunk to `search_px` if it is larger, then as it is; with pixel sizes."""
    import cv2

    halvings = int(np.ceil(np.log2(max(gray.shape) / search_px)))
    if halvings < 1:
        return [(gray, 1.0)]
    scale = 2**halvings
    size = (gray.shape[1] // scale, gray.shape[0] // scale)
    cut = gray[: size[1] * scale, : size[0] * scale]
    small = np.asarray(cv2.resize(cut, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return [(small, float(scale)), (gray, 1.0)]


def _for_twins(gray: UInt8, grid: Array) -> tuple[UInt8, int]:
    """Return the picture, shrunk as far as squares like the grid's stay large, and its search size.

    Most pictures have no second board, and a search for none costs as much as one for the first.
    """
    square = float(np.median(np.linalg.norm(np.diff(grid, axis=1), axis=-1)))
    small, _ = _sizes(gray, max(gray.shape) * TWIN_SQUARE_PX / max(square, 1.0))[0]
    return small, min(SEARCH_PX, max(small.shape))


def _covered(gray: UInt8, grid: Array) -> UInt8:
    """Return the image with the board painted over, a square's width around it included."""
    import cv2

    middle = grid.mean((0, 1))
    rim = np.concatenate([grid[0], grid[-1], grid[:, 0], grid[:, -1]])
    grown = middle + (rim - middle) * (1 + 2.2 / (min(grid.shape[:2]) - 1))
    hull = cv2.convexHull(np.rint(grown).astype(np.int32))
    return np.asarray(
        cv2.fillPoly(gray.copy(), [np.asarray(hull)], float(np.median(gray))), dtype=np.uint8
    )


def _goes_on(gray: UInt8, grid: Array) -> bool:
    """Return whether a further line of corners follows on any side."""
    for turn in range(4):
        turned = np.rot90(grid, turn)
        beyond = 2 * turned[0] - turned[1]
        if _line_share(gray, np.concatenate([beyond[None], turned])) > LINE_SHARE:
            return True
    return False


def _line_share(gray: UInt8, grid: Array) -> float:
    """Return the share of the first row (c, 2) of a grid that is corners of a chessboard."""
    arms = grid_arms(grid)[0]
    dark = np.arange(len(arms)) % 2 == 0
    return max(float(refine_saddles(gray, grid[0], arms, d).good.mean()) for d in (dark, ~dark))


def _without_clutter(gray: UInt8, grid: Array) -> Array:
    """Return the grid without outer lines that are no corners, such as the paper's edge."""
    for turn in range(4):
        turned = np.rot90(grid, turn)
        while len(turned) > min(MIN_PART) and _line_share(gray, turned) < LINE_SHARE:
            turned = turned[1:]
        grid = np.rot90(turned, -turn)
    return grid


def number_corners(gray: UInt8, grid: Array) -> tuple[Array, bool]:
    """Return the corners (rows, columns, 2) numbered, and whether the first square is dark.

    The first square is the one between the first corner's +x and +y.
    Of the numberings that keep the shape, those are left out that are mirrored, then those that
    begin at a white square, if one begins at a black one; then x goes along the image's x.
    """
    choices: list[tuple[bool, float, Array]] = []
    for turned in _same_shape(grid):
        x, y = turned[0, -1] - turned[0, 0], turned[-1, 0] - turned[0, 0]
        if x[0] * y[1] - x[1] * y[0] <= 0:
            continue
        choices.append((_first_is_dark(gray, turned), float(x[0] / np.linalg.norm(x)), turned))
    dark, _, best = max(choices, key=lambda choice: choice[:2])
    return best, dark


def _same_shape(grid: Array) -> list[Array]:
    """Return the numberings of a grid (r, c, 2) with as many rows and columns."""
    turns = [np.rot90(g, k) for g in (grid, grid[:, ::-1]) for k in range(4)]
    return [g for g in turns if g.shape == grid.shape]


def _first_is_dark(gray: UInt8, grid: Array) -> bool:
    """Return whether the squares of the first one's colour are the dark ones."""
    middle = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    level = bilinear(gray.astype(np.float64), middle)
    r, c = np.indices(level.shape)
    even = (r + c) % 2 == 0
    # Neighbours are compared, because light may fall off across the board.
    down = np.diff(level, axis=0) * np.where(even[:-1], 1, -1)
    right = np.diff(level, axis=1) * np.where(even[:, :-1], 1, -1)
    return bool(np.concatenate([down.ravel(), right.ravel()]).mean() > 0)
