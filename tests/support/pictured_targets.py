"""Pictures of printed targets at known poses, rendered with several rays a pixel."""

from functools import cache

import numpy as np

from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics
from realsim.records.targets import CharucoBoard, Chessboard, CircleGrid, TagBoard
from realsim_calibration.sheets.artwork import target_image

CAMERA = CameraIntrinsics(width=640, height=480, fx=600.0, fy=600.0, cx=319.5, cy=239.5)
PER_M, MARGIN, SUPER = 8000.0, 240, 6  # page pixels per metre and about the target, rays a pixel
TARGETS = {
    "tags": TagBoard(rows=3, columns=4, tag_size_m=0.032, gap_m=0.008),
    "tag16h5": TagBoard(rows=3, columns=3, tag_size_m=0.03, gap_m=0.01, family="tag16h5"),
    "kalibr": TagBoard(
        rows=3, columns=3, tag_size_m=0.04, gap_m=0.012, ids_from="bottom", corner_squares=True
    ),
    "one tag": TagBoard(rows=1, columns=1, tag_size_m=0.064, gap_m=0.02, first_id=7),
    "charuco": CharucoBoard(rows=5, columns=7, square_m=0.025, marker_m=0.018),
    "charuco old": CharucoBoard(
        rows=6, columns=7, square_m=0.025, marker_m=0.018, dictionary="DICT_5X5_100", legacy=True
    ),
    "chessboard": Chessboard(rows=6, columns=7, square_m=0.02),
    "circles": CircleGrid(rows=5, columns=7, pitch_m=0.025, large_origin=True),
    "asymmetric": CircleGrid(rows=7, columns=4, pitch_m=0.02, asymmetric=True),
}  # fmt: skip


@cache
def page_of(target):
    """Return the printed page (30 ink, 215 paper), and the board's origin on it [px]."""
    white, origin = target_image(target, PER_M, MARGIN / PER_M)
    return np.where(white > 127, 215, 30).astype(np.uint8), origin


def picture(
    target, T, rng=None, blur=0.8, noise=4.0, page=None, intrinsics=CAMERA, also=(), shade=0.0
):
    """Return a picture of the page, and of further ones at the poses `also`."""
    import cv2

    rng = rng or np.random.default_rng(0)
    page, (u, v) = page_of(target) if page is None else page
    to_page = np.array([[PER_M, 0, u], [0, PER_M, v], [0, 0, 1]])
    half = (SUPER - 1) / 2
    fine = np.full((480 * SUPER, 640 * SUPER), 120, np.uint8)
    for pose in (T, *also):
        H = intrinsics.K @ pose[:3, [0, 1, 3]] @ np.linalg.inv(to_page)
        big = np.array([[SUPER, 0, half], [0, SUPER, half], [0, 0, 1.0]]) @ H
        size = fine.shape[::-1]
        cv2.warpPerspective(page, big, size, fine, cv2.INTER_NEAREST, cv2.BORDER_TRANSPARENT)
    image = cv2.resize(fine, (640, 480), interpolation=cv2.INTER_AREA).astype(np.float64)
    image = cv2.GaussianBlur(image, (0, 0), blur)
    image = image * (1 + shade * (np.arange(640) / 639 - 0.5))
    image = image + rng.normal(scale=noise, size=image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def pose(target, tilt_deg, azimuth_deg=30.0, roll_deg=20.0, distance=0.4, aim=(0.0, 0.0)):
    """Return T_cam_board of a camera that looks at the target's middle, moved by `aim` [m]."""
    points = target.points_board
    middle = (points.min(0) + points.max(0)) / 2 + np.array([*aim, 0.0])
    tilt, azimuth = np.radians([tilt_deg, azimuth_deg])
    away = [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)]
    return se3.invert(se3.look_at(middle + distance * np.array(away), middle, np.radians(roll_deg)))


def truth(target, T, intrinsics=CAMERA):
    return camera.project(intrinsics, se3.transform(T, target.points_board))
