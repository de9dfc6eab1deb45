"""Functions that tasks of tests run, in whatever process or on whatever node."""

import errno
import signal
import time
from pathlib import Path

from realsim.errors import InputError
from realsim.store import atomic


def doubled(number):
    return 2 * number


def odd_fails(number):
    if number % 2:
        raise InputError(f"{number} is odd")
    return number


def waits_then(seconds, value):
    time.sleep(seconds)
    return value


def sizes(*paths):
    """Return the bytes of files, and of every file of folders by its name."""
    return [
        {p.name: p.stat().st_size for p in sorted(path.iterdir())}
        if path.is_dir()
        else path.stat().st_size
        for path in paths
    ]


def dies_first(marks, times, signal_number=signal.SIGKILL):
    """Kill the own process so many times; every life leaves a mark."""
    lives = len(list(Path(marks).iterdir()))
    (Path(marks) / f"life_{lives}").touch()
    if lives < times:
        signal.raise_signal(signal_number)
    return lives


def rewrites(folder, text):
    """Change a folder: one file anew, one longer, one gone, a large one; the last is `last.txt`."""
    (folder / "changed.txt").write_text(text)
    with (folder / "log.txt").open("a") as file:
        file.write(text)
    (folder / "gone.txt").unlink()
    (folder / "below").mkdir(exist_ok=True)
    (folder / "below" / "large.bin").write_bytes(bytes(20_000_000))
    (folder / "empty.txt").write_bytes(b"")
    (folder / "last.txt").write_text("done")
    return sorted(p.name for p in folder.iterdir())


def spoils_and_fails(folder):
    (folder / "changed.txt").write_text("spoiled")
    raise InputError("it cannot be done")


def fills_the_disk(folder, is_stored):
    """Meet a full disk, as a stage tells it or as the system does."""
    full = OSError(errno.ENOSPC, "No space left on device")
    if not is_stored:
        raise full
    with atomic.storing(Path(folder), "a result"):
        raise full
