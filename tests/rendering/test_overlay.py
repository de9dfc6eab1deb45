"""Drawings land on the right pixels in the right colours."""

from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics, GraspSet
from realsim.rendering import overlay
from realsim.rendering.map_pictures import (
    NOTHING,
    coordinates_picture,
    instance_picture,
    normals_picture,
)
from realsim.rendering.overlay import instance_color
from realsim.rendering.overlay_words import write_legend, write_names
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
    out = write_legend(black(), [("mug", (255, 0, 0))], np.zeros((240, 320), bool))
    overlay.save_png(tmp_path / "a.png", out)
    assert np.array_equal(cv2.imread(str(tmp_path / "a.png"))[..., ::-1], out)
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]
    refused("folder", overlay.save_png, tmp_path / "nowhere" / "a.png", out)


# --- Names, legends, hatching, and colours that stay apart without red-green vision.

PROTAN = np.array(
    [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
     [-0.003882, -0.048116, 1.051998]]
)  # fmt: skip
DEUTAN = np.array(
    [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
     [-0.011820, 0.042940, 0.968881]]
)  # fmt: skip
"""Linear RGB without one of the cones: Machado, Oliveira and Fernandes 2009, severity 1."""
VISIONS = {"all cones": np.eye(3), "protanopia": PROTAN, "deuteranopia": DEUTAN}
TOLD_APART = 18.0
"""Difference in CIELAB; about 2 is just noticeable side by side."""


def lab(color: tuple[int, int, int], vision: np.ndarray) -> np.ndarray:
    c = np.array(color) / 255
    linear = np.clip(vision @ np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4), 0, 1)
    seen = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return cv2.cvtColor(seen[None, None].astype(np.float32), cv2.COLOR_RGB2LAB)[0, 0]


@pytest.mark.parametrize("vision", VISIONS)
def test_verdicts_and_scores_are_told_apart_by_every_vision(vision: str) -> None:
    scores = [overlay.score_color(s) for s in (0.0, 0.5, 1.0)]
    for colors in (list(overlay.VERDICT_RGB.values()), scores):
        seen = [lab(c, VISIONS[vision]) for c in colors]
        assert min(np.linalg.norm(a - b) for a, b in combinations(seen, 2)) > TOLD_APART


def test_hatching_stays_in_its_mask_and_shows_what_is_under_it() -> None:
    rgb = np.full((200, 300, 3), 90, np.uint8)
    mask = np.zeros((200, 300), bool)
    mask[50:120, 60:200] = True
    out = overlay.draw_hatched(rgb, mask, (255, 0, 200))
    assert np.array_equal(np.any(out != rgb, axis=-1), mask)
    assert 0.1 < np.all(out == (255, 0, 200), axis=-1)[mask].mean() < 0.6
    assert np.array_equal(overlay.draw_hatched(rgb, mask & False, (255, 0, 200)), rgb)


def boxes_of_names(names: dict[int, str], ids: np.ndarray) -> np.ndarray:
    grey = np.full((*ids.shape, 3), 200, np.uint8)
    out = write_names(grey, ids, names, dict.fromkeys(names, (0, 255, 0)))
    return np.all(out == overlay.INK, axis=-1)


def test_names_of_objects_on_top_of_each_other_do_not_overlap() -> None:
    ids = np.full((480, 640), -1, np.int32)
    for k in range(4):
        ids[200:204, 300 + k] = k
    one = np.count_nonzero(boxes_of_names({0: "a mug"}, ids))
    assert np.count_nonzero(boxes_of_names(dict.fromkeys(range(4), "a mug"), ids)) > 3.7 * one


def test_names_stay_in_the_picture_and_unseen_objects_have_none() -> None:
    ids = np.full((120, 160), -1, np.int32)
    assert not boxes_of_names({0: "a mug"}, ids).any()
    ids[110:120, 0:4] = 0
    assert boxes_of_names({0: "a name that is much wider than the whole picture is"}, ids).any()


@pytest.mark.parametrize("corner", range(4))
def test_the_legend_goes_where_it_hides_least(corner: int) -> None:
    busy = np.ones((480, 640), bool)
    rows = slice(0, 240) if corner < 2 else slice(240, 480)
    columns = slice(0, 320) if corner % 2 == 0 else slice(320, 640)
    busy[rows, columns] = False
    rgb = np.zeros((480, 640, 3), np.uint8)
    entries = [("accepted", (0, 170, 130))]
    out = write_legend(rgb, entries, busy, ramp="p_hold", lines=["not visible: mug"])
    changed = np.any(out != rgb, axis=-1)
    assert changed.any() and not np.any(changed & busy)
    assert changed.mean() < 0.05  # small
    assert np.all(out == (0, 170, 130), axis=-1).any()
    assert np.all(out == overlay.score_color(1.0), axis=-1).any()


# --- Label maps as pictures: colours that mean what they say, and nothing where nothing is.

IDS = np.array([[-1, 0, 3], [3, 3, -1]])


def test_every_instance_has_the_colour_of_its_outline() -> None:
    picture = instance_picture(IDS)
    assert tuple(picture[0, 1]) == instance_color(0)
    assert tuple(picture[1, 0]) == instance_color(3)
    assert tuple(picture[0, 0]) == NOTHING


def test_a_photograph_stays_where_no_instance_is() -> None:
    picture = instance_picture(IDS, np.full((2, 3, 3), 200, np.uint8), strength=1.0)
    assert tuple(picture[0, 0]) == (200, 200, 200)
    assert tuple(picture[0, 2]) == instance_color(3)
    other = np.zeros((4, 3, 3), np.uint8)
    refused("photograph is 3x4 and the instances are 3x2", instance_picture, IDS, other)


def test_normals_towards_the_viewer_are_blue_upwards_green_rightwards_red() -> None:
    n = np.array([[[0, 0, -1], [0, -1, 0], [1, 0, 0], [0, 0, 0]]], np.float32)
    picture = normals_picture(n)
    assert [int(np.argmax(c)) for c in picture[0, :3]] == [2, 1, 0]
    assert tuple(picture[0, 3]) == NOTHING


def test_coordinates_run_over_the_box_of_the_model() -> None:
    box = np.array([[-0.1, 0.0, 0.2], [0.1, 0.5, 0.4]])
    ids = np.array([[5, 5, 5, -1]])
    at = np.stack([box[0], box[1], box.mean(0), np.zeros(3)])[None]
    picture = coordinates_picture(at, ids, {5: box})
    np.testing.assert_array_equal(picture[0, :3], [[0] * 3, [255] * 3, [128] * 3])
    assert tuple(picture[0, 3]) == NOTHING
    np.testing.assert_array_equal(coordinates_picture(at, ids)[0, :2], picture[0, :2])
    refused(r"instance 5 has no box", coordinates_picture, at, ids, {4: box})


def test_maps_of_another_kind_are_refused() -> None:
    refused(r"\(H, W, 3\) is accepted", normals_picture, np.zeros((4, 4)))
    refused("both must be of the same view", coordinates_picture, np.zeros((4, 4, 3)), IDS)
