"""Targets in real pictures: everything is found, and OpenCV's own points fit a camera no better."""

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

import real_data
from realsim.app.calibrate.board_views import require_target
from realsim.records.targets import CharucoBoard, CircleGrid
from realsim_calibration.detect.find import find_target
from realsim_calibration.detect.homography import fit_homography, seen_from_front
from realsim_calibration.detect.visible import DRAWN
from refusals import refused

DATA = real_data.DATA / "handeye"
pytestmark = [pytest.mark.real, real_data.needs(DATA)]
CIRCLES = CircleGrid(rows=10, columns=10, pitch_m=0.0254, large_origin=True)


def load(pattern, every):
    """Return the files of a set of pictures and every so many of the pictures."""
    files = sorted(DATA.glob(pattern), key=lambda p: int(p.stem.split("-")[-1]))
    assert files, f"no pictures {DATA / pattern}"
    return files, [cv2.cvtColor(cv2.imread(str(f)), cv2.COLOR_BGR2RGB) for f in files[::every]]


def opencv_points(image, target):
    """Return (n, 2) with NaN for missing points, in our numbering for the circles."""
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    uv = np.full((len(target.points_board), 2), np.nan)
    shape = (target.columns, target.rows)
    p = cv2.SimpleBlobDetector_Params()
    p.minArea, p.maxArea, p.minThreshold, p.maxThreshold = 25, 5000, 20, 220
    p.filterByCircularity = p.filterByConvexity = p.filterByInertia = False
    p.minDistBetweenBlobs = 5
    blobs = cv2.SimpleBlobDetector_create(p)
    ok, corners = cv2.findCirclesGrid(
        gray, shape, flags=cv2.CALIB_CB_SYMMETRIC_GRID, blobDetector=blobs
    )
    return np.reshape(corners, (-1, 2)) if ok else uv


def camera_rms(uvs, target, size):
    points = target.points_board.astype(np.float32)
    seen = [(u, np.isfinite(u[:, 0])) for u in uvs]
    seen = [(u, m) for u, m in seen if m.sum() >= 6]
    return cv2.calibrateCamera(
        [points[m] for _, m in seen], [u[m].astype(np.float32) for u, m in seen], size, None, None
    )[0]


@pytest.mark.slow
def test_all_views_are_found_and_fit_a_camera_better_than_with_opencv():
    target, board = CIRCLES, CIRCLES.points_board
    _, pictures = load("rosi_circles/images/*.png", every=3)
    ours, theirs = [], []
    for image in pictures:
        d = find_target(image, target)
        assert len(d) >= len(board) - 1, d.rejected
        uv = np.full((len(board), 2), np.nan)
        uv[d.point_ids] = d.uv
        ours.append(uv)
        assert seen_from_front(fit_homography(board[d.point_ids, :2], d.uv), board[:, :2])
        other = opencv_points(image, target)
        # OpenCV may begin at another end: number its points by ours.
        apart = np.linalg.norm(other[None] - uv[:, None], axis=-1)
        apart[~np.isfinite(apart)] = np.inf
        matched = other[apart.argmin(1)]
        matched[(apart.min(1) > 5.0) | ~np.isfinite(uv[:, 0])] = np.nan
        theirs.append(matched)
    size = (pictures[0].shape[1], pictures[0].shape[0])
    a, b = camera_rms(ours, target, size), camera_rms(theirs, target, size)
    print(f"{len(pictures)} views, {a:.4f} px, with OpenCV's points {b:.4f} px")
    assert a < b


def test_untouched_photographs_are_not_said_to_be_drawn_on():
    for image in load("rosi_circles/images/*.png", every=5)[1]:
        found = find_target(image, CIRCLES)
        assert len(found) > 90 and not any(r.startswith(DRAWN) for r in found.rejected)


@pytest.mark.slow
def test_a_wrong_board_file_is_answered_with_what_is_there():
    files, pictures = load("rtde_ur5e/Hand-Eye-Data/*.jpg", every=1000)
    wrong = CharucoBoard(rows=7, columns=5, square_m=0.033, marker_m=0.02)
    d = find_target(pictures[0], wrong)
    assert len(d) == 0
    folder: Any = SimpleNamespace(images=files[:1], labels=["0.jpg"])
    refused(r"dict=APRILTAG_36h11.*17 markers of DICT_6X6_50", require_target, folder, [d], wrong)
