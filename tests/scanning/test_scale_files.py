"""scale.json: what is written comes back bit for bit, and what is damaged is named."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest

from realsim.errors import NotRigidError
from realsim.scanning.scale.files import (
    ScaleRecord,
    installed_versions,
    json_lines,
    load_record,
    load_start,
    record_from_json,
    record_to_json,
)
from realsim.scanning.scale.measured import parse_measurement
from realsim.scanning.scale.measured_check import with_measurements
from refusals import refused
from scale_fits import fit_of, known_scan


@pytest.fixture(scope="module")
def known():
    return known_scan("wedge", 1)


@pytest.fixture(scope="module")
def record(known):
    lengths = [parse_measurement("longest=500mm"), parse_measurement("between 0,0,0 0,0,1=3m")]
    fit, checks = with_measurements(fit_of(known), known.scan, lengths)
    inputs = {"key": "abc", "mesh": {"name": "wedge"}, "at": [0.1, 0.2]}
    poses = ({"index": 0, "T_world_cam": np.eye(4).tolist()},)
    return ScaleRecord(
        fit=fit, inputs=inputs, config={"field_cells": 96}, measured=checks, poses=poses,
        versions=installed_versions(),
    )  # fmt: skip


def same(a, b) -> bool:
    """Whether two values are the same to the last bit; NaN is the same as NaN."""
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.tobytes() == b.tobytes()
    if hasattr(a, "__dataclass_fields__"):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if isinstance(a, tuple | list):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    return a == b or (a != a and b != b)


def test_a_record_comes_back_and_is_written_the_same_again(record, tmp_path):
    path = tmp_path / "scale.json"
    path.write_text(json_lines(record_to_json(record)))
    loaded = load_record(path)
    assert same(loaded, record)
    assert json_lines(record_to_json(loaded)) == path.read_text()
    with pytest.raises(TypeError, match="JSON"):
        json_lines(record_to_json(replace(record, inputs={"bad": object()})))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: d.pop("format"), "format"),
        (lambda d: d.update(format_version=99), "Update realsim"),
        (lambda d: d["fit"].pop("sigma"), "sigma"),
        (lambda d: d["fit"].update(covariance=[[1]]), "covariance"),
        (lambda d: d["fit"].update(limits=[{"name": "x"}]), "limits.*--overwrite"),
    ],
)
def test_damage_is_named(record, change, said):
    data = record_to_json(record)
    change(data)
    refused(said, record_from_json, data)


def test_a_file_that_is_no_json_is_named(tmp_path):
    (tmp_path / "scale.json").write_text('{"format": "realsim sc')
    refused("not valid JSON", load_record, tmp_path / "scale.json")
    refused("does not exist", load_record, tmp_path / "none.json")


# --- starts -----------------------------------------------------------------------------------


def test_a_result_is_a_start(record, tmp_path):
    (tmp_path / "scale.json").write_text(json_lines(record_to_json(record)))
    start = load_start(tmp_path / "scale.json")
    assert start.scale == record.fit.scale
    np.testing.assert_array_equal(start.T_world_obj, record.fit.T_world_obj)


def written(tmp_path, **values):
    path = tmp_path / "start.json"
    path.write_text(json.dumps(values))
    return path


def test_a_start_is_two_values(tmp_path):
    start = load_start(written(tmp_path, scale=0.1, T_world_obj=np.eye(4).tolist()))
    assert start.scale == 0.1 and start.source == "given"


def test_a_start_that_is_none_is_named(tmp_path):
    scaled = np.diag([2.0, 2, 2, 1]).tolist()
    with pytest.raises(NotRigidError, match="never inside"):
        load_start(written(tmp_path, scale=2.0, T_world_obj=scaled))
    for scale in (-1, 0, "big", None, True):
        refused("scale", load_start, written(tmp_path, scale=scale, T_world_obj=np.eye(4).tolist()))
    refused("shape", load_start, written(tmp_path, scale=1.0, T_world_obj=[1, 2, 3]))
    refused("lacks T_world_obj", load_start, written(tmp_path, scale=1.0))
