"""JSON files of a session, read with messages that say what to do."""

from pathlib import Path
from typing import Any

from realsim.errors import InputError
from realsim.untrusted import json_text


def read_json_file(path: Path | str) -> Any:
    """Return the values of a JSON file.

    Raises:
        InputError: it is missing, or not JSON by `realsim.untrusted.json_text`.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} does not exist; has the step that writes it been run?")
    try:
        return json_text.read_json(path)
    except InputError as error:
        raise InputError(
            f"{error} Restore the file, or delete it and run the step that writes it again."
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
