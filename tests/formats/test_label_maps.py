"""Label maps: round trips within a count, and zeros that mean 'nothing' alone."""

import numpy as np

from map_formulas import normal_counts
from realsim.formats import label_maps
from realsim.formats.bop import labels as bop_labels
from refusals import refused


def test_instances_come_back():
    ids = np.random.default_rng(0).integers(-1, 300, (20, 30)).astype(np.int32)
    np.testing.assert_array_equal(label_maps.instances_of(label_maps.instance_counts(ids)), ids)
    refused("65535 are in this view", label_maps.instance_counts, np.full((2, 2), 65535, np.int32))


def test_normals_come_back_and_nothing_stays_nothing():
    rng = np.random.default_rng(2)
    n = rng.normal(size=(40, 50, 3)).astype(np.float32)
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    n[0, :3] = [[0, 0, -1], [-1, 0, 0], [1, 0, 0]]
    n[5:9] = 0
    counts = normal_counts(n)
    assert not counts[5:9].any() and counts[:5].any(axis=-1).all()
    np.testing.assert_array_equal(counts[0, 0], [32768, 32768, 0])
    np.testing.assert_allclose(label_maps.normals_of(counts), n, atol=2e-5)


def test_run_lengths_of_a_window_are_those_of_the_image():
    rng = np.random.default_rng(3)
    for x, y, w, h in [(0, 0, 7, 5), (2, 0, 3, 5), (2, 1, 4, 3), (6, 4, 1, 1), (1, 1, 0, 0)]:
        for density in (0.0, 0.5, 1.0):
            window = rng.random((h, w)) < density
            image = np.zeros((5, 7), bool)
            image[y : y + h, x : x + w] = window
            rle = bop_labels.rle_of(window, origin=(x, y), shape=(5, 7))
            assert rle == bop_labels.rle_of(image)
            np.testing.assert_array_equal(bop_labels.mask_of(rle), image)
            area, box = bop_labels.rle_area_and_bbox(rle)
            assert area == image.sum() and box == bop_labels.bbox_of(image, inclusive=True)
    refused("reaches out", bop_labels.rle_of, np.ones((3, 3), bool), origin=(5, 0), shape=(5, 7))
