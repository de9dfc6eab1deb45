"""A file of settings with every option, commented out.

What is in force of every option, and where it came from.
"""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from realsim.app.command import (
    ENVIRONMENT,
    LONGEST_SENTENCE,
    default_of,
    settable,
    spelling,
    take_old_variables,
    variable,
)  # fmt: skip
from realsim.app.config.settings import ConfigFile, kind_of
from realsim.errors import InputError

DEFAULT = "default"
Commands = Mapping[tuple[str, ...], click.Command]


@dataclass(frozen=True, kw_only=True, slots=True)
class InForce:
    """The value of one option where the command line says nothing."""

    command: str
    """Such as `school run`."""
    option: str
    """As it is typed, without dashes."""
    value: Any
    """None: not set."""
    origin: str
    """`default`, a file with its line, or the name of a variable."""


def in_force(
    commands: Commands, settings: Mapping[str, Any], file: ConfigFile | None
) -> list[InForce]:
    """Return the value and the origin of every option of the commands.

    Args:
        commands: by their path.
        settings: of the file, as `default_map` has them.
        file: where they come from.

    Raises:
        InputError: a variable's value cannot be used.
    """
    for path, command in commands.items():
        take_old_variables(command, path)
    return [
        _one(path, option, _of(settings, path), file)
        for path, command in commands.items()
        for option in settable(command)
    ]


def _of(settings: Mapping[str, Any], path: Sequence[str]) -> Mapping[str, Any]:
    for name in path:
        settings = settings.get(name, {})
    return settings


def _one(
    path: tuple[str, ...], option: click.Option, settings: Mapping[str, Any],
    file: ConfigFile | None,
) -> InForce:  # fmt: skip
    ctx = click.Context(click.Command(path[-1]), default_map=dict(settings), info_name=path[-1])
    name = spelling(option)
    value, source = option.consume_value(ctx, {})
    origin = DEFAULT
    if source is ParameterSource.ENVIRONMENT:
        origin = variable(path, option)
        try:
            value = option.type_cast_value(ctx, value)
        except click.BadParameter as error:
            raise InputError(f"{origin}={os.environ[origin]}: {error.format_message()}") from error
    elif source is ParameterSource.DEFAULT_MAP and file is not None:
        tables, key = list(path), name
        if f"{file.path}" == file.place(tables, key):
            key = name.replace("-", "_")
        origin = file.place(tables, key)
        value = option.type_cast_value(ctx, value)
    else:
        value = default_of(option)
    if isinstance(value, tuple):
        value = list(value)
    return InForce(command=" ".join(path), option=name, value=value, origin=origin)


def strange_variables(commands: Commands) -> Iterator[str]:
    """Return a sentence for every variable that looks like an option's and is none's."""
    known = {variable(path, o) for path, command in commands.items() for o in settable(command)}
    heads = {"_".join([ENVIRONMENT, *path]).replace("-", "_").upper() + "_" for path in commands}
    for name in sorted(os.environ):
        if name in known or not any(name.startswith(head) for head in heads):
            continue
        close = get_close_matches(name, sorted(known), n=1)
        perhaps = f" Did you mean {close[0]}?" if close else ""
        yield f"the variable {name} is of no option; nothing reads it.{perhaps}"


HEAD = """\
# Settings of realsim: a table for each command, a key for each of its options.
# Every line is commented out and shows the default; "" means: not set.
# Read from: realsim --config FILE, else the file that REALSIM_CONFIG names, else ./realsim.toml,
# else ~/.config/realsim/config.toml. Over the file go variables (REALSIM_REGISTER_VIEWS=64), over
# both the command line. `realsim config show` tells what is in force.
"""


def template(commands: Commands) -> str:
    """Return the file; with all comment marks removed it changes nothing."""
    parts = [HEAD]
    for path, command in commands.items():
        options = settable(command)
        if not options:
            continue
        lines = [f"\n# {command.get_short_help_str(LONGEST_SENTENCE)}", f"[{'.'.join(path)}]"]
        for option in options:
            told = " ".join((option.help or "").split())
            lines.append(f"## {told} ({_many(option)}{kind_of(option)})")
            lines.append(f"# {spelling(option)} = {toml_value(default_of(option))}")
        parts.append("\n".join(lines) + "\n")
    return "".join(parts)


def _many(option: click.Option) -> str:
    return "a list of: " if option.multiple or option.nargs > 1 else ""


def toml_value(value: Any) -> str:
    """Return a value as TOML writes it; None as an empty text."""
    if value is None:
        return '""'
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return f"[{', '.join(toml_value(v) for v in value)}]"  # pyright: ignore[reportUnknownVariableType]
    if isinstance(value, int | float):
        return repr(value)
    # A JSON string is a TOML basic string.
    return json.dumps(str(value) if isinstance(value, Path) else value)
