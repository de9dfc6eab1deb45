"""GraspNet's annotations: four decimals, chosen so that the direction is the nearest."""

import numpy as np
import pytest

from realsim.errors import InputError, UnitError
from realsim.formats.graspnet.annotations import (
    annotation_bytes,
    object_fields,
    pose_of,
    quaternion_text,
    read_objects,
)
from realsim.geometry import se3

COUNT = 300


def rounded(q):
    return " ".join(f"{x:.4f}" for x in q)


def test_a_quaternion_that_was_read_is_written_again_up_to_its_sign():
    qs = np.random.default_rng(0).normal(size=(COUNT, 4))
    qs /= np.linalg.norm(qs, axis=1, keepdims=True)
    for q in qs:
        text = rounded(q)
        again = quaternion_text(se3.from_quaternion_wxyz([float(x) for x in text.split()]))
        assert np.array(again.split(), float).tolist() in (
            np.array(text.split(), float).tolist(), (-np.array(text.split(), float)).tolist(),
        )  # fmt: skip


def test_positions_are_off_by_half_of_the_last_digit_at_most():
    Ts = se3.random_transform(np.random.default_rng(2), COUNT, spread=0.5)
    off = [pose_of(object_fields(4, T))[:3, 3] - T[:3, 3] for T in Ts]
    assert np.abs(off).max() <= 0.5e-4 + 1e-12


def test_what_is_written_is_read_and_unknown_elements_survive(tmp_path):
    Ts = se3.random_transform(np.random.default_rng(3), 3, spread=0.3)
    rows = [object_fields(n, T) | {"obj_name": "a <b> & c"} for n, T in zip((4, 0, 4), Ts)]  # noqa: B905
    rows[1] |= {"judge": "good", "not a tag": "gone"}
    path = tmp_path / "0000.xml"
    path.write_bytes(annotation_bytes(rows))
    found = read_objects(path)
    assert [o.number for o in found] == [4, 0, 4]
    assert dict(found[0].fields) == rows[0]
    assert found[1].fields["judge"] == "good" and "not a tag" not in found[1].fields
    path.write_bytes(annotation_bytes([o.fields for o in found]))
    assert [dict(o.fields) for o in read_objects(path)] == [dict(o.fields) for o in found]
    path.write_bytes(annotation_bytes([]))
    assert read_objects(path) == ()


@pytest.mark.parametrize(
    ("change", "error", "what"),
    [
        ({"pos_in_world": "412.1000 10.0000 502.0000"}, UnitError, "millimetres"),
        ({"ori_in_world": "2.0 0.0 0.0 0.0"}, InputError, "length 2"),
        ({"ori_in_world": "1.0 0.0 nan 0.0"}, InputError, "4 finite"),
        ({"obj_id": "1e400"}, InputError, "obj_id"),
        ({"obj_id": "-1"}, InputError, "whole numbers from 0"),
        ({"obj_id": "0.5"}, InputError, "whole numbers from 0"),
        ({"pos_in_world": "1 2"}, InputError, "3 finite"),
    ],
)
def test_what_cannot_be_is_named(tmp_path, change, error, what):
    path = tmp_path / "0000.xml"
    path.write_bytes(annotation_bytes([object_fields(1, np.eye(4)) | change]))
    with pytest.raises(error, match=what):
        read_objects(path)
