"""The depth camera's laws: noise, bias, shadows, and reproducibility."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from realsim.errors import InputError
from realsim.records import CameraIntrinsics
from realsim.rendering.depth_sensors.model import DepthSensorModel
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


def test_mistakes_are_named() -> None:
    with pytest.raises(InputError, match="millimetres"):
        DepthSensorModel(baseline_m=18.0)
    with pytest.raises(InputError, match="the camera 320x240"):
        EXACT.measure(np.ones((10, 10)), CAMERA, np.random.default_rng(0))


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


def test_wrong_fields_and_profiles_are_named() -> None:
    refused("there is no depth camera 'd999'", DepthSensorModel.from_profile, "d999")
    refused("has no 'noise'", DepthSensorModel.from_profile, "d405", noise=1.0)
    refused("millimetres", DepthSensorModel, depth_unit_m=1.0)
