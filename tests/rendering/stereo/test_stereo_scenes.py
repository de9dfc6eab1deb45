"""What a stereo camera loses and where: shadows, blank surfaces, mirrors; and reproducibility.

A stereo simulator fitted to planes makes planes that are as noisy and as torn.
"""

import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from grey_planes import grey_plane, plane_noise
from plain_meshes import card
from realsim.geometry import camera as lens
from realsim.records import CameraIntrinsics
from realsim.rendering.appearance import Material
from realsim.rendering.depth_sensors.fit_pictures import stereo_fit_picture
from realsim.rendering.depth_sensors.profiles import DepthProfile, profile
from realsim.rendering.labels import LabelRenderer
from realsim.rendering.rays import PlacedMesh
from realsim.rendering.stereo import (
    FittedStereo,
    StereoCamera,
    StereoConfig,
    StereoDepth,
    fit_stereo,
)
from refusals import refused

CAMERA = CameraIntrinsics(width=360, height=240, fx=360, fy=360, cx=179.5, cy=119.5)
RICH = StereoConfig(texture_contrast=0.25)
BLANK = StereoConfig(texture_contrast=0.0)
FAR, NEAR = 0.8, 0.5
WIDE = replace(profile("d435"), pattern="none", quantum_px=0.0)


MATTE = Material(base_color=(0.6, 0.6, 0.6), roughness=1.0)
CARD_BEFORE_WALL = [grey_plane(CAMERA, FAR), card(0, NEAR, 0.08, MATTE)]


def seen(
    scene: list[PlacedMesh], camera: DepthProfile, config: StereoConfig, seed: int = 0
) -> StereoDepth:
    rng = np.random.default_rng(seed)
    return StereoCamera(scene, camera, config).measure(CAMERA, np.eye(4), rng)


def test_shadows_lie_left_of_near_things_and_nowhere_else() -> None:
    camera = replace(profile("d435"), quantum_px=0.0, baseline_m=0.05)
    hole = seen(CARD_BEFORE_WALL, camera, RICH).depth_m == 0
    # The card spans u = 179.5 +- 57.6, v = 119.5 +- 57.6; it hides fB (1/near - 1/far) columns.
    left, right, top, bottom = 122, 237, 62, 177
    shadow = int(360 * 0.05 * (1 / NEAR - 1 / FAR))
    assert shadow == 13
    rows = slice(top + 8, bottom - 8)
    # The edge of the card is fattened into its shadow by up to half a window.
    assert hole[rows, left - shadow + 1 : left - 4].mean() > 0.8
    slack = 6
    elsewhere = np.ones(hole.shape, bool)
    elsewhere[top - slack : bottom + slack, left - shadow - slack : left + slack] = False
    elsewhere[:, : int(360 * 0.05 / FAR) + slack] = False  # left of the second eye's picture
    elsewhere[:, -slack:] = False
    assert hole[elsewhere].mean() < 0.01
    assert hole[rows, right + 4 : right + 4 + shadow].mean() < 0.05
    assert hole[top - 4 - shadow : top - 4, left:right].mean() < 0.05


def test_a_blank_wall_has_no_depth_until_dots_fall_on_it() -> None:
    def fill(name: str, config: StereoConfig) -> float:
        depth = seen([grey_plane(CAMERA, 0.6)], profile(name), config).depth_m
        return float(np.mean(depth[10:-10, 50:-10] > 0))

    assert fill("d405", BLANK) < 0.1
    assert fill("d405", RICH) > 0.98
    assert fill("d435", BLANK) > 0.98
    assert fill("d435", replace(BLANK, dot_power=0.0)) < 0.1


def test_a_highlight_of_polished_metal_misleads_or_is_lost_and_matte_paint_is_not() -> None:
    def good(material: Material) -> float:
        scene = [grey_plane(CAMERA, FAR), card(0, NEAR, 0.1, material)]
        on = seen(scene, WIDE, StereoConfig()).depth_m[80:160, 140:220]
        return float(np.mean(np.abs(on - NEAR) < 0.005))

    assert good(MATTE) > 0.98
    assert good(Material(base_color=(0.9, 0.9, 0.9), metallic=1.0, roughness=0.1)) < 0.5


def test_dark_things_far_away_are_lost_by_structured_light() -> None:
    def fill(grey: float, z: float) -> float:
        paint = Material(base_color=(grey,) * 3, roughness=1.0)
        d = seen([card(0, z, z, paint)], profile("structured_light"), StereoConfig()).depth_m
        return float(np.mean(d[40:-40, 60:-40] > 0))

    assert fill(0.5, 0.6) == 1.0 and fill(0.5, 2.0) == 1.0
    assert fill(0.01, 0.6) > 0.9 and fill(0.01, 2.0) < 0.1


def test_the_same_seed_gives_the_same_bytes_and_another_does_not() -> None:
    camera = StereoCamera(CARD_BEFORE_WALL, profile("d435"), RICH)
    first, again, other = (
        camera.measure(CAMERA, np.eye(4), np.random.default_rng(seed)) for seed in (5, 5, 6)
    )
    for b in (again, seen(CARD_BEFORE_WALL, profile("d435"), RICH, seed=5)):
        assert first.depth_m.tobytes() == b.depth_m.tobytes()
        assert first.left.tobytes() == b.left.tobytes()
        assert first.right.tobytes() == b.right.tobytes()
    assert first.left.tobytes() != other.left.tobytes()


def test_a_distorted_camera_reports_depth_on_its_raw_pixels() -> None:
    raw = replace(CAMERA, distortion=[-0.15, 0.05])
    exact = LabelRenderer(CARD_BEFORE_WALL).render(raw, np.eye(4)).depth_m
    rng = np.random.default_rng(0)
    found = StereoCamera(CARD_BEFORE_WALL, WIDE, RICH).measure(raw, np.eye(4), rng)
    assert found.depth_m.shape == (240, 360)
    known = (found.depth_m > 0) & (exact > 0)
    assert known[:, 40:].mean() > 0.9
    assert np.mean(np.abs(found.depth_m - exact)[known] < 0.01) > 0.96
    # The card's corners bulge: the undistorted camera would miss the border by 3 px there.
    assert abs(lens.project(raw, np.array([[0.08, 0.08, NEAR]]))[0][0] - (179.5 + 57.6)) > 0.4


def test_moving_the_world_and_the_camera_together_changes_nothing() -> None:
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    T[:3, 3] = [0.3, -0.2, 0.1]
    moved = [replace(p, T_world_obj=T @ p.T_world_obj) for p in CARD_BEFORE_WALL]
    dark = replace(RICH, ambient=0.0)  # the room's light does not move with them
    here, there = (
        StereoCamera(scene, profile("d435"), dark).measure(CAMERA, pose, np.random.default_rng(0))
        for scene, pose in ((CARD_BEFORE_WALL, np.eye(4)), (moved, T))
    )
    both = (here.depth_m > 0) & (there.depth_m > 0)
    assert both.mean() > 0.8
    assert np.mean(np.abs(here.depth_m - there.depth_m)[both] < 1e-3) > 0.99


def test_what_a_configuration_cannot_be_is_named() -> None:
    for field, value in (("window_px", 8), ("full_well", 0.0), ("mean_level", 1.5),
                         ("read_noise", -1.0), ("texture_contrast", float("nan"))):  # fmt: skip
        refused(field if field != "window_px" else "window", StereoConfig, **{field: value})


# --- fits -----------------------------------------------------------------------------------------


LONG = CameraIntrinsics(width=420, height=280, fx=640, fy=640, cx=209.5, cy=139.5)


def frame(config: StereoConfig, kind: str, z: float, seed: int) -> np.ndarray:
    """Return a tilted plane as a camera of this configuration reports it, in counts of its unit."""
    scene = [grey_plane(LONG, z, 8.0 * (-1) ** seed, 5.0)]
    seen = StereoCamera(scene, profile(kind), config).measure(
        LONG, np.eye(4), np.random.default_rng(seed)
    )
    unit = np.float32(profile(kind).depth_unit_m)
    return np.round(seen.depth_m / unit) * unit


DIM = StereoConfig(full_well=3000.0, least_texture_snr=2.6)


@lru_cache(maxsize=1)
def stripes_fit() -> FittedStereo:
    true = StereoConfig(stripe_noise_px=0.11)
    frames = [frame(true, "structured_light", z, k) for k, z in enumerate((0.5, 0.9))]
    return fit_stereo(frames, LONG, "structured_light")


@pytest.mark.slow
def test_a_known_sensors_statistics_are_recovered() -> None:
    fit = fit_stereo([frame(DIM, "d405", z, k) for k, z in enumerate((0.2, 0.3))], LONG, "d405")
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
    notes = " ".join(fit_stereo([noisy], LONG, "d405").notes)
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
    refused("0 frames", fit_stereo, [], LONG, "d405")
    refused("millimetres", fit_stereo, [good * 1000], LONG, "d405")
    refused("the camera 420x280", fit_stereo, [good[:200]], LONG, "d405")
    other = tmp_path / "sensor.json"
    other.write_text(json.dumps({"format": "realsim depth sensor 1", "model": {}}))
    refused("--simulator stereo", StereoConfig.load, other)
    document = replace(StereoConfig(), full_well=5.0).document()
    document["config"]["window_px"] = 6
    other.write_text(json.dumps(document))
    refused("window", StereoConfig.load, other)


# --- Laws of matching on planes: no bias, no pixel-locking, noise as the geometry says.

LAW_CAMERA = replace(CAMERA, fx=640, fy=640)
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
