"""Hand-written TOML: fields read by name, wrong ones named with what was meant."""

import math
import tomllib
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from realsim.errors import InputError


class Fields:
    """One table of a TOML file; remembers which file and where, for messages."""

    def __init__(self, values: dict[str, Any], where: str, known: tuple[str, ...]) -> None:
        """Check the keys.

        Raises:
            InputError: a key that is not known; it is named with the nearest known one.
        """
        self.values, self.where = values, where
        if unknown := [key for key in values if key not in known]:
            key = unknown[0]
            near = get_close_matches(key, known, n=1, cutoff=0.5)
            meant = f" Was '{near[0]}' meant?" if near else ""
            raise InputError(f"{where}: '{key}' is not known.{meant} There are {', '.join(known)}.")

    def text(self, key: str) -> str:
        """Return a text that must be there."""
        value = self.values.get(key)
        if not isinstance(value, str) or not value.strip():
            raise InputError(f"{self.where}: {key} is {_shown(value)}; a text is needed.")
        return value

    def number(self, key: str, default: float) -> float:
        """Return a finite number, or the default."""
        value = self.values.get(key, default)
        if not _is_number(value):
            raise InputError(f"{self.where}: {key} is {_shown(value)}; a number is needed.")
        return float(value)

    def row(self, key: str, count: int, default: tuple[float, ...] | None = None) -> list[float]:
        """Return a list of `count` numbers, finite or not."""
        value = self.values.get(key, default)
        if (
            not isinstance(value, list | tuple)
            or len(value) != count
            or not all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
        ):
            raise InputError(
                f"{self.where}: {key} is {_shown(value)}; a list of {count} numbers is needed."
            )
        return [float(v) for v in value]

    def finite_row(
        self, key: str, count: int, default: tuple[float, ...] | None = None
    ) -> list[float]:
        """Return a list of `count` finite numbers."""
        row = self.row(key, count, default)
        if not all(math.isfinite(v) for v in row):
            raise InputError(f"{self.where}: {key} is {row}; finite numbers are needed.")
        return row

    def tables(self, key: str) -> list[dict[str, Any]]:
        """Return the [[key]] tables, none if there are none."""
        value = self.values.get(key, [])
        if not isinstance(value, list) or not all(isinstance(v, dict) for v in value):
            raise InputError(f"{self.where}: {key} must be written as [[{key}]] tables.")
        return value


def read_toml(path: Path) -> dict[str, Any]:
    """Return a TOML file's values.

    Raises:
        InputError: no such file, or not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path} does not exist. Give the path of a TOML file.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read: {error}.") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(
            f"{path} is not TOML: {error}. Numbers are written 0.035 (with a point), texts in "
            "quotes, lists in brackets."
        ) from None


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _shown(value: Any) -> str:
    return "missing" if value is None else repr(value)
