"""Analytic grasps of an upgrade: tried by the School, kept beside its own, compared with labels."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from realsim.app.console import Console
from realsim.app.upgrade.analytic import FOLDER, agreement_of
from realsim.app.upgrade.run import UpgradeConfig, run_upgrade
from realsim.formats.graspnet.grasp_labels import read_grasp_labels
from realsim.formats.grasps.hdf5 import read_grasps_hdf5
from realsim.formats.grasps.scene_grasps import untried_set
from realsim.geometry import se3
from realsim.geometry.parts import part
from realsim.records import GraspSet
from realsim.store import load_grasps
from upgradable_datasets import NAMES, bop_dataset, content_and_times, graspnet_dataset, standing

QUIET = Console(quiet=True)


def tried(friction: list[float], scores: list[float]) -> GraspSet:
    """Return a set of which physics has said something."""
    n = len(scores)
    base = untried_set(np.tile(np.eye(4), (n, 1, 1)), obj_id=1)
    return replace(
        base, scores=np.array(scores), base_scores=np.zeros(n), slip_m=np.zeros((n, 4)),
        slip_rad=np.zeros((n, 4)), reachable=np.ones(n, dtype=bool), failures=("",) * n,
        measures={"closure_friction": np.array(friction)},
    )  # fmt: skip


def test_labels_and_scores_that_rank_alike_have_the_correlation_minus_one() -> None:
    friction = [0.1 * k for k in range(1, 11)] * 2
    found = agreement_of([tried(friction, [1.05 - f for f in friction])])
    assert found is not None and found["score_vs_friction"]["rho"] == pytest.approx(-1.0)
    assert [level["tried"] for level in found["levels"]] == [2] * 10
    assert found["good"] == 2 * 5
    again = agreement_of([tried(friction, friction)])
    assert again is not None and again["score_vs_friction"]["rho"] == pytest.approx(1.0)


@pytest.mark.slow
def test_analytic_grasps_are_tried_and_kept_beside_the_schools_own(tmp_path: Path) -> None:
    dataset, out = bop_dataset(tmp_path / "dataset"), tmp_path / "out"
    config = UpgradeConfig(grasps_per_object=2, where=1)
    run_upgrade(config, dataset, out, QUIET)
    scene = out / "test/000001"
    own = content_and_times(scene / "grasps")
    result = run_upgrade(replace(config, analytic=8), dataset, out, QUIET)
    assert content_and_times(scene / "grasps").keys() == own.keys()
    assert [len(s) for s in load_grasps(scene)] == [2, 2]
    sets = load_grasps(scene / FOLDER)
    assert [s.obj_id for s in sets] == [part(n).obj_id for n in NAMES]
    for s in sets:
        assert 0 < len(s) <= 8
        labels = read_grasp_labels(out / f"grasp_label/{s.obj_id - 1:03d}_labels.npz")
        index = [tuple(row) for row in labels.index.tolist()]
        chosen = s.parameters["analytic"]["label_index"]
        for row, friction in zip(chosen, s.measures["closure_friction"], strict=True):
            assert labels.friction[index.index(tuple(row))] == pytest.approx(friction)
        # Every grasp is its label's, moved at most along the closing axis and back.
        Ts = labels.Ts_obj_grasp()[[index.index(tuple(r)) for r in chosen]]
        np.testing.assert_allclose(Ts[:, :3, :3], s.Ts_obj_grasp[:, :3, :3], atol=1e-6)
        along_x = (se3.invert(Ts) @ s.Ts_obj_grasp)[:, 0, 3]
        np.testing.assert_allclose(along_x, 0, atol=1e-6)
        assert np.isfinite(s.scores).all()
    assert len(read_grasps_hdf5(scene / FOLDER / "grasps.h5").sets) == 2
    assert result.analytic is not None
    assert result.analytic["grasps"] == sum(len(s) for s in sets)
    told = json.loads((out / "upgrade.json").read_text())
    assert told["analytic"]["levels"] == result.analytic["levels"]
    assert "Analytic grasps, tried" in (out / "upgrade.html").read_text()
    kept = content_and_times(scene / FOLDER)
    (scene / "stages/upgrade.json").unlink()  # gone through again: what is finished stays
    run_upgrade(replace(config, analytic=8), dataset, out, QUIET)
    assert content_and_times(scene / FOLDER) == kept
    _a_graspnet_roots_own_labels_are_taken(tmp_path, out / "grasp_label")


def _a_graspnet_roots_own_labels_are_taken(tmp_path: Path, labels: Path) -> None:
    dataset = graspnet_dataset(tmp_path / "graspnet")
    (dataset / "grasp_label").mkdir()
    for file in labels.glob("*.npz"):
        shutil.copy(file, dataset / "grasp_label" / file.name)
    before, out = content_and_times(dataset), tmp_path / "from_graspnet"
    run_upgrade(UpgradeConfig(grasps_per_object=2, analytic=4, where=1), dataset, out, QUIET)
    assert content_and_times(dataset) == before
    scene = out / "test_kinect/000100"
    xml = "annotations/0001.xml"
    home = dataset / "scenes/scene_0100/kinect"
    assert (scene / "imported" / xml).read_bytes() == (home / xml).read_bytes()
    placed = json.loads((scene / "registration/scene.json").read_text())["objects"]
    for o, p in zip(placed, standing(), strict=True):
        # The world is the table's frame, as GraspNet has it; depth is in whole millimetres.
        T = np.array(o["T_world_obj"])
        np.testing.assert_allclose(T[:3, 3], p.T_world_obj[:3, 3], atol=1.5e-3)
    assert not (out / "grasp_label").exists()
    sets = load_grasps(out / "test_kinect/000100" / FOLDER)
    assert {s.parameters["analytic"]["from"] for s in sets} <= {p.name for p in labels.glob("*")}
    source = json.loads((out / "test_kinect/000100/imported/source.json").read_text())
    assert source["grasp_labels"] == sorted(f"grasp_label/{p.name}" for p in labels.glob("*.npz"))
