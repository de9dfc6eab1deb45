"""A stereo simulator fitted to planes makes planes that are as noisy and as torn."""

import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from grey_planes import grey_plane, plane_noise
from realsim.records import CameraIntrinsics
from realsim.rendering.depth_sensors.fit_pictures import stereo_fit_picture
from realsim.rendering.depth_sensors.profiles import profile
from realsim.rendering.stereo import FittedStereo, StereoCamera, StereoConfig, fit_stereo
from refusals import refused

CAMERA = CameraIntrinsics(width=420, height=280, fx=640, fy=640, cx=209.5, cy=139.5)


def frame(config: StereoConfig, kind: str, z: float, seed: int) -> np.ndarray:
    """Return a tilted plane as a camera of this configuration reports it, in counts of its unit."""
    scene = [grey_plane(CAMERA, z, 8.0 * (-1) ** seed, 5.0)]
    seen = StereoCamera(scene, profile(kind), config).measure(
        CAMERA, np.eye(4), np.random.default_rng(seed)
    )
    unit = np.float32(profile(kind).depth_unit_m)
    return np.round(seen.depth_m / unit) * unit


DIM = StereoConfig(full_well=3000.0, least_texture_snr=2.6)


@lru_cache(maxsize=1)
def stripes_fit() -> FittedStereo:
    true = StereoConfig(stripe_noise_px=0.11)
    frames = [frame(true, "structured_light", z, k) for k, z in enumerate((0.5, 0.9))]
    return fit_stereo(frames, CAMERA, "structured_light")


@pytest.mark.slow
def test_a_known_sensors_statistics_are_recovered() -> None:
    fit = fit_stereo([frame(DIM, "d405", z, k) for k, z in enumerate((0.2, 0.3))], CAMERA, "d405")
    assert fit.config.full_well == pytest.approx(DIM.full_well, rel=0.2)
    assert fit.config.least_texture_snr == pytest.approx(DIM.least_texture_snr, rel=0.1)
    for f in fit.frames:
        assert f.measured.hole_share > 0.1
        assert f.simulated.sigma_px == pytest.approx(f.measured.sigma_px, rel=0.08)
        assert f.simulated.hole_share == pytest.approx(f.measured.hole_share, abs=0.04)
    assert not any("cannot be met" in n for n in fit.notes)


def test_noise_of_stripes_is_recovered_and_thresholds_without_evidence_stay() -> None:
    fit = stripes_fit()
    assert fit.config.stripe_noise_px == pytest.approx(0.11, rel=0.08)
    assert fit.config.least_signal == StereoConfig().least_signal


def test_what_the_simulator_cannot_do_is_said() -> None:
    rng = np.random.default_rng(0)
    exact = np.full((280, 420), 0.3)
    d = 640 * 0.018 / exact + 0.6 * rng.standard_normal(exact.shape)
    noisy = (640 * 0.018 / d).astype(np.float32)
    noisy[rng.random(exact.shape) < 0.4] = 0
    notes = " ".join(fit_stereo([noisy], CAMERA, "d405").notes)
    assert "noise cannot be met in 1 of 1 frames" in notes and "--simulator disparity" in notes
    assert "holes cannot be met" in notes or "is the simulator's own" in notes


def test_a_fit_is_written_loaded_and_drawn(tmp_path: Path) -> None:
    fit = stripes_fit()
    path = tmp_path / "stereo.json"
    path.write_text(json.dumps(fit.document(), allow_nan=False))
    assert StereoConfig.load(path) == fit.config
    assert stereo_fit_picture(fit).startswith(b"\x89PNG")


def test_mistakes_are_named(tmp_path: Path) -> None:
    good = frame(StereoConfig(), "d405", 0.3, 0)
    refused("0 frames", fit_stereo, [], CAMERA, "d405")
    refused("millimetres", fit_stereo, [good * 1000], CAMERA, "d405")
    refused("the camera 420x280", fit_stereo, [good[:200]], CAMERA, "d405")
    other = tmp_path / "sensor.json"
    other.write_text(json.dumps({"format": "realsim depth sensor 1", "model": {}}))
    refused("--simulator stereo", StereoConfig.load, other)
    document = replace(StereoConfig(), full_well=5.0).document()
    document["config"]["window_px"] = 6
    other.write_text(json.dumps(document))
    refused("window", StereoConfig.load, other)


# --- Laws of matching on planes: no bias, no pixel-locking, noise as the geometry says.

LAW_CAMERA = CameraIntrinsics(width=360, height=240, fx=640, fy=640, cx=179.5, cy=119.5)
QUIET = StereoConfig(full_well=1e8, read_noise=0.0, texture_contrast=0.25, least_texture_snr=1.0)
PASSIVE = replace(profile("d405"), quantum_px=0.0, min_z_m=0.05, max_z_m=5.0)


@lru_cache(maxsize=16)
def disparities(z: float, tilt: float, turn: float) -> tuple[np.ndarray, np.ndarray]:
    """Return measured and true disparity of a plane away from the image's border."""
    camera = StereoCamera([grey_plane(LAW_CAMERA, z, tilt, turn)], PASSIVE, QUIET)
    measured = camera.measure(LAW_CAMERA, np.eye(4), np.random.default_rng(0)).disparity_px
    u, v = np.meshgrid(np.arange(360.0), np.arange(240.0))
    x, y = (u - LAW_CAMERA.cx) / LAW_CAMERA.fx, (v - LAW_CAMERA.cy) / LAW_CAMERA.fy
    a, b = np.radians(tilt), np.radians(turn)
    # The plane's normal is Rx(a) Ry(b) z; it goes through (0, 0, z).
    n = np.array([np.sin(b), -np.sin(a) * np.cos(b), np.cos(a) * np.cos(b)])
    exact = LAW_CAMERA.fx * PASSIVE.baseline_m / z * (n[0] * x + n[1] * y + n[2]) / n[2]
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
    sigma = plane_noise(StereoConfig(), camera, LAW_CAMERA, z, np.random.default_rng(1))
    return z * z * sigma / (LAW_CAMERA.fx * baseline)


def test_depth_noise_grows_with_the_square_of_the_distance() -> None:
    # Octaves of the texture: at twice the distance the pixels see the same contrast again.
    assert sigma_z(0.6, 0.018) / sigma_z(0.3, 0.018) == pytest.approx(4.0, rel=0.15)


def test_noise_falls_with_light_and_window_and_texture() -> None:
    def sigma(**changes: float) -> float:
        config = replace(StereoConfig(), **changes)
        return plane_noise(config, PASSIVE, LAW_CAMERA, 0.4, np.random.default_rng(2))

    usual = sigma()
    # Four times the electrons: half the shot noise; rounding to bytes and read noise stay.
    assert sigma(full_well=40000.0) / usual == pytest.approx(0.5, abs=0.1)
    assert sigma(window_px=11) < 0.8 * usual
    assert sigma(texture_contrast=0.3) / usual == pytest.approx(0.5, abs=0.12)
    assert sigma(noise_floor_px=0.2) == pytest.approx(np.hypot(0.2, usual), rel=0.1)


def test_the_range_ends_and_is_nearer_for_fewer_pixels() -> None:
    config, narrow = StereoConfig(), replace(PASSIVE, min_z_m=0.9, max_z_m=1.2)
    # 360 of 1280 columns: 0.9 m becomes 0.253 m.
    for z, share in ((0.23, 0.0), (0.30, 1.0), (1.1, 1.0), (1.4, 0.0)):
        camera = StereoCamera([grey_plane(LAW_CAMERA, z)], narrow, config)
        depth = camera.measure(LAW_CAMERA, np.eye(4), np.random.default_rng(0)).depth_m
        assert np.mean(depth[:, 60:] > 0) == pytest.approx(share, abs=0.1), z
