"""Several files of a folder that change together: a kill leaves all of them old, or all new.

New files are first written whole to a folder of their own, `.adding`, then listed in a note there.
From the note on the change counts: it is finished by moving the files into place, in the order of
the note, and whoever opens the folder after a kill does just that. Without the note nothing has
happened, and `.adding` is thrown away by the next writer.
"""

import os
import shutil
import time
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from realsim.errors import InputError
from realsim.store import atomic
from realsim.store.atomic import storing, sync_folder
from realsim.store.lock import only_run_in
from realsim.untrusted.own_json import read_object

ADDING = ".adding"
NOTE = "commit.json"
WAIT_S = 30.0
"""How long a writer waits for another [s]: a model is written in far less than a second, the work
before it is done outside the lock."""
PAUSE_S = 0.05


@contextmanager
def only_writer_of(folder: Path) -> Generator[None]:
    """Keep other writers out of a folder; wait for one that is there.

    Raises:
        InputError: another is writing there all the time.
    """
    deadline = time.monotonic() + WAIT_S
    while True:
        lock = only_run_in(folder)
        try:
            lock.__enter__()
            break
        except InputError:
            if time.monotonic() > deadline:
                raise
            time.sleep(PAUSE_S)
    try:
        yield
    finally:
        lock.__exit__(None, None, None)


def is_unfinished(folder: Path) -> bool:
    """Whether a kill came between the note of a change and its end."""
    return (folder / ADDING / NOTE).is_file()


def finish_interrupted(folder: Path) -> bool:
    """Finish a change that a kill interrupted; return whether there was one.

    Nothing is changed where a writer is at work: it finishes by itself, and is waited for.
    """
    if not is_unfinished(folder):
        return False
    with only_writer_of(folder):
        if not is_unfinished(folder):
            return False
        with storing(folder, "what an interrupted run left undone"):
            _move_into_place(folder)
    return True


def commit(folder: Path, files: Mapping[str, bytes], gone: Sequence[str] = ()) -> None:
    """Write files in this order and delete others, all or nothing; the caller is the only writer.

    Args:
        folder: where they are.
        files: path in the folder -> content.
        gone: paths that are deleted, before the files are put in place.

    Raises:
        StorageError: the disk is full or refuses; everything is as it was.
    """
    staging = folder / ADDING
    with storing(folder, f"{len(files)} files"):
        if is_unfinished(folder):
            _move_into_place(folder)
        shutil.rmtree(staging, ignore_errors=True)
        try:
            for name, data in files.items():
                atomic.write_bytes(staging / name, data)
            atomic.write_json(staging / NOTE, {"files": list(files), "gone": list(gone)})
        except OSError:
            shutil.rmtree(staging, ignore_errors=True)
            raise
        _move_into_place(folder)


def _move_into_place(folder: Path) -> None:
    """Do what the note says; a part that was done before the kill is not done again."""
    staging = folder / ADDING
    note = read_object(staging / NOTE)
    for name in note["gone"]:
        (folder / name).unlink(missing_ok=True)
    for name in note["files"]:
        place = folder / name
        place.parent.mkdir(parents=True, exist_ok=True)
        if (staging / name).is_file():
            os.replace(staging / name, place)
            sync_folder(place.parent)
    (staging / NOTE).unlink()
    sync_folder(staging)
    shutil.rmtree(staging, ignore_errors=True)
