"""The depth camera's laws: noise, bias, shadows, and reproducibility."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from realsim.records import CameraIntrinsics
from realsim.rendering.depth_sensors.edges import edges_of
from realsim.rendering.depth_sensors.fit import FittedDepthModel, fit_depth_model
from realsim.rendering.depth_sensors.fit_pictures import fit_picture
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.depth_sensors.plane import find_plane
from realsim.rendering.depth_sensors.statistics import disparity_step, hole_share, local_noise
from refusals import refused

CAMERA = CameraIntrinsics(width=320, height=240, fx=320, fy=320, cx=159.5, cy=119.5)
EXACT, COARSE = DepthSensorModel.noiseless(), DepthSensorModel.noiseless(1 / 32)


def flat(z: float) -> np.ndarray:
    return np.full((240, 320), z, np.float32)


def with_a_box() -> np.ndarray:
    depth = flat(0.6)
    depth[80:160, 120:200] = 0.3
    return depth


@pytest.mark.parametrize(("z", "correlation"), [(0.15, 0.0), (0.6, 2.0)])
def test_sigma_z_grows_with_the_square_of_depth(z: float, correlation: float) -> None:
    model = replace(EXACT, disparity_noise_px=0.08, correlation_px=correlation)
    measured = model.measure(flat(z), CAMERA, np.random.default_rng(1))
    law = z * z * 0.08 / (320 * 0.018)
    assert measured.std() == pytest.approx(law, rel=0.10)
    assert model.sigma_z(z, CAMERA) == pytest.approx(law)


def test_neighbouring_noise_is_alike_only_when_correlated() -> None:
    def correlation(sigma: float) -> float:
        model = replace(EXACT, disparity_noise_px=0.08, correlation_px=sigma)
        z = model.measure(flat(0.4), CAMERA, np.random.default_rng(2))
        return float(np.corrcoef(z[:, 1:].ravel(), z[:, :-1].ravel())[0, 1])

    assert abs(correlation(0.0)) < 0.02
    # A Gaussian window of sigma s gives neighbours the correlation exp(-1 / (4 s^2)).
    assert correlation(2.0) == pytest.approx(np.exp(-1 / 16), abs=0.02)


def test_bias_law() -> None:
    model = replace(EXACT, bias_px=0.5)
    for z in (0.2, 0.5):
        measured = model.measure(flat(z), CAMERA, np.random.default_rng(0))
        fB = 320 * 0.018
        assert np.allclose(measured, fB / (fB / z + 0.5), rtol=1e-5)


def test_without_faults_depth_is_the_identity_up_to_the_quantum() -> None:
    depth = np.random.default_rng(0).uniform(0.1, 1.2, (240, 320)).astype(np.float32)
    assert np.allclose(EXACT.measure(depth, CAMERA, np.random.default_rng(0)), depth, rtol=1e-6)
    coarse = COARSE.measure(depth, CAMERA, np.random.default_rng(0))
    d, q = 320 * 0.018 / depth, 320 * 0.018 / coarse
    assert np.abs(q - d).max() <= 1 / 64 + 1e-4
    assert np.abs(q * 32 - np.round(q * 32)).max() < 1e-3


def test_nothing_stays_nothing_and_the_range_ends() -> None:
    depth = flat(0.3)
    depth[:50] = 0
    depth[50:60] = 0.05
    depth[60:70] = 2.5
    model = replace(DepthSensorModel(), bias_px=0.3)
    measured = model.measure(depth, CAMERA, np.random.default_rng(3))
    assert np.all(measured[:50] == 0)
    # At the steps themselves matches between the two surfaces may come into range.
    assert np.all(measured[51:59] == 0) and np.all(measured[61:69] == 0)
    assert measured.dtype == np.float32
    assert np.mean(measured[70:] > 0) > 0.85
    seen = measured[measured > 0]
    assert seen.min() >= 0.07 and seen.max() <= 1.5


def test_the_shadow_lies_to_the_left_and_is_as_wide_as_the_step_in_disparity() -> None:
    model = replace(EXACT, occlusion=True)
    lost = model.measure(with_a_box(), CAMERA, np.random.default_rng(0)) == 0
    d_near, d_far = 320 * 0.018 / 0.3, 320 * 0.018 / 0.6
    row = np.flatnonzero(lost[120])
    shadow = row[row > 50]
    assert shadow.max() == 119  # it ends where the box begins
    assert len(shadow) == pytest.approx(d_near - d_far, abs=1.0)
    border = row[row < 50]
    assert len(border) == pytest.approx(d_far, abs=1.0) and border[0] == 0
    assert not lost[:80, 20:].any()


def test_only_edges_suffer_from_edge_faults() -> None:
    model = replace(EXACT, edge_dropout=0.4, edge_flying=0.3)
    measured = model.measure(with_a_box(), CAMERA, np.random.default_rng(7))
    near_edge = np.zeros((240, 320), bool)
    near_edge[79:161, 119:201] = True
    near_edge[81:159, 121:199] = False
    lost = measured == 0
    between = (measured > 0.301) & (measured < 0.599)
    assert not np.any((lost | between) & ~near_edge)
    assert lost[near_edge].mean() == pytest.approx(0.4, abs=0.1)
    assert between[near_edge].mean() == pytest.approx(0.3, abs=0.1)


def test_surfaces_seen_edge_on_are_lost() -> None:
    model = replace(EXACT, grazing_from_deg=70.0, grazing_to_deg=85.0)

    def share(tilt_deg: float) -> float:
        # The plane n . X = 0.4 with n tilted about the x axis, small so that the angle is even.
        i = CameraIntrinsics(width=320, height=240, fx=3200, fy=3200, cx=159.5, cy=119.5)
        v = (np.arange(240) - 119.5)[:, None] / 3200
        t = np.radians(tilt_deg)
        depth = np.broadcast_to(0.4 * np.cos(t) / (np.cos(t) + v * np.sin(t)), (240, 320))
        out = model.measure(depth.astype(np.float32), i, np.random.default_rng(1))
        return float(np.mean(out == 0))

    assert share(60.0) == 0.0
    assert share(77.5) == pytest.approx(0.5, abs=0.12)
    assert share(87.5) > 0.9


# --- The default depth camera gives the bytes it has always given, and loads what it writes.

SMALL_CAMERA = CameraIntrinsics(width=160, height=120, fx=160, fy=160, cx=79.5, cy=59.5)
WHITE = DepthSensorModel(
    disparity_noise_px=0.03, quantum_px=1 / 80, edge_jump_px=0.4, bias_px=0.2, correlation_px=0
)


HEAD = '{"format": "realsim depth sensor 1"'


def tilted_with_a_box() -> np.ndarray:
    v, u = np.mgrid[:120, :160]
    depth = (0.6 / (1 + 0.002 * (v - 60) + 0.001 * (u - 80))).astype(np.float32)
    depth[30:80, 50:100] = 0.3
    depth[:6] = 0
    depth[90:, 120:] = (0.6 / (1 + np.arange(40) * 0.9))[None]
    return depth


@pytest.mark.parametrize(
    ("model", "digest"),
    [
        (DepthSensorModel(), "5bec6a4e236b7a7add9dbfb135c129b3dc60615450d969a4f64c8b4e723e228b"),
        (COARSE, "4ff30763909fd153c564044751807868ba807c5d51c9676c1e85810bccf320f5"),
        (WHITE, "c1028aeebcf69e988d088e4cd2cbf6899a0229acc2b0ad3f7d040a5cf42928fe"),
    ],
)
def test_faults_that_are_off_change_no_byte(model: DepthSensorModel, digest: str) -> None:
    measured = model.measure(tilted_with_a_box(), SMALL_CAMERA, np.random.default_rng(11))
    assert hashlib.sha256(measured.tobytes()).hexdigest() == digest


@pytest.mark.parametrize("name", ["d405", "d415", "d435", "structured_light"])
def test_a_profile_written_and_loaded_is_the_same(name: str, tmp_path: Path) -> None:
    model = DepthSensorModel.from_profile(name, disparity_noise_px=0.123)
    (tmp_path / "sensor.json").write_text(json.dumps(model.document()))
    assert DepthSensorModel.load(tmp_path / "sensor.json") == model
    assert model.disparity_noise_px == 0.123


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "is not valid JSON"),
        ("[1]", "no depth sensor model"),
        (HEAD + ', "model": {"colour": 1}}', "has no 'colour'"),
        (HEAD + ', "model": {"baseline_m": "0.018"}}', "finite float"),
        (HEAD + ', "model": {"baseline_m": 18}}', "millimetres"),
        (HEAD + ', "model": {"border": 1}}', "finite bool"),
        (HEAD + ', "model": {"quantum_px": NaN}}', "NaN at model.quantum_px"),
        (HEAD + f', "model": {{"quantum_px": {10**309}}}}}', "finite float"),
        (HEAD + "}", "no object 'model'"),
    ],
)
def test_a_wrong_file_is_named(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "sensor.json"
    path.write_text(text)
    refused(said, DepthSensorModel.load, path)


def test_wrong_fields_profiles_and_images_are_named() -> None:
    refused("there is no depth camera 'd999'", DepthSensorModel.from_profile, "d999")
    refused("has no 'noise'", DepthSensorModel.from_profile, "d405", noise=1.0)
    for wrong in ({"depth_unit_m": 1.0}, {"baseline_m": 18.0}):
        refused("millimetres", DepthSensorModel, **wrong)
    rng = np.random.default_rng(0)
    refused("the camera 320x240", EXACT.measure, np.ones((10, 10)), CAMERA, rng)


# --- fits: what a sensor was is what its pictures of a plane say, or say they cannot -------------


WIDE = CameraIntrinsics(width=400, height=300, fx=380, fy=380, cx=199.5, cy=149.5)
SOFT = DepthSensorModel.from_profile(
    "d405", disparity_noise_px=0.05, correlation_px=1.2, correlation_aspect=1.0,
    blobs_per_megapixel=80, blob_radius_px=4.0,
)  # fmt: skip


def wall(z: float, tilt_u: float = 0.3, tilt_v: float = 0.2) -> np.ndarray:
    """Return the exact depth of a plane with the normal (tilt_u, tilt_v, 1)."""
    v, u = np.mgrid[:300, :400]
    return (z / (1 + tilt_u * (u - 199.5) / 380 + tilt_v * (v - 149.5) / 380)).astype(np.float32)


WALLS = (wall(0.3, 0.3, 0.2), wall(0.5, 0.1, -0.3))


def frames_of(model: DepthSensorModel, exact: Sequence[np.ndarray] = WALLS) -> list[np.ndarray]:
    return [model.measure(z, WIDE, np.random.default_rng(k)) for k, z in enumerate(exact)]


@lru_cache
def fitted(model: DepthSensorModel, kind: str = "d405") -> FittedDepthModel:
    return fit_depth_model(frames_of(model), WIDE, kind)


def test_parameters_are_recovered_within_their_uncertainty() -> None:
    fit = fitted(SOFT)
    for name in ("disparity_noise_px", "correlation_px", "correlation_aspect", "quantum_px",
                 "slow_noise_px", "column_band_px", "native_pitch_px"):  # fmt: skip
        estimate = fit.estimates[name]
        true = getattr(SOFT, name)
        assert estimate.determined, name
        assert abs(estimate.value - true) <= 3 * estimate.uncertainty, name
        # An uncertainty that is too great would make this law empty.
        assert estimate.uncertainty <= max(0.15 * true, 0.3 if name == "correlation_px" else 0.04)
    law = fit.estimates["distance_exponent"]
    assert law.determined and abs(law.value - 2) <= 3 * law.uncertainty < 0.3
    for name in ("blobs_per_megapixel", "blob_radius_px"):  # holes without cause
        estimate = fit.estimates[name]
        assert abs(estimate.value - getattr(SOFT, name)) <= 3 * estimate.uncertainty


def test_what_things_before_a_wall_show_is_recovered() -> None:
    model = DepthSensorModel.from_profile("d405", edge_dropout=0.6, border_margin_px=4.0)
    scenes = [exact.copy() for exact in WALLS]
    for scene in scenes:
        for u in range(50, 400, 60):
            scene[40:260, u : u + 14] *= 0.8
    start = replace(model, edge_dropout=0.3, border_margin_px=0.0)
    found = edges_of(frames_of(model, scenes), WIDE, start)
    for name in ("edge_dropout", "border_margin_px"):
        off = abs(found[name].value - getattr(model, name))
        # Notches that edges tear make more edges: a sixth of the loss is not seen as such.
        assert found[name].determined and off <= 0.2 * getattr(model, name), name
    bare = edges_of(frames_of(SOFT, WALLS[:1]), WIDE, SOFT)
    assert not bare["edge_dropout"].determined and "depth edges" in bare["edge_dropout"].note


@pytest.mark.slow
def test_stripes_and_slow_noise_are_found() -> None:
    model = DepthSensorModel.from_profile(
        "structured_light", column_band_px=0.2, slow_noise_px=0.1, slow_correlation_px=7.0,
        depth_unit_m=1e-4, min_z_m=0.1, band_width_px=40.0,
    )  # fmt: skip
    frames = frames_of(model, [2 * w for w in WALLS])
    found = fit_depth_model(frames, WIDE, "structured_light", unit_m=1e-4).estimates
    assert found["column_band_px"].value == pytest.approx(0.2, rel=0.4)
    assert found["row_band_px"].value < 0.05
    assert found["slow_noise_px"].value == pytest.approx(0.1, rel=0.3)


def test_noise_of_depth_grows_with_the_square_of_depth_over_focal_length_and_baseline() -> None:
    model = DepthSensorModel.from_profile(
        "d405", depth_unit_m=0.0, quantum_px=0.0, whole_pixel_gain=0.0
    )
    sigma = []
    for z in (0.25, 0.5):
        plane = find_plane(*frames_of(model, [wall(z, 0, 0)]), WIDE, 0.018)
        sigma.append(float(np.nanstd(plane.residual)) * plane.distance_m**2 / (380 * 0.018))
    assert sigma[1] / sigma[0] == pytest.approx(4, rel=0.05)
    assert sigma == pytest.approx([float(model.sigma_z(z, WIDE)) for z in (0.25, 0.5)], rel=0.05)


@pytest.mark.slow
def test_bias_is_found_only_against_the_truth() -> None:
    model = replace(SOFT, bias_px=0.25)
    blind = fitted(model).estimates["bias_px"]
    told = fit_depth_model(frames_of(model), WIDE, "d405", truths=WALLS).estimates["bias_px"]
    assert not blind.determined and blind.value == 0 and "another plane" in blind.note
    assert abs(told.value - 0.25) <= 3 * told.uncertainty < 0.05


@pytest.mark.slow
def test_loss_by_obliquity_is_found_from_oblique_planes() -> None:
    model = DepthSensorModel.from_profile(
        "d405", grazing_from_deg=60.0, grazing_to_deg=80.0, blobs_per_megapixel=0.0, max_z_m=10.0,
        correlation_px=2.0,
    )  # fmt: skip
    oblique = [np.clip(wall(0.5, 0.0, tilt), 0.05, 9) for tilt in (1.4, 2.0, 2.6, 3.2)]
    found = fit_depth_model(frames_of(model, oblique), WIDE, "d405").estimates
    assert found["grazing_from_deg"].determined
    for name, true in (("grazing_from_deg", 60), ("grazing_to_deg", 80)):
        assert abs(found[name].value - true) <= 2.5 * found[name].uncertainty < 15


def test_what_frames_do_not_determine_is_said() -> None:
    (frame,) = frames_of(SOFT, WALLS[:1])
    fit = fit_depth_model([frame], WIDE, "d405")
    assert not fit.estimates["distance_exponent"].determined
    assert "one distance only" in fit.estimates["distance_exponent"].note
    assert not fit.estimates["grazing_from_deg"].determined
    assert not fit.estimates["warp_px"].determined
    coarse = fit_depth_model([np.round(frame, 2)], WIDE, "d405", unit_m=0.01)
    assert not coarse.estimates["quantum_px"].determined
    assert "hides steps" in coarse.estimates["quantum_px"].note
    region = np.zeros(frame.shape, bool)
    region[100:190, 150:260] = True
    small = fit_depth_model([frame], WIDE, "d405", regions=[region])
    assert not small.estimates["disparity_noise_px"].determined
    assert "squares of 64 px" in small.estimates["disparity_noise_px"].note


def test_a_fit_is_written_drawn_and_loaded(tmp_path: Path) -> None:
    fit = fitted(SOFT)
    path = tmp_path / "sensor.json"
    path.write_text(json.dumps(fit.document(), allow_nan=False))
    assert DepthSensorModel.load(path) == fit.model
    assert fit_picture(fit).startswith(b"\x89PNG")


def test_the_step_is_found_down_to_what_the_files_can_show() -> None:
    def step(quantum: float, unit: float) -> float:
        model = replace(SOFT, quantum_px=quantum, depth_unit_m=unit)
        z = model.measure(wall(0.3), WIDE, np.random.default_rng(2))
        return disparity_step(z, WIDE, 0.018, unit).quantum_px

    assert step(1 / 32, 1e-4) == pytest.approx(1 / 32, rel=0.005)
    assert step(0.07, 1e-4) == pytest.approx(0.07, rel=0.005)
    assert step(0.0, 1e-4) == 0
    assert step(1 / 32, 1e-3) == 0


def test_local_noise_knows_planes_and_white_noise() -> None:
    white = replace(DepthSensorModel.noiseless(), disparity_noise_px=0.05, correlation_px=0.0)
    exact = local_noise(wall(0.4), WIDE, 0.018)
    assert exact.median_px < 1e-4 and exact.windows == 292 * 392
    noisy = white.measure(wall(0.4), WIDE, np.random.default_rng(3))
    assert local_noise(noisy, WIDE, 0.018).median_px == pytest.approx(0.05, rel=0.03)
    noisy[100:110] = 0
    band = np.zeros((300, 400), bool)
    band[100:120] = True
    assert hole_share(noisy, band) == 0.5


def test_mistakes_of_a_fit_are_named() -> None:
    good = SOFT.measure(WALLS[0], WIDE, np.random.default_rng(0))
    v, u = np.mgrid[:300, :400]
    ball = 0.5 - 0.3 * np.sqrt(np.maximum(1 - ((u - 200) / 260) ** 2 - ((v - 150) / 260) ** 2, 0))
    rough = np.random.default_rng(0).uniform(0.2, 1.0, (300, 400)).astype(np.float32)
    for frames, said in (
        ([], "no frames"),
        ([good * 1000], "millimetres"),
        ([(good * 1000).astype(np.uint16)], "Multiply them by the unit"),
        ([good[:200]], "the camera 400x300"),
        ([np.zeros_like(good)], "holds no measurement"),
        ([rough], "no plane|bent surface"),
        ([ball.astype(np.float32)], "bent surface|no plane"),
    ):
        refused(said, fit_depth_model, frames, WIDE, "d405")
    refused("1 frames and 2 names", fit_depth_model, [good], WIDE, "d405", names=["a", "b"])
