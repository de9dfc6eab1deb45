"""Arrays and their JSON notes in one npz file, written whole or not at all."""

import json
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

NOTES = "notes_json"
"""Name of the array that holds the notes as UTF-8 JSON."""


def write_arrays(path: Path, arrays: dict[str, NDArray[Any]], notes: dict[str, Any]) -> None:
    """Write arrays and notes to `path`; a reader finds the whole file or none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = np.frombuffer(json.dumps(notes).encode(), dtype=np.uint8)
    handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            contents: dict[str, NDArray[Any]] = {**arrays, NOTES: text}
            np.savez(file, **contents)  # pyright: ignore[reportArgumentType]
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def read_arrays(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return arrays and notes of a file of `write_arrays`."""
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files if name != NOTES}
        notes: dict[str, Any] = json.loads(file[NOTES].tobytes().decode())
    return arrays, notes
