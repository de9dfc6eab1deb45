"""What comes from one browser: done in its order, and for the object that was shown."""

import contextlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from realsim.errors import InputError

if TYPE_CHECKING:
    from realsim.review.window.window import Window

ANY = ""
"""What is meant by that which nobody clicked."""


class Hands:
    """Keys and clicks of a browser, one after the other."""

    def __init__(self, window: "Window") -> None:
        """Take whose they are; nothing is shown yet.

        Args:
            window: of the browser.
        """
        self._window = window
        self._work, self._look = ThreadPoolExecutor(1), ThreadPoolExecutor(1)
        self._shown, self._meant = "/", ANY
        """What the browser is known to show, and what it showed at this click."""
        self.done = 0
        """How much is done: the page hands on the next key then."""

    def do(self, action: Callable[[], object], *, is_key: bool = True) -> None:
        """Do something after what came before it.

        Args:
            action: what.
            is_key: whether it is for any object, or the page sees to that itself.
        """
        meant = ANY if is_key else self._shown

        def work() -> None:
            self._meant = meant
            self._window.attempt(action)
            self._meant = ANY
            self.done += 1
            self._window.photographs.tell()
            self._look.submit(self._wait_until_shown)

        with contextlib.suppress(RuntimeError):  # the browser is gone
            self._work.submit(work)

    def require_shown(self) -> None:
        """Refuse what was clicked while the browser showed another object than is looked at now.

        Raises:
            InputError: it did.
        """
        if self._meant not in (ANY, self._window.whose):
            raise InputError(
                "another object was chosen just before that was pressed: nothing is done. Look at "
                "it, and press again."
            )

    def close(self) -> None:
        """Do no more."""
        for pool in (self._work, self._look):
            pool.shutdown(wait=False, cancel_futures=True)

    def _wait_until_shown(self) -> None:
        here = self._window.whose
        if here != self._shown:
            self._window.browser.wait_for(here)
            self._shown = here
