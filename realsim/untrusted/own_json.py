"""JSON files that realsim itself writes: declared once, as the record or struct that they hold.

    class Note(OwnFile, kw_only=True):         # unknown fields are told; dataclasses do as well
        format: Literal["realsim note 1"] = "realsim note 1"
        depth_unit_m: Annotated[float, Meta(gt=0, le=0.02)]
        T_world_obj: Array       # nested lists; NaN is null
        sigma_px: Real = math.nan              # any double: NaN is null, infinity "inf"
        scenes: dict[str, Scene] = {}          # records of realsim.records as they are

    atomic.write_json(path, to_json(note))
    note = read_own(path, Note)     # InputError: "path: ... `float` > 0.0 - at `depth_unit_m` ..."

Python writes a float as the shortest text that reads as the same float, so nothing is lost. What
`realsim.untrusted.json_text` refuses (doubled keys, bombs, NaN as a word) is refused here as well.
Two classes in one field have a common base, a `Tagged`. What a record's own `__post_init__` checks
needs no second check.
"""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_origin

import msgspec
import numpy as np
from msgspec.inspect import type_info

from realsim.arrays import Array
from realsim.errors import InputError, UnreadableError
from realsim.untrusted import json_text

Declared = TypeVar("Declared")
REMEDY = "Restore the file, or delete it and run the step that writes it again."

if TYPE_CHECKING:
    Real = float
else:

    class _Doubles(type):
        def __instancecheck__(cls, value: object) -> bool:
            return isinstance(value, float)

    class Real(metaclass=_Doubles):
        """Any double in a file: NaN is null, the infinities are "inf" and "-inf"."""


class OwnFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The base of a file's declaration."""


class Tagged:
    """The base of records that share a field; each has `kind: Literal["its word"] = "its word"`."""

    __slots__ = ()


def to_json(value: Any) -> Any:
    """Return a record, struct, array or number as plain JSON values, bit for bit."""
    return _finite(msgspec.to_builtins(value, str_keys=True, enc_hook=_plain))


def from_json(data: Any, kind: type[Declared], what: str) -> Declared:
    """Return what `to_json` made JSON of.

    Args:
        data: plain JSON values.
        kind: a struct, a dataclass, or a list, tuple or dict of them.
        what: what the data is, or its file, for messages.

    Raises:
        InputError: a field is missing, of another type or out of range; the message names it.
    """
    try:
        return msgspec.convert(data, kind, dec_hook=_built)
    except msgspec.ValidationError as error:
        told = str(error).replace("`$.", "`").replace(" - at `$`", "")
        if "missing" in told and " - at `" not in told and isinstance(data, dict):
            told += f"; it has: {', '.join(map(str, data)) or 'nothing'}"
        if (names := "unknown field" in told) or "enum value" in told:
            at = told.partition(" - at `")[2].replace("[...]", "").strip("`$")
            at = at.rpartition(".")[2].partition("[")[0]
            told += f"; accepted: {', '.join(map(str, _words(type_info(kind), at, names)))}"
        raise InputError(f"{what}: {told[:1].lower()}{told[1:500]}.") from error
    except InputError as error:  # a record's own check
        raise type(error)(f"{what}: {error}") from error


def number_from_json(value: Any) -> float:
    """Return the number that `to_json` made JSON of."""
    return math.nan if value is None else float(value)


def array_from_json(values: Any, shape: tuple[int, ...] | None = None) -> Array:
    """Return the array that `to_json` made JSON of, in a shape if one is given."""
    array = np.array(values, dtype=np.float64)
    return array if shape is None else array.reshape(shape)


def read_own(path: Path | str, kind: type[Declared]) -> Declared:
    """Return what a file holds.

    Raises:
        InputError: it is missing, no JSON, or not as declared.
    """
    return from_json(read_values(path), kind, str(path))


def read_values(path: Path | str) -> Any:
    """Return the plain values of a file of ours.

    Raises:
        InputError: it is missing, or not JSON by `realsim.untrusted.json_text`.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} does not exist; has the step that writes it been run?")
    try:
        return json_text.read_json(path)
    except UnreadableError:
        raise
    except InputError as error:
        raise InputError(f"{error} {REMEDY}") from error


def read_object(path: Path | str) -> dict[str, Any]:
    """Return the plain values of a file of ours that holds an object.

    Raises:
        InputError: as `read_values`, or it holds something else.
    """
    value = read_values(path)
    if not isinstance(value, dict):
        raise InputError(f"{path} holds a {type(value).__name__}; an object is expected.")
    return {str(key): item for key, item in value.items()}  # pyright: ignore[reportUnknownVariableType]


def noted(path: Path | str) -> dict[str, Any]:
    """Return what a note of ours says; nothing where it is not there, and a damaged one is none."""
    try:
        return read_object(path)
    except (InputError, OSError):
        return {}


def _words(kind: Any, field: str, names: bool, inside: bool = False) -> list[Any]:
    """Return the words, or the names of fields, that a field of this name may hold anywhere."""
    fields = getattr(kind, "fields", ())
    known = [f.encode_name for f in fields] if names else list(getattr(kind, "values", ()))
    if known and (inside or not field):
        return known
    parts = [getattr(kind, n, None) for n in ("type", "item_type", "value_type")]
    parts += getattr(kind, "types", ())
    found = [_words(part, field, names, inside) for part in parts if part]
    found += [_words(f.type, field, names, inside or f.encode_name == field) for f in fields]
    return list(dict.fromkeys(word for words in found for word in words))


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"a {type(value).__name__} has no form in JSON")


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if not isinstance(value, float) or math.isfinite(value):
        return value
    return None if math.isnan(value) else ("inf" if value > 0 else "-inf")


def _built(kind: Any, value: Any) -> Any:
    if kind is Real:
        return number_from_json(value)
    if get_origin(kind) is np.ndarray:
        return np.array(value, dtype=kind.__args__[1].__args__[0])
    if isinstance(kind, type) and issubclass(kind, Tagged):
        words: dict[str, Any] = {}
        each: list[Any] = kind.__subclasses__()
        for known in each:  # a class with slots stands after the one without
            words[known.__dataclass_fields__["kind"].default] = known
        found = value.get("kind") if isinstance(value, dict) else None
        if found not in words:
            raise ValueError(f"kind {found!r} is not known; {', '.join(words)} are")
        return msgspec.convert(value, words[found], dec_hook=_built)
    # A mistake in the declaration, so no error of the kind that a file's contents raise.
    raise RuntimeError(f"{kind} is declared in a file of ours and has no form in JSON")
