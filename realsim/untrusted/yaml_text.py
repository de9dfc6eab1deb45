"""YAML of others: plain values by the core schema of YAML 1.2, nothing that runs or unfolds.

The events of the parser are put together here and not by its own constructor: so the depth, the
unfolded size of aliases, doubled keys and every tag are watched while the file is read, and a
thousand digits or a date that does not exist raise nothing of their own.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from realsim.errors import InputError
from realsim.untrusted.files import checked_text

MOST_BYTES = 50e6
"""Largest file [bytes]. The parser is Python: it reads 0.2 MB a second."""
MOST_UNFOLDED = 10_000_000
"""Values with every alias written out."""
DEEPEST = 100
LONGEST_NUMBER = 400
NAMED: dict[str, bool | None] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
}
WHOLE = re.compile(r"[-+]?[0-9]+")
OTHER_BASE = re.compile(r"0o[0-7]+|0x[0-9a-fA-F]+")
FLOAT = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")
NOT_FINITE = re.compile(r"[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)")
CORE = "tag:yaml.org,2002:"


def read_yaml(path: Path | str, *, most_bytes: float = MOST_BYTES) -> Any:
    """Return the values of a YAML file of one document.

    Args:
        path: the file, UTF-8.
        most_bytes: largest file that is read [bytes].

    Raises:
        InputError: it is missing, too large, not UTF-8, not YAML, has several documents, tags
            beyond plain values, a key twice, merged keys, aliases that unfold beyond ten million
            values, NaN or infinity, or is nested deeper than 100.
    """
    path = Path(path)
    return parsed_yaml(checked_text(path, most_bytes), str(path))


def parsed_yaml(text: str, where: str) -> Any:
    """Return the values of YAML text; `where` names it in messages.

    Raises:
        InputError: as `read_yaml`.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        events: Iterator[Any] = YAML(typ="safe", pure=True).parse(text)
        return _Document(where).read(events)
    except InputError:
        raise
    except YAMLError as error:
        raise _unreadable(where, re.sub(r"\s+", " ", str(error))[:200]) from error
    except (RecursionError, MemoryError) as error:
        raise _unreadable(where, "too large or too deep") from error
    except (ValueError, TypeError, AttributeError, LookupError, AssertionError) as error:
        # What the parser trips over in files that it does not expect.
        raise _unreadable(where, f"{type(error).__name__}: {str(error)[:200]}") from error


def _unreadable(where: str, why: str) -> InputError:
    return InputError(f"{where} is not valid YAML ({why}).")


@dataclass(slots=True)
class _Open:
    """A sequence or mapping whose end has not come."""

    value: list[Any] | dict[Any, Any]
    anchor: str | None
    count: int = 1
    """Values in it, aliases written out."""
    key: list[Any] = field(default_factory=list[Any])
    """The key that waits for its value; none or one."""


class _Document:
    """Puts one document together."""

    def __init__(self, where: str) -> None:
        self._where = where
        self._open: list[_Open] = []
        self._known: dict[str, tuple[Any, int]] = {}
        self._root: list[Any] = []

    def read(self, events: Iterator[Any]) -> Any:
        documents = 0
        for event in events:
            kind = type(event).__name__
            if kind == "ScalarEvent":
                self._put(self._scalar(event), 1, event.anchor)
            elif kind == "SequenceStartEvent":
                self._begin([], event, ("seq",))
            elif kind == "MappingStartEvent":
                self._begin({}, event, ("map",))
            elif kind in ("SequenceEndEvent", "MappingEndEvent"):
                ended = self._open.pop()
                self._put(ended.value, ended.count, ended.anchor)
            elif kind == "AliasEvent":
                self._put(*self._alias(str(event.anchor)), None)
            elif kind == "DocumentStartEvent":
                documents += 1
                if documents > 1:
                    raise InputError(f"{self._where} has several documents; one is read.")
        return self._root[0] if self._root else None

    def _begin(self, value: list[Any] | dict[Any, Any], event: Any, plain: tuple[str, ...]) -> None:
        self._require_plain(event, plain)
        if len(self._open) >= DEEPEST:
            raise InputError(f"{self._where} is nested deeper than {DEEPEST} levels.")
        self._open.append(_Open(value, event.anchor))

    def _put(self, value: Any, count: int, anchor: str | None) -> None:
        """Put a value where it belongs: the document, the list, or as key or value."""
        if anchor is not None:
            self._known[str(anchor)] = (value, count)
        if not self._open:
            self._root.append(value)
            return
        into = self._open[-1]
        into.count += count
        if into.count > MOST_UNFOLDED:
            raise InputError(
                f"{self._where} unfolds to more than {MOST_UNFOLDED} values; aliases of aliases "
                "can make any number of them. Write it without aliases."
            )
        if isinstance(into.value, list):
            into.value.append(value)
        elif not into.key:
            into.key.append(self._key(value, into.value))
        else:
            into.value[into.key.pop()] = value

    def _key(self, key: Any, there: dict[Any, Any]) -> Any:
        if isinstance(key, (list, dict)):
            raise InputError(f"{self._where} has a list or mapping as a key; texts are expected.")
        if key in there:
            raise InputError(f"{self._where} has the key '{key!s:.60}' twice: which one holds?")
        if key == "<<":
            raise InputError(f"{self._where} merges mappings with '<<'; write the keys out.")
        return key

    def _alias(self, anchor: str) -> tuple[Any, int]:
        if anchor not in self._known:
            raise InputError(
                f"{self._where} has the alias '*{anchor:.60}' inside of what it stands for, or "
                "before it. Write it without aliases."
            )
        return self._known[anchor]

    def _require_plain(self, event: Any, plain: tuple[str, ...]) -> str:
        """Return the name of a core tag, '' if there is none."""
        tag = getattr(event, "tag", None)
        name = "" if tag is None else str(tag)
        if name in ("", "!"):
            return ""
        short = name.removeprefix(CORE)
        if short == name or short not in plain:
            raise InputError(
                f"{self._where} has the tag '{name:.60}'; plain numbers, texts, lists and mappings "
                "are read, no objects of a program."
            )
        return short

    def _scalar(self, event: Any) -> Any:
        tag = self._require_plain(event, ("str", "int", "float", "bool", "null"))
        text = str(event.value)
        if tag == "str" or (tag == "" and (event.style is not None or str(event.tag) == "!")):
            return text
        value = self._plain(text)
        if tag == "float" and type(value) is int:
            value = float(value) if abs(value) < 10**300 else math.inf
        kinds = {"int": int, "float": float, "bool": bool, "null": type(None)}
        if tag and type(value) is not kinds[tag]:
            raise InputError(f"{self._where} has '{text:.60}' as {tag}, which it is not.")
        if isinstance(value, float) and not math.isfinite(value):
            raise InputError(f"{self._where} has the number '{text:.60}'; it has to be finite.")
        return value

    def _plain(self, text: str) -> Any:
        """Return what a text without quotes stands for."""
        if text in NAMED:
            return NAMED[text]
        if text[0] not in "+-.0123456789":
            return text
        if NOT_FINITE.fullmatch(text):
            return math.nan
        is_number = WHOLE.fullmatch(text) or FLOAT.fullmatch(text) or OTHER_BASE.fullmatch(text)
        if is_number and len(text) > LONGEST_NUMBER:
            raise InputError(f"{self._where} has a number of {len(text)} digits.")
        if WHOLE.fullmatch(text):
            return int(text)
        if OTHER_BASE.fullmatch(text):
            return int(text[2:], 8 if text[1] == "o" else 16)
        return float(text) if is_number else text
