"""The guide to a new lab quotes what realsim says of each classic mistake."""

import re

import classic_mistakes as made
import pytest
from printed import NUMBER, near

from documents import ROOT

GUIDE = ROOT / "docs/how-to/calibrate-a-new-lab.md"
ROWS = {
    "quaternion w x y z": made.quaternion_order,
    "the board was pushed": made.moved_board,
    "the sheet was printed at 97 %": made.scaled_print,
    "the hand turned about one axis": made.one_axis,
}


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


def test_the_guide_has_ten_mistakes_and_those_that_are_made() -> None:
    rows = table()
    assert len(rows) == 10
    assert all(any(m.startswith(known) for m, _ in rows) for known in ROWS)


@pytest.mark.slow
@pytest.mark.parametrize("mistake", ROWS)
def test_a_mistake_is_named_as_the_guide_says(mistake: str) -> None:
    (said,) = [said for m, said in table() if m.startswith(mistake)]
    message = ROWS[mistake]()
    assert quoted(said)
    for quote in quoted(said):
        assert says(message, quote), f"{quote}\nis not in\n{message}"
