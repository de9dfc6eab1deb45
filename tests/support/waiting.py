"""Wait for what other threads, processes and browsers bring about."""

import time
from collections.abc import Callable


def comes_about(holds: Callable[[], object], seconds: float = 30.0) -> bool:
    """Return whether something holds before long; whoever asks it is not idle meanwhile."""
    end = time.monotonic() + seconds
    while not holds():
        if time.monotonic() > end:
            return False
        time.sleep(0.01)
    return True
