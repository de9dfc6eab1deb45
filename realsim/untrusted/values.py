"""Plain values out of files of others: numbers, texts and mappings, or a message that says where.

`name` says in the message what the value is and where it stands, such as "'fx' of scene.json".
"""

import math
import os
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array
from realsim.errors import InputError

EXACT_WHOLE = 2**53
"""Up to here every whole number is a double."""
LONGEST_TEXT = 10_000
"""Characters of a name, a path or a remark."""
LONGEST_PART, LONGEST_PATH = 250, 2000
"""Bytes of a name and of a path in a data set; a system takes them with an ending and a folder."""


def number(value: Any, name: str, low: float = -math.inf, high: float = math.inf) -> float:
    """Return a finite number within [low, high].

    Raises:
        InputError: it is no number (a text or true is none), not finite, or out of range.
    """
    if isinstance(value, (bool, np.bool_)) or not isinstance(
        value, (int, float, np.integer, np.floating)
    ):
        raise InputError(f"{name} is {_shown(value)}; a number is expected.")
    try:
        found = float(value)
    except OverflowError:
        found = math.inf
    if not math.isfinite(found) or not low <= found <= high:
        raise InputError(f"{name} is {_shown(value)}; {_range(low, high)} is expected.")
    return found


def whole(value: Any, name: str, low: float = -math.inf, high: float = math.inf) -> int:
    """Return a whole number within [low, high]; 640.0 is one.

    Raises:
        InputError: it is no number, not whole, or out of range.
    """
    if isinstance(value, (int, np.integer)) and not isinstance(value, bool):
        found = int(value)
    else:
        exact = number(value, name)
        if not exact.is_integer() or abs(exact) > EXACT_WHOLE:
            raise InputError(f"{name} is {_shown(value)}; a whole number is expected.")
        found = int(exact)
    if not low <= found <= high:
        raise InputError(f"{name} is {_shown(value)}; {_range(low, high)} is expected.")
    return found


def numbers(value: Any, count: int | None, name: str) -> Array:
    """Return a flat list of finite numbers as (count,) float64; None = any count.

    Raises:
        InputError: it is no list or array of that many finite numbers.
    """
    if isinstance(value, np.ndarray):
        array = cast("NDArray[Any]", value)
        listed: list[Any] = array.ravel().tolist()
        flat = array.ndim == 1
    else:
        flat = isinstance(value, (list, tuple))
        listed = list(value) if flat else []
    if not flat or (count is not None and len(listed) != count):
        wanted = "numbers" if count is None else f"{count} numbers"
        found = f"a list of {len(listed)}" if flat else _shown(value)
        raise InputError(f"{name} is {found}; a list of {wanted} is expected.")
    if all(type(item) is float for item in listed):
        array = np.array(listed, dtype=np.float64)
        if np.isfinite(array).all():
            return array
    return np.array(
        [number(item, f"number {k + 1} of {name}") for k, item in enumerate(listed)],
        dtype=np.float64,
    )


def text(value: Any, name: str) -> str:
    """Return a text of printable characters, 1 to 10,000 of them.

    Raises:
        InputError: it is no text, empty, too long, or has characters that no name has.
    """
    if not isinstance(value, str):
        raise InputError(f"{name} is {_shown(value)}; a text is expected.")
    if not value.strip() or len(value) > LONGEST_TEXT:
        raise InputError(f"{name} has {len(value)} characters; 1 to {LONGEST_TEXT} are expected.")
    if any(not c.isprintable() and c not in "\t\r\n" for c in value):
        raise InputError(f"{name} is {_shown(value)}; it has characters that no name has.")
    return value


def mapping(value: Any, name: str) -> dict[str, Any]:
    """Return a mapping whose keys are texts; whole numbers as keys become texts.

    Raises:
        InputError: it is no mapping, or has other keys.
    """
    if not isinstance(value, Mapping):
        raise InputError(f"{name} is {_shown(value)}; named values are expected.")
    found = cast("Mapping[Any, Any]", value)
    for key in found:
        if not isinstance(key, str) and (isinstance(key, bool) or not isinstance(key, int)):
            raise InputError(f"{name} has the key {_shown(key)}; its keys have to be texts.")
    named = {str(key): item for key, item in found.items()}
    if len(named) < len(found):
        raise InputError(f"{name} has a key twice, as number and as text.")
    return named


def need(data: Any, keys: tuple[str, ...], what: str) -> dict[str, Any]:
    """Return data as an object that has the keys.

    Raises:
        InputError: it is not one; the message names what is missing.
    """
    if not isinstance(data, dict):
        raise InputError(f"{what}: an object is expected, found {type(data).__name__}.")
    record = {str(k): v for k, v in cast("dict[Any, Any]", data).items()}
    missing = [key for key in keys if key not in record]
    if missing:
        raise InputError(
            f"{what} lacks {', '.join(missing)}; it has: {', '.join(record) or 'nothing'}."
        )
    return record


def path_inside(folder: Path, value: Any, name: str) -> Path:
    """Return the path that a file names, if it stays inside the folder, links resolved.

    Raises:
        InputError: as of `relative_path`, or a link leads out.
    """
    path = folder / relative_path(value, name)
    try:
        if path.resolve().is_relative_to(folder.resolve()):
            return path
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(f"{name} is {_shown(value)}; no file has such a name.") from error
    raise InputError(_LEADS_OUT.format(name, _shown(value), folder))


def relative_path(value: Any, name: str) -> PurePosixPath:
    """Return the path that a file names, relative to a folder that it does not leave by itself.

    Raises:
        InputError: it is no text, absolute, goes up with '..', or no system has files of such a
            name.
    """
    given = text(value, name)
    path = PurePosixPath(given.replace("\\", "/"))
    try:
        sizes = [len(os.fsencode(part)) for part in path.parts]
    except ValueError:
        sizes = [LONGEST_PATH]
    if max(sizes, default=0) > LONGEST_PART or sum(sizes) > LONGEST_PATH or "\0" in given:
        raise InputError(f"{name} is {_shown(value)}; no file has such a name.")
    if path.is_absolute() or ".." in path.parts or given[1:2] == ":":
        raise InputError(_LEADS_OUT.format(name, _shown(value), "the data set"))
    return path


_LEADS_OUT = (
    "{} is {}, which leads out of {}. Files are only read from inside the data set: copy the file "
    "there and name it relative to the folder."
)


def _shown(value: Any) -> str:
    """Return a value for a message; of a large one the kind, never all of it."""
    if isinstance(value, str):
        return repr(value[:60]) + ("..." if len(value) > 60 else "")
    if isinstance(value, int) and abs(value) > 10**40:
        return "a number of more than 40 digits"
    if value is None or isinstance(value, (bool, int, float, np.generic)):
        return f"{value!s:.60}"
    size = f" of {len(cast('Any', value))}" if isinstance(value, (list, tuple, dict)) else ""
    return f"a {type(value).__name__}{size}"


def _range(low: float, high: float) -> str:
    if math.isinf(low) and math.isinf(high):
        return "a finite number"
    if math.isinf(high):
        return f"{low:g} or more"
    return f"{high:g} or less" if math.isinf(low) else f"a number from {low:g} to {high:g}"
