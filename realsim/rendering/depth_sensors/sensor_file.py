"""Sensors as records of plain numbers: made from named values, read from JSON files and written."""

import json
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from realsim.errors import InputError


class SensorRecord:
    """What a sensor's dataclass inherits; all of its fields have plain defaults."""

    __slots__ = ()
    FORMAT: ClassVar[str]
    """What the key "format" of its JSON files says."""
    KEY: ClassVar[str]
    """The key of its fields in them."""
    NAME: ClassVar[str]
    """How messages call it."""
    COMMAND: ClassVar[str]
    """What writes such files."""

    @classmethod
    def from_fields(cls, values: Mapping[str, Any], source: str) -> Self:
        """Return the record of named values; fields that are not named keep their defaults.

        Args:
            values: field and value.
            source: where they are from, for the message.

        Raises:
            InputError: a name is no field, a value has the wrong type or is out of range.
        """
        known: dict[str, type[Any]] = {f.name: type(f.default) for f in fields(cls)}  # type: ignore[arg-type]
        for name, value in values.items():
            if name not in known:
                raise InputError(
                    f"{source}: {cls.NAME} has no '{name}'; it has: {', '.join(known)}."
                )
            kind = known[name]
            right = isinstance(value, bool) if kind is bool else _is_number(value, kind)
            if not right:
                raise InputError(
                    f"{source}: {name} is {value!r}; a finite {kind.__name__} is accepted."
                )
        return cls(**{n: known[n](v) for n, v in values.items()})

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Return the sensor in a JSON file that `realsim depth-fit` wrote.

        Raises:
            InputError: the file cannot be read, is of another kind, or holds a wrong value.
        """
        path = Path(path)
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, ValueError) as error:
            raise InputError(
                f"{path} cannot be read as JSON ({error}); give the file that `{cls.COMMAND}` "
                "writes."
            ) from error
        if not isinstance(document, dict) or document.get("format") != cls.FORMAT:
            raise InputError(
                f"{path} is no {cls.FORMAT.removeprefix('realsim ').rstrip(' 0123456789')} model: "
                f"its format is not '{cls.FORMAT}'. Give the file that `{cls.COMMAND}` writes."
            )
        values = document.get(cls.KEY)
        if not isinstance(values, dict):
            raise InputError(f"{path} has no object '{cls.KEY}'.")
        return cls.from_fields(values, str(path))

    def document(self) -> dict[str, Any]:
        """Return what `load` reads, ready for JSON."""
        return {"format": self.FORMAT, self.KEY: asdict(self)}  # type: ignore[call-overload]


def _is_number(value: object, kind: type) -> bool:
    """Return whether a value is a finite number, and a whole one where that is wanted."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return bool(np.isfinite(value)) and (kind is float or float(value).is_integer())
