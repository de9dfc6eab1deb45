"""What comes from one browser: done in its order, and told to the page, which waits for it."""

import contextlib
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from realsim.review.window.window import Window

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
