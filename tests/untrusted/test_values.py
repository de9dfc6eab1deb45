"""Plain values of others: taken as they are, or refused with their name."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from realsim.untrusted import values
from refusals import refused


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_a_finite_number_is_itself(x: float) -> None:
    assert values.number(x, "x") == x
    assert values.numbers([x, 1], 2, "x").tolist() == [x, 1.0]


@pytest.mark.parametrize(
    "value", [None, True, "1", [1], {}, float("nan"), float("inf"), 10**400, 1j, np.float64("nan")]
)
def test_what_is_no_number_is_refused(value: Any) -> None:
    refused("'fx' is", values.number, value, "'fx'")
    refused("'fx'", values.numbers, [1.0, value], 2, "'fx'")


def test_whole_numbers_may_be_written_as_floats_but_not_round_ones() -> None:
    assert values.whole(640.0, "n") == 640
    for wrong in (640.5, 1e300, True, "3"):
        refused("n is", values.whole, wrong, "n")


def test_ranges_hold_their_ends() -> None:
    assert values.number(1, "x", 1, 2) == 1.0 and values.whole(2, "x", 1, 2) == 2
    for wrong in (0.999, 2.001):
        refused("1 to 2", values.number, wrong, "x", 1, 2)
    refused("more than 40 digits; 2 or less", values.whole, 10**500, "x", high=2)
    refused("0 or more", values.whole, -1, "x", low=0)


@pytest.mark.parametrize("value", [[1, 2], [1, 2, 3, 4], 3, "123", {"a": 1}, None])
def test_lists_have_their_length(value: Any) -> None:
    refused("t is", values.numbers, value, 3, "t")


def test_texts_and_mappings() -> None:
    assert values.text("a b", "name") == "a b"
    assert values.mapping({"a": 1, 2: 3}, "m") == {"a": 1, "2": 3}
    for wrong in ("", " ", "a\0b", "\x1b[2J", 3, None, "x" * 10_001):
        refused("name", values.text, wrong, "name")
    for bad in ([], None, {None: 1}, {True: 1}, {1: 1, "1": 2}):
        refused("m ", values.mapping, bad, "m")


@pytest.mark.parametrize(
    "name", ["../x", "a/../../x", "/etc/passwd", "C:\\x", "..\\x", "a\0b", "link/x", "\u8336" * 86]
)
def test_paths_stay_inside(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    (folder / "link").symlink_to(tmp_path)
    assert values.path_inside(folder, "a/b.png", "'rgb'") == folder / "a/b.png"
    refused("'rgb'", values.path_inside, folder, name, "'rgb'")
