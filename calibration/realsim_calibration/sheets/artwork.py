"""What is black on a target: modules on a grid of exact lines, and dots.

Every target but a circle grid is a grid of rectangles, black or white, between lines that need not
be evenly spaced. From this one form come the vector outlines of the sheet, where neighbouring black
modules are one area without a seam, and the pictures, where each pixel is its exact share of white.
"""

from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Array32, Mask, UInt8
from realsim.errors import InputError
from realsim.records import TAG_CELLS, CharucoBoard, Chessboard, CircleGrid, TagBoard, Target
from realsim_calibration.targets import marker_sets

DOT_SHARE = 0.5
"""Diameter of a dot as a share of the distance to its nearest neighbour: large for accurate
centres, and as much white as black between them, so that they stay apart under blur and tilt."""
LARGE_DOT_SHARE = 0.75
"""The same for the larger first dot: half as large again is told apart at every tilt in use."""
MOST_PIXELS = 200_000_000
"""Largest picture [px]: beyond it the resolution was mistyped."""
DOT_ROWS = 32
"""Sub-rows per pixel by which a dot's edge is integrated; the error stays below 1/1000 pixel."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Artwork:
    """The black parts of a target in its board frame [m]."""

    x_m: Array
    """(nx + 1,) lines across x, ascending."""
    y_m: Array
    """(ny + 1,) lines across y, ascending."""
    black: Mask
    """(ny, nx) whether the rectangle between the lines is black."""
    dots: Array
    """(n, 3) x, y and radius of the dots."""

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """Least x and y, largest x and y of what is black."""
        if len(self.dots):
            centres, radii = self.dots[:, :2], self.dots[:, 2:]
            low, high = (centres - radii).min(axis=0), (centres + radii).max(axis=0)
        else:
            low, high = (np.array([self.x_m[k], self.y_m[k]]) for k in (0, -1))
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def artwork_of(target: Target) -> Artwork:
    """Return what is black on a target.

    Raises:
        InputError: its markers do not exist.
    """
    marker_sets.check_markers(target)
    if isinstance(target, TagBoard):
        return _tag_board(target)
    if isinstance(target, CharucoBoard):
        return _charuco(target)
    if isinstance(target, Chessboard):
        return _chessboard(target)
    return _circles(target)


def quiet_zone_m(target: Target) -> float:
    """Return the white border that the target needs at least, beyond what is black [m].

    Tags need one module by the definition of their families; square fields a fifth of a field, so
    that their outline is not taken for part of the surroundings; dots their usual distance.
    """
    if isinstance(target, TagBoard):
        return target.tag_size_m / TAG_CELLS[target.family]
    if isinstance(target, CircleGrid):
        return nearest_dots_m(target) * (1 - DOT_SHARE)
    return target.square_m / 5


def nearest_dots_m(target: CircleGrid) -> float:
    """Return the distance of neighbouring dots [m]."""
    return target.pitch_m * (np.sqrt(2.0) if target.asymmetric else 1.0)


def dot_diameters_m(target: CircleGrid) -> tuple[float, float]:
    """Return the diameters of a dot and of the first dot as printed [m]."""
    near = nearest_dots_m(target)
    first = LARGE_DOT_SHARE if target.large_origin else DOT_SHARE
    return near * DOT_SHARE, near * first


def _tag_lines(count: int, size: float, gap: float, cells: int, outer: bool) -> Array:
    """Return the lines across one direction of a tag board [m]."""
    starts = np.arange(count)[:, None] * (size + gap)
    lines = (starts + np.arange(cells + 1) / cells * size).ravel()
    return np.concatenate([[-gap], lines, [lines[-1] + gap]]) if outer else lines


def _tag_board(board: TagBoard) -> Artwork:
    """Return the modules of a tag board; the gaps are columns and rows of the grid too."""
    cells, outer = TAG_CELLS[board.family], int(board.corner_squares)
    size = (board.tag_size_m, board.gap_m, cells, board.corner_squares)
    x, y = _tag_lines(board.columns, *size), _tag_lines(board.rows, *size)
    black = np.zeros((len(y) - 1, len(x) - 1), dtype=bool)
    for k, tag_id in enumerate(board.ids):
        row, column = divmod(k, board.columns)
        r, c = outer + row * (cells + 1), outer + column * (cells + 1)
        modules = marker_sets.marker_modules(marker_sets.tag_dictionary(board.family), int(tag_id))
        black[r : r + cells, c : c + cells] = modules
    if outer:
        black[:: cells + 1, :: cells + 1] = True
    return Artwork(x_m=x, y_m=y, black=black, dots=np.zeros((0, 3)))


def _field_lines(count: int, square: float, within: Array) -> Array:
    """Return the lines across one direction of fields that are all divided alike [m]."""
    lines = np.arange(count, dtype=np.float64)[:, None] * square + within
    return np.append(lines.ravel(), count * square)


def _charuco(board: CharucoBoard) -> Artwork:
    """Return the fields and markers of a ChArUco board, placed by OpenCV's own board."""
    from cv2 import aruco

    dictionary = marker_sets.load_dictionary(board.dictionary)
    size = (board.columns, board.rows)
    layout = aruco.CharucoBoard(size, board.square_m, board.marker_m, dictionary)
    layout.setLegacyPattern(board.legacy)
    cells = int(dictionary.markerSize) + 2
    border = (board.square_m - board.marker_m) / 2
    within = np.concatenate([[0.0], border + np.arange(cells + 1) / cells * board.marker_m])
    x, y = (_field_lines(n, board.square_m, within) for n in size)
    per = cells + 2
    black = np.ones((board.rows * per, board.columns * per), dtype=bool)
    for marker_id, corners in zip(np.ravel(layout.getIds()), layout.getObjPoints(), strict=True):
        column, row = np.floor(np.mean(corners, axis=0)[:2] / board.square_m).astype(int)
        field = black[row * per : (row + 1) * per, column * per : (column + 1) * per]
        field[:] = False
        field[1:-1, 1:-1] = marker_sets.marker_modules(board.dictionary, int(marker_id))
    return Artwork(x_m=x, y_m=y, black=black, dots=np.zeros((0, 3)))


def _chessboard(board: Chessboard) -> Artwork:
    """Return the fields of a chessboard; the one at the top left is black."""
    x = np.arange(-1.0, board.columns + 1) * board.square_m
    y = np.arange(-1.0, board.rows + 1) * board.square_m
    black = np.add.outer(np.arange(board.rows + 1), np.arange(board.columns + 1)) % 2 == 0
    return Artwork(x_m=x, y_m=y, black=black, dots=np.zeros((0, 3)))


def _circles(grid: CircleGrid) -> Artwork:
    """Return the dots of a circle grid."""
    usual, first = dot_diameters_m(grid)
    dots = grid.points_board.copy()
    dots[:, 2] = usual / 2
    dots[0, 2] = first / 2
    nothing = np.zeros((0, 0), dtype=bool)
    return Artwork(x_m=np.zeros(1), y_m=np.zeros(1), black=nothing, dots=dots)


# --- outlines ---------------------------------------------------------------------------------


def outlines(artwork: Artwork) -> list[Array]:
    """Return the closed outlines (k, 2) [m] of the black rectangles, merged where they touch.

    An outline keeps black on its right (y runs down), so that the outer ones run clockwise and
    holes the other way. Where black fields meet in a corner only, each keeps its own outline.
    """
    black = np.pad(artwork.black, 1)
    steps: dict[tuple[int, int], list[tuple[int, int]]] = {}
    sides = (
        (black[1:-1, 1:-1] & ~black[:-2, 1:-1], (0, 0), (0, 1)),
        (black[1:-1, 1:-1] & ~black[1:-1, 2:], (0, 1), (1, 0)),
        (black[1:-1, 1:-1] & ~black[2:, 1:-1], (1, 1), (0, -1)),
        (black[1:-1, 1:-1] & ~black[1:-1, :-2], (1, 0), (-1, 0)),
    )
    for where, offset, step in sides:
        for r, c in np.argwhere(where):
            steps.setdefault((int(r) + offset[0], int(c) + offset[1]), []).append(step)
    loops: list[Array] = []
    while steps:
        corners = np.array(_walk(steps))
        loops.append(np.stack([artwork.x_m[corners[:, 1]], artwork.y_m[corners[:, 0]]], -1))
    return loops


def _walk(steps: dict[tuple[int, int], list[tuple[int, int]]]) -> list[tuple[int, int]]:
    """Take one closed outline out of the steps; return the (row, column) lines of its corners."""
    start = at = next(iter(steps))
    step = steps[at][0]
    first = step
    corners: list[tuple[int, int]] = []
    while True:
        choices = steps[at]
        right = (step[1], -step[0])
        following = right if right in choices else (step if step in choices else choices[0])
        choices.remove(following)
        if not choices:
            del steps[at]
        if following != step:
            corners.append(at)
        step = following
        at = (at[0] + step[0], at[1] + step[1])
        if at == start:
            break
    # The start is a corner unless the outline arrives there going straight on.
    return [start, *corners] if step != first else corners


# --- pictures ---------------------------------------------------------------------------------


def _shares(lines: Array, origin: float, px_per_m: float, pixels: int) -> Array:
    """Return (pixels, intervals) the share of each pixel that each interval covers."""
    edges = (lines - origin) * px_per_m
    nearest = np.round(edges)
    # A line that is meant to lie on a pixel border lies on it, in spite of rounding.
    edges = np.where(np.abs(edges - nearest) < 1e-6, nearest, edges)
    below = np.clip(edges[None, :] - np.arange(pixels)[:, None], 0.0, 1.0)
    return np.diff(below, axis=1)


def black_share(
    artwork: Artwork, px_per_m: float, corner_m: tuple[float, float], size: tuple[int, int]
) -> Array32:
    """Return (H, W) the share of each pixel that is black, integrated exactly.

    Args:
        artwork: what is black.
        px_per_m: pixels per metre.
        corner_m: the outer corner of the first pixel in the board frame [m].
        size: width and height [px].
    """
    width, height = size
    across = _shares(artwork.x_m, corner_m[0], px_per_m, width).astype(np.float32)
    down = _shares(artwork.y_m, corner_m[1], px_per_m, height).astype(np.float32)
    black = artwork.black.astype(np.float32)
    share: Array32 = np.asarray(down @ black @ across.T, dtype=np.float32)
    for x, y, radius in artwork.dots:
        u, v = (x - corner_m[0]) * px_per_m, (y - corner_m[1]) * px_per_m
        _add_dot(share, u, v, radius * px_per_m)
    return np.clip(share, np.float32(0), np.float32(1))


def _add_dot(share: Array32, u: float, v: float, radius: float) -> None:
    """Add one dot's share; each of its sub-rows is a chord, whose ends are exact."""
    height, width = share.shape
    top, bottom = max(0, int(v - radius)), min(height, int(np.ceil(v + radius)) + 1)
    left, right = max(0, int(u - radius)), min(width, int(np.ceil(u + radius)) + 1)
    if top >= bottom or left >= right:
        return
    y = top + (np.arange((bottom - top) * DOT_ROWS) + 0.5) / DOT_ROWS
    half = np.sqrt(np.clip(radius**2 - (y - v) ** 2, 0.0, None))
    pixels = np.arange(left, right)[None, :]
    ends = np.clip((u + half)[:, None] - pixels, 0, 1) - np.clip((u - half)[:, None] - pixels, 0, 1)
    rows = ends.reshape(bottom - top, DOT_ROWS, right - left).mean(axis=1)
    share[top:bottom, left:right] += rows.astype(np.float32)


def target_image(
    target: Target, px_per_m: float, margin_m: float
) -> tuple[UInt8, tuple[float, float]]:
    """Return a picture of the printed target, and where its board frame's origin is.

    Each pixel is the exact share of white of its area. With a whole number of pixels per module and
    in the margin, every edge lies on a pixel border and the picture is black and white only.

    Args:
        target: any target.
        px_per_m: pixels per metre.
        margin_m: white around what is black [m].

    Returns:
        (H, W) picture, 0 = black, 255 = white; and the origin of the board frame (u, v) [px], where
        integer pixels are pixel centres: a point at (x, y) [m] is at origin + px_per_m * (x, y).

    Raises:
        InputError: the resolution or the margin is not positive, or the picture is too large.
    """
    if not (np.isfinite(px_per_m) and px_per_m > 0 and np.isfinite(margin_m) and margin_m >= 0):
        raise InputError(
            f"a target's picture needs a resolution and a margin, got {px_per_m} pixels per metre "
            f"and {margin_m} m; the first must be positive, the second not negative."
        )
    artwork = artwork_of(target)
    x0, y0, x1, y1 = artwork.bounds_m
    corner = (x0 - margin_m, y0 - margin_m)
    extent = (x1 + margin_m - corner[0], y1 + margin_m - corner[1])
    width, height = (int(np.ceil(v * px_per_m - 1e-6)) for v in extent)
    if width * height > MOST_PIXELS:
        raise InputError(
            f"the target's picture would have {width} x {height} pixels; at most "
            f"{MOST_PIXELS // 10**6} million are accepted. Lower {px_per_m:g} pixels per metre."
        )
    share = black_share(artwork, px_per_m, corner, (width, height))
    picture = np.rint(255.0 * (1.0 - share)).astype(np.uint8)
    return picture, (-corner[0] * px_per_m - 0.5, -corner[1] * px_per_m - 0.5)
