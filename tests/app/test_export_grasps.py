"""Grasps of a session in other programs' formats, through `realsim export`."""

import numpy as np
import pytest

from realsim.app.annotate.current import annotate_session
from realsim.app.console import Console
from realsim.formats.graspnet.grasp_group import read_grasp_group
from realsim.formats.session_scene import open_session_scene
from realsim.store import SessionStore, load_grasps, load_scene, save_grasps
from synthetic_scenes import captured_session
from tried_grasps import tried_set
from typed_commands import finished, refused


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    store = captured_session(tmp_path_factory.mktemp("grasps") / "scene_000002", count=2)
    rng = np.random.default_rng(4)
    for o in load_scene(store).objects:
        save_grasps(store, tried_set(rng, 30, obj_id=o.obj_id, instance=o.instance))
    annotate_session(store, Console(quiet=True))
    return store.folder


def test_grasps_of_a_frame_are_in_its_camera(session, tmp_path):
    finished("export", session, "--to", "grasp-group", "--out", tmp_path / "out", "--quiet")
    sets = load_grasps(SessionStore.open(session))
    scene = open_session_scene(SessionStore.open(session))
    for index in scene.indices:
        group = read_grasp_group(tmp_path / f"out/scene_000002/{index:06d}.npy")
        poses = {o.instance: o.T_cam_obj for o in scene.frame(index).objects}
        want = [
            (poses[s.instance] @ T, label)
            for s in sets
            for T, label in zip(s.Ts_obj_grasp, s.labels, strict=True)
            if np.isfinite(label)
        ]
        assert len(group) == len(want) > 10
        np.testing.assert_allclose(group.Ts_a_grasp, [T for T, _ in want], atol=2e-6)
        np.testing.assert_allclose(group.scores, [label for _, label in want], atol=1e-6)


def test_grasps_are_of_sessions(session, tmp_path):
    finished("export", session, "--to", "bop", "--out", tmp_path / "bop", "--quiet")
    hdf5 = ("--to", "hdf5", "--out", tmp_path / "o")
    assert "is no session" in refused("export", tmp_path / "bop", *hdf5)
    assert not (tmp_path / "o").exists()
    said = refused("export", session, *hdf5, "--least-score", "0.5")
    assert "says nothing of realsim HDF5" in said
