"""JSON of others is read as json reads it, or refused with the file's name."""

import json
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from realsim.untrusted.json_text import parsed_json, read_json
from refusals import refused

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(exclude_categories=("Cs", "Cc"))),
    lambda inner: st.lists(inner) | st.dictionaries(st.text("abc", min_size=1), inner),
    max_leaves=20,
)  # fmt: skip


@given(value=VALUES)
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_what_json_wrote_is_read_back(value: object) -> None:
    assert parsed_json(json.dumps(value), "there") == value


def test_the_mark_of_windows_editors_is_no_character(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(b'\xef\xbb\xbf{"a": 1}')
    assert read_json(tmp_path / "a.json") == {"a": 1}


@pytest.mark.parametrize(("text", "says"), [
    ('{"starts": [{"x": 1}, {"T": [[0, NaN]]}]}', "has NaN at starts[1].T[0][1]: "),
    ("[1e999]", "double precision"),
    ("[-" + "9" * 1_000_000 + "]", "1000001 digits"),
    ("[" * 100_000 + "]" * 100_000, "deeper"),
    ('{"a":' * 300 + "1" + "}" * 300, "deeper"),
    ('{"a": 1, "b": 2, "a": 3}', "'a' is there twice"),
    ('["\\ud800"]', "half a character"),
    ('["a\\u0000b"]', "zero"),
    ("[1, 2", "not valid JSON"),
])  # fmt: skip
def test_what_cannot_be_computed_with_is_refused(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(text)
    said = refused(r"a\.json", read_json, path)
    assert says in said
    assert len(said) < 600


def test_escaped_characters_of_two_halves_and_escaped_backslashes_are_text() -> None:
    assert parsed_json('["\\ud83d\\ude00", "C:\\\\u0000"]', "x") == ["\U0001f600", "C:\\u0000"]


def test_every_limit_refuses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.json"
    path.write_text("[[1], [2], [3]]")
    refused("MB", read_json, path, most_bytes=10)
    monkeypatch.setattr("realsim.untrusted.json_text.MOST_CONTAINERS", 3)
    refused("4 arrays", read_json, path)


def test_other_encodings_folders_and_nothing_are_refused(tmp_path: Path) -> None:
    (tmp_path / "latin.json").write_bytes(b'["\xe9"]')
    refused("UTF-8", read_json, tmp_path / "latin.json")
    refused("is a folder", read_json, tmp_path)
    for name in ("none.json", "a\0b"):
        refused("does not exist", read_json, tmp_path / name)
