"""GraspGen's JSON: its loader finds what it looks for, and the grasps come back."""

import json

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from realsim.formats.grasps.graspgen import write_graspgen
from realsim.formats.grasps.hand_frames import grasp_poses, hand_poses
from realsim.formats.grasps.scene_grasps import executed, held, measures_of_json
from realsim.untrusted.own_json import array_from_json
from tried_grasps import tried_set


@given(st.integers(0, 2**32 - 1), st.sampled_from(["acronym", "panda_hand", "grasp"]))
@settings(max_examples=10, deadline=None)
def test_tried_grasps_are_written_with_all_that_is_known(tmp_path_factory, seed, frame):
    s = tried_set(np.random.default_rng(seed), 25)
    path = tmp_path_factory.mktemp("gg") / "mug.json"
    write_graspgen(path, s, file="mug.obj", scale=0.5, frame=frame)
    found, rows = json.loads(path.read_text()), executed(s)
    assert found["object"] == {"file": "mug.obj", "scale": 0.5}
    Ts = grasp_poses(found["grasps"]["transforms"], frame) if rows.any() else np.zeros((0, 4, 4))
    np.testing.assert_allclose(Ts, s.Ts_obj_grasp[rows], rtol=0, atol=1e-15)
    np.testing.assert_array_equal(found["grasps"]["object_in_gripper"], held(s)[rows])
    ours, n = found["realsim"], int(rows.sum())
    for name in ("scores", "base_scores", "widths_m"):
        np.testing.assert_array_equal(array_from_json(ours[name], (n,)), getattr(s, name)[rows])
    for name, values in measures_of_json(ours["measures"], n, "the file").items():
        np.testing.assert_array_equal(values, s.measures[name][rows])
    assert list(ours["measures"]) == list(s.measures)


def test_the_file_has_graspgens_keys_and_axes(tmp_path):
    s = tried_set(np.random.default_rng(2), 25)
    data = json.loads(write_graspgen(tmp_path / "a.json", s, file="mug.obj").read_text())
    assert data["object"] == {"file": "mug.obj", "scale": 1.0}
    T, mask = (np.asarray(data["grasps"][name]) for name in ("transforms", "object_in_gripper"))
    assert mask.dtype == bool and mask.shape == T.shape[:1]
    rows = executed(s)
    # approach +z, closing along x, from the hand's base
    np.testing.assert_array_equal(T[:, :3, 2], s.Ts_obj_grasp[rows, :3, 2])
    np.testing.assert_array_equal(T[:, :3, 0], s.Ts_obj_grasp[rows, :3, 1])
    np.testing.assert_array_equal(T, hand_poses(s.Ts_obj_grasp[rows], "acronym"))
    assert data["realsim"]["left_out"] == int((~rows).sum()) > 0
