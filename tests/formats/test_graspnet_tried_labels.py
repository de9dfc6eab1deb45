"""Tried grasps as GraspNet's labels, read by a reader that shares no code with the writer."""

import importlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labelled_scenes import PLACES, SceneInMemory, labelled_scene
from realsim.formats.export_folder import ExportFolder
from realsim.formats.graspnet import tried_labels
from realsim.formats.graspnet.writing import GraspnetWriteConfig, write_graspnet_scene
from realsim.formats.grasps.scene_grasps import SceneGrasps, executed
from tried_grasps import tried_set

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
TWO_TALL = (*PLACES, (1, 0.1, -0.1, 0.4))
"""Instance 3 is a second thing of object 1."""


@pytest.fixture(scope="module")
def load_grasp():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        return importlib.import_module("campaign_graspnet").load_grasp


class WithGrasps(SceneInMemory):
    def grasps(self):
        return self.tried


def scene_with(folder, number, sets):
    plain = labelled_scene(folder, [0, 1], places=TWO_TALL)
    scene = WithGrasps(folder=plain.folder, frames=plain.frames, masks=plain.masks)
    scene.T_world_table, scene.number = plain.T_world_table, number
    scene.tried = SceneGrasps(sets=sets)
    return scene


def held_set(rng, obj_id, instance, n=40):
    """Return a set in which a half holds; one that holds closes at no friction."""
    s = tried_set(rng, n, obj_id=obj_id, instance=instance, measures=("closure_friction",))
    scores = np.where(executed(s), rng.uniform(0, 1, n), np.nan)
    friction = rng.choice([0.2, 0.6, np.inf, 1.2], n)
    return replace(s, scores=scores, measures={"closure_friction": friction})


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    home, rng = tmp_path_factory.mktemp("tried"), np.random.default_rng(5)
    scenes = [
        scene_with(home / f"{k}", k, tuple(held_set(rng, *of) for of in ((1, 0), (7, 1), (1, 3))))
        for k in (0, 4)
    ]  # fmt: skip
    folder = ExportFolder.begin(home / "out", {})
    written = [write_graspnet_scene(s, folder, GraspnetWriteConfig()) for s in scenes]
    told = tried_labels.write_tried_labels(folder, ((s.number, s.grasps()) for s in scenes))
    folder.finish({})
    return home / "out", scenes, written, told


def held_in(scene, index):
    poses = {o.instance: o.T_cam_obj for o in scene.frame(index).objects}
    sets = scene.grasps().sets
    return np.concatenate([poses[s.instance] @ s.Ts_obj_pads[s.good & executed(s)] for s in sets])


def test_what_held_comes_back_in_its_own_scene_and_on_its_own_thing(tree, load_grasp):
    root, scenes, written, told = tree
    assert told == ()
    for scene, one in zip(scenes, written, strict=True):
        for image, index in enumerate(scene.indices):
            Ts = held_in(scene, index)
            places, rotations = load_grasp(root, root / f"scenes/scene_{scene.number:04d}", image)
            assert len(places) == len(Ts) == one.counts["grasps"] > 20
            far = np.linalg.norm(Ts[:, None, :3, 3] - places[None], axis=2)
            near = far.argmin(axis=1)
            assert sorted(near.tolist()) == list(range(len(Ts)))
            assert far.min(axis=1).max() < 1e-6
            cos = np.einsum("na,na->n", Ts[:, :3, 2], rotations[near, :, 0])
            assert np.degrees(np.arccos(cos.min())) < 8.9
            turned = np.abs(np.einsum("na,na->n", Ts[:, :3, 1], rotations[near, :, 1]))
            assert np.degrees(np.arccos(turned.min())) < 8.9
        (note,) = [n for n in one.notes if "300 directions" in n]
        assert f"{one.counts['grasps']} of " in note


def test_frictions_are_graspnets_and_an_object_without_grasps_has_empty_labels(tree):
    root, scenes, _, _ = tree
    labels = np.load(root / "grasp_label/000_labels.npz")
    of_one = [s for x in scenes for s in x.grasps().sets if s.obj_id == 1]
    count = sum(int((s.good & executed(s)).sum()) for s in of_one)
    scores = labels["scores"]
    assert scores.shape == (count, 300, 12, 4) and (scores > 0).sum() == count
    np.testing.assert_allclose(np.unique(scores), [-1.0, 0.2, 0.6, 1.0], atol=1e-6)
    assert np.load(root / "grasp_label/029_labels.npz")["scores"].shape == (0, 300, 12, 4)
    assert len(np.load(root / "collision_label/scene_0004/collision_labels.npz")) == 4


def test_every_image_has_its_rectangles(tree):
    root, _, _, _ = tree
    files = sorted(root.glob("scenes/*/realsense/rect/*.npy"))
    assert len(files) == 4
    for file in files:
        scores, objects = np.load(file)[:, 5:].T
        assert set(objects.tolist()) <= {0, 6}
        assert np.all((scores > 0.05) & (scores < 1.1))


def test_more_than_a_file_holds_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(tried_labels, "MOST_POINTS", 3)
    scene = scene_with(tmp_path / "s", 0, (held_set(np.random.default_rng(1), 7, 1),))
    folder = ExportFolder.begin(tmp_path / "out", {})
    write_graspnet_scene(scene, folder, GraspnetWriteConfig())
    (told,) = tried_labels.write_tried_labels(folder, [(0, scene.grasps())])
    assert "object 006" in told and "a label file holds 3" in told
    assert np.load(tmp_path / "out/grasp_label/006_labels.npz")["points"].shape == (3, 3)
