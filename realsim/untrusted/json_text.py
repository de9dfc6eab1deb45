"""JSON of others: finite numbers, each key once, and no more than fits into memory."""

import json
import math
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from realsim.errors import InputError
from realsim.untrusted.files import checked_text

MOST_BYTES = 512e6
"""Largest file [bytes]: the labels of BOP's largest scenes have 100 MB."""
MOST_CONTAINERS = 20_000_000
"""Arrays and objects in one file: an empty one has 2 bytes in the file and 64 in memory."""
DEEPEST = 100
"""Arrays in arrays: no format of scenes, grasps or cameras goes beyond ten."""
LONGEST_NUMBER = 400
"""Characters of one whole number; the largest double has 309."""
STRANGE_ESCAPE = re.compile(r"\\u(?:0000|[dD][89a-fA-F])")


def read_json(path: Path | str, *, most_bytes: float = MOST_BYTES) -> Any:
    """Return the values of a JSON file.

    Args:
        path: the file, UTF-8.
        most_bytes: largest file that is read [bytes].

    Raises:
        InputError: it is missing, too large, not UTF-8, not JSON, nested deeper than 100, has NaN,
            infinity or a number beyond double precision, a key twice in one object, or text with
            half a character or a zero in it.
    """
    path = Path(path)
    return parsed_json(checked_text(path, most_bytes), str(path))


def parsed_json(text: str, where: str) -> Any:
    """Return the values of JSON text; `where` names it in messages.

    Raises:
        InputError: as `read_json`.
    """
    containers = text.count("[") + text.count("{")
    if containers > MOST_CONTAINERS:
        raise InputError(
            f"{where} holds {containers} arrays and objects; at most {MOST_CONTAINERS} are read."
        )
    strange: set[str] = set()
    try:
        value = json.loads(
            text, parse_constant=lambda name: strange.add(name) or float(name),
            parse_float=_finite, parse_int=_whole, object_pairs_hook=_each_once,
        )  # fmt: skip
    except RecursionError as error:
        raise _too_deep(where) from error
    except (ValueError, MemoryError) as error:
        raise InputError(
            f"{where} is not valid JSON ({str(error) or 'too large'}). Write it again "
            "with the program that made it."
        ) from error
    _require_shallow(value, where)
    if strange:
        raise InputError(
            f"{where} has {min(strange)} at {_strange_place(value):.200}: JSON has no such number, "
            "and nothing can be computed with it. Write a number, or leave the entry out."
        )
    if STRANGE_ESCAPE.search(text):
        _require_whole_characters(value, where)
    return value


def _finite(text: str) -> float:
    number = float(text)
    if math.isfinite(number):
        return number
    raise ValueError(f"the number {text:.40} is beyond double precision")


def _whole(text: str) -> int:
    if len(text) > LONGEST_NUMBER:
        raise ValueError(f"a number of {len(text)} digits, {text:.20}...")
    return int(text)


def _strange_place(value: Any, place: str = "") -> str:
    """Return where the first number that is not finite stands, such as starts[1].radius_mm."""
    if isinstance(value, float):
        return "" if math.isfinite(value) else place.lstrip(".") or "the top"
    parts: Iterable[tuple[str, Any]] = ()
    if type(value) is dict:
        parts = ((f"{place}.{key}", inner) for key, inner in value.items())
    elif type(value) is list:
        parts = ((f"{place}[{k}]", inner) for k, inner in enumerate(value))
    return next(filter(None, (_strange_place(inner, at) for at, inner in parts)), "")


def _each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key '{twice:.60}' is there twice in one object: which one holds?")
    return found


def _too_deep(where: str) -> InputError:
    return InputError(f"{where} is nested deeper than {DEEPEST} levels; that is no data set.")


def _require_shallow(value: Any, where: str) -> None:
    """Go down level by level, without recursion."""
    level: list[Any] = [value] if isinstance(value, (list, dict)) else []
    for _ in range(DEEPEST):
        below: list[Any] = []
        for container in level:
            inner = container.values() if type(container) is dict else container
            below += [item for item in inner if type(item) is list or type(item) is dict]
        if not below:
            return
        level = below
    raise _too_deep(where)


def _require_whole_characters(value: Any, where: str) -> None:
    """Refuse texts that no file name and no other file can hold."""
    written = json.dumps(value, ensure_ascii=False)
    try:
        written.encode("utf-8")
    except UnicodeEncodeError as error:
        raise InputError(f"{where} has text with half a character in it ({error}).") from error
    if STRANGE_ESCAPE.search(written.replace("\\\\", "")):
        raise InputError(f"{where} has text with the character zero in it; no name has one.")
