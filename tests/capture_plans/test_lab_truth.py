"""The truth follows from seed and joints, is as far off as configured, and survives JSON."""

import json

import numpy as np
import pytest

from realsim.geometry import se3
from realsim_capture_plans.lab import LabConfig, SimulatedLab, load_truth
from realsim_capture_plans.lab.truth import (
    T_EE_CAM_NOMINAL,
    factory_intrinsics,
    true_chain,
    true_intrinsics,
    true_mount,
)
from refusals import refused

Q = np.array([0.3, -1.2, 1.4, -1.7, -1.5, 0.4])
ROD = ("stepped_shaft",)


def test_sizes_of_the_unknowns_are_those_of_the_config():
    configs = [LabConfig(seed=s) for s in range(60)]
    off = np.stack([se3.invert(T_EE_CAM_NOMINAL) @ true_mount(c) for c in configs])
    np.testing.assert_allclose(np.linalg.norm(off[:, :3, 3], axis=1), 3e-3, rtol=1e-9)
    np.testing.assert_allclose(np.degrees(se3.angle(off)), 1.0, rtol=1e-6)
    chains = [true_chain(c) for c in configs]
    assert np.std([c.delta_theta for c in chains]) == pytest.approx(0.2e-3, rel=0.15)
    assert np.std([c.delta_a for c in chains]) == pytest.approx(0.1e-3, rel=0.15)
    assert np.std([c.delta_d for c in chains]) == pytest.approx(0.1e-3, rel=0.15)
    factory = factory_intrinsics(configs[0])
    lenses = [true_intrinsics(c) for c in configs]
    assert np.std([c.fx / factory.fx for c in lenses]) == pytest.approx(0.003, rel=0.3)
    assert np.std([c.cx - factory.cx for c in lenses]) == pytest.approx(3, rel=0.3)
    d = np.stack([c.distortion for c in lenses])
    assert np.all((d[:, 0] > -0.061) & (d[:, 0] < -0.039))
    assert np.all((d[:, 1] < 0.061) & (d[:, 1] > 0.039))
    assert np.std(d[:, 2:4]) == pytest.approx(3e-4, rel=0.3)
    assert np.all(d[:, 5:] == 0)
    assert not factory.is_distorted


def test_repeatability_belongs_to_the_stop_and_has_its_size():
    truth = SimulatedLab(LabConfig(seed=1, objects=ROD)).truth
    np.testing.assert_array_equal(truth.T_base_ee(Q), truth.T_base_ee(Q.copy()))
    rng = np.random.default_rng(0)
    stops = Q + rng.uniform(-1, 1, (200, 6))
    noise = np.array(
        [se3.log(se3.invert(truth.chain.forward(q)) @ truth.T_base_ee(q)) for q in stops]
    )
    assert np.std(noise[:, 3:]) == pytest.approx(0.03e-3, rel=0.1)
    assert np.std(noise[:, :3]) == pytest.approx(np.radians(0.01), rel=0.1)
    assert abs(np.corrcoef(noise[:-1, 0], noise[1:, 0])[0, 1]) < 0.2


def test_truth_survives_the_disk_and_knows_every_view(tmp_path):
    lab = SimulatedLab(LabConfig(seed=2, n_objects=3))
    path = lab.write_truth(tmp_path / "S-truth", {7: Q, 3: Q + 0.1})
    assert path == tmp_path / "S-truth" / "truth.json"
    read = load_truth(tmp_path / "S-truth")
    assert [v.index for v in read.views] == [3, 7]
    np.testing.assert_array_equal(read.views[1].T_world_cam, lab.truth.T_world_cam(Q))
    # A view that was not listed can still be recomputed, by another process.
    np.testing.assert_array_equal(read.T_world_cam(Q + 0.2), lab.truth.T_world_cam(Q + 0.2))
    np.testing.assert_array_equal(read.intrinsics.distortion, lab.truth.intrinsics.distortion)
    np.testing.assert_array_equal(read.T_world_board, lab.truth.T_world_board)
    for a, b in zip(read.objects, lab.truth.objects, strict=True):
        np.testing.assert_allclose(a.T_world_obj, b.T_world_obj, atol=1e-15)
        assert (a.obj_id, a.instance) == (b.obj_id, b.instance)
    assert read.chain.name == "UR5"
    panda = SimulatedLab(LabConfig(seed=2, objects=ROD, arm="panda"))
    q = panda.arm.state().joints
    panda.write_truth(tmp_path / "P-truth", {0: q})
    again = load_truth(tmp_path / "P-truth")
    assert again.chain.joints == 7 and np.all(again.chain.delta_theta != 0)
    np.testing.assert_array_equal(again.T_world_cam(q), panda.truth.T_world_cam(q))
    first = path.read_bytes()
    lab.write_truth(tmp_path / "S-truth", {7: Q, 3: Q + 0.1})
    assert path.read_bytes() == first


def test_a_missing_broken_or_foreign_truth_is_refused(tmp_path):
    refused("there is no truth", load_truth, tmp_path)
    (tmp_path / "truth.json").write_text("{")
    refused("not valid JSON", load_truth, tmp_path)
    (tmp_path / "truth.json").write_text(json.dumps({"version": 99}))
    refused("version", load_truth, tmp_path)


def test_the_operator_is_off_by_the_configured_amount_in_all_directions():
    lab = SimulatedLab(LabConfig(seed=3, n_objects=5))
    rng = np.random.default_rng(0)
    offs = []
    for _ in range(40):
        for start, true in zip(lab.operator_starts(rng), lab.truth.objects, strict=True):
            assert (start.obj_id, start.instance) == (true.obj_id, true.instance)
            assert start.verdict == "unchecked"
            offs.append(se3.invert(true.T_world_obj) @ start.T_world_obj)
    offs = np.array(offs)
    rms = np.sqrt(np.mean(np.sum(offs[:, :3, 3] ** 2, axis=1)))
    assert rms == pytest.approx(8e-3, rel=0.1)
    assert np.sqrt(np.mean(se3.angle(offs) ** 2)) == pytest.approx(np.radians(8), rel=0.1)
    assert np.abs(offs[:, :3, 3].mean(0)).max() < 1e-3
    first, again = (lab.operator_starts(np.random.default_rng(9)) for _ in range(2))
    np.testing.assert_array_equal(first[0].T_world_obj, again[0].T_world_obj)
