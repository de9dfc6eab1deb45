"""Find a target's points in an image, whatever kind of target it is.

Find a whole grid of dots, number it, and measure where the dots' middles are seen.

How blurred is a picture? For messages where a target was not found.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from realsim.arrays import Array, Int64, UInt8
from realsim.errors import InputError
from realsim.records import CameraIntrinsics
from realsim.records.targets import CharucoBoard, Chessboard, CircleGrid, TagBoard, Target
from realsim_calibration.detect.charuco import find_charuco
from realsim_calibration.detect.chessboard import find_chessboard
from realsim_calibration.detect.edges import bend, straighten
from realsim_calibration.detect.ellipses import Dots, find_blobs, outline_bias, refine_dots
from realsim_calibration.detect.homography import apply_homography, fit_homography, seen_from_front
from realsim_calibration.detect.images import gray_image, no_points, size_of
from realsim_calibration.detect.lattice import Laid, Node, grow_lattices, lay_pattern
from realsim_calibration.detect.tags import TagDetections, detect_tags
from realsim_calibration.detect.visible import drawing_reason
from realsim_calibration.views import TargetDetection

LEVELS = 4
"""Halvings at which edges are looked at: blur up to about 16 px is measured."""
AGAIN_PX = 1.5
"""Blur that is added to see how much an edge loses."""
RESOLVED_PX = 1.2
"""From this blur on a level shows the edge itself, not its own pixels."""
STRONG = 0.3
"""Share of the steepest slopes (99.5 %) from which on a slope is an edge."""
MIN_SLOPE = 1.0
"""Least slope of an edge [levels/px]."""
MIN_EDGES = 30
"""Fewer pixels of edges tell nothing."""
BLURRED_PX = 1.5
"""From here on the edges are too soft: markers are lost from about 2 px on."""

BLURRED = "the picture is blurred"
"""How a reason begins that says so."""


def edge_blur_px(gray: UInt8) -> float:
    """Return the median blur of a picture's edges as one sigma [px]; NaN where it has none.

    An edge of blur s loses slope by sqrt(1 + a^2 / s^2) when blurred by a more (Zhuo and Sim,
    "Defocus map estimation from a single image", 2011). Coarse levels come first: there noise is
    small and a wide edge is narrow.
    """
    import cv2

    found = float("nan")
    for level in reversed(range(LEVELS)):
        size = (gray.shape[1] >> level, gray.shape[0] >> level)
        if min(size) < 16:
            continue
        small = np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), np.float32)
        slope = _slope(small)
        edge = slope > max(STRONG * float(np.percentile(slope, 99.5)), MIN_SLOPE)
        edge &= slope >= cv2.dilate(slope, np.ones((3, 3), np.uint8))
        if np.count_nonzero(edge) < MIN_EDGES:
            continue
        again = _slope(cv2.GaussianBlur(small, (0, 0), AGAIN_PX))
        loss = float(np.median(slope[edge] / np.maximum(again[edge], 1e-6)))
        blur = AGAIN_PX / float(np.sqrt(max(loss**2 - 1, 1e-3)))
        found = blur * 2**level
        if blur > RESOLVED_PX:
            break
    return found


def _slope(image: Any) -> Any:
    """Return the steepness of an image [levels/px]."""
    import cv2

    return cv2.magnitude(
        cv2.Sobel(image, cv2.CV_32F, 1, 0, scale=1 / 8),
        cv2.Sobel(image, cv2.CV_32F, 0, 1, scale=1 / 8),
    )


def blur_reason(gray: UInt8) -> str:
    """Return what to say of a picture that is blurred; empty where it is sharp."""
    blur = edge_blur_px(gray)
    if not blur > BLURRED_PX:
        return ""
    return (
        f"{BLURRED}: its edges spread over {blur:.1f} px (1 sigma, at most "
        f"{BLURRED_PX:g}). Let the arm rest before the picture is taken, focus, expose shorter"
    )


BIAS_ROUNDS = 2
"""Map, bias, map without bias: the second bias differs from the third by 1e-4 px."""
MIN_CUBIC = 30
"""Dots from which the ten terms of a cubic are taken; fewer follow the noise."""
LARGE_AREA = 1.6
"""Least area of the large origin dot in others' areas."""
MAX_MISFIT = 0.25
"""Furthest that a dot may lie from where one map of the plane puts it, in pitches: the lens
bends a grid by less, a wrong lattice is off by more."""
MIN_SHARE = 0.7
"""Least share of the dots that must be measurable."""


def grid_nodes(grid: CircleGrid) -> tuple[Int64, list[Int64]]:
    """Return the dots as nodes (n, 2) of a lattice, and the lines a larger grid would add."""

    def nodes(r: Int64, c: Int64) -> Int64:
        if not grid.asymmetric:
            return np.stack([c, r], -1)
        # The steps of the lattice are (1, 1) and (-1, 1).
        x, y = 2 * c + r % 2, r
        return np.stack([(x + y) // 2, (y - x) // 2], -1)

    rows, columns = np.arange(grid.rows), np.arange(grid.columns)
    beyond = [nodes(np.full_like(columns, r), columns) for r in (-1, grid.rows)]
    beyond += [nodes(rows, np.full_like(rows, c)) for c in (-1, grid.columns)]
    r, c = np.divmod(np.arange(grid.rows * grid.columns), grid.columns)
    return nodes(r, c), beyond


def find_circles(
    rgb: UInt8, grid: CircleGrid, *, intrinsics: CameraIntrinsics | None = None
) -> TargetDetection:
    """Return the middles of a circle grid that is seen as a whole, dark dots or bright ones.

    The first dot is the large one where the grid has one; otherwise x runs along the image's x as
    closely as the grid allows. Perspective and, with intrinsics, the lens are taken out of the
    ellipses' middles.

    Raises:
        InputError: the image is not 8 bit.
    """
    gray = gray_image(rgb)
    reasons: list[str] = []
    for image in (gray, 255 - gray):
        detection, reason = _of_one_shade(image, grid, intrinsics)
        if detection is not None:
            return detection
        reasons.append(reason)
    # The shade that shows more dots explains more.
    return no_points(gray, max(reasons, key=_dots_told))


def _dots_told(reason: str) -> int:
    first = reason.split(" ", 1)[0]
    return int(first) if first.isdigit() else 10**6


def _of_one_shade(
    gray: UInt8, grid: CircleGrid, intrinsics: CameraIntrinsics | None
) -> tuple[TargetDetection | None, str]:
    """Return the grid of dark dots, or why there is none."""
    middles, axes = find_blobs(gray)
    sizes = np.abs(np.linalg.det(axes))
    lattice, laid = _best_fit(grow_lattices(middles, sizes), grid)
    total = grid.rows * grid.columns
    if not laid or laid[0].seen < total:
        return None, _partly(lattice, laid, grid)
    if all(one.larger for one in laid):
        return None, (
            f"the grid of dots in the picture is larger than {grid.columns}x{grid.rows}: correct "
            "rows and columns"
        )
    laid = [one for one in laid if not one.larger]
    rest = np.setdiff1d(np.arange(len(middles)), laid[0].points)
    _, second = _best_fit(grow_lattices(middles[rest], sizes[rest]), grid)
    if second and second[0].seen == total:
        return None, "two equal circle grids are in view: cover one"
    board = grid.points_board[:, :2]
    points, reason = _numbered(laid, middles, axes, board, grid)
    if points is None:
        mirror = lay_pattern(lattice, *grid_nodes(grid), mirrored=True)
        if grid.large_origin and mirror and mirror[0].seen == total:
            other, _ = _numbered(mirror, middles, axes, board, grid)
            if other is not None:
                reason = "the large dot is at the wrong corner: is the picture mirrored?"
        return None, reason
    middles, axes = middles[points], axes[points]
    dots = refine_dots(gray, middles, axes, _gaps(middles, axes))
    return _measured(gray, dots, grid, intrinsics)


def _best_fit(
    lattices: list[dict[Node, int]], grid: CircleGrid
) -> tuple[dict[Node, int], list[Laid]]:
    """Return the largest lattice that holds the whole grid, or else the largest one, and how."""
    total, nodes = grid.rows * grid.columns, grid_nodes(grid)
    for lattice in lattices:
        if len(lattice) < total:
            break
        laid = lay_pattern(lattice, *nodes)
        if laid and laid[0].seen == total:
            return lattice, laid
    return (lattices[0], lay_pattern(lattices[0], *nodes)) if lattices else ({}, [])


def _partly(lattice: dict[tuple[int, int], int], laid: list[Laid], grid: CircleGrid) -> str:
    """Return what was found of a grid that is not whole."""
    total, seen = grid.rows * grid.columns, laid[0].seen if laid else 0
    text = f"{seen} of {total} dots of the {grid.columns}x{grid.rows} grid"
    if seen < len(lattice):
        other = replace(grid, asymmetric=not grid.asymmetric)
        nodes, beyond = grid_nodes(other)
        fits = lay_pattern(lattice, nodes, beyond)
        if fits and fits[0].seen == total:
            return f"{text}; with asymmetric={other.asymmetric} all would fit"
    turned = replace(grid, rows=grid.columns, columns=grid.rows)
    fits = lay_pattern(lattice, *grid_nodes(turned))
    if fits and fits[0].seen == total:
        return f"{text}; with {turned.rows} rows and {turned.columns} columns all would fit"
    return f"{text}: a circle grid must be seen whole, free of glare, and its dots must not touch"


def _numbered(
    laid: list[Laid], middles: Array, axes: Array, board: Array, grid: CircleGrid
) -> tuple[Int64 | None, str]:
    """Return the point of every dot, or why none of the numberings will do."""
    best: tuple[float, Int64] | None = None
    ratios: list[float] = []
    for one in laid:
        uv = middles[one.points]
        H = fit_homography(board, uv)
        misfit = np.linalg.norm(apply_homography(H, board) - uv, axis=-1).max()
        step = float(np.linalg.norm(apply_homography(H, board[0] + _right(grid)) - uv[0]))
        if misfit > MAX_MISFIT * step:
            continue
        # A dot's area on the board: the image's, over the map's derivative.
        w = np.concatenate([board, np.ones((len(board), 1))], -1) @ H[2]
        area = np.abs(np.linalg.det(axes[one.points]) * w**3 / np.linalg.det(H))
        ratio = float(area[0] / np.median(area))
        ratios.append(ratio)
        along = apply_homography(H, board.mean(0) + _right(grid)) - apply_homography(
            H, board.mean(0)
        )
        score = ratio if grid.large_origin else float(along[0] / np.linalg.norm(along))
        if best is None or score > best[0]:
            best = (score, one.points)
    if best is None:
        return None, "the dots do not lie on one flat grid"
    if grid.large_origin and best[0] < LARGE_AREA:
        return None, (
            f"no dot that can be the first is larger than the others (its area is "
            f"{max(ratios):.2f} of theirs, at least {LARGE_AREA:g} is expected): is "
            "large_origin right?"
        )
    return best[1], ""


def _right(grid: CircleGrid) -> Array:
    return np.array([grid.pitch_m, 0.0])


def _gaps(middles: Array, axes: Array) -> Array:
    """Return the white space (n,) between a dot and the nearest [px]."""
    radius = np.linalg.eigvalsh(axes)[:, 1]
    apart = np.linalg.norm(middles[:, None] - middles[None], axis=-1)
    apart = apart - radius[:, None] - radius[None]
    np.fill_diagonal(apart, np.inf)
    return apart.min(1)


def _measured(
    gray: UInt8, dots: Dots, grid: CircleGrid, intrinsics: CameraIntrinsics | None
) -> tuple[TargetDetection | None, str]:
    """Return the detection, the bias of the ellipses' middles taken out."""
    good = np.array([not f for f in dots.faults], dtype=bool)
    faults = tuple(f"dot {k}: {f}" for k, f in enumerate(dots.faults) if f)
    if good.mean() < MIN_SHARE:
        return None, f"{int(good.sum())} of {len(good)} dots could be measured; {faults[0]}"
    board = grid.points_board[:, :2]
    ids = np.flatnonzero(good)
    uv = middles = dots.uv[good]
    for _ in range(BIAS_ROUNDS):
        H = fit_homography(board[good], straighten(intrinsics, uv))
        if not seen_from_front(H, board):
            return None, "the dots are numbered mirror-wise: is the picture mirrored?"
        to_image = _to_image(H, board[good], uv, intrinsics)
        uv = middles - outline_bias(to_image, board[good], _radii(H, dots, grid)[good])
    return (
        TargetDetection(
            point_ids=ids, uv=uv, sd_px=dots.sd_px[good], image_size=size_of(gray), rejected=faults
        ),
        "",
    )


def _to_image(
    H: Array, board: Array, uv: Array, intrinsics: CameraIntrinsics | None
) -> Callable[[Array], Array]:
    """Return the map of board points into the image; a cubic stands for an unknown lens."""
    if intrinsics is not None or len(board) < MIN_CUBIC:
        return lambda points: bend(intrinsics, apply_homography(H, points))
    middle, size = board.mean(0), np.ptp(board, axis=0).max() / 2

    def terms(points: Array) -> Array:
        x, y = np.moveaxis((points - middle) / size, -1, 0)
        return np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], -1)

    w = np.linalg.lstsq(terms(board), uv - apply_homography(H, board), rcond=None)[0]
    return lambda points: apply_homography(H, points) + terms(points) @ w


def _radii(H: Array, dots: Dots, grid: CircleGrid) -> Array:
    """Return the dots' radii on the board (n,) [m]: one for all, the large dot's its own."""
    board = grid.points_board[:, :2]
    w = np.concatenate([board, np.ones((len(board), 1))], -1) @ H[2]
    each = np.sqrt(dots.area / np.pi * np.abs(w**3 / np.linalg.det(H)))
    radii = np.full(len(board), float(np.median(each)))
    if grid.large_origin:
        radii[0] = each[0]
    return radii


FEW_POINTS = 8
"""With fewer points it is looked at whether the picture is blurred."""


def find_target(
    image: UInt8, target: Target, *, intrinsics: CameraIntrinsics | None = None
) -> TargetDetection:
    """Return the points of a target that can be trusted; none is no error, `rejected` says why.

    Tags and ChArUco boards may be seen in part, chessboards and circle grids must be whole. Points
    of a target with `half_turn` are numbered along the image's x; the true end is not known.

    Args:
        image: (H, W, 3) RGB or (H, W) gray, uint8.
        target: what was printed.
        intrinsics: with them the lens is taken into account: straight edges may look bent, and
            ellipses lie askew. Rough ones will do.

    Raises:
        InputError: the image is not 8 bit, the intrinsics belong to another image size, or the
            marker dictionary is not known.
    """
    gray = gray_image(image)
    if intrinsics is not None and size_of(gray) != (intrinsics.width, intrinsics.height):
        width, height = size_of(gray)
        raise InputError(
            f"the image is {width}x{height} px, the intrinsics are for {intrinsics.width}x"
            f"{intrinsics.height}: give the intrinsics of this image size, or none."
        )
    found = _points(gray, target, intrinsics)
    if len(found) < FEW_POINTS:
        blurred = blur_reason(gray)
        if blurred:
            return replace(found, rejected=(blurred, *found.rejected))
    drawn = drawing_reason(image, found.uv)
    return replace(found, rejected=(drawn, *found.rejected)) if drawn else found


def _points(gray: UInt8, target: Target, intrinsics: CameraIntrinsics | None) -> TargetDetection:
    """Return the points by the search for the target's kind."""
    if isinstance(target, TagBoard):
        return tag_points(detect_tags(gray, target, intrinsics=intrinsics), target, size_of(gray))
    if isinstance(target, CharucoBoard):
        return find_charuco(gray, target, intrinsics=intrinsics)
    if isinstance(target, Chessboard):
        return find_chessboard(gray, target, intrinsics=intrinsics)
    assert isinstance(target, CircleGrid)
    return find_circles(gray, target, intrinsics=intrinsics)


def tag_points(
    detections: TagDetections, board: TagBoard, image_size: tuple[int, int]
) -> TargetDetection:
    """Return tags as points of the board, four a tag.

    Raises:
        InputError: a tag does not belong to the board.
    """
    row_of = {int(tag): row for row, tag in enumerate(board.ids)}
    wrong = [int(i) for i in detections.ids if int(i) not in row_of]
    if wrong:
        raise InputError(
            f"tags {wrong} are not on the board, whose ids run from {board.ids.min()} to "
            f"{board.ids.max()}."
        )
    rows = np.array([row_of[int(i)] for i in detections.ids], dtype=np.int64)
    return TargetDetection(
        point_ids=(4 * rows[:, None] + np.arange(4)).ravel(),
        uv=detections.corners_px.reshape(-1, 2),
        # A tag's figure is for both axes together.
        sd_px=np.repeat(detections.corner_sd_px / np.sqrt(2.0), 4),
        image_size=image_size,
        rejected=tuple(f"tag {i}: {reason}" for i, reason in detections.rejected),
    )
