"""The keys of the review page.

W A S D Q E and the arrows move the browser's camera, so none of them is taken. Keys do nothing
while a text is being written.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import viser

from realsim.review.placing.placing import Axis, Kind

if TYPE_CHECKING:
    from realsim.review.window.window import Window

Letter = Literal[
    "H", "N", "P", "Y", "X", "Z", "M", "V", "B", "T", "C", "F", "J", "L", "K", "I", "O", "U"
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Key:
    """A key and what it does."""

    key: Letter
    words: str
    act: Callable[["Window"], object]


@dataclass(frozen=True, slots=True)
class Step:
    """A key that moves the object along an axis; with Shift it turns it about the axis."""

    key: Letter
    axis: Axis
    sign: int


KEYS = (
    Key("N", "Next undecided object", lambda w: w.next_undecided(1)),
    Key("P", "Previous undecided object", lambda w: w.next_undecided(-1)),
    Key("Y", "Accept the object", lambda w: w.object.decide("accept")),
    Key("X", "Reject the object", lambda w: w.object.decide("reject")),
    Key("Z", "Undo the last line on the object", lambda w: w.object.undo()),
    Key("M", "Correct the object", lambda w: w.correct.begin()),
    Key("V", "Save the pose", lambda w: w.correct.save()),
    Key("B", "Put the object back", lambda w: w.correct.put_back()),
    Key("T", "Snap by ICP", lambda w: w.correct.snap()),
    Key("C", "Show the chosen view's photograph", lambda w: w.views.show_chosen()),
    Key("F", "Look at the object", lambda w: w.stand.look_at_object()),
    Key("H", "Look at the whole scene", lambda w: w.stand.first_look()),
)
STEPS = (
    Step("J", "x", -1),
    Step("L", "x", 1),
    Step("K", "y", -1),
    Step("I", "y", 1),
    Step("O", "z", -1),
    Step("U", "z", 1),
)
WAYS: tuple[tuple[Kind, Literal["shift"] | None], ...] = (("move", None), ("turn", "shift"))


def bind_keys(window: "Window") -> None:
    """Give one browser its keys; Ctrl+K lists them."""
    add = window.client.gui.add_command
    for key in KEYS:
        handle = add(key.words, hotkey=key.key, icon=viser.Icon.KEYBOARD)
        handle.on_trigger(_doing(window, key.act))
    for step in STEPS:
        mark = "+" if step.sign > 0 else "\u2212"
        for kind, modifier in WAYS:
            words = f"{kind.capitalize()} the object: {mark}{step.axis}"
            handle = add(words, hotkey=step.key, modifier=modifier, icon=viser.Icon.KEYBOARD)
            handle.on_trigger(_doing(window, _nudging(step, kind)))


def _doing(window: "Window", act: Callable[["Window"], object]) -> Callable[[Any], None]:
    return window.guarded(lambda _: act(window))


def _nudging(step: Step, kind: Kind) -> Callable[["Window"], object]:
    return lambda window: window.correct.nudge(step.axis, step.sign, kind)
