"""What a depth sensor was is what a fit to its pictures of a plane says, or says it cannot."""

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

CAMERA = CameraIntrinsics(width=400, height=300, fx=380, fy=380, cx=199.5, cy=149.5)
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
    return [model.measure(z, CAMERA, np.random.default_rng(k)) for k, z in enumerate(exact)]


@lru_cache
def fitted(model: DepthSensorModel, kind: str = "d405") -> FittedDepthModel:
    return fit_depth_model(frames_of(model), CAMERA, kind)


def test_parameters_are_recovered_within_their_uncertainty() -> None:
    model = SOFT
    fit = fitted(model)
    for name in ("disparity_noise_px", "correlation_px", "correlation_aspect", "quantum_px",
                 "slow_noise_px", "column_band_px", "native_pitch_px"):  # fmt: skip
        estimate = fit.estimates[name]
        true = getattr(model, name)
        assert estimate.determined, name
        assert abs(estimate.value - true) <= 3 * estimate.uncertainty, name
        # An uncertainty that is too great would make this law empty.
        assert estimate.uncertainty <= max(0.15 * true, 0.3 if name == "correlation_px" else 0.04)
    law = fit.estimates["distance_exponent"]
    assert law.determined and abs(law.value - 2) <= 3 * law.uncertainty < 0.3


def test_holes_without_cause_are_counted() -> None:
    fit = fitted(SOFT)
    for name in ("blobs_per_megapixel", "blob_radius_px"):
        estimate = fit.estimates[name]
        assert abs(estimate.value - getattr(SOFT, name)) <= 3 * estimate.uncertainty


def test_what_things_before_a_wall_show_is_recovered() -> None:
    model = DepthSensorModel.from_profile("d405", edge_dropout=0.6, border_margin_px=4.0)
    scenes = [exact.copy() for exact in WALLS]
    for scene in scenes:
        for u in range(50, 400, 60):
            scene[40:260, u : u + 14] *= 0.8
    start = replace(model, edge_dropout=0.3, border_margin_px=0.0)
    found = edges_of(frames_of(model, scenes), CAMERA, start)
    for name in ("edge_dropout", "border_margin_px"):
        off = abs(found[name].value - getattr(model, name))
        # Notches that edges tear make more edges: a sixth of the loss is not seen as such.
        assert found[name].determined and off <= 0.2 * getattr(model, name), name
    bare = edges_of(frames_of(SOFT, WALLS[:1]), CAMERA, SOFT)
    assert not bare["edge_dropout"].determined and "depth edges" in bare["edge_dropout"].note


@pytest.mark.slow
def test_stripes_and_slow_noise_are_found() -> None:
    model = DepthSensorModel.from_profile(
        "structured_light", column_band_px=0.2, slow_noise_px=0.1, slow_correlation_px=7.0,
        depth_unit_m=1e-4, min_z_m=0.1, band_width_px=40.0,
    )  # fmt: skip
    frames = frames_of(model, [2 * w for w in WALLS])
    found = fit_depth_model(frames, CAMERA, "structured_light", unit_m=1e-4).estimates
    assert found["column_band_px"].value == pytest.approx(0.2, rel=0.4)
    assert found["row_band_px"].value < 0.05
    assert found["slow_noise_px"].value == pytest.approx(0.1, rel=0.3)


def test_noise_of_depth_grows_with_the_square_of_depth_over_focal_length_and_baseline() -> None:
    model = DepthSensorModel.from_profile(
        "d405", depth_unit_m=0.0, quantum_px=0.0, whole_pixel_gain=0.0
    )
    sigma = []
    for z in (0.25, 0.5):
        plane = find_plane(*frames_of(model, [wall(z, 0, 0)]), CAMERA, 0.018)
        sigma.append(float(np.nanstd(plane.residual)) * plane.distance_m**2 / (380 * 0.018))
    assert sigma[1] / sigma[0] == pytest.approx(4, rel=0.05)
    assert sigma == pytest.approx([float(model.sigma_z(z, CAMERA)) for z in (0.25, 0.5)], rel=0.05)


@pytest.mark.slow
def test_bias_is_found_only_against_the_truth() -> None:
    model = replace(SOFT, bias_px=0.25)
    blind = fitted(model).estimates["bias_px"]
    told = fit_depth_model(frames_of(model), CAMERA, "d405", truths=WALLS).estimates["bias_px"]
    assert not blind.determined and blind.value == 0 and "another plane" in blind.note
    assert abs(told.value - 0.25) <= 3 * told.uncertainty < 0.05


@pytest.mark.slow
def test_loss_by_obliquity_is_found_from_oblique_planes() -> None:
    model = DepthSensorModel.from_profile(
        "d405", grazing_from_deg=60.0, grazing_to_deg=80.0, blobs_per_megapixel=0.0, max_z_m=10.0,
        correlation_px=2.0,
    )  # fmt: skip
    oblique = [np.clip(wall(0.5, 0.0, tilt), 0.05, 9) for tilt in (1.4, 2.0, 2.6, 3.2)]
    found = fit_depth_model(frames_of(model, oblique), CAMERA, "d405").estimates
    assert found["grazing_from_deg"].determined
    for name, true in (("grazing_from_deg", 60), ("grazing_to_deg", 80)):
        assert abs(found[name].value - true) <= 2.5 * found[name].uncertainty < 15


def test_what_frames_do_not_determine_is_said() -> None:
    (frame,) = frames_of(SOFT, WALLS[:1])
    fit = fit_depth_model([frame], CAMERA, "d405")
    assert not fit.estimates["distance_exponent"].determined
    assert "one distance only" in fit.estimates["distance_exponent"].note
    assert not fit.estimates["grazing_from_deg"].determined
    assert not fit.estimates["warp_px"].determined
    coarse = fit_depth_model([np.round(frame, 2)], CAMERA, "d405", unit_m=0.01)
    assert not coarse.estimates["quantum_px"].determined
    assert "hides steps" in coarse.estimates["quantum_px"].note
    region = np.zeros(frame.shape, bool)
    region[100:190, 150:260] = True
    small = fit_depth_model([frame], CAMERA, "d405", regions=[region])
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
        z = model.measure(wall(0.3), CAMERA, np.random.default_rng(2))
        return disparity_step(z, CAMERA, 0.018, unit).quantum_px

    assert step(1 / 32, 1e-4) == pytest.approx(1 / 32, rel=0.005)
    assert step(0.07, 1e-4) == pytest.approx(0.07, rel=0.005)
    assert step(0.0, 1e-4) == 0
    assert step(1 / 32, 1e-3) == 0


def test_local_noise_knows_planes_and_white_noise() -> None:
    white = replace(DepthSensorModel.noiseless(), disparity_noise_px=0.05, correlation_px=0.0)
    exact = local_noise(wall(0.4), CAMERA, 0.018)
    assert exact.median_px < 1e-4 and exact.windows == 292 * 392
    noisy = white.measure(wall(0.4), CAMERA, np.random.default_rng(3))
    assert local_noise(noisy, CAMERA, 0.018).median_px == pytest.approx(0.05, rel=0.03)
    noisy[100:110] = 0
    band = np.zeros((300, 400), bool)
    band[100:120] = True
    assert hole_share(noisy, band) == 0.5


def test_mistakes_are_named() -> None:
    good = SOFT.measure(WALLS[0], CAMERA, np.random.default_rng(0))
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
        refused(said, fit_depth_model, frames, CAMERA, "d405")
    refused("1 frames and 2 names", fit_depth_model, [good], CAMERA, "d405", names=["a", "b"])
