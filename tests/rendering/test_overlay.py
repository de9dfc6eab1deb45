"""Drawings land on the right pixels in the right colours."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics, GraspSet
from realsim.rendering import overlay
from refusals import refused
from tried_grasps import plain_grasps

CAMERA = CameraIntrinsics(width=320, height=240, fx=300, fy=300, cx=159.5, cy=119.5,
                          distortion=np.array([-0.1, 0.05, 0.001, 0.0]))  # fmt: skip
T_CAM_OBJ = se3.from_translation([0.0, 0.0, 0.4])


def grasps(scores: list[float], Ts: np.ndarray | None = None) -> GraspSet:
    n = len(scores)
    return plain_grasps(n if Ts is None else Ts, widths_m=np.full(n, 0.06), scores=scores)


def black() -> np.ndarray:
    return np.zeros((240, 320, 3), np.uint8)


def test_fingertips_are_drawn_where_they_project() -> None:
    # A gripper that comes from the side, so that the fingers are seen in full.
    T = se3.from_rt(se3.exp_so3([0, np.pi / 2, 0]), [0, 0, 0])[None]
    out = overlay.draw_grasps(black(), CAMERA, T_CAM_OBJ, grasps([1.0], T))
    line = overlay.gripper_lines(0.06)[0]
    assert np.allclose(line[[0, -1]], [[0, -0.03, 0], [0, 0.03, 0]])
    assert np.allclose(line[1, 2], -0.05)
    for a, b in pairwise(line):
        for s in (0.05, 0.5, 0.95):
            point = se3.transform(T_CAM_OBJ @ T[0], (a + s * (b - a))[None])
            u, v = np.round(camera.project(CAMERA, point)[0]).astype(int)
            assert tuple(out[v, u]) == overlay.score_color(1.0)


def test_only_the_chosen_grasps_are_drawn_and_behind_the_camera_nothing() -> None:
    assert not overlay.draw_grasps(black(), CAMERA, T_CAM_OBJ, grasps([1.0, 0.5]), []).any()
    behind = se3.from_translation([0, 0, -0.4])
    assert not overlay.draw_grasps(black(), CAMERA, behind, grasps([1.0])).any()
    # One that straddles the camera plane is cut, not smeared across the picture.
    astride = se3.from_translation([0, 0, 0.02])
    overlay.draw_grasps(black(), CAMERA, astride, grasps([1.0]))
    overlay.draw_axes(black(), CAMERA, astride @ se3.exp([0, np.pi, 0, 0, 0, 0]), 0.1)


def test_a_p_hold_of_few_draws_is_dashed_in_its_own_colour() -> None:
    T = se3.from_rt(se3.exp_so3([0, np.pi / 2, 0]), [0, 0, 0])[None]
    many, few = (
        replace(grasps([1.0], T), measures={"p_hold": np.zeros(1), "p_hold_draws": np.array([n])})
        for n in (32.0, 4.0)
    )
    whole, cut = (overlay.draw_grasps(black(), CAMERA, T_CAM_OBJ, g) for g in (many, few))
    red = overlay.score_color(0.0)
    counts = [int(np.all(out == red, axis=-1).sum()) for out in (whole, cut)]
    assert 0.4 * counts[0] < counts[1] < 0.8 * counts[0]
    for line in overlay.gripper_lines(0.06):  # dashes begin and end where the line does
        dashes = overlay.dashed([line])
        np.testing.assert_array_equal(dashes[0][0], line[0])
        np.testing.assert_array_equal(dashes[-1][1], line[-1])


def test_scores_run_from_red_over_yellow_to_green() -> None:
    red, yellow, green = (overlay.score_color(s) for s in (0.0, 0.5, 1.0))
    assert red[0] > 2 * red[1] and green[1] > 2 * green[0]
    assert yellow[0] > 200 and yellow[1] > 150 and yellow[2] < 100
    assert overlay.score_color(float("nan")) == overlay.UNTRIED
    assert overlay.score_color(7.0) == green


def test_outlines_keep_to_the_mask_and_its_rim() -> None:
    ids = np.full((240, 320), -1, np.int32)
    ids[50:100, 60:160] = 4
    rgb = np.full((240, 320, 3), 100, np.uint8)
    out = overlay.draw_outlines(rgb, ids, thickness=3)
    color = np.all(out == overlay.instance_color(4), axis=-1)
    rim = ids == 4
    rim[53:97, 63:157] = False
    assert np.array_equal(color, rim)
    assert np.all(rgb == 100)  # the given picture is not touched
    assert np.array_equal(out[75, 100], [100, 100, 100]) and np.array_equal(out[0, 0], rgb[0, 0])


def test_depth_picture_marks_missing_black_and_near_red() -> None:
    depth = np.tile(np.linspace(0.2, 1.0, 64, dtype=np.float32), (8, 1))
    depth[0] = 0
    picture = overlay.depth_picture(depth, 0.2, 1.0)
    assert not picture[0].any() and np.all(picture[1:].max(-1) > 60)
    assert picture[3, 0, 0] > picture[3, 0, 2] and picture[3, -1, 2] > picture[3, -1, 0]
    assert not overlay.depth_picture(np.zeros((4, 5))).any()


def test_contact_sheet_holds_every_picture() -> None:
    images = [np.full((60, 80, 3), k, np.uint8) for k in (10, 90, 170)]
    sheet = overlay.contact_sheet(images, 2, ["a", "b", "a caption that is far too long"])
    for k in (10, 90, 170):
        assert np.count_nonzero(np.all(sheet == k, axis=-1)) >= 60 * 80
    refused("2 captions for 3", overlay.contact_sheet, images, 2, ["a", "b"])


def test_legend_and_png(tmp_path: Path) -> None:
    import cv2

    out = overlay.draw_legend(black(), [("mug", (255, 0, 0))])
    overlay.save_png(tmp_path / "a.png", out)
    assert np.array_equal(cv2.imread(str(tmp_path / "a.png"))[..., ::-1], out)
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]
    refused("folder", overlay.save_png, tmp_path / "nowhere" / "a.png", out)
