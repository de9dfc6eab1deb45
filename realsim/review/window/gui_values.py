"""What a browser may set the controls to: whoever opens the page can send any message.

Viser takes every value that is sent. Here it is looked at before, so that no control ever holds a
choice that it does not offer, and no panel has to ask.
"""

import logging
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import viser

from realsim.errors import InputError
from realsim.local_pages import refuse_uploads
from realsim.review.replaying.grasp_words import one_line

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
