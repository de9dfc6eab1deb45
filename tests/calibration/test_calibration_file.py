"""`calibration.json`: every number comes back, and a damaged file is named."""

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from realsim.geometry import se3
from realsim.records import CharucoBoard, Chessboard, CircleGrid, TagBoard, Target
from realsim_calibration.exports import FrameNames, calibration_text, read_calibration
from realsim_calibration.results import HandEyeReport, Mode
from refusals import refused

Maker = Callable[..., HandEyeReport]
FRAMES = FrameNames(robot_base="base", hand="tool0", camera_optical="cam_optical", name="ur5")
TARGETS: tuple[Target, ...] = (
    TagBoard(rows=4, columns=6, tag_size_m=0.03, gap_m=0.01, ids_from="bottom"),
    CharucoBoard(rows=7, columns=5, square_m=0.033, marker_m=0.02),
    Chessboard(rows=6, columns=8, square_m=0.0219),
    CircleGrid(rows=10, columns=10, pitch_m=0.0254, large_origin=True),
)


@given(
    twist=st.tuples(*[st.floats(-1.5, 1.5)] * 6),
    seed=st.integers(0, 11),
    target=st.sampled_from(TARGETS),
)
@settings(max_examples=12, deadline=None)
def test_json_round_trip_is_exact(
    full_record: Maker,
    twist: tuple[float, ...],
    seed: int,
    target: Target,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    mode: Mode = "eye_in_hand" if seed % 2 else "eye_to_hand"
    report = full_record(se3.exp(twist), mode, target, seed)
    path = tmp_path_factory.mktemp("json") / "calibration.json"
    path.write_text(calibration_text(report, FRAMES), encoding="utf-8")
    again = read_calibration(path)
    assert type(again.target) is type(report.target)
    assert calibration_text(again, FRAMES) == path.read_text(encoding="utf-8")
    assert_same_record(report, again)


def assert_same_record(a: Any, b: Any) -> None:
    """Compare dataclasses field by field; a rotation may be made orthonormal within 1e-12."""
    assert type(a) is type(b)
    for field in dataclasses.fields(a):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if dataclasses.is_dataclass(x):
            assert_same_record(x, y)
        elif isinstance(x, np.ndarray):
            np.testing.assert_allclose(y, x, rtol=0, atol=1e-12, err_msg=field.name)
            assert y.shape == x.shape
        elif isinstance(x, tuple) and x and dataclasses.is_dataclass(x[0]):
            for u, v in zip(x, y, strict=True):
                assert_same_record(u, v)
        elif isinstance(x, float) and math.isnan(x):
            assert math.isnan(y)
        else:
            assert x == y, field.name


DROPPED = object()


def damaged(report: HandEyeReport, key: str, value: Any) -> str:
    document = json.loads(calibration_text(report, FRAMES))
    at = document
    *way, last = key.split("/")
    for step in way:
        at = at[int(step) if step.isdigit() else step]
    if value is DROPPED:
        del at[last]
    else:
        at[last] = value
    return json.dumps(document)


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("schema", "other", "schema 'other'"),
        ("version", 99, "version 99"),
        ("mode", "sideways", "sideways"),
        ("X", DROPPED, "missing required field `X`"),
        ("X/quaternion_xyzw", [1.0, 0.0, 0.0, 0.0], "different transforms"),
        ("views/2/uv", [[1.0, "x"]], "views[2].uv"),
        ("views/0/index", None, "views[0].index"),
        ("target/rows", DROPPED, "rows"),
        ("checks/0/verdict", "superb", "superb"),
        ("robot_map/kind", "odd", "odd"),
        ("intrinsics_alone/fx", "wide", "fx"),
        ("board/half_sides_m", [0.1], "half_sides_m"),
        ("map_scores", [["none"]], "map_scores"),
    ],
)
def test_a_damaged_entry_is_named(
    full_record: Maker, key: str, value: Any, says: str, tmp_path: Path
) -> None:
    path = tmp_path / "calibration.json"
    path.write_text(damaged(full_record(np.eye(4)), key, value))
    said = refused(r"calibration\.json", read_calibration, path)
    assert says in said


@pytest.mark.parametrize(("text", "says"), [("{", "not valid JSON"), ("[1, 2]", "list")])
def test_another_file_is_named(text: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    refused("does not exist", read_calibration, path)
    path.write_text(text)
    refused(says, read_calibration, path)
