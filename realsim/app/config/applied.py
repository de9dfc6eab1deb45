"""Settings of a file become the defaults of the commands."""

from pathlib import Path

import click

from realsim.app.command import Group
from realsim.app.config.settings import HERE, ConfigFile, find_config, settings_of
from realsim.errors import InputError

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
