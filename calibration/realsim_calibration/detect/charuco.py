"""Find the inner corners of a ChArUco board: markers say which, the saddles say where."""

from dataclasses import replace

import numpy as np

from realsim.arrays import Array, Int64, Mask, UInt8
from realsim.records import CameraIntrinsics
from realsim.records.targets import CharucoBoard
from realsim_calibration.detect.homography import (
    agreeing,
    apply_homography,
    fit_homography,
    fit_layout,
)
from realsim_calibration.detect.images import gray_image, no_points, size_of
from realsim_calibration.detect.markers import TWO_BOARDS, decode_markers, several_boards
from realsim_calibration.detect.saddles import OUTSIDE, Saddles, refine_saddles
from realsim_calibration.views import TargetDetection

REASONS_TOLD = 6
"""Corners named one by one in `rejected`; the rest is counted."""
LAYOUT_SHARE = 0.5
"""Furthest that a marker's corner may lie from where the others put it, in marker sides."""
MIN_MARKERS = 2
"""Least number of markers that agree: one alone may be chance."""
NEAR_MARKERS = 6
"""A corner is expected where the map of so many nearest markers puts it: few, so that the
lens does not bend the map."""
NEAR_CORNERS = 8
"""A corner without a readable marker is expected where so many found ones put it."""
MIN_POINTS = 4
"""Fewer corners give no pose."""


def charuco_markers(board: CharucoBoard) -> Array:
    """Return the markers' corners (n, 4, 2) by id [m], clockwise from the top left."""
    r, c = np.divmod(np.arange(board.rows * board.columns), board.columns)
    white = (r + c) % 2 == white_parity(board)
    inset = (board.square_m - board.marker_m) / 2
    origin = np.stack([c, r], -1)[white] * board.square_m + inset
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float64)
    return origin[:, None] + square * board.marker_m


def white_parity(board: CharucoBoard) -> int:
    """Return (row + column) % 2 of the white squares: 0 in the old pattern with even rows."""
    return 0 if board.legacy and board.rows % 2 == 0 else 1


def find_charuco(
    rgb: UInt8, board: CharucoBoard, *, intrinsics: CameraIntrinsics | None = None
) -> TargetDetection:
    """Return the inner corners of a ChArUco board that are seen next to a decoded marker.

    Raises:
        InputError: the image is not 8 bit, or the dictionary is not known.
    """
    gray = gray_image(rgb)
    ids, quads = decode_markers(gray, board.dictionary)
    good, quads, rejected = markers_on_board(ids, quads, board)
    ids, quads = ids[good], quads[good]
    if not len(ids):
        return no_points(gray, *rejected)
    point_ids, start, arms = _expected(ids, quads, board)
    uv, sd = np.full((2, len(board.points_board), 2), np.nan)
    tried: dict[int, str] = {}
    # What was found says where corners without a readable marker must be, and so on outwards.
    while len(point_ids):
        found = _refined(gray, (point_ids, start, arms), board, intrinsics)
        tried |= dict(zip(point_ids.tolist(), found.faults, strict=True))
        uv[point_ids[found.good]] = found.uv[found.good]
        sd[point_ids[found.good], 0] = found.sd_px[found.good]
        point_ids, start, arms = _beside(uv, tried, board)
    rejected += _told({k: fault for k, fault in tried.items() if fault and fault != OUTSIDE})
    good = np.flatnonzero(np.isfinite(uv[:, 0]))
    if len(good) < MIN_POINTS:
        return no_points(gray, *rejected, f"{len(good)} corners are too few")
    return TargetDetection(
        point_ids=good,
        uv=uv[good],
        sd_px=sd[good, 0],
        image_size=size_of(gray),
        rejected=tuple(rejected),
    )


def _refined(
    gray: UInt8,
    expected: tuple[Int64, Array, Array],
    board: CharucoBoard,
    intrinsics: CameraIntrinsics | None,
) -> Saddles:
    """Return expected corners (numbers, places, arms) as they are measured."""
    point_ids, start, arms = expected
    row, column = np.divmod(point_ids, board.columns - 1)
    dark = (row + column) % 2 != white_parity(board)
    clear = (board.square_m - board.marker_m) / 2 / board.square_m
    return refine_saddles(gray, start, arms, dark, clear, intrinsics)


def _told(faults: dict[int, str]) -> list[str]:
    """Return the faults of corners as sentences, the first few one by one."""
    bad = sorted(faults.items())
    told = [f"corner {i}: {f}" for i, f in bad[:REASONS_TOLD]]
    if len(bad) > REASONS_TOLD:
        told.append(f"{len(bad) - REASONS_TOLD} more corners of this kind")
    return told


def markers_on_board(
    ids: Int64, quads: Array, board: CharucoBoard
) -> tuple[Mask, Array, list[str]]:
    """Return which markers (n,) lie on the board, all corners as it counts them, and faults."""
    known = charuco_markers(board)
    values, counts = np.unique(ids, return_counts=True)
    twice = np.isin(ids, values[counts > 1])
    ours = ids < len(known)
    rejected = [f"marker {i}: not on this board" for i in np.unique(ids[~ours])]
    rejected += [f"marker {i}: seen more than once" for i in np.unique(ids[twice & ours])]
    usable = ours & ~twice
    if several_boards(ids[ours]):
        return np.zeros(len(ids), dtype=bool), quads, [TWO_BOARDS, *rejected]
    if usable.sum() < MIN_MARKERS:
        if usable.any():
            rejected.append(f"{int(usable.sum())} marker alone may be chance")
        return np.zeros(len(ids), dtype=bool), quads, rejected
    known = known[ids[usable]]
    fits, roll, better = fit_layout(
        known, quads[usable], LAYOUT_SHARE,
        lambda limit, least: _remedy(ids[usable], quads[usable], board, limit, least),
    )  # fmt: skip
    good = np.zeros(len(ids), dtype=bool)
    good[usable] = fits
    if good.any():
        rejected += [
            f"marker {i}: does not lie where the rest of the board puts it"
            for i in ids[usable & ~good]
        ]
    else:
        better = better or ". Are rows, columns, square and marker size right?"
        rejected.append(
            f"{len(known)} markers were read, but they do not lie as the board file says{better}"
        )
    return good, np.roll(quads, roll, axis=1), rejected


def _remedy(ids: Int64, quads: Array, board: CharucoBoard, limit: float, least: int) -> str:
    """Return how markers do lie, where a usual mistake explains so many; empty where none does."""
    turned = replace(board, rows=board.columns, columns=board.rows)
    candidates = (
        (replace(board, legacy=not board.legacy), f"with legacy={not board.legacy}"),
        (turned, f"with {turned.rows} rows and {turned.columns} columns of squares"),
        (replace(turned, legacy=not board.legacy),
         f"with {turned.rows} rows, {turned.columns} columns and legacy={not board.legacy}"),
    )  # fmt: skip
    for candidate, how in candidates:
        if agreeing(charuco_markers(candidate)[ids], quads, limit).sum() >= least:
            return f"; {how} they would"
    return ""


def _expected(ids: Int64, quads: Array, board: CharucoBoard) -> tuple[Int64, Array, Array]:
    """Return the inner corners next to a marker, where to expect them, and their arms [px]."""
    known = charuco_markers(board)[ids]
    middle = known.mean(1)
    side = board.square_m
    places: list[tuple[int, Array]] = []
    for k, p in enumerate(board.points_board[:, :2]):
        # A marker next to the corner has its middle half a diagonal off; one more square is far.
        distance = np.linalg.norm(middle - p, axis=-1)
        if distance.min() > side:
            continue
        near = np.argsort(distance)[:NEAR_MARKERS]
        near = near[distance[near] < 3 * side]
        places.append((k, fit_homography(known[near].reshape(-1, 2), quads[near].reshape(-1, 2))))
    return _starts(places, board)


def _beside(uv: Array, tried: dict[int, str], board: CharucoBoard) -> tuple[Int64, Array, Array]:
    """Return corners not tried yet beside those found (uv, NaN where not), as `_expected` does."""
    places: list[tuple[int, Array]] = []
    found = np.flatnonzero(np.isfinite(uv[:, 0]))
    known = board.points_board[:, :2]
    for k in np.setdiff1d(np.arange(len(uv)), list(tried)):
        distance = np.linalg.norm(known[found] - known[k], axis=-1) / board.square_m
        near = found[np.argsort(distance)[:NEAR_CORNERS]]
        if len(near) < NEAR_CORNERS or distance.min() > 1.5:
            continue
        # Points on one line say nothing about what lies beside it.
        if np.linalg.matrix_rank(known[near] - known[near].mean(0), tol=0.5 * board.square_m) < 2:
            continue
        places.append((int(k), fit_homography(known[near], uv[near])))
    return _starts(places, board)


def _starts(places: list[tuple[int, Array]], board: CharucoBoard) -> tuple[Int64, Array, Array]:
    """Return numbers (n,), rough corners (n, 2) and arms (n, 4, 2) [px] under maps (3, 3)."""
    step = np.array([[0, 0], [1, 0], [0, 1], [-1, 0], [0, -1]]) * board.square_m
    seen = [apply_homography(H, board.points_board[k, :2] + step) for k, H in places]
    at = np.array(seen).reshape(-1, 5, 2)
    return np.array([k for k, _ in places], np.int64), at[:, 0], at[:, 1:] - at[:, :1]
