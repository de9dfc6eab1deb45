"""Pictures that are dark or blurred: found, or named for what they are."""

import numpy as np
import pytest

from pictured_targets import TARGETS, page_of, picture, pose, truth
from realsim_calibration.detect.blur import edge_blur_px
from realsim_calibration.detect.drawings import COVERED, DRAWN, drawing_reason
from realsim_calibration.detect.find import find_target


@pytest.mark.parametrize("tilt", [10.0, 45.0])
def test_a_dark_chessboard_in_a_bright_room_is_found(tilt):
    board, (page, origin) = TARGETS["chessboard"], page_of(TARGETS["chessboard"])
    T, rng = pose(board, tilt), np.random.default_rng(1)
    dark = np.where(page > 127, 50, 10).astype(np.uint8)
    image = picture(board, T, noise=0.0, page=(dark, origin))
    sheet = picture(board, T, blur=0.1, noise=0.0, page=(np.full_like(page, 255), origin)) > 200
    image = np.where(sheet, image, 230) + rng.normal(scale=2.0, size=image.shape)
    found = find_target(np.clip(np.rint(image), 0, 255).astype(np.uint8), board)
    assert len(found) == len(board.points_board)
    assert np.abs(found.uv - truth(board, T)[found.point_ids]).max() < 0.3


@pytest.mark.parametrize("name", ["tags", "charuco", "chessboard", "circles"])
def test_a_blurred_picture_is_named_as_blurred(name):
    board = TARGETS[name]
    T, rng = pose(board, 30.0), np.random.default_rng(0)
    for blur in (0.8, 2.0, 4.0):
        measured = edge_blur_px(picture(board, T, rng, blur=blur))
        assert 0.7 * blur < measured < 1.5 * max(blur, 0.8), blur
    found = find_target(picture(board, T, rng, blur=9.0), board)
    assert len(found) == 0
    assert found.rejected[0].startswith("the picture is blurred: its edges spread over")
    assert "rest" in found.rejected[0]


def test_a_sharp_picture_without_the_board_is_not_called_blurred():
    found = find_target(
        picture(TARGETS["circles"], pose(TARGETS["circles"], 20.0)), TARGETS["tags"]
    )
    assert len(found) == 0 and not any("blurred" in r for r in found.rejected)
    assert np.isnan(edge_blur_px(np.full((100, 100), 90, np.uint8)))


@pytest.mark.parametrize(("seed", "view"), [(0, 0), (0, 3), (1, 2)])
def test_a_line_made_up_in_the_margin_does_not_shift_the_numbers(seed, view):
    # OpenCV's newer search misses a line of these boards, or makes one up.
    board, rng = TARGETS["chessboard"], np.random.default_rng(seed)
    for k in range(view + 1):
        T = pose(board, rng.uniform(8, 40), 36.0 * k, rng.uniform(-80, 80), rng.uniform(0.3, 0.4))
        image = picture(board, T, rng, noise=2.0)
    found = find_target(image, board)
    assert len(found) == len(board.points_board)
    assert np.abs(found.uv - truth(board, T)[found.point_ids]).max() < 0.3


def test_blue_fringes_and_a_tint_are_no_drawings():
    # A camera whose blue spreads from the light into the dots, and which tints the dark.
    import cv2

    board, rng = TARGETS["circles"], np.random.default_rng(3)
    gray = picture(board, pose(board, 25.0), rng, blur=1.0, noise=0.0).astype(float)
    blue = cv2.dilate(gray, np.ones((3, 3)))
    image = np.stack([1.2 * gray - 30, 1.2 * gray - 20, 1.2 * blue + 10], axis=-1)
    image = np.clip(image + rng.normal(scale=3.0, size=image.shape), 0, 255).astype(np.uint8)
    found = find_target(image, board)
    assert len(found) == len(board.points_board)
    assert drawing_reason(image, found.uv) == ""
    cv2.drawChessboardCorners(
        image, (board.columns, board.rows), found.uv.astype(np.float32)[:, None], True
    )
    assert drawing_reason(image, found.uv).startswith(DRAWN)


@pytest.mark.parametrize("quality", [90, 100])
def test_drawn_corners_are_told_after_jpeg(quality):
    import cv2

    board = TARGETS["chessboard"]
    T = pose(board, 25.0)
    image = cv2.cvtColor(picture(board, T, noise=2.0), cv2.COLOR_GRAY2BGR)
    uv = truth(board, T).astype(np.float32)
    cv2.drawChessboardCorners(image, (board.columns, board.rows), uv[:, None], True)
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    rgb = cv2.cvtColor(cv2.imdecode(data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    assert drawing_reason(rgb, uv).startswith(DRAWN)


@pytest.mark.parametrize("color", [(255, 0, 0), (0, 255, 0), (0, 0, 255)])
def test_a_target_whose_points_are_all_drawn_over_is_named(color):
    """Discs over every point: nothing is found, and the colours say why."""
    import cv2

    board = TARGETS["chessboard"]
    T = pose(board, 20.0)
    image = np.repeat(picture(board, T)[..., None], 3, -1)
    assert drawing_reason(image, np.zeros((0, 2))) == ""
    for u, v in truth(board, T):
        cv2.circle(image, (round(u), round(v)), 14, color, -1)
    found = find_target(image, board)
    assert len(found) < 4
    said = [r for r in found.rejected if r.startswith(COVERED)]
    assert said and "drawn over the target?" in said[0]
