"""Names, legends, hatching, and colours that stay apart without red-green vision."""

from itertools import combinations

import cv2
import numpy as np
import pytest

from realsim.rendering import overlay
from realsim.rendering.overlay_words import write_legend, write_names

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
    out = write_names(
        np.full((*ids.shape, 3), 200, np.uint8), ids, names, dict.fromkeys(names, (0, 255, 0))
    )
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
    out = write_legend(
        rgb, [("accepted", (0, 170, 130))], busy, ramp="p_hold", lines=["not visible: mug"]
    )
    changed = np.any(out != rgb, axis=-1)
    assert changed.any() and not np.any(changed & busy)
    assert changed.mean() < 0.05  # small
    assert np.all(out == (0, 170, 130), axis=-1).any()
    assert np.all(out == overlay.score_color(1.0), axis=-1).any()
