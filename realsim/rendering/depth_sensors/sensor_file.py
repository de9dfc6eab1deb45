"""Sensors in JSON files: a record's fields by name, each checked against the record's own types."""

import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from realsim.errors import InputError


def checked_fields(
    record: type[Any], values: Mapping[str, Any], source: str, what: str
) -> dict[str, Any]:
    """Return named values in the types that a record's defaults have.

    Args:
        record: a dataclass whose fields all have plain defaults.
        values: field and value.
        source: where they are from, for the message.
        what: how to call the record in the message.

    Raises:
        InputError: a name is no field, or a value has the wrong type or is not finite.
    """
    known: dict[str, type[Any]] = {f.name: type(f.default) for f in fields(record)}
    for name, value in values.items():
        if name not in known:
            raise InputError(f"{source}: {what} has no '{name}'; it has: {', '.join(known)}.")
        kind = known[name]
        right = isinstance(value, bool) if kind is bool else _is_number(value, kind)
        if not right:
            raise InputError(
                f"{source}: {name} is {value!r}; a finite {kind.__name__} is accepted."
            )
    return {n: known[n](v) for n, v in values.items()}


def read_sensor(path: Path | str, format_: str, key: str, command: str) -> dict[str, Any]:
    """Return the fields that a sensor's JSON file holds under `key`.

    Args:
        path: the file.
        format_: what its "format" must be.
        key: of the fields.
        command: what writes such files, for the message.

    Raises:
        InputError: the file cannot be read or is of another kind.
    """
    path = Path(path)
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise InputError(
            f"{path} cannot be read as JSON ({error}); give the file that `{command}` writes."
        ) from error
    if not isinstance(document, dict) or document.get("format") != format_:
        raise InputError(
            f"{path} is no {format_.removeprefix('realsim ').rstrip(' 0123456789')} model: its "
            f"format is not '{format_}'. Give the file that `{command}` writes."
        )
    values = document.get(key)
    if not isinstance(values, dict):
        raise InputError(f"{path} has no object '{key}'.")
    return values


def _is_number(value: object, kind: type) -> bool:
    """Return whether a value is a finite number, and a whole one where that is wanted."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return bool(np.isfinite(value)) and (kind is float or float(value).is_integer())
