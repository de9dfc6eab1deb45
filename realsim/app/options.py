"""How a command declares itself: its options by name, out of `realsim.app.meanings`.

    @command("annotate", "realsim annotate demo/session")
    @SESSIONS
    @options(maps="instance,depth", workers=Has(1, "; frames at a time"), address="")
    @rare(no_depth_check=False)
    def annotate_command(console: Console, sessions: tuple[Path, ...], maps: str, ...) -> None:

A value is the option's default. `--json` and `--quiet` come with `command`, as does the `Console`.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from typing import Any

import click

from realsim.app.command import Command, Decorator, spelling
from realsim.app.meanings import FLAG, MEANINGS
from realsim.app.option_values import FOLDER
from realsim.app.outputs import OutputFile

ALL = "realsim.help_all"
"""In the context: whether the help shows rare options, too."""
SESSIONS = click.argument("sessions", type=FOLDER, nargs=-1, required=True, metavar="SESSION...")
SOURCE = click.argument("source", type=FOLDER)


Where = Any
"""The `realsim.many.PoolConfig` of --workers and --address; its module is heavy."""


@dataclass(frozen=True, slots=True)
class Has:
    """What one command has of its own for an option."""

    default: Any = None
    note: str = ""
    """Continues the meaning in the help; in [brackets] what the default is."""
    kind: click.ParamType[Any] | None = None
    """The type, where a command accepts less: a range, a choice, a guarded output."""
    required: bool = False


class Option(click.Option):
    """An option whose meaning is that of its name; a rare one is left out of the short help."""

    def __init__(self, words: Sequence[str], *, meaning: str, is_rare: bool, **attrs: Any) -> None:
        """Take click's arguments, the meaning, and whether the option is rare."""
        super().__init__(words, **attrs)
        self.meaning, self.is_rare = meaning, is_rare

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Return name and help, None for a rare option unless all are asked for."""
        return None if self.is_rare and not ctx.meta.get(ALL) else super().get_help_record(ctx)


def _declared(key: str, given: Any, is_rare: bool) -> Decorator:
    name = key.replace("_", "-")
    means, has = MEANINGS[name], given if isinstance(given, Has) else Has(given)
    note, bracket, default = has.note.partition("[")
    told = f"{means.says}{note.rstrip()}.  {bracket}{default}"
    is_shown = has.default is not None and has.default not in ("", ()) and means.kind is not FLAG
    return click.option(
        f"--{name}", means.name or key, cls=Option, meaning=means.says, is_rare=is_rare,
        type=has.kind or means.kind, is_flag=means.kind is FLAG, show_default=is_shown,
        required=has.required, help=told.rstrip(), metavar=means.metavar,
        multiple=not means.many, nargs=means.many or 1,
        # To click a default of None is a value that is there: nothing would be required.
        **{} if has.required else {"default": has.default},
    )  # fmt: skip


def options(is_rare: bool = False, /, **given: Any) -> Decorator:
    """Return the decorator that adds options by name; a value is a default, or a `Has`."""

    def decorated(work: Callable[..., Any]) -> Callable[..., Any]:
        for key, value in reversed(given.items()):
            work = _declared(key, value, is_rare)(work)
        return work

    return decorated


def rare(**given: Any) -> Decorator:
    """Return the decorator that adds options which only `--help-all` shows."""
    return options(True, **given)


def command(name: str, *examples: str, group: click.Group | None = None) -> Decorator:
    """Return the decorator that makes a command of a function.

    The function gets a `Console` before its options, and one `where` for --workers and --address.
    Where it returns False a check has failed: exit code 1. It returns nothing else.

    Args:
        name: as it is typed.
        examples: lines that begin with `realsim`; the tests run them.
        group: that it belongs to; None = it is loaded by its place in `realsim.app.cli`.
    """

    def decorated(work: Callable[..., Any]) -> click.Command:
        @wraps(work)
        def run(as_json: bool, quiet: bool, **given: Any) -> Any:
            from realsim.app.console import Console

            if "address" in given:
                from realsim.many import PoolConfig

                pool = PoolConfig(workers=given.pop("workers"), address=given.pop("address"))
                given["where"] = pool
            passed = work(Console(quiet=quiet, as_json=as_json), **given)
            if passed is not None and not passed:
                sys.exit(1)

        made = click.command(name, cls=Command, examples=examples)(run)
        options(quiet=False, json=False)(made)
        has_rare = any(isinstance(p, Option) and p.is_rare for p in made.params)
        made.params.append(_help_all(hidden=not has_rare))
        if group is not None:
            group.add_command(made)
        return made

    return decorated


def _show_all(ctx: click.Context, option: click.Parameter, asked: bool) -> None:
    if asked and not ctx.resilient_parsing:
        ctx.meta[ALL] = True
        click.echo(ctx.get_help(), color=ctx.color)
        ctx.exit()


def _help_all(*, hidden: bool) -> click.Option:
    return click.Option(
        ["--help-all"], is_flag=True, is_eager=True, expose_value=False, callback=_show_all,
        hidden=hidden, help="Show this message with the rare options, and exit.",
    )  # fmt: skip


def many(workers: Any = 2, note: str = "") -> Decorator:
    """Return the two options for where work is done, which the command gets as one, `where`."""
    return options(workers=Has(workers, note), address="")


def json_file(key: str, *keys: str, top: bool = False) -> Has:
    """Return what --json-file has of its own; `keys` tell the command's own files.

    Args:
        key: of the document.
        keys: more of them.
        top: they count at the document's top alone, where another command's holds this one inside.
    """
    marks = [f'\n "{name}"' if top else f'"{name}"' for name in (key, *keys)]
    return Has(kind=OutputFile({".json": marks}, "document"))


def two_meanings(commands: Mapping[tuple[str, ...], click.Command]) -> dict[str, list[str]]:
    """Return the options whose name means more than one thing, with all that each means.

    The meaning is what the help says before a command's own note, with the kind of value: a switch,
    a number, a path, one or several.

    Args:
        commands: by their path, as `realsim.app.command.walk` gives them.
    """
    found: dict[str, set[str]] = {}
    for option in (p for c in commands.values() for p in c.params if isinstance(p, click.Option)):
        says = option.meaning if isinstance(option, Option) else option.help or ""
        kind = f"{option.type.name} x {0 if option.multiple else option.nargs}"
        found.setdefault(spelling(option), set()).add(
            f"{says} ({'switch' if option.is_flag else kind})"
        )
    return {name: sorted(meanings) for name, meanings in found.items() if len(meanings) > 1}
