"""Points found on rendered targets, whose true places are known.

Imported by `calibration.py` (`--part corners`).

Every view is a picture of a flat target at 0.5 m (1280x720 px, f = 900 px), tilted by up to 55 deg
and rolled at random, rendered with 8x8 rays a pixel, blurred and made noisy. OpenCV's own detectors
are measured on the same pictures.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from realsim.arrays import Array, Image, Int64
from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics
from realsim.records.targets import CharucoBoard, Chessboard, CircleGrid, TagBoard, Target
from realsim_calibration.detect.find import find_target
from realsim_calibration.sheets.artwork import target_image
from realsim_calibration.targets.marker_sets import load_dictionary, tag_dictionary

SUPER = 8
"""Rays per pixel and axis."""
BLOCK_ROWS = 60
"""Pixel rows that are rendered at once."""
TEXTURE_M = 1e-4
"""Edge of a texture pixel [m]."""
MARGIN_M = 0.03
"""White paper about the target [m]."""
INK, PAPER, TABLE = 30, 215, 120
"""Gray levels."""
DISTANCE_M = 0.5
MAX_TILT_DEG = 55.0
LEVELS = {"moderate": (0.8, 4.0), "strong": (1.5, 6.0)}
"""(blur sigma [px], noise [gray levels])."""
CAMERA = CameraIntrinsics(width=1280, height=720, fx=900.0, fy=900.0, cx=639.5, cy=359.5)
KINDS: dict[str, Target] = {
    "tags 36h11": TagBoard(rows=4, columns=6, tag_size_m=0.04, gap_m=0.01),
    "tags 36h10": TagBoard(rows=4, columns=6, tag_size_m=0.04, gap_m=0.01, family="tag36h10"),
    "tags 25h9": TagBoard(rows=4, columns=6, tag_size_m=0.035, gap_m=0.01, family="tag25h9"),
    "tags 16h5": TagBoard(rows=4, columns=6, tag_size_m=0.03, gap_m=0.01, family="tag16h5"),
    "tags kalibr": TagBoard(
        rows=4, columns=6, tag_size_m=0.04, gap_m=0.012, ids_from="bottom", corner_squares=True
    ),
    "charuco": CharucoBoard(rows=7, columns=10, square_m=0.03, marker_m=0.022),
    "charuco 6x6_100": CharucoBoard(
        rows=6, columns=9, square_m=0.033, marker_m=0.02, dictionary="DICT_6X6_100", legacy=True
    ),
    "chessboard": Chessboard(rows=6, columns=9, square_m=0.025),
    "circles": CircleGrid(rows=7, columns=10, pitch_m=0.025),
    "circles origin": CircleGrid(rows=8, columns=8, pitch_m=0.025, large_origin=True),
    "circles asymmetric": CircleGrid(rows=11, columns=4, pitch_m=0.02, asymmetric=True),
}
"""What is measured."""


def draw_target(target: Target) -> tuple[Image, Array]:
    """Return the printed page and the map (3, 3) from board metres to its pixels."""
    per_m = 1.0 / TEXTURE_M
    white, (u, v) = target_image(target, per_m, MARGIN_M)
    page = np.rint(INK + (PAPER - INK) * (white / 255.0)).astype(np.uint8)
    return page, np.array([[per_m, 0, u], [0, per_m, v], [0, 0, 1]])


def photograph(
    target: Target,
    T_cam_board: Array,
    rng: np.random.Generator,
    blur_px: float,
    noise: float,
    intrinsics: CameraIntrinsics = CAMERA,
) -> Image:
    """Return a picture of the target: 8x8 rays a pixel through the lens, blur, noise."""
    import cv2

    page, to_page = draw_target(target)
    image = np.full((intrinsics.height, intrinsics.width), float(TABLE))
    to_page = to_page @ np.linalg.inv(T_cam_board[:3, [0, 1, 3]])
    (left, top), (right, bottom) = _extent(page, to_page, intrinsics)
    for row in range(top, bottom, BLOCK_ROWS):
        rows, columns = slice(row, min(row + BLOCK_ROWS, bottom)), slice(left, right)
        image[rows, columns] = _block(page, to_page, intrinsics, rows, columns)
    image = np.asarray(cv2.GaussianBlur(image, (0, 0), blur_px))
    image = image + rng.normal(scale=noise, size=image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _extent(page: Image, to_page: Array, intrinsics: CameraIntrinsics) -> Array:
    """Return the first pixel and the one after the last (2, 2) of the page in the picture."""
    h, w = page.shape
    rim = np.linspace(0, 1, 21)
    ends = [np.stack(np.broadcast_arrays(*p), -1) for p in ((rim, 0), (rim, 1), (0, rim), (1, rim))]
    xyw = np.c_[np.concatenate(ends) * [w, h], np.ones(84)] @ np.linalg.inv(to_page).T
    uv = camera.project(intrinsics, xyw)
    limit = [intrinsics.width, intrinsics.height]
    return np.clip([np.floor(uv.min(0)) - 2, np.ceil(uv.max(0)) + 3], 0, limit).astype(int)


def _block(
    page: Image, to_page: Array, intrinsics: CameraIntrinsics, rows: slice, columns: slice
) -> Array:
    """Return the mean of the rays of a block of pixels."""
    import cv2

    h, w = rows.stop - rows.start, columns.stop - columns.start
    corner = np.array([columns.start, rows.start]) - 0.5 + 0.5 / SUPER
    if intrinsics.is_distorted:
        # The lens is smooth: rays between the pixels of a coarse grid are interpolated, written out
        # because the fixed-point remap of OpenCV rounds positions to 1/32 of the grid.
        gx = np.arange(columns.start - 2.0, columns.stop + 4.0, 2.0)
        gy = np.arange(rows.start - 2.0, rows.stop + 4.0, 2.0)
        xy, _ = camera.undistort(intrinsics, np.stack(np.meshgrid(gx, gy), -1))
        x = (corner[0] + np.arange(w * SUPER) / SUPER - gx[0]) / 2.0
        y = (corner[1] + np.arange(h * SUPER) / SUPER - gy[0]) / 2.0
        i, j = x.astype(int), y.astype(int)
        a, b = (x - i)[:, None], (y - j)[:, None, None]
        xy = xy[j] * (1 - b) + xy[j + 1] * b
        xy = xy[:, i] * (1 - a) + xy[:, i + 1] * a
        p = xy @ to_page[:, :2].T + to_page[:, 2]
        where = (p[..., :2] / p[..., 2:]).astype(np.float32)
        fine = cv2.remap(page, where, None, cv2.INTER_NEAREST, borderValue=TABLE)
    else:
        ray = np.array([[1 / SUPER, 0, corner[0]], [0, 1 / SUPER, corner[1]], [0, 0, 1]])
        M = to_page @ np.linalg.inv(intrinsics.K) @ ray
        flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        size = (w * SUPER, h * SUPER)
        fine = cv2.warpPerspective(page, M, size, flags=flags, borderValue=TABLE)
    return cv2.resize(np.asarray(fine, np.float32), (w, h), interpolation=cv2.INTER_AREA)


def look(target: Target, rng: np.random.Generator) -> Array:
    """Return T_cam_board of a camera 0.5 m from the target's middle, tilted and rolled."""
    points = target.points_board
    middle = (points.min(0) + points.max(0)) / 2
    tilt, azimuth = np.radians(rng.uniform(0, MAX_TILT_DEG)), rng.uniform(0, 2 * np.pi)
    away = [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)]
    # The board's z points into the paper: the camera stands on its negative side.
    T = se3.look_at(middle + DISTANCE_M * np.array(away), middle, rng.uniform(-np.pi, np.pi))
    return se3.invert(T)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PointErrors:
    """Errors of one target's points over all views."""

    errors: Array
    """(n, 2) found minus true [px]."""
    visible: int
    """Points that were inside the pictures, 5 px from their border."""

    @property
    def rms_px(self) -> float:
        """RMS 2-D error [px]."""
        return float(np.sqrt(np.mean(np.sum(self.errors**2, -1)))) if len(self.errors) else np.nan

    @property
    def found_share(self) -> float:
        """Found points of the visible ones."""
        return len(self.errors) / max(self.visible, 1)


Finder = Callable[[Image, Target], tuple[Int64, Array]]


def ours(image: Image, target: Target) -> tuple[Int64, Array]:
    """Return point numbers and places of our own finder."""
    d = find_target(image, target)
    return d.point_ids, d.uv


def opencv(image: Image, target: Target) -> tuple[Int64, Array]:
    """Return the same of OpenCV's detectors, each with the refinement that suits it best."""
    import cv2
    from cv2 import aruco

    ids, uv = np.zeros(0, np.int64), np.zeros((0, 2))
    if isinstance(target, TagBoard):
        parameters = aruco.DetectorParameters()
        parameters.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
        dictionary = load_dictionary(tag_dictionary(target.family))
        corners, found, _ = aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
        if found is not None:
            row = {int(tag): k for k, tag in enumerate(target.ids)}
            kept = [
                (row[int(i)], q)
                for i, q in zip(found.ravel(), corners, strict=True)
                if int(i) in row
            ]
            ids = np.array([4 * r + j for r, _ in kept for j in range(4)], np.int64)
            uv = np.array([q for _, q in kept], dtype=np.float64).reshape(-1, 2)
    elif isinstance(target, CharucoBoard):
        board = aruco.CharucoBoard(
            (target.columns, target.rows),
            target.square_m,
            target.marker_m,
            load_dictionary(target.dictionary),
        )
        board.setLegacyPattern(target.legacy)
        corners, found, _, _ = aruco.CharucoDetector(board).detectBoard(image)
        if found is not None:
            ids, uv = np.asarray(found).ravel().astype(np.int64), np.asarray(corners, np.float64)
    else:
        shape = (target.columns, target.rows)
        if isinstance(target, Chessboard):
            ok, corners = cv2.findChessboardCornersSB(image, shape, flags=cv2.CALIB_CB_ACCURACY)
        else:
            flag = (
                cv2.CALIB_CB_ASYMMETRIC_GRID if target.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
            )
            ok, corners = cv2.findCirclesGrid(image, shape, flags=flag)
        if ok:
            uv = np.asarray(corners, dtype=np.float64)
            ids = np.arange(len(uv))
    return ids, uv.reshape(-1, 2)


def _ends(target: Target) -> list[Int64]:
    """Return the numberings that a finder cannot tell apart."""
    n = np.arange(len(target.points_board))
    if isinstance(target, TagBoard | CharucoBoard):
        return [n]
    grid = n.reshape(target.rows, target.columns)
    turns = [np.rot90(g, k) for g in (grid, grid.T) for k in range(4)]
    return [t.ravel() for t in turns if t.shape == grid.shape]


@lru_cache(maxsize=64)
def _view(kind: str, level: str, seed: int) -> Image:
    """Return the picture of a seed; all finders see the same."""
    rng = np.random.default_rng(seed)
    T = look(KINDS[kind], rng)
    return photograph(KINDS[kind], T, rng, *LEVELS[level], CAMERA)


def measure(kind: str, level: str, seeds: Sequence[int], finder: Finder = ours) -> PointErrors:
    """Return the errors of one kind of target, one view a seed."""
    target = KINDS[kind]
    # Our numbering is right but for a half turn; OpenCV's may also start at any other end.
    ends = _ends(target) if finder is opencv or getattr(target, "half_turn", False) else None
    errors, visible = [np.zeros((0, 2))], 0
    for seed in seeds:
        T = look(target, np.random.default_rng(seed))
        truth = camera.project(CAMERA, se3.transform(T, target.points_board))
        limit = [CAMERA.width - 6, CAMERA.height - 6]
        visible += int(np.all((truth > 5) & (truth < limit), axis=-1).sum())
        ids, uv = finder(_view(kind, level, seed), target)
        if len(ids):
            choices = [uv - truth[end[ids]] for end in (ends or _ends(target)[:1])]
            errors.append(min(choices, key=lambda e: float(np.sum(e**2))))
    return PointErrors(errors=np.concatenate(errors), visible=visible)
