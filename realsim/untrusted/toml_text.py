"""TOML that people write: settings and limits, small, shallow, and without strange characters."""

import re
import tomllib
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any

from realsim.errors import InputError
from realsim.untrusted.files import checked_text

MOST_BYTES = 1e6
"""Largest file [bytes]; every option of every command, with its meaning, takes a twentieth."""
DEEPEST = 20
"""Tables in tables: no command and no figure needs more than three."""
MOST_PARTS = 20
"""Parts of one dotted name, such as registration.accepted."""
LONG_NAME = re.compile(rf"""(?<![\w"'-])(?:[\w"'-]++[ \t]*+\.[ \t]*+){{{MOST_PARTS}}}""")
LARGEST = 2**63
"""TOML's whole numbers have 64 bits; hexadecimal ones are read at any length."""


def read_toml(path: Path) -> tuple[str, dict[str, Any]]:
    """Return the text of a TOML file and its values.

    Raises:
        InputError: as `parsed_toml`, or it is missing, no UTF-8, or has more than 1 MB.
    """
    text = checked_text(path, MOST_BYTES)
    return text, parsed_toml(text, str(path))


@lru_cache(maxsize=64)  # a robot is looked for by name in every robot's file, again and again
def parsed_toml(text: str, where: str) -> dict[str, Any]:
    """Return the values of TOML text, not to be changed; `where` names it in messages.

    Raises:
        InputError: it is no TOML, nested deeper than 20 levels, has a whole number beyond 64 bits,
            or the character zero in a text.
    """
    _require_short_names(text, where)
    try:
        values = tomllib.loads(text)
    except RecursionError as error:
        raise _too_deep(where) from error
    except ValueError as error:  # a TOMLDecodeError is one, a number of 5000 digits another
        said = str(error)
        if "integer string conversion" in said:
            said = "a number has thousands of digits"
        raise InputError(
            f"{where} is not TOML: {said}. Texts stand in quotes, tables in brackets, as in "
            'out = "page.html" and [register].'
        ) from error
    _require_plain(values, where)
    return values


def _require_short_names(text: str, where: str) -> None:
    """Refuse names of very many parts before they are read: the time grows as their square."""
    found = LONG_NAME.search(text)
    if found is not None:
        line = text.count("\n", 0, found.start()) + 1
        raise InputError(
            f"{where}, line {line}: a name of more than {MOST_PARTS} parts; none has more than "
            "three."
        )


def _require_plain(values: dict[str, Any], where: str) -> None:
    """Go down level by level, without recursion."""
    level: list[Any] = [values]
    for _ in range(DEEPEST):
        below: list[Any] = []
        for container in level:
            _require_plain_items(container, where)
            inner = container.values() if type(container) is dict else container
            below += [item for item in inner if type(item) in (list, dict)]
        if not below:
            return
        level = below
    raise _too_deep(where)


def _require_plain_items(container: Any, where: str) -> None:
    named: Iterable[tuple[Any, Any]] = (
        container.items() if type(container) is dict else (("a list", item) for item in container)
    )
    for name, value in named:
        if "\0" in name or (isinstance(value, str) and "\0" in value):
            raise InputError(
                f"{where}: {name.replace(chr(0), '?'):.60} has a text with the character zero in "
                "it; no name of a file and no option has one."
            )
        if isinstance(value, int) and not -LARGEST <= value < LARGEST:
            raise InputError(f"{where}: {name:.60} has a whole number of more than 64 bits.")


def _too_deep(where: str) -> InputError:
    return InputError(f"{where} is nested deeper than {DEEPEST} levels; settings are not.")
