"""Values as JSON has them: results, tables, reports, plans."""

import json
import math
from collections.abc import Mapping, Set
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, cast


def json_value(value: object) -> Any:
    """Return a value as JSON has it: arrays as lists, records by field, NaN and infinity as null.

    Raises:
        TypeError: it is something else; the command that gives it is at fault.
    """
    if value is None or isinstance(value, bool | int | str):
        return value
    found: Any
    if isinstance(value, float):
        found = float(value) if math.isfinite(value) else None
    elif isinstance(value, Path):
        found = str(value)
    elif isinstance(value, Mapping):
        items = cast("Mapping[object, object]", value).items()
        found = {str(key): json_value(each) for key, each in items}
    elif isinstance(value, list | tuple):
        found = [json_value(each) for each in cast("list[object]", value)]
    elif isinstance(value, Set):
        found = sorted(json_value(each) for each in cast("Set[object]", value))
    elif is_dataclass(value):
        found = {f.name: json_value(getattr(value, f.name)) for f in fields(value)}
    elif hasattr(value, "tolist"):  # numpy's arrays and numbers, without loading numpy for it
        found = json_value(cast(Any, value).tolist())
    else:
        raise TypeError(f"no JSON value: {type(value).__name__}")
    return found


def json_document(value: object) -> str:
    """Return a command's result as JSON text."""
    return json.dumps(json_value(value), indent=1, allow_nan=False)
