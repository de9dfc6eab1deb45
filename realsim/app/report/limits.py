"""Limits on figures, for scripts: what must hold, and what of it is broken."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from realsim.app.report.figures import Figure, require_known, shown
from realsim.errors import InputError
from realsim.untrusted.toml_text import read_toml

FAIL_ON = re.compile(r"\s*([\w.]+)\s*([<>])\s*(\S+)\s*")
"""NAME<VALUE or NAME>VALUE."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Limit:
    """What a figure must keep; a limit that is exactly met is kept."""

    name: str
    least: float = -math.inf
    greatest: float = math.inf


def limit_of(text: str) -> Limit:
    """Return the limit of `--fail-on NAME<VALUE` or `NAME>VALUE`: the figure must not be so.

    Raises:
        InputError: not of this form, no such figure, or a value that is no finite number.
    """
    found = FAIL_ON.fullmatch(text)
    if found is None:
        raise InputError(
            f"--fail-on '{text}' cannot be read; NAME<VALUE or NAME>VALUE is expected, such as "
            "'registration.accepted<5' (quoted: < and > mean something to the shell)."
        )
    name, sign, value = found.groups()
    require_known(name)
    number = _number(value, f"--fail-on '{text}'")
    return Limit(name=name, least=number) if sign == "<" else Limit(name=name, greatest=number)


def read_limits(path: Path) -> list[Limit]:
    """Return the limits of a TOML file: figure = {min = ..., max = ...}.

    Names with dots may be quoted, or written as TOML's own tables: both mean the same.

    Raises:
        InputError: no such file, no TOML, an unknown figure, or a limit of another form or not
            finite.
    """
    try:
        _, told = read_toml(path)
    except InputError as error:
        raise InputError(f"--limits: {error}") from error
    limits = list(_limits(told, "", path))
    if not limits:
        raise InputError(
            f"--limits '{path}' names no figure; lines such as calibration.held_out_px = "
            "{max = 0.5} are expected."
        )
    return limits


def _limits(told: Mapping[str, Any], before: str, path: Path) -> Iterator[Limit]:
    for key, value in told.items():
        name = f"{before}{key}"
        if not isinstance(value, dict):
            require_known(name)
            raise InputError(
                f"--limits '{path}': {name} = {value!r} is no limit; {{max = ...}}, {{min = ...}} "
                "or both are expected."
            )
        rows: Mapping[str, Any] = value
        if rows and set(rows) <= {"min", "max"}:
            require_known(name)
            ends = {k: _number(v, f"--limits '{path}': {name}.{k}") for k, v in rows.items()}
            limit = Limit(
                name=name, least=ends.get("min", -math.inf), greatest=ends.get("max", math.inf)
            )
            if limit.least > limit.greatest:
                raise InputError(f"--limits '{path}': {name} has min above max.")
            yield limit
        elif rows:
            yield from _limits(rows, f"{name}.", path)
        else:
            raise InputError(f"--limits '{path}': {name} has neither min nor max.")


def _number(value: Any, what: str) -> float:
    try:
        if isinstance(value, bool):
            raise ValueError
        number = float(value)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what}: '{value!s:.60}' is no number.") from error
    if not math.isfinite(number):
        raise InputError(
            f"{what}: '{value!s:.60}' is no limit; a finite number is expected. Leave out the end "
            "that has none."
        )
    return number


def broken(limits: Sequence[Limit], figures: Mapping[str, Figure]) -> Iterator[str]:
    """Return in words which limits are not kept; one on a figure that is not there is not."""
    for limit in limits:
        figure = figures.get(limit.name)
        if figure is None:
            yield f"{limit.name} is not there: its stage has not been run, or says nothing."
            continue
        value = f"{limit.name} is {shown(figure.value, figure.sigma)} {figure.meaning.unit}".strip()
        if figure.value < limit.least:
            yield f"{value}, at least {limit.least:g} is asked for."
        if figure.value > limit.greatest:
            yield f"{value}, at most {limit.greatest:g} is asked for."
