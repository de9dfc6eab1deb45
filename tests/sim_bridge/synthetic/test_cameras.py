"""Cameras of synthetic views: where they stand, where they look, how evenly they are spread."""

import numpy as np
import pytest

from realsim import InputError
from realsim_sim_bridge.synthetic.cameras import hemisphere_cameras

CENTER = np.array([0.4, -0.2, 0.1])


def spread(count=200, seed=0, elevation_deg=(15.0, 85.0)):
    rng = np.random.default_rng(seed)
    return hemisphere_cameras(CENTER, (0.5, 0.8), count, rng, elevation_deg)


def directions(Ts):
    away = Ts[:, :3, 3] - CENTER
    return away / np.linalg.norm(away, axis=1, keepdims=True)


def test_cameras_stand_within_the_asked_distances_and_elevations():
    Ts = spread()
    away = np.linalg.norm(Ts[:, :3, 3] - CENTER, axis=1)
    assert away.min() >= 0.5 and away.max() <= 0.8
    assert away.min() < 0.53 and away.max() > 0.77
    elevation = np.degrees(np.arcsin(directions(Ts)[:, 2]))
    assert elevation.min() >= 15 - 1e-9 and elevation.max() <= 85 + 1e-9


def test_the_picture_stands_upright_and_the_center_is_ahead():
    Ts = spread()
    assert np.abs(Ts[:, 2, 0]).max() < 1e-12  # x axis level
    assert (Ts[:, 2, 1] < 0).all()  # y axis down
    to_center = -directions(Ts)
    angle = np.degrees(np.arccos(np.sum(Ts[:, :3, 2] * to_center, axis=1)))
    assert angle.max() < 10 and angle.mean() > 1


def test_equal_areas_of_the_band_get_equal_numbers():
    found = directions(spread(2000))
    height = found[:, 2]
    low, high = np.sin(np.radians([15, 85]))
    counts, _ = np.histogram(height, np.linspace(low, high, 11))
    assert counts.min() >= 190 and counts.max() <= 210
    azimuth = np.arctan2(*found[:, 1::-1].T)
    counts, _ = np.histogram(azimuth, np.linspace(-np.pi, np.pi, 9))
    assert counts.min() > 225 and counts.max() < 275


def test_the_same_seed_gives_the_same_cameras_and_another_one_others():
    assert np.array_equal(spread(20, 3), spread(20, 3))
    assert not np.allclose(spread(20, 3), spread(20, 4))


def test_what_cannot_be_is_refused():
    for radius, count, elevation in (
        ((0.5, 0.4), 5, (15, 85)), ((0, 1), 5, (15, 85)), ((0.4, 0.5), 0, (15, 85)),
        ((0.4, 0.5), 5, (50, 20)),
    ):  # fmt: skip
        with pytest.raises(InputError, match="accepted"):
            hemisphere_cameras(CENTER, radius, count, np.random.default_rng(0), elevation)
