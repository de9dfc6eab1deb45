"""`realsim config`: show what is in force, print a template."""

from collections.abc import Mapping
from typing import Any

import click

from realsim.app.command import Command, Group, walk
from realsim.app.console import Console
from realsim.app.options import command, options
from realsim.errors import InputError

config_command = Group(
    "config",
    examples=("realsim config show register", "realsim config template"),
    help="""Settings from a file: every option of every command.

    \b
    The first of these that is there is read:
      realsim --config FILE ...
      the file that REALSIM_CONFIG names (empty: none)
      ./realsim.toml
      ~/.config/realsim/config.toml

    Variables (REALSIM_REGISTER_VIEWS=64) go over the file, the command line over both.
    """,
)


@command(
    "show",
    "realsim config show",
    "realsim config show school run",
    "realsim config show --all",
    group=config_command,
)
@click.argument("path", nargs=-1, metavar="[COMMAND]")
@options(all=False)
@click.pass_context
def show_command(
    ctx: click.Context, console: Console, path: tuple[str, ...], show_all: bool
) -> None:
    """Show what is in force, and where each value came from.

    Without COMMAND only what is set somewhere; of a COMMAND, every option.
    """
    from realsim.app.config.settings import config_file
    from realsim.app.config.template import DEFAULT, in_force, strange_variables

    file = config_file(ctx)
    root = ctx.find_root()
    assert isinstance(root.command, Group)
    every = walk(root.command)
    chosen = {name: c for name, c in every.items() if name[: len(path)] == path}
    if not chosen:
        known = ", ".join(" ".join(name) for name in every)
        raise InputError(f"there is no command '{' '.join(path)}'; there are: {known}.")
    settings: Mapping[str, Any] = root.default_map or {}
    rows = in_force(chosen, settings, file)
    shown = [r for r in rows if path or show_all or r.origin != DEFAULT]
    console.say(f"file: {'none' if file is None else file.path}")
    if shown:
        table = [[f"{r.command} --{r.option}", _text(r.value), r.origin] for r in shown]
        console.table("In force", ["option", "value", "from"], table)
    else:
        console.say("every option has its default; `realsim config show COMMAND` lists them.")
    console.warn(*strange_variables(every))
    console.result({"file": None if file is None else file.path, "options": shown})


def _text(value: Any) -> str:
    if value is None:
        return "not set"
    if isinstance(value, bool):
        return "true" if value else "false"
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


@config_command.command(
    "template", cls=Command,
    examples=("realsim config template", "realsim config template > realsim.toml"),
)  # fmt: skip
@click.pass_context
def template_command(ctx: click.Context) -> None:
    """Print a file of settings with every option, its meaning and its default, commented out."""
    from realsim.app.config.template import template

    root = ctx.find_root().command
    assert isinstance(root, Group)
    click.echo(template(walk(root)), nl=False)
