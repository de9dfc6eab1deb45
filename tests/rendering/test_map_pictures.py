"""Label maps as pictures: colours that mean what they say, and nothing where nothing is."""

import numpy as np
import pytest

from realsim.errors import InputError
from realsim.rendering.map_pictures import (
    NOTHING,
    coordinates_picture,
    instance_picture,
    normals_picture,
)
from realsim.rendering.overlay import instance_color
from refusals import refused

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
    with pytest.raises(InputError, match=r"photograph is 3x4 and the instances are 3x2"):
        instance_picture(IDS, np.zeros((4, 3, 3), np.uint8))


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
