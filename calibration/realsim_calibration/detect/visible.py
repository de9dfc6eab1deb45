"""What does a picture show, whatever the board file says? For messages where nothing was found.

Pictures that another program has drawn on: corners, axes, text over the target.
"""

from itertools import product

import numpy as np

from realsim.arrays import Array, Int64, Mask, UInt8
from realsim.records import CharucoBoard
from realsim_calibration.detect.charuco import markers_on_board
from realsim_calibration.detect.chessboard import largest_chessboard
from realsim_calibration.detect.ellipses import find_blobs
from realsim_calibration.detect.homography import AGREEING_SHARE
from realsim_calibration.detect.images import gray_image
from realsim_calibration.detect.lattice import grow_lattices, unimodular
from realsim_calibration.detect.markers import decode_markers
from realsim_calibration.detect.saddles import grid_arms, refine_saddles
from realsim_calibration.targets.marker_sets import dictionary_names, dictionary_size

SEARCH_PX = 1600
"""Larger pictures are halved until they fit: a diagnosis need not see the smallest marker."""
LARGEST = (
    "DICT_APRILTAG_36h11", "DICT_6X6_250", "DICT_5X5_250", "DICT_4X4_250", "DICT_7X7_250",
    "DICT_ARUCO_ORIGINAL", "DICT_ARUCO_MIP_36h12", "DICT_APRILTAG_25h9", "DICT_APRILTAG_36h10",
    "DICT_APRILTAG_16h5",
)  # fmt: skip
"""Dictionaries that hold all smaller ones, the commonest first; of a thousand the
first 250 codes will do, because every code costs time."""
MIN_MARKERS = {"DICT_4X4_250": 4, "DICT_APRILTAG_16h5": 4, "DICT_ARUCO_ORIGINAL": 4}
"""Markers from which a dictionary is believed where clutter decodes by chance."""
USUAL_MIN_MARKERS = 2
MIN_SADDLES = 0.8
"""Share of a chessboard's corners that must be measurable: noise makes false ones."""
MIN_FILLED = 0.6
"""Share of a lattice's bounding box that must hold dots: specks of noise grow ragged lattices."""
MIN_DOTS = 16
"""Least lattice of dots that is told of: a row of screws is no target."""
SIZE_SPREAD = 0.35
"""Median departure of dots' radii from their median: a target's dots are of one size."""

DARK = 40
"""A picture is too dark where 99 % of it is below this level of 255: a tenth of its range and
less is left to tell black from white."""
USUAL_MARKER = 0.7
"""Edge of a ChArUco board's markers, in squares: 0.6 to 0.85 are in use."""
LEAST_SQUARES, MOST_SQUARES = 3, 40
"""Squares along the edges of ChArUco boards."""


def dark_reason(image: UInt8) -> str:
    """Return what to say of a picture that is too dark; empty where it is bright enough.

    Raises:
        InputError: the image is not 8 bit.
    """
    gray = gray_image(image)
    if np.percentile(gray, 99) >= DARK:
        return ""
    return (
        f"the picture is too dark, under-exposed ({_exposure(gray)}). Expose longer, raise the "
        "gain, or light the target until its white parts are at 150 to 230"
    )


def what_is_visible(image: UInt8) -> str:
    """Return what an image shows of any kind of target, as a clause: "17 markers of DICT_6X6_100".

    All dictionaries are tried, plain and mirrored, then chessboards, then grids of dots: about a
    second. "nothing that looks like a target" where there is none.

    Raises:
        InputError: the image is not 8 bit.
    """
    gray = _halved(gray_image(image))
    seen, side = _markers(gray)
    board = _chessboard(gray, side)
    dots, count = _dots(gray)
    if not seen:
        mirrored, _ = _markers(np.ascontiguousarray(gray[:, ::-1]))
        if mirrored:
            return f"{mirrored}, but MIRRORED: flip the picture left to right"
    if board is not None and 2 * board.shape[0] * board.shape[1] > count:
        r, c = board.shape[:2]
        text = f"a chessboard with {max(r, c)}x{min(r, c)} inner corners"
        return f"{text} and {seen} (a ChArUco board?)" if seen else text
    if seen or dots:
        return seen or dots
    return f"nothing that looks like a target ({_exposure(gray)})"


def _halved(gray: UInt8) -> UInt8:
    """Return the picture at a size that is searched quickly."""
    import cv2

    while max(gray.shape) > SEARCH_PX:
        half = cv2.resize(gray, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        gray = np.asarray(half, dtype=np.uint8)
    return gray


def _chessboard(gray: UInt8, marker_px: float) -> Array | None:
    """Return the corners (r, c, 2) of a real chessboard with squares larger than the markers."""
    grid = largest_chessboard(gray, SEARCH_PX)
    if grid is None:
        return None
    arms = grid_arms(grid)
    if np.median(np.linalg.norm(arms, axis=-1)) < marker_px:
        return None
    even = np.indices(grid.shape[:2]).sum(0).ravel() % 2 == 0
    share = max(
        float(refine_saddles(gray, grid.reshape(-1, 2), arms.reshape(-1, 4, 2), d).good.mean())
        for d in (even, ~even)
    )
    return grid if share >= MIN_SADDLES else None


def _markers(gray: UInt8) -> tuple[str, float]:
    """Return the markers of the dictionary that explains most, and their median side [px]."""
    best: tuple[int, str, Int64, Array] | None = None
    for name in LARGEST:
        ids, quads = decode_markers(gray, name)
        different = len(np.unique(ids))
        if different < MIN_MARKERS.get(name, USUAL_MIN_MARKERS):
            continue
        if best is None or different > best[0]:
            best = (different, name, ids, quads)
    if best is None:
        return "", 0.0
    different, name, ids, quads = best
    side = np.linalg.norm(quads - np.roll(quads, 1, axis=1), axis=-1)
    double = len(ids) - different
    more = f" ({double} of them more than once: two boards?)" if double else _layout(*best[1:])
    name = _smallest(name, int(ids.max()))
    text = f"{different} markers of {name}, ids {ids.min()} to {ids.max()}{more}"
    return text, float(np.median(side))


def _layout(dictionary: str, ids: Int64, quads: Array) -> str:
    """Return the ChArUco board whose last markers these may be, as a clause; empty where none."""
    squares = range(LEAST_SQUARES, MOST_SQUARES)
    for rows, columns, legacy in product(squares, squares, (False, True)):
        if rows * columns // 2 != ids.max() + 1:
            continue
        board = CharucoBoard(rows=rows, columns=columns, square_m=1.0, marker_m=USUAL_MARKER,
                             dictionary=dictionary, legacy=legacy)  # fmt: skip
        lie = markers_on_board(ids, quads, board)[0]
        if lie.sum() >= AGREEING_SHARE * len(ids):
            return f", which lie as on charuco:{columns}x{rows}{',legacy' * legacy}"
    return ""


def _smallest(name: str, most: int) -> str:
    """Return the smallest dictionary that holds an id; a larger one begins with the same codes."""
    if not name.endswith("_250"):
        return name
    stem = name[: -len("250")]
    sizes = sorted((dictionary_size(n), n) for n in dictionary_names() if n.startswith(stem))
    return next(n for size, n in sizes if most < size) + " (or larger)"


def _dots(gray: UInt8) -> tuple[str, int]:
    """Return the grid of dots in words, '' where there is none, and how many there are."""
    best: dict[tuple[int, int], int] = {}
    for shade in (gray, 255 - gray):
        middles, axes = find_blobs(np.asarray(shade, dtype=np.uint8))
        for lattice in grow_lattices(middles, np.abs(np.linalg.det(axes))):
            radius = np.sqrt(np.abs(np.linalg.det(axes[list(lattice.values())])))
            if np.median(np.abs(radius / np.median(radius) - 1)) <= SIZE_SPREAD:
                best = max(best, lattice, key=len)
    if len(best) < MIN_DOTS:
        return "", 0
    nodes = np.array(list(best))
    # The basis in which the lattice fills its bounding box best is the board's own.
    extents = [np.ptp(nodes @ M.T, axis=0) + 1 for M in unimodular()]
    w, h = min(extents, key=lambda e: int(e.prod()))
    if len(nodes) >= 0.9 * w * h:
        return f"a grid of {max(w, h)}x{min(w, h)} dots", len(nodes)
    diagonal = np.array([[1, -1], [1, 1]])
    rows = min((np.ptp(nodes @ (diagonal @ M).T, axis=0) + 1 for M in unimodular()),
               key=lambda e: int(e.prod()))  # fmt: skip
    if len(nodes) >= 0.45 * rows.prod():
        return f"an asymmetric grid of {len(nodes)} dots", len(nodes)
    if len(nodes) < MIN_FILLED * w * h:
        return "", 0
    return f"a grid of at least {len(nodes)} dots, not all of it", len(nodes)


def _exposure(gray: UInt8) -> str:
    """Return how bright the picture is: most failures are too dark, too bright or out of focus."""
    low, high = np.percentile(gray, [1, 99])
    return f"gray levels {low:.0f} to {high:.0f} of 255"


CHROMA = 120
"""Difference of the largest and the smallest channel from which a pixel is coloured."""
NEUTRAL = 80
"""Chroma up to which a pixel shows the target itself, tinted by the lamp or the camera."""
AROUND_PX = 7
"""Width of the square about a pixel in which the target's own shades are looked for."""
BEYOND = 50
"""Levels by which a drawn pixel's channel lies outside of the shades around it. The soft edges of
a lens with colour fringes lie between dark and bright in every channel, however blue they are.
NEUTRAL and BEYOND were chosen on two real sets and three rendered boards, untouched and
with corners and axes drawn, before and after JPEG."""
GREEN = 60
"""Levels by which green exceeds red and blue where it was drawn: a lens bends green less than blue
and more than red, so that it never stands out alone."""
DRAWN_SHARE = (0.003, 0.35)
"""Share of drawn pixels within the target: below is noise, beyond the print is coloured."""
DRAWN = "coloured lines or dots are drawn over the target"
"""How a reason begins that says so."""


MIN_HULL = 4
"""Fewer points do not say where in the picture the target is."""
PURE, PURE_SHARE = 200, 0.002
"""Chroma of colours as programs draw them, and the share of a picture from which they are named
where no target is found. Chosen on three real sets: untouched 0.01 %, every point of a board
covered by a disc 0.7 % and more."""
COVERED = "pure colours cover"
"""How a reason begins that says so."""


def drawing_reason(image: UInt8, uv: Array) -> str:
    """Return what to say of a picture with drawings on its target; empty where there are none.

    Args:
        image: (H, W, 3) RGB, or (H, W) gray, in which nothing can be told.
        uv: (n, 2) the target's points [px]; of fewer than four the whole picture is judged.
    """
    import cv2

    if image.ndim != 3:
        return ""
    if len(uv) < MIN_HULL:
        share = float((np.ptp(image.astype(np.int16), axis=-1) > PURE).mean())
        if share <= PURE_SHARE:
            return ""
        return (
            f"{COVERED} {100 * share:.1f} % of the picture, as programs draw them: are lines or "
            "dots drawn over the target? Use the pictures as the camera gave them"
        )
    hull = cv2.convexHull(np.rint(uv).astype(np.int32))
    u, v, w, h = cv2.boundingRect(hull)
    inside = np.zeros((h, w), np.uint8)
    cv2.fillConvexPoly(inside, np.asarray(hull) - [u, v], 1)
    part = image[v : v + h, u : u + w]
    inside = inside[: part.shape[0], : part.shape[1]]
    share = float((_drawn(part) & (inside > 0)).sum() / max(int(inside.sum()), 1))
    if not DRAWN_SHARE[0] < share < DRAWN_SHARE[1]:
        return ""
    return (
        f"{DRAWN} ({100 * share:.1f} % of it): corners below them are off. Use the "
        "pictures as the camera gave them"
    )


def _drawn(part: UInt8) -> Mask:
    """Return (H, W) which pixels are coloured as nothing of the target around them can be."""
    import cv2

    levels = part.astype(np.int16)
    chroma = np.ptp(levels, axis=-1)
    box = np.ones((AROUND_PX, AROUND_PX), np.uint8)
    own = chroma <= NEUTRAL
    low = cv2.erode(np.where(own[..., None], part, 255).astype(np.uint8), box).astype(np.int16)
    high = cv2.dilate(np.where(own[..., None], part, 0).astype(np.uint8), box).astype(np.int16)
    known = cv2.dilate(own.astype(np.uint8), box) > 0
    beyond = np.maximum(low - levels, levels - high).max(axis=-1)
    green = levels[..., 1] - np.maximum(levels[..., 0], levels[..., 2]) > GREEN
    return np.asarray((chroma > CHROMA) & (known & (beyond > BEYOND) | green))
