"""A calibration board as a textured mesh, its tag corners exactly on texel borders."""

from typing import Any

import numpy as np

from realsim.arrays import Array, UInt8
from realsim.errors import InputError
from realsim.records import Mesh, TagBoard

TAG_MODULES = 8
"""Width of a 36h11 tag in modules: 6 bits and the black border on both sides."""
FAMILY_SIZE = 587
"""Number of tags in the 36h11 family."""


def tag_pattern(tag_id: int) -> UInt8:
    """Return the (8, 8) modules of a 36h11 tag, 0 = black, 255 = white, first row at the top.

    Raises:
        InputError: the family has no such tag.
    """
    import cv2

    if not 0 <= tag_id < FAMILY_SIZE:
        raise InputError(f"tag {tag_id} is not in the 36h11 family; its ids are 0 to 586.")
    aruco: Any = cv2.aruco
    dictionary = aruco.getPredefinedDictionary(aruco.DICT_APRILTAG_36h11)
    return np.asarray(aruco.generateImageMarker(dictionary, tag_id, TAG_MODULES), np.uint8)


def board_mesh(board: TagBoard, margin_m: float = 0.02, px_per_m: float = 5000.0) -> Mesh:
    """Return the printed board in frame `board`: x right, y down, z into the paper.

    The printed side is the one that faces -z. The sheet is cut along the tags' edges into a grid
    of rectangles whose texture coordinates are piecewise linear: every tag has a whole number of
    texels per module, whatever its size and the gap, so its corners are texel borders.

    Args:
        board: the board.
        margin_m: white paper around the outermost tags [m].
        px_per_m: texels per metre, at least; four per module are the least.

    Raises:
        InputError: the margin or the resolution is not positive.
    """
    if margin_m <= 0 or px_per_m <= 0:
        raise InputError(
            f"a board needs a white margin and a resolution, got {margin_m} m and {px_per_m} "
            "texels per metre; both must be positive."
        )
    module_m = board.tag_size_m / TAG_MODULES
    per_module = max(4, int(np.ceil(module_m * px_per_m)))
    texels_per_m = per_module / module_m
    tag_px = TAG_MODULES * per_module
    gap_px = max(1, round(board.gap_m * texels_per_m))
    margin_px = max(1, round(margin_m * texels_per_m))
    x_m, x_px = _grid_lines(board.columns, (board.tag_size_m, board.gap_m, margin_m),
                            (tag_px, gap_px, margin_px))  # fmt: skip
    y_m, y_px = _grid_lines(board.rows, (board.tag_size_m, board.gap_m, margin_m),
                            (tag_px, gap_px, margin_px))  # fmt: skip

    texture = np.full((int(y_px[-1]), int(x_px[-1])), 255, np.uint8)
    for k, tag_id in enumerate(board.ids):
        row, column = divmod(k, board.columns)
        y, x = int(y_px[1 + 2 * row]), int(x_px[1 + 2 * column])
        bits = np.kron(tag_pattern(int(tag_id)), np.ones((per_module, per_module), np.uint8))
        texture[y : y + tag_px, x : x + tag_px] = bits

    xx, yy = np.meshgrid(x_m, y_m)
    u, v = np.meshgrid(x_px / x_px[-1], 1.0 - y_px / y_px[-1])
    ny, nx = xx.shape
    top_left = (np.arange(ny - 1)[:, None] * nx + np.arange(nx - 1)).ravel()
    a, b, c, d = top_left, top_left + 1, top_left + nx + 1, top_left + nx
    # Counter-clockwise seen from -z, where y runs down.
    faces = np.concatenate([np.stack([a, d, c], -1), np.stack([a, c, b], -1)])
    return Mesh(
        vertices=np.stack([xx.ravel(), yy.ravel(), np.zeros(xx.size)], -1),
        faces=faces.astype(np.int32),
        uv=np.stack([u.ravel(), v.ravel()], -1),
        texture=np.repeat(texture[..., None], 3, axis=-1),
    )


def _grid_lines(
    tags: int, sizes_m: tuple[float, float, float], sizes_px: tuple[int, int, int]
) -> tuple[Array, Array]:
    """Return the cuts along one side, in metres from the first tag and in texels from the edge.

    Args:
        tags: number of tags along this side.
        sizes_m: tag, gap and margin [m].
        sizes_px: tag, gap and margin in texels.
    """
    lines: list[Array] = []
    for tag, gap, margin in (sizes_m, sizes_px):
        steps = [margin, *([tag, gap] * tags)[:-1], margin]
        lines.append(np.concatenate([[0.0], np.cumsum(steps, dtype=np.float64)]))
    return lines[0] - sizes_m[2], lines[1]
