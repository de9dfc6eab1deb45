"""The guide to a new lab quotes what realsim says of each classic mistake."""

import re

import classic_mistakes as made
import pytest
from documents import ROOT
from printed import NUMBER, near

GUIDE = ROOT / "docs/how-to/calibrate-a-new-lab.md"
ROWS = {
    "poses inverted": made.inverted_poses,
    "quaternion w x y z": made.quaternion_order,
    "degrees read as radians": made.degrees_for_radians,
    "millimetres for metres": made.millimetres,
    "another board": made.board_size,
    "a detection failed": made.shifted_images,
    "the board was pushed": made.moved_board,
    "one image was saved twice": made.frozen_camera,
    "the sheet was printed at 97 %": made.scaled_print,
    "the hand turned about one axis": made.one_axis,
}
REST = (made.slipped_mount, made.other_resolution)


def quoted(text: str) -> list[str]:
    return [" ".join(m.split()) for m in re.findall(r"(?<!\*)\*([^*|]+)\*(?!\*)", text)]


def says(message: str, quote: str) -> bool:
    """Return whether a message has the quote in it, figures as near as the tour states."""
    pattern = f"({NUMBER.pattern})".join(re.escape(words) for words in NUMBER.split(quote))
    for m in re.finditer(pattern, message):
        if all(near(a, b) for a, b in zip(NUMBER.findall(quote), m.groups(), strict=True)):
            return True
    return False


def table() -> list[tuple[str, str]]:
    part = GUIDE.read_text(encoding="utf-8").partition("## Ten classic mistakes")[2]
    rows = [line.strip("| ").split(" | ") for line in part.splitlines() if line.startswith("|")]
    return [(mistake.strip(), said) for mistake, said in rows[2:]]


def test_the_quotes_are_compared_with_their_figures() -> None:
    assert says("the ratio is 0.97 +-0.01 now", "ratio is 0.98 +-0.01")
    assert not says("the ratio is 0.97 +-0.01 now", "ratio is 1.98 +-0.01")
    assert not says("the ratio is 0.97", "the share is 0.97")


def test_the_guide_has_ten_mistakes_and_all_are_made() -> None:
    rows = table()
    assert len(rows) == len(ROWS) == 10
    assert all(any(m.startswith(known) for known in ROWS) for m, _ in rows)


@pytest.mark.slow
@pytest.mark.parametrize("mistake", ROWS)
def test_a_mistake_is_named_as_the_guide_says(mistake: str) -> None:
    (said,) = [said for m, said in table() if m.startswith(mistake)]
    message = ROWS[mistake]()
    assert quoted(said)
    for quote in quoted(said):
        assert says(message, quote), f"{quote}\nis not in\n{message}"


@pytest.mark.slow
def test_what_is_seen_but_not_named_is_told_so() -> None:
    after = GUIDE.read_text(encoding="utf-8").partition("Two more:")[2]
    messages = [made() for made in REST]
    for quote, message in zip(quoted(after), messages, strict=True):
        assert says(message, quote), f"{quote}\nis not in\n{message}"
