"""Arrays and their JSON notes in one npz file, written whole or not at all."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.store import atomic
from realsim.untrusted.arrays import read_npz

Made = TypeVar("Made")
NOTES = "notes_json"
"""Name of the array that holds the notes as UTF-8 JSON."""
MOST_BYTES = 8e9
"""Largest sum of the arrays of one file that is read [bytes]."""


def write_arrays(path: Path, arrays: dict[str, NDArray[Any]], notes: dict[str, Any]) -> None:
    """Write arrays and notes to `path`; a reader finds the whole file or none."""
    text = np.frombuffer(json.dumps(notes).encode(), dtype=np.uint8)
    contents: dict[str, NDArray[Any]] = {**arrays, NOTES: text}
    with atomic.replacing(path, flush=True) as file:
        np.savez(file, **contents)  # pyright: ignore[reportArgumentType]


def read_arrays(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return arrays and notes of a file of `write_arrays`.

    Raises:
        InputError: the file is damaged.
    """
    try:
        arrays = read_npz(path, most_bytes=MOST_BYTES, texts=True)
        notes: dict[str, Any] = json.loads(arrays.pop(NOTES).tobytes().decode())
    except (InputError, ValueError, KeyError) as error:
        raise InputError(f"{error} Delete {path}: its content is computed again.") from error
    return arrays, notes


def rebuilt(
    path: Path, build: Callable[[dict[str, NDArray[Any]], dict[str, Any]], Made]
) -> Made | None:
    """Return what arrays and notes of a file make, or None: no file, damaged, of other content."""
    if not path.is_file():
        return None
    try:
        return build(*read_arrays(path))
    except (InputError, KeyError, TypeError, ValueError):
        return None


def is_whole(path: Path) -> bool:
    """Return whether a file of `write_arrays` is there and whole; a damaged one is deleted."""
    if not path.is_file():
        return False
    try:
        read_arrays(path)
    except InputError:
        path.unlink()
        return False
    return True
