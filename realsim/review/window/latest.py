"""Work of which only the latest is worth doing: a picture of where an object is by now."""

import threading
from collections.abc import Callable


class LatestOnly:
    """Does a piece of work in a thread of its own; what is asked meanwhile is done once after."""

    def __init__(self, work: Callable[[], None]) -> None:
        """Wait to be asked.

        Args:
            work: looks itself what is to be done; it must not raise.
        """
        self._work = work
        self._lock = threading.Lock()
        self._is_wanted = self._is_running = False

    def ask(self) -> None:
        """Have it done soon; returns at once."""
        with self._lock:
            self._is_wanted = True
            if self._is_running:
                return
            self._is_running = True
        threading.Thread(target=self._run, name="review-latest", daemon=True).start()

    def _run(self) -> None:
        while True:
            with self._lock:
                if not self._is_wanted:
                    self._is_running = False
                    return
                self._is_wanted = False
            self._work()
