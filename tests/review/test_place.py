"""The address of a window: what it says, and that nobody's link can do harm."""

import pytest

from realsim.review.window.place import Place


def test_an_address_is_read_as_it_was_written() -> None:
    place = Place(
        scene="000050 & more", instance=4, eye=(0.1, -0.25, 1.5), look_at=(0.0, 0.0, 0.0625)
    )
    assert Place.of(place.text("a box")) == place


@pytest.mark.parametrize(
    "text",
    ["", "scene", "=&&=", "instance=-1&view=1e3", "instance=\u0663", "eye=1,2&at=0,0,0",
     "eye=nan,0,0&at=0,0,0", "eye=1e9,0,0&at=0,0,0", "eye=1,1,1&at=1,1,1", "a=1&" * 500],
)  # fmt: skip
def test_what_is_no_place_is_left_out(text: str) -> None:
    assert Place.of(text) == Place()
