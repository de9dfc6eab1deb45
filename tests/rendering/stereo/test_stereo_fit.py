"""A stereo simulator fitted to planes makes planes that are as noisy and as torn."""

import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from grey_planes import grey_plane
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
    frames = [frame(DIM, "d405", z, k) for k, z in enumerate((0.2, 0.3))]
    fit = fit_stereo(frames, CAMERA, "d405")
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
