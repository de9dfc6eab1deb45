"""Every layout of images and poses that the documents list is read, and without being told."""

from pathlib import Path

import numpy as np
import pytest

from pose_layouts import LAYOUTS, PAIRS, folder_a_pose, layouts_read, save_images, tiny
from realsim.geometry import se3
from realsim_calibration.inputs import read_board_poses, read_image_folder
from refusals import refused

GUIDE = Path(__file__).parents[2] / "docs/how-to/calibrate-from-your-own-files.md"


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    return layouts_read(tmp_path_factory.mktemp("layouts"))


@pytest.mark.parametrize("name", [*LAYOUTS, *PAIRS])
def test_a_layout_is_read(result, name):
    assert result[name] == ""


def test_the_guide_lists_every_layout():
    rows = [line for line in GUIDE.read_text().splitlines() if line.startswith("| `")]
    listed = [row.split("`")[1] for row in rows]
    assert listed == [*LAYOUTS, *PAIRS] and len(listed) >= 16


def test_pairs_that_do_not_say_whose_they_are_are_refused(tmp_path):
    for name, text in (("a.json", '[{"A": [1], "B": [2]}]'), ("a.csv", "x,y,z\n1,2,3\n4,5,6\n")):
        (tmp_path / name).write_text(text)
        refused(r"does not say which.*object_wrt_sensor", read_board_poses, None, tmp_path / name)


def test_a_pose_folder_with_two_images_is_named(tmp_path):
    Ts = se3.random_transform(np.random.default_rng(0), 4, spread=0.5)
    folder_a_pose(tmp_path, Ts, [tiny(k) for k in range(4)])
    save_images(tmp_path / "pose_02", [tiny(9)], "second.png")
    refused(r"pose_02 holds 2 images.*second.png", read_image_folder, tmp_path, tmp_path)
