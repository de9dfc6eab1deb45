"""JSON files of a session, read with messages that say what to do."""

import json
from pathlib import Path
from typing import Any

from realsim.errors import InputError


def read_json_file(path: Path | str) -> Any:
    """Return the values of a JSON file.

    Raises:
        InputError: it is missing or not JSON.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} does not exist; has the step that writes it been run?")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(
            f"{path} is not valid JSON ({error}). Restore it, or delete it and run the step that "
            "writes it again."
        ) from error


def read_object(path: Path) -> dict[str, Any]:
    """Return the values of a JSON file that holds an object.

    Raises:
        InputError: it is missing, not JSON, or something else.
    """
    value = read_json_file(path)
    if not isinstance(value, dict):
        raise InputError(f"{path} holds a {type(value).__name__}; an object is expected.")
    return {str(key): item for key, item in value.items()}  # pyright: ignore[reportUnknownVariableType]
