"""YAML of others is read as ruamel's safe loader reads it, or refused."""

import json
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML

from realsim.untrusted.yaml_text import parsed_yaml, read_yaml
from refusals import refused

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**12), 10**12) | st.floats(-1e9, 1e9)
    | st.text("abyesno0.1:-#'\" \n~é", max_size=8),
    lambda inner: st.lists(inner, max_size=4)
    | st.dictionaries(st.text("abc", min_size=1), inner, max_size=4),
    max_leaves=12,
)  # fmt: skip


@given(value=VALUES)
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_what_a_yaml_writer_wrote_is_read_back(
    tmp_path_factory: pytest.TempPathFactory, value: Any
) -> None:
    path = tmp_path_factory.getbasetemp() / "a.yaml"
    writer = YAML(typ="safe", pure=True)
    writer.default_flow_style = False  # in flow style it writes {a: :0}, which it cannot read
    writer.dump(value, path)
    assert read_yaml(path) == value


@given(value=VALUES)
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_json_is_yaml(value: Any) -> None:
    assert parsed_yaml(json.dumps(value), "there") == value


def test_plain_values_are_those_of_yaml_1_2() -> None:
    text = "[1, -2, 0x1f, 0o17, 1e3, 1.5, .5, yes, off, true, ~, null, 2020-01-01, 1_000, '1', 0b1]"
    assert parsed_yaml(text, "x") == [
        1, -2, 31, 15, 1000.0, 1.5, 0.5, "yes", "off", True, None, None, "2020-01-01", "1_000",
        "1", "0b1",
    ]  # fmt: skip


def test_an_alias_is_what_it_stands_for() -> None:
    assert parsed_yaml("{a: &x [1, 2], b: *x}", "x") == {"a": [1, 2], "b": [1, 2]}


LAUGHS = "a0: &a0 [ha, ha]\n" + "".join(
    f"a{k + 1}: &a{k + 1} [{', '.join([f'*a{k}'] * 9)}]\n" for k in range(30)
)


@pytest.mark.parametrize(("text", "says"), [
    (LAUGHS, "unfolds"),
    ("&a [*a]", "inside of what it stands for"),
    ("[" * 2_000, "deeper"),
    ("!!python/object/apply:os.system ['true']", "tag"),
    ("a: .nan", "finite"),
    ("a: 1e999", "finite"),
    ("a: " + "9" * 1_000_000, "digits"),
    ("a: 1\nb: 2\na: 3", "'a' twice"),
    ("a: &x {b: 1}\nc: {<<: *x}", "<<"),
    ("? [1]\n: 2", "as a key"),
    ("--- 1\n--- 2", "several documents"),
    ("a: [1, 2", "not valid YAML"),
    ("a: \x07", "not valid YAML"),
    ("!!int x", "as int"),
])  # fmt: skip
def test_what_unfolds_runs_or_is_no_number_is_refused(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(text)
    said = refused(r"a\.yaml", read_yaml, path)
    assert says in said
    assert len(said) < 600


def test_size_and_emptiness(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("")
    assert read_yaml(path) is None
    path.write_text("a: 1")
    refused("MB", read_yaml, path, most_bytes=2)
    assert not math.isnan(parsed_yaml("1.0", "x"))
