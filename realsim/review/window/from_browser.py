"""What a browser may set the controls to: whoever opens the page can send any message.

Viser takes every value that is sent. Here it is looked at before, so that no control ever holds a
choice that it does not offer, and no panel has to ask.

What comes from one browser: done in its order, and told to the page, which waits for it.

The keys of the review page.

W A S D Q E and the arrows move the browser's camera, so none of them is taken. Keys do nothing
while a text is being written.
"""

import contextlib
import logging
import math
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import viser

from realsim.errors import InputError
from realsim.local_pages import refuse_uploads
from realsim.review.placing.placing import Axis, Kind
from realsim.review.replaying.grasp_words import one_line

if TYPE_CHECKING:
    from realsim.review.window.window import Window


log = logging.getLogger(__name__)
MOST_TEXT = 20_000
"""Characters of a text field: more than a comment may have, so that it can still be shortened."""
SHOWN, SHOWN_TEXT = 8, 60
"""Choices that a refusal lists, and characters of the value that it shows."""


def refuse_foreign_values(gui: viser.GuiApi, refuse: Callable[[str], None]) -> None:
    """Put a check before what one browser sets its controls to, and before its camera.

    Args:
        gui: of the client.
        refuse: told why a value was not taken.
    """
    from viser import _messages as viser_messages

    api: Any = gui
    wire, take = api._websock_interface, api._handle_gui_updates

    async def checked(client_id: int, message: Any) -> None:
        handle = api._gui_input_handle_from_uuid.get(message.uuid)
        if handle is not None:
            try:
                check_update(handle, message.updates)
            except InputError as error:
                refuse(str(error))
                # The browser shows the value that it sent; it is told the one that holds.
                held = {"value": handle.value}
                wire.queue_message(viser_messages.GuiUpdateMessage(message.uuid, held))
                return
        await take(client_id, message)

    takers = wire._incoming_handlers.pop(viser_messages.ViewerCameraMessage)

    async def seen(client_id: int, message: Any) -> None:
        if not is_camera(message):
            return log.warning("a message from a browser was not understood: %.200r", message)
        for taker in takers:
            await taker(client_id, message)

    refuse_uploads(wire)
    wire.unregister_handler(viser_messages.GuiUpdateMessage, take)
    wire.register_handler(viser_messages.GuiUpdateMessage, checked)
    wire.register_handler(viser_messages.ViewerCameraMessage, seen)


def forget_callbacks(gui: viser.GuiApi) -> None:
    """Let no control call anything when it is set: its browser is gone.

    Work that is still under way sets controls. Viser would begin a callback for each, on a loop
    that may be closed by then.
    """
    api: Any = gui
    for handle in tuple(api._gui_input_handle_from_uuid.values()):
        handle._impl.update_cb.clear()


def is_camera(camera: Any) -> bool:
    """Return whether what a browser gives as its camera has a place, a direction and what is up."""
    parts = ((camera.wxyz, 4), (camera.position, 3), (camera.look_at, 3), (camera.up_direction, 3))
    try:
        return all(np.isfinite(v).all() and np.shape(v) == (n,) for v, n in parts)
    except (TypeError, ValueError):
        return False


def check_update(handle: Any, updates: Mapping[str, Any]) -> None:
    """Check what a control is to be set to.

    Args:
        handle: the control.
        updates: property -> value, as the browser sent them.

    Raises:
        InputError: it is not offered, not a number, or not the value at all.
    """
    foreign = sorted(set(updates) - {"value"})
    if foreign:
        raise InputError(f"a browser may set the value of a control, and not {_short(foreign[0])}.")
    if "value" not in updates:
        return
    value, held = updates["value"], handle.value
    options: tuple[str, ...] | None = getattr(handle, "options", None)
    if options is not None:
        if value not in options:
            more = ", ..." if len(options) > SHOWN else ""
            listed = ", ".join(options[:SHOWN]) + more
            raise InputError(f"{_short(value)} is not one of the choices: {listed}.")
    elif isinstance(held, bool):
        if not isinstance(value, bool):
            raise InputError(f"{_short(value)} is neither on nor off.")
    elif isinstance(held, int | float):
        if isinstance(value, bool) or not isinstance(value, int | float) or not _is_finite(value):
            raise InputError(f"{_short(value)} is no number.")
    elif isinstance(held, str):
        if not isinstance(value, str):
            raise InputError(f"{_short(value)} is no text.")
        if len(value) > MOST_TEXT:
            raise InputError(
                f"the text has {len(value):,} characters; at most {MOST_TEXT:,} are taken."
            )


def _is_finite(value: float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond all floats
        return False


def _short(value: object) -> str:
    text = one_line(str(value))
    return f"'{text[:SHOWN_TEXT]}...'" if len(text) > SHOWN_TEXT else f"'{text}'"


TOLD = '<i data-realsim-hands="{client}/{received}" data-at-work="{at_work}"></i>'
"""What `page.js` reads: it hands on the next key or click when nothing is at work."""


class Hands:
    """Keys and clicks of a browser, one after the other."""

    def __init__(self, window: "Window") -> None:
        """Take whose they are; nothing has come yet.

        Args:
            window: of the browser.
        """
        self._window = window
        self._work, self._lock = ThreadPoolExecutor(1), threading.Lock()
        self._html = window.client.gui.add_html("")
        self._received = self._done = 0

    def do(self, action: Callable[[], object]) -> None:
        """Do something after what came before it."""

        def work() -> None:
            try:
                self._window.attempt(action)
                self._window.attempt(self._window.photographs.tell)
            finally:  # the page waits for it
                with self._lock:
                    self._done += 1
                    self._tell()

        with self._lock, contextlib.suppress(RuntimeError):  # the browser is gone
            self._work.submit(work)
            self._received += 1
            self._tell()

    def close(self) -> None:
        """Do no more."""
        self._work.shutdown(wait=False, cancel_futures=True)

    def _tell(self) -> None:
        if self._window.stands:
            self._html.content = TOLD.format(
                client=self._window.client.client_id,
                received=self._received,
                at_work=self._received - self._done,
            )


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
