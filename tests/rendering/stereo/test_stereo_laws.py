"""Laws of matching on planes: no bias, no pixel-locking, noise as the geometry says."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from grey_planes import grey_plane, plane_noise
from realsim.records import CameraIntrinsics
from realsim.rendering.depth_sensors.profiles import profile
from realsim.rendering.stereo import StereoCamera, StereoConfig

CAMERA = CameraIntrinsics(width=360, height=240, fx=640, fy=640, cx=179.5, cy=119.5)
QUIET = StereoConfig(full_well=1e8, read_noise=0.0, texture_contrast=0.25, least_texture_snr=1.0)
PASSIVE = replace(profile("d405"), quantum_px=0.0, min_z_m=0.05, max_z_m=5.0)


@lru_cache(maxsize=16)
def disparities(z: float, tilt: float, turn: float) -> tuple[np.ndarray, np.ndarray]:
    """Return measured and true disparity of a plane away from the image's border."""
    camera = StereoCamera([grey_plane(CAMERA, z, tilt, turn)], PASSIVE, QUIET)
    measured = camera.measure(CAMERA, np.eye(4), np.random.default_rng(0)).disparity_px
    u, v = np.meshgrid(np.arange(360.0), np.arange(240.0))
    x, y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    a, b = np.radians(tilt), np.radians(turn)
    # The plane's normal is Rx(a) Ry(b) z; it goes through (0, 0, z).
    n = np.array([np.sin(b), -np.sin(a) * np.cos(b), np.cos(a) * np.cos(b)])
    exact = CAMERA.fx * PASSIVE.baseline_m / z * (n[0] * x + n[1] * y + n[2]) / n[2]
    inner = np.s_[10:-10, 60:-10]
    return measured[inner], exact[inner]


@pytest.mark.parametrize("z", [0.315, 0.6])
def test_a_facing_plane_has_its_disparity(z: float) -> None:
    measured, exact = disparities(z, 0.0, 0.0)
    assert np.mean(measured > 0) > 0.999
    error = measured[measured > 0] - exact[measured > 0]
    assert abs(error.mean()) < 0.02
    assert np.sqrt(np.mean(error**2)) < 0.04


@pytest.mark.parametrize(("tilt", "turn"), [(40.0, 0.0), (0.0, 40.0)])
def test_a_tilted_plane_has_its_disparity_without_a_staircase(tilt: float, turn: float) -> None:
    measured, exact = disparities(0.4, tilt, turn)
    assert np.mean(measured > 0) > 0.98
    error = measured[measured > 0] - exact[measured > 0]
    assert abs(error.mean()) < 0.05
    assert np.sqrt(np.mean(error**2)) < 0.1
    # Pixel-locking shows in the sub-pixel part: more pixels near whole numbers than there should
    # be, and an error that goes up and down with it.
    part, true_part = measured[measured > 0] % 1, exact[measured > 0] % 1
    found = np.histogram(part, 16, (0, 1))[0] / len(part) * 16
    assert 0.7 < found.min() and found.max() < 1.4
    by_part = [error[(true_part >= f) & (true_part < f + 1 / 8)].mean() for f in np.arange(8) / 8]
    assert np.ptp(by_part) < 0.06


def sigma_z(z: float, baseline: float) -> float:
    camera = replace(PASSIVE, baseline_m=baseline)
    sigma = plane_noise(StereoConfig(), camera, CAMERA, z, np.random.default_rng(1))
    return z * z * sigma / (CAMERA.fx * baseline)


def test_depth_noise_grows_with_the_square_of_the_distance() -> None:
    # Octaves of the texture: at twice the distance the pixels see the same contrast again.
    assert sigma_z(0.6, 0.018) / sigma_z(0.3, 0.018) == pytest.approx(4.0, rel=0.15)


def test_noise_falls_with_light_and_window_and_texture() -> None:
    def sigma(**changes: float) -> float:
        config = replace(StereoConfig(), **changes)
        return plane_noise(config, PASSIVE, CAMERA, 0.4, np.random.default_rng(2))

    usual = sigma()
    # Four times the electrons: half the shot noise; rounding to bytes and read noise stay.
    assert sigma(full_well=40000.0) / usual == pytest.approx(0.5, abs=0.1)
    assert sigma(window_px=11) < 0.8 * usual
    assert sigma(texture_contrast=0.3) / usual == pytest.approx(0.5, abs=0.12)
    floor = sigma(noise_floor_px=0.2)
    assert floor == pytest.approx(np.hypot(0.2, usual), rel=0.1)


def test_the_range_ends_and_is_nearer_for_fewer_pixels() -> None:
    config, narrow = StereoConfig(), replace(PASSIVE, min_z_m=0.9, max_z_m=1.2)
    # 360 of 1280 columns: 0.9 m becomes 0.253 m.
    for z, share in ((0.23, 0.0), (0.30, 1.0), (1.1, 1.0), (1.4, 0.0)):
        camera = StereoCamera([grey_plane(CAMERA, z)], narrow, config)
        depth = camera.measure(CAMERA, np.eye(4), np.random.default_rng(0)).depth_m
        assert np.mean(depth[:, 60:] > 0) == pytest.approx(share, abs=0.1), z
