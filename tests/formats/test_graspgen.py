"""GraspGen's JSON: its loader finds what it looks for, and the grasps come back."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from realsim.errors import InputError
from realsim.formats.grasps.graspgen import read_graspgen, write_graspgen
from realsim.formats.grasps.hand_frames import hand_poses
from realsim.formats.grasps.scene_grasps import executed, held
from tried_grasps import tried_set


@given(st.integers(0, 2**32 - 1), st.sampled_from(["acronym", "panda_hand", "grasp"]))
@settings(max_examples=10, deadline=None)
def test_tried_grasps_written_and_read_are_the_same(tmp_path_factory, seed, frame):
    s = tried_set(np.random.default_rng(seed), 25)
    path = tmp_path_factory.mktemp("gg") / "mug.json"
    found = read_graspgen(write_graspgen(path, s, file="mug.obj", scale=0.5, frame=frame))
    rows = executed(s)
    np.testing.assert_allclose(found.Ts_obj_grasp, s.Ts_obj_grasp[rows], rtol=0, atol=1e-15)
    np.testing.assert_array_equal(found.object_in_gripper, held(s)[rows])
    np.testing.assert_array_equal(found.scores, s.scores[rows])
    np.testing.assert_array_equal(found.base_scores, s.base_scores[rows])
    np.testing.assert_array_equal(found.widths_m, s.widths_m[rows])
    assert (found.file, found.scale) == ("mug.obj", 0.5)
    again = found.as_set(5, 1)
    assert np.isnan(again.scores).all() and again.obj_id == 5
    assert list(again.measures) == list(s.measures)
    for name, values in again.measures.items():
        np.testing.assert_array_equal(values, s.measures[name][rows])


def test_the_file_has_graspgens_keys_and_axes(tmp_path):
    s = tried_set(np.random.default_rng(2), 25)
    data = json.loads(write_graspgen(tmp_path / "a.json", s, file="mug.obj").read_text())
    assert data["object"] == {"file": "mug.obj", "scale": 1.0}
    T = np.asarray(data["grasps"]["transforms"])
    mask = np.asarray(data["grasps"]["object_in_gripper"])
    assert mask.dtype == bool and mask.shape == T.shape[:1]
    rows = executed(s)
    # approach +z, closing along x, from the hand's base
    np.testing.assert_array_equal(T[:, :3, 2], s.Ts_obj_grasp[rows, :3, 2])
    np.testing.assert_array_equal(T[:, :3, 0], s.Ts_obj_grasp[rows, :3, 1])
    np.testing.assert_array_equal(T, hand_poses(s.Ts_obj_grasp[rows], "acronym"))
    assert data["realsim"]["left_out"] == int((~rows).sum()) > 0


def test_a_file_of_graspgens_own_is_read_in_its_convention(tmp_path):
    T = np.eye(4)
    T[:3, 3] = [0.1, 0.2, 0.3]
    value = {
        "object": {"file": "a.obj", "scale": 1},
        "grasps": {"transforms": [T.tolist()] * 2, "object_in_gripper": [True, False]},
    }
    path = tmp_path / "a.json"
    path.write_text(json.dumps(value))
    found = read_graspgen(path)
    np.testing.assert_allclose(found.Ts_obj_grasp[0, :3, 3], [0.1, 0.2, 0.4034])
    np.testing.assert_array_equal(found.Ts_obj_grasp[0, :3, 1], [1, 0, 0])
    assert found.scores is None and np.isnan(found.as_set(1).widths_m).all()
    turned = read_graspgen(path, frame="panda_hand").Ts_obj_grasp[0]
    np.testing.assert_array_equal(turned[:3, :3], np.eye(3))


@pytest.mark.parametrize(
    "change",
    [
        lambda v: v.pop("grasps"),
        lambda v: v["object"].update(scale=-1),
        lambda v: v["grasps"].update(object_in_gripper=[2, 0]),
        lambda v: v["grasps"].update(transforms=np.zeros((2, 4, 4)).tolist()),
        lambda v: v.update(realsim={"frame": "elsewhere"}),
        lambda v: v.update(realsim={"measures": {"p_hold": [0.5]}}),
        lambda v: v.update(realsim={"measures": {"goodness": [0.5, 0.5]}}),
    ],
)
def test_what_is_no_graspgen_file_is_refused(tmp_path, change):
    value = {
        "object": {"file": "a.obj", "scale": 1},
        "grasps": {"transforms": [np.eye(4).tolist()] * 2, "object_in_gripper": [True, False]},
    }
    change(value)
    path = tmp_path / "a.json"
    path.write_text(json.dumps(value))
    with pytest.raises(InputError):
        read_graspgen(path)
