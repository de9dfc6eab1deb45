"""One run at a time in a folder."""

import fcntl
import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from realsim.errors import InputError


@contextmanager
def only_run_in(folder: Path) -> Generator[None]:
    """Keep other runs out of a folder while this one works in it; a kill releases it.

    The lock is on the folder itself, so that no file is left behind.

    Raises:
        InputError: another run is working there.
    """
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                f"another run is working in '{folder}'. Wait until it ends, stop it, or choose "
                "another folder; two at once would mix their results."
            ) from None
        try:
            yield
        finally:
            # By itself it would go on in processes that were forked meanwhile.
            fcntl.flock(handle, fcntl.LOCK_UN)
    finally:
        os.close(handle)
