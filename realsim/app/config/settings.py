"""What a file of settings may say, held against the commands' own options.

Which file of settings is in force, and where in it a setting stands.

Settings of a file become the defaults of the commands.
"""

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, cast

import click

from realsim.app import command as command_line
from realsim.app.command import Group
from realsim.app.option_values import Amount
from realsim.errors import InputError
from realsim.untrusted.toml_text import read_toml
from realsim.user_cache import home

VARIABLE = "REALSIM_CONFIG"
"""Names the file; empty: none is read."""
HERE = Path("realsim.toml")
"""In the current folder: the settings of a project."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ConfigFile:
    """A file of settings as it was read."""

    path: Path
    text: str
    tables: Mapping[str, Any]
    """As TOML has them."""
    is_named: bool
    """Whether a person named it; otherwise it was found, and that is told."""

    def place(self, tables: Sequence[str], key: str = "") -> str:
        """Return the file and, where it can be told, the line of a table or of a key in it."""
        line = line_of(self.text, tables, key)
        return f"{self.path}, line {line}" if line else f"{self.path}"


def own_file() -> Path:
    """Return the file of a person's own settings."""
    folder = os.environ.get("XDG_CONFIG_HOME") or home() / ".config"
    return Path(folder) / "realsim" / "config.toml"


def find_config(named: Path | None) -> ConfigFile | None:
    """Return the file in force: the named one, that of REALSIM_CONFIG, ./realsim.toml, one's own.

    Raises:
        InputError: a named file is not there, or a file is not TOML.
    """
    variable = os.environ.get(VARIABLE)
    if named is not None:
        return read_config(named, "--config names", is_named=True)
    if variable is not None:
        if not variable:
            return None
        return read_config(Path(variable), f"{VARIABLE} names", is_named=True)
    for path in (HERE, own_file()):
        if os.path.isfile(path):  # no, too, in a home that may not be looked into
            return read_config(path, "", is_named=path != HERE)
    return None


def read_config(path: Path, who: str, *, is_named: bool) -> ConfigFile:
    """Read a file of settings.

    Raises:
        InputError: it is not there, cannot be read, or is not TOML that `read_toml` takes.
    """
    if not path.is_file():
        raise InputError(
            f"{who} {path}, which is {'no file' if path.exists() else 'not there'}. Give a TOML "
            "file; `realsim config template` prints one."
        )
    text, tables = read_toml(path)
    return ConfigFile(path=path, text=text, tables=tables, is_named=is_named)


def line_of(text: str, tables: Sequence[str], key: str = "") -> int | None:
    """Return the line (from 1) where a table begins, or where a key of it stands.

    Plain tables and keys are found, which is what people write; None for others.
    """
    here: list[str] = []
    for number, line in enumerate(text.splitlines(), 1):
        head = re.match(r"\s*\[\s*([^\[\]]+?)\s*\]", line)
        if head is not None:
            here = _names(head[1])
            if not key and here[: len(tables)] == list(tables):
                return number
            continue
        entry = re.match(r"\s*([\w\"'.-]+(?:\s*\.\s*[\w\"'-]+)*)\s*=", line)
        if entry is None:
            continue
        full = [*here, *_names(entry[1])]
        wanted = [*tables, key] if key else list(tables)
        if full[: len(wanted)] == wanted:
            return number
    return None


def _names(dotted: str) -> list[str]:
    return [part.strip().strip("\"'") for part in dotted.split(".")]


Settings = dict[str, Any]
"""Values by click's name of a parameter; of a group, Settings by the name of a command."""


def settings_of(root: command_line.Group, file: ConfigFile) -> Settings:
    """Return the defaults that a file gives, as click's `default_map` has them.

    Raises:
        InputError: a table or key that there is not, or a value of another kind; names the line.
    """
    return _of_group(root, (), file.tables, file)


def _of_group(
    group: command_line.Group, path: tuple[str, ...], tables: Mapping[str, Any], file: ConfigFile
) -> Settings:
    ctx = command_line.context_of(group, path)
    names = group.list_commands(ctx)
    found: Settings = {}
    for name, value in tables.items():
        command = group.get_command(ctx, name) if name in names else None
        if command is None:
            raise _unknown_table(path, name, value, names, file)
        here = (*path, name)
        if not isinstance(value, dict):
            raise InputError(
                f"{file.place(path, name)}: '{name}' is a command, and its settings are a table: "
                f"[{'.'.join(here)}]."
            )
        inner = cast("dict[str, Any]", value)
        if isinstance(command, command_line.Group):
            found[name] = _of_group(command, here, inner, file)
        else:
            found[name] = _of_command(command, here, inner, file)
    return found


def _unknown_table(
    path: tuple[str, ...], name: str, value: Any, names: list[str], file: ConfigFile
) -> InputError:
    """Return the error of a table, or a key outside of a command's table."""
    is_table = isinstance(value, dict)
    where = file.place((*path, name)) if is_table else file.place(path, name)
    before = f"'{'.'.join(path)}'" if path else "realsim"
    what = f"[{'.'.join((*path, name))}] is no command of {before}"
    if not is_table:
        what = f"'{name}' stands outside of a command's table"
    tables = [".".join((*path, n)) for n in names]
    return InputError(f"{where}: {what}{_perhaps(name, names)}. Tables are: {', '.join(tables)}.")


def _of_command(
    command: click.Command, path: tuple[str, ...], table: Mapping[str, Any], file: ConfigFile
) -> Settings:
    options = {command_line.spelling(option): option for option in command_line.settable(command)}
    renamed = command_line.old_names(command, path)
    found: Settings = {}
    for key, value in table.items():
        name = key.replace("_", "-")
        if name in renamed:
            command_line.say_renamed(f"{file.place(path, key)}: {key}", renamed[name])
            name = renamed[name]
        option = options.get(name)
        where = f"{file.place(path, key)}: [{'.'.join(path)}]"
        if option is None:
            raise InputError(
                f"{where} has no option '{key}'{_perhaps(name.lower(), list(options))}. Its "
                f"options are: {', '.join(options)}."
            )
        assert option.name is not None
        if option.name in found:
            raise InputError(f"{where} sets '{name}' twice; keep one of them.")
        if value == "" and command_line.default_of(option) is None:
            continue  # "not set", as the template writes it
        found[option.name] = _value(option, value, f"{where} {key}")
    return found


def _value(option: click.Option, value: Any, where: str) -> Any:
    """Return a value as click takes it, checked.

    Raises:
        InputError: it is of another kind, or out of range.
    """
    if option.multiple or option.nargs > 1:
        several = cast("list[Any]", value) if isinstance(value, list) else [value]
        if not option.multiple and len(several) != option.nargs:
            raise InputError(
                f"{where} = {_shown(value)} cannot be used; a list of {option.nargs} is accepted."
            )
        return [_one(option, each, where) for each in several]
    if isinstance(value, list) and kind_of(option) == "a text in quotes":
        value = ",".join(map(str, cast("list[Any]", value)))
    return _one(option, value, where)


def _one(option: click.Option, value: Any, where: str) -> Any:
    kind = kind_of(option)
    accepted: tuple[type, ...] = {
        "true or false": (bool,),
        "a whole number": (int,),
        "a number": (int, float),
    }.get(kind, (str, int, float))
    is_flag = kind == "true or false"
    if not isinstance(value, accepted) or isinstance(value, bool) != is_flag:
        raise InputError(f"{where} = {_shown(value)} cannot be used; {kind} is accepted.")
    if is_flag:
        return value
    text = str(value)
    if isinstance(option.type, click.Path):
        try:
            text = str(Path(text).expanduser())  # on the command line the shell does it
        except RuntimeError as error:
            raise InputError(f"{where} = {_shown(value)} cannot be used: {error}") from error
    ctx = click.Context(click.Command("settings"), resilient_parsing=True)
    try:
        option.type.convert(text, option, ctx)
    except click.BadParameter as error:
        told = command_line.in_words(error)
        raise InputError(f"{where} = {_shown(value)} cannot be used: {told}") from error
    return text


def kind_of(option: click.Option) -> str:
    """Return in words what an option takes."""
    kind = option.type
    if option.is_flag:
        return "true or false"
    if isinstance(kind, click.Choice):
        return f"one of {', '.join(str(c) for c in kind.choices if c)}"
    if isinstance(kind, click.Path):
        return "a path in quotes"
    if isinstance(kind, click.IntRange) or kind is click.INT:
        words = kind.words if isinstance(kind, Amount) else ()
        return " or ".join(("a whole number", *(f"{w} in quotes" for w in words)))
    if isinstance(kind, click.FloatRange) or kind is click.FLOAT:
        return "a number"
    return "a text in quotes"


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return f'"{value}"' if isinstance(value, str) else str(value)


def _perhaps(name: str, names: list[str]) -> str:
    close = get_close_matches(name, names, n=2)
    return f" (did you mean {' or '.join(close)}?)" if close else ""


FILE = "realsim.config_file"
"""In the context: the ConfigFile in force, or None."""
TROUBLE = "realsim.config_trouble"
"""In the context: what is wrong with the file, for the commands that can do without."""
DO_WITHOUT = ("config", "completion", "doctor")
"""These run although the file is wrong: they tell about it, or help to mend it."""


def apply_config(ctx: click.Context, named: Path | None, *, quiet: bool) -> None:
    """Find the file in force, and give its settings to the commands of `ctx`.

    Raises:
        InputError: the file cannot be used.
    """
    root = ctx.command
    assert isinstance(root, Group)
    ctx.meta[FILE] = None
    try:
        file = find_config(named)
        if file is None:
            return
        ctx.meta[FILE] = file
        ctx.default_map = settings_of(root, file)
    except InputError as error:
        if ctx.invoked_subcommand not in DO_WITHOUT:
            raise
        ctx.meta[TROUBLE] = error
        return
    if not file.is_named and not quiet and ctx.invoked_subcommand not in DO_WITHOUT:
        click.echo(f"note: settings are taken from {HERE} in this folder.", err=True)


def config_file(ctx: click.Context) -> ConfigFile | None:
    """Return the file in force.

    Raises:
        InputError: it cannot be used.
    """
    trouble: InputError | None = ctx.meta.get(TROUBLE)
    if trouble is not None:
        raise trouble
    file: ConfigFile | None = ctx.meta.get(FILE)
    return file
