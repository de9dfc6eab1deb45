"""Files that are there whole or not at all.

A file is written under a temporary name in the same folder, flushed to the disk, and renamed; a
rename within one folder is atomic. Then the folder is flushed, too: only that makes the new name
outlive a power cut. So when a call returns, its file is on the disk, and what is written by the
next call can never be there without it. What a killed process leaves behind is a temporary file
that nobody reads; whoever owns the folder asks for `leftovers` and deletes them.

A full disk is an OSError: the file, and the lines that were there, are as before the call.

One run at a time in a folder.
"""

import contextlib
import csv
import errno
import fcntl
import io
import json
import math
import os
import shutil
import threading
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import ArrayLike

from realsim.errors import InputError, RealsimError

TEMPORARY_SUFFIX = ".part"
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""What the system says when there is no room: disk, quota, size of one file."""
BYTES_PER_MB = 1e6


class StorageError(RealsimError):
    """The disk is full or refuses to be written; what was stored before is as it was."""


@contextlib.contextmanager
def storing(folder: Path, what: str) -> Generator[None]:
    """Turn the system's refusal to write into a StorageError that says what to do."""
    try:
        yield
    except OSError as error:
        if error.errno in FULL:
            free = shutil.disk_usage(folder).free / BYTES_PER_MB
            raise StorageError(
                f"there is no room for {what} in {folder} ({error.strerror}; {free:.1f} MB free). "
                "Everything stored before is intact. Make room, then run the same command again: "
                "it goes on from here."
            ) from error
        raise StorageError(
            f"{what} could not be written in {folder} ({error.strerror or error}). Everything "
            "stored before is intact. Check that the disk is there and that the folder may be "
            "written, then run the same command again: it goes on from here."
        ) from error


def temporary(path: Path) -> Path:
    """Return the name under which this thread writes a file before it is whole."""
    # The process number tells a leftover from a file that another process is writing right now.
    writer = f"{os.getpid()}-{threading.get_ident()}"
    return path.with_name(f".{path.name}.{writer}{TEMPORARY_SUFFIX}")


def sync_folder(folder: Path) -> None:
    """Have the names in a folder on the disk."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _make_folder(folder: Path) -> None:
    """Make a folder and those above it; each name is flushed to the disk."""
    if folder.is_dir():
        return
    _make_folder(folder.parent)
    folder.mkdir(exist_ok=True)
    sync_folder(folder.parent)


@contextlib.contextmanager
def replacing(path: Path, *, flush: bool) -> Generator[IO[bytes]]:
    """Open a file that is written piece by piece; it gets its name when it is whole.

    Args:
        path: the file; its folder is made as needed.
        flush: whether its bytes are on the disk before (see `write_bytes`).
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    unnamed = temporary(path)
    try:
        with unnamed.open("wb") as file:
            yield file
            if flush:
                file.flush()
                os.fsync(file.fileno())
        os.replace(unnamed, path)
    except BaseException:
        unnamed.unlink(missing_ok=True)
        raise


def write_bytes(
    path: Path | str, data: bytes, *, announce: Callable[[], None] | None = None, flush: bool = True
) -> None:
    """Write the file whole or not at all; folders are made as needed.

    Args:
        path: the file.
        data: its bytes.
        announce: called when the bytes are on the disk and the rename is next. Who keeps a list of
            files writes it here, and finishes the rename after a kill (see `leftovers`).
        flush: False leaves it to the system when the bytes reach the disk: a kill still leaves
            the file whole, a power cut may not. For what can be made again from other files.
    """
    path = Path(path)
    _make_folder(path.parent)
    unnamed = temporary(path)
    announced = False
    try:
        with unnamed.open("wb") as file:
            file.write(data)
            file.flush()
            if flush:
                os.fsync(file.fileno())
        if announce is not None:
            announce()
            announced = True
        os.replace(unnamed, path)
        if flush:
            sync_folder(path.parent)
    except BaseException as error:
        if not announced:
            unnamed.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno and error.filename is None:
            error.filename = str(path)  # a full disk names no file
        raise


def write_text(path: Path | str, text: str) -> None:
    """Write UTF-8 text whole or not at all."""
    write_bytes(path, text.encode("utf-8"))


def json_bytes(value: Any, *, indent: int | None = 1) -> bytes:
    """Return plain values as JSON; NaN and infinity are refused, they are not JSON.

    Floats come back bit for bit: Python writes the shortest text that reads as the same number.
    """
    return (json.dumps(value, indent=indent, allow_nan=False) + "\n").encode("utf-8")


def write_json(path: Path | str, value: Any) -> None:
    """Write plain JSON values whole or not at all."""
    write_bytes(path, json_bytes(value))


def csv_bytes(header: Sequence[str], rows: Iterable[Sequence[object]]) -> bytes:
    """Return rows as CSV (RFC 4180, UTF-8); what is not known, None or NaN, is an empty cell."""
    text = io.StringIO(newline="")
    table = csv.writer(text)
    table.writerow(header)
    for row in rows:
        table.writerow(["" if isinstance(c, float) and math.isnan(c) else c for c in row])
    return text.getvalue().encode("utf-8")


def npz_bytes(**arrays: ArrayLike) -> bytes:
    """Return arrays as the bytes of a compressed npz file; the same arrays give the same bytes."""
    buffer = io.BytesIO()
    named: dict[str, Any] = {name: np.asarray(value) for name, value in arrays.items()}
    np.savez_compressed(buffer, **named)
    return buffer.getvalue()


def write_npz(path: Path | str, **arrays: ArrayLike) -> None:
    """Write arrays as a compressed npz file, whole or not at all."""
    write_bytes(path, npz_bytes(**arrays))


def append_line(path: Path | str, line: str) -> None:
    """Append one line in one write and flush it to the disk; all of it or, on an error, nothing.

    A kill can tear the line; `complete_lines` does not see it and `repair_lines` removes it.
    """
    path = Path(path)
    is_new = not path.exists()
    handle = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        before = os.fstat(handle).st_size
        try:
            data = memoryview((line + "\n").encode("utf-8"))
            while data:
                data = data[os.write(handle, data) :]
            os.fsync(handle)
        except BaseException:
            # The disk is full: half a line would spoil the one that is appended after it.
            with contextlib.suppress(OSError):
                os.ftruncate(handle, before)
            raise
    finally:
        os.close(handle)
    if is_new:
        sync_folder(path.parent)


def complete_lines(path: Path | str) -> list[str]:
    """Return the lines that end in a newline: a torn last one is not among them."""
    path = Path(path)
    if not path.is_file():
        return []
    data = path.read_bytes()
    whole = data[: data.rfind(b"\n") + 1]
    return [line for line in whole.decode("utf-8", errors="replace").split("\n") if line]


def repair_lines(path: Path | str) -> bool:
    """Cut off a torn last line, so that the next one starts on its own; return whether it did."""
    path = Path(path)
    if not path.is_file():
        return False
    data = path.read_bytes()
    end = data.rfind(b"\n") + 1
    if end == len(data):
        return False
    with path.open("r+b") as file:
        file.truncate(end)
        os.fsync(file.fileno())
    return True


def _is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def leftovers(folder: Path | str) -> list[tuple[Path, Path]]:
    """Return (temporary file, its final path) of processes that are no longer running."""
    found: list[tuple[Path, Path]] = []
    for path in Path(folder).rglob(f".*{TEMPORARY_SUFFIX}"):
        name, _, writer = path.name[1 : -len(TEMPORARY_SUFFIX)].rpartition(".")
        pid = writer.partition("-")[0]
        if name and pid.isdecimal() and not _is_running(int(pid)):
            found.append((path, path.with_name(name)))
    return found


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
