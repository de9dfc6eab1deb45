"""isaac_grasp YAML: any YAML reader reads it, and finds everything."""

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from realsim.formats.grasps.isaac_grasp import write_isaac_grasp
from realsim.formats.grasps.scene_grasps import labelled, measures_of_json
from realsim.records.grasps import MEASURES
from realsim.untrusted.own_json import array_from_json
from refusals import refused
from tried_grasps import tried_set


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_tried_grasps_are_written_with_all_that_is_known(tmp_path_factory, seed):
    rng = np.random.default_rng(seed)
    some = tuple(name for name in MEASURES if rng.random() < 0.7)
    s = tried_set(rng, 25, measures=some)
    path = tmp_path_factory.mktemp("ig") / "mug.yaml"
    found = YAML(typ="safe").load(write_isaac_grasp(path, s, object_frame="mug"))["grasps"]
    rows = labelled(s)
    assert list(found) == [f"grasp_{row}" for row in np.flatnonzero(rows)]
    assert [g["confidence"] for g in found.values()] == s.labels[rows].tolist()
    assert f"# confidence: {s.label}" in path.read_text()
    fingers = [g["cspace_position"]["panda_finger_joint1"] for g in found.values()]
    np.testing.assert_array_equal(2 * np.array(fingers), s.widths_m[rows])
    assert {g["pregrasp_cspace_position"]["panda_finger_joint1"] for g in found.values()} <= {0.04}
    ours = [g["realsim"] for g in found.values()]
    for name, values in (("score", s.scores), ("base_score", s.base_scores)):
        found = array_from_json([t[name] for t in ours], (len(ours),))
        np.testing.assert_array_equal(found, values[rows])
    columns = {name: [t[name] for t in ours] for name in some}
    for name, values in measures_of_json(columns, len(ours), "the file").items():
        np.testing.assert_array_equal(values, s.measures[name][rows])


def test_the_quaternion_is_scalar_first_and_turns_the_right_way(tmp_path):
    s = tried_set(np.random.default_rng(3), 25)
    data = YAML(typ="safe").load(write_isaac_grasp(tmp_path / "a.yaml", s, object_frame="a"))
    assert data["format"] == "isaac_grasp" and data["format_version"] == 1.0
    assert data["gripper_frame_link"] == "panda_hand"
    for row in np.flatnonzero(labelled(s)):
        entry = data["grasps"][f"grasp_{row}"]
        q = [*entry["orientation"]["xyz"], entry["orientation"]["w"]]
        R = Rotation.from_quat(q).as_matrix()
        np.testing.assert_allclose(R, s.Ts_obj_grasp[row, :3, :3], atol=1e-14)


def test_a_width_that_the_hand_cannot_take_is_refused(tmp_path):
    s = tried_set(np.random.default_rng(5), 40)
    for width in (0.09, np.nan):
        wide = replace(s, widths_m=np.full(40, width))
        refused("width", write_isaac_grasp, tmp_path / "a.yaml", wide, object_frame="a")
    assert list(tmp_path.iterdir()) == []
