"""isaac_grasp YAML: any YAML reader reads it, and the grasps come back."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML

from realsim.errors import InputError
from realsim.formats.grasps.hand_frames import hand_poses
from realsim.formats.grasps.isaac_grasp import read_isaac_grasp, write_isaac_grasp
from realsim.formats.grasps.scene_grasps import labelled
from realsim.records.grasps import MEASURES
from tried_grasps import tried_set

EXAMPLE = """
format: isaac_grasp
format_version: 1.0
object_frame: /World/mug
gripper_frame: /World/panda_hand
grasps:
  "grasp_0":
    confidence: 1.0
    position: [-0.04346, 0.06759, 0.19895]
    orientation: {w: 0.00332, xyz: [0.98453, 0.16837, 0.04837]}
    cspace_position: {panda_finger_joint1: 0.00943}
    pregrasp_cspace_position: {panda_finger_joint1: 0.04}
"""
"""The example of the specification."""


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_tried_grasps_written_and_read_are_the_same(tmp_path_factory, seed):
    rng = np.random.default_rng(seed)
    some = tuple(name for name in MEASURES if rng.random() < 0.7)
    s = tried_set(rng, 25, measures=some)
    path = tmp_path_factory.mktemp("ig") / "mug.yaml"
    found = read_isaac_grasp(write_isaac_grasp(path, s, object_frame="mug"))
    rows = labelled(s)
    np.testing.assert_allclose(found.Ts_obj_grasp, s.Ts_obj_grasp[rows], rtol=0, atol=1e-14)
    np.testing.assert_array_equal(found.confidences, s.labels[rows])
    np.testing.assert_array_equal(found.scores, s.scores[rows])
    np.testing.assert_array_equal(found.base_scores, s.base_scores[rows])
    again = found.as_set(7)
    assert list(again.measures) == (list(some) if rows.any() else [])
    for name, values in again.measures.items():
        np.testing.assert_array_equal(values, s.measures[name][rows])
    assert f"# confidence: {s.label}" in path.read_text()
    np.testing.assert_array_equal(found.widths_m, s.widths_m[rows])
    np.testing.assert_array_equal(found.openings_m, 0.08)
    assert found.names == tuple(f"grasp_{row}" for row in np.flatnonzero(rows))
    assert np.isnan(again.scores).all()


def test_the_specifications_example_is_read(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text(EXAMPLE)
    found = read_isaac_grasp(path)
    T_hand = hand_poses(found.Ts_obj_grasp[0], "panda_hand")
    np.testing.assert_allclose(T_hand[:3, 3], [-0.04346, 0.06759, 0.19895], atol=1e-15)
    # A half turn about the axis (0.98453, 0.16837, 0.04837), nearly.
    w = np.array([0.98453, 0.16837, 0.04837])
    expected = 2 * np.outer(w, w) - np.eye(3)
    np.testing.assert_allclose(T_hand[:3, :3], expected, atol=0.01)
    assert found.widths_m[0] == 2 * 0.00943 and found.openings_m[0] == 0.08


def test_the_quaternion_is_scalar_first_and_turns_the_right_way(tmp_path):
    s = tried_set(np.random.default_rng(3), 25)
    data = YAML(typ="safe").load(write_isaac_grasp(tmp_path / "a.yaml", s, object_frame="a"))
    assert data["format"] == "isaac_grasp" and data["format_version"] == 1.0
    assert data["gripper_frame_link"] == "panda_hand"
    for row in np.flatnonzero(labelled(s)):
        entry = data["grasps"][f"grasp_{row}"]
        w, (x, y, z) = entry["orientation"]["w"], entry["orientation"]["xyz"]
        R = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        np.testing.assert_allclose(R, s.Ts_obj_grasp[row, :3, :3], atol=1e-14)


def test_a_width_that_the_hand_cannot_take_is_refused(tmp_path):
    s = tried_set(np.random.default_rng(5), 40)
    for width in (0.09, np.nan):
        with pytest.raises(InputError, match="width"):
            write_isaac_grasp(
                tmp_path / "a.yaml", replace(s, widths_m=np.full(40, width)), object_frame="a"
            )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("format: isaac_grasp", "format: other"),
        ("format_version: 1.0", "format_version: 2.0"),
        ("confidence: 1.0", "confidence: 1.5"),
        ("w: 0.00332", "w: 1.0"),
        ("-0.04346", "left"),
        ("cspace_position", "realsim: {goodness: 1.0}\n    cspace_position"),
        ("cspace_position", "realsim: {safety: 1.0}\n    cspace_position"),
        ("grasps:", "other:"),
        ("grasps:", "grasps: !!python/object:os.system"),
    ],
)  # fmt: skip
def test_what_is_no_isaac_grasp_file_is_refused(tmp_path, old, new):
    assert old in EXAMPLE
    path = tmp_path / "a.yaml"
    path.write_text(EXAMPLE.replace(old, new, 1))
    with pytest.raises(InputError):
        read_isaac_grasp(path)
