"""The figures of a plane: what a fit compares, on noise whose figures are known."""

import numpy as np
import pytest

from realsim.errors import InputError
from realsim.records import CameraIntrinsics
from realsim.rendering.depth_sensors.noise import correlated
from realsim.rendering.depth_sensors.profiles import profile
from realsim.rendering.stereo import StereoConfig, disparity_statistics, plane_statistics

CAMERA = CameraIntrinsics(width=240, height=180, fx=400, fy=400, cx=119.5, cy=89.5)


@pytest.mark.parametrize("radius", [1.5, 3.0])
def test_known_noise_on_a_tilted_plane_is_found_again(radius: float) -> None:
    rng = np.random.default_rng(0)
    u, v = np.meshgrid(np.arange(640.0), np.arange(480.0))
    d = 20 + 0.01 * u - 0.02 * v + 0.08 * correlated(rng, (480, 640), radius)
    d[rng.random(d.shape) < 0.1] = 0
    d[200:204, 300:304] = 60  # a wrong match is not noise
    sigma, holes, correlation = disparity_statistics(d, 20.0)
    assert sigma == pytest.approx(0.08, rel=0.08)
    assert holes == pytest.approx(0.1, abs=0.005)
    assert correlation == pytest.approx(radius, rel=0.1)


def test_a_configuration_is_summed_up_and_repeats() -> None:
    config = StereoConfig()
    first, again = (
        plane_statistics(config, profile("d405"), CAMERA, 0.25, np.random.default_rng(3))
        for _ in range(2)
    )
    assert first == again
    sigma, holes, correlation = first
    # Intel's usual figure is 0.08 px; the windows share pixels, so neighbours share noise.
    assert 0.04 < sigma < 0.16 and holes < 0.02 and 0.5 < correlation < 4


def test_less_texture_means_more_holes() -> None:
    holes = [
        plane_statistics(
            StereoConfig(texture_contrast=c), profile("d405"), CAMERA, 0.25,
            np.random.default_rng(0),
        )[1]
        for c in (0.15, 0.04, 0.0)
    ]  # fmt: skip
    assert holes[0] < 0.02 < holes[1] < holes[2] and holes[2] > 0.9


def test_a_plane_that_is_not_measured_has_no_noise() -> None:
    sigma, holes, correlation = disparity_statistics(np.zeros((100, 100)), 5.0)
    assert np.isnan(sigma) and holes == 1.0 and np.isnan(correlation)
    with pytest.raises(InputError, match="positive"):
        plane_statistics(StereoConfig(), profile("d405"), CAMERA, -1.0, np.random.default_rng(0))
