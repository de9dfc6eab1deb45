"""Files that are there whole or not at all.

A file is written under a temporary name in the same folder, flushed to the disk, and renamed; a
rename within one folder is atomic. What a killed process leaves behind is a temporary file that
nobody reads; whoever owns the folder asks for `leftovers` and deletes them.
"""

import io
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

TEMPORARY_SUFFIX = ".part"


def _temporary(path: Path) -> Path:
    # The process number tells a leftover from a file that another process is writing right now.
    return path.with_name(f".{path.name}.{os.getpid()}{TEMPORARY_SUFFIX}")


def write_bytes(
    path: Path | str, data: bytes, *, announce: Callable[[], None] | None = None
) -> None:
    """Write the file whole or not at all; folders are made as needed.

    Args:
        path: the file.
        data: its bytes.
        announce: called when the bytes are on the disk and the rename is next. Who keeps a list of
            files writes it here, and finishes the rename after a kill (see `leftovers`).
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _temporary(path)
    announced = False
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        if announce is not None:
            announce()
            announced = True
        os.replace(temporary, path)
    except BaseException:
        if not announced:
            temporary.unlink(missing_ok=True)
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
    """Append one line in one write and flush it to the disk.

    A kill can tear the line; `complete_lines` does not see it and `repair_lines` removes it.
    """
    handle = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        data = memoryview((line + "\n").encode("utf-8"))
        while data:
            data = data[os.write(handle, data) :]
        os.fsync(handle)
    finally:
        os.close(handle)


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
        name, _, pid = path.name[1 : -len(TEMPORARY_SUFFIX)].rpartition(".")
        if name and pid.isdecimal() and not _is_running(int(pid)):
            found.append((path, path.with_name(name)))
    return found
