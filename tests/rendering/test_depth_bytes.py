"""The default depth camera gives the bytes it has always given, and loads what it writes."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from realsim.records import CameraIntrinsics
from realsim.rendering.depth_sensors.model import DepthSensorModel
from refusals import refused

CAMERA = CameraIntrinsics(width=160, height=120, fx=160, fy=160, cx=79.5, cy=59.5)
WHITE = DepthSensorModel(
    disparity_noise_px=0.03, quantum_px=1 / 80, edge_jump_px=0.4, bias_px=0.2, correlation_px=0
)


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
        (
            DepthSensorModel.noiseless(1 / 32),
            "4ff30763909fd153c564044751807868ba807c5d51c9676c1e85810bccf320f5",
        ),
        (WHITE, "c1028aeebcf69e988d088e4cd2cbf6899a0229acc2b0ad3f7d040a5cf42928fe"),
    ],
)
def test_faults_that_are_off_change_no_byte(model: DepthSensorModel, digest: str) -> None:
    measured = model.measure(tilted_with_a_box(), CAMERA, np.random.default_rng(11))
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
        ('{"format": "realsim depth sensor 1", "model": {"colour": 1}}', "has no 'colour'"),
        ('{"format": "realsim depth sensor 1", "model": {"baseline_m": "0.018"}}', "finite float"),
        ('{"format": "realsim depth sensor 1", "model": {"baseline_m": 18}}', "millimetres"),
        ('{"format": "realsim depth sensor 1", "model": {"border": 1}}', "finite bool"),
        (
            '{"format": "realsim depth sensor 1", "model": {"quantum_px": NaN}}',
            "NaN at model.quantum_px",
        ),
        (
            f'{{"format": "realsim depth sensor 1", "model": {{"quantum_px": {10**309}}}}}',
            "finite float",
        ),
        ('{"format": "realsim depth sensor 1"}', "no object 'model'"),
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
