"""GraspNet's annotations: what is written is read."""

import numpy as np
import pytest

from realsim.errors import InputError, UnitError
from realsim.formats.graspnet.annotations import (
    annotation_bytes,
    object_fields,
    pose_of,
    read_objects,
)
from realsim.geometry import se3
from refusals import refused

COUNT = 300


def test_poses_lose_nothing_in_the_text():
    Ts = se3.random_transform(np.random.default_rng(2), COUNT, spread=0.5)
    for T in Ts:
        off = se3.invert(T) @ pose_of(object_fields(4, T))
        assert np.linalg.norm(off[:3, 3]) < 1e-9 and se3.angle(off) < 1e-8


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
    refused(what, read_objects, path, error=error)
