"""A file of settings with every option, commented out."""

import json
from pathlib import Path
from typing import Any

import click

from realsim.app.command import default_of, settable, spelling
from realsim.app.config.in_force import Commands
from realsim.app.config.settings import kind_of

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
        lines = [f"\n# {command.get_short_help_str(90)}", f"[{'.'.join(path)}]"]
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
