"""What all commands have in common: late loading, examples, settings from the environment."""

import os
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any

import click
from click.core import ParameterSource

from realsim.app.meanings import OLD_NAMES

LONGEST_SENTENCE = 200
"""Characters of a command's first sentence in the list of commands: it is wrapped, not cut."""
COMMAND_KEY = "realsim.command"
"""In the context: the words that were typed after `realsim`."""
ENVIRONMENT = "REALSIM"
"""Begins the names of all variables: REALSIM_SCHOOL_RUN_FORCE is --force of `school run`."""


class Exemplified(click.Command):
    """A command or group whose help ends with examples."""

    def __init__(self, name: str | None, *, examples: Sequence[str] = (), **attrs: Any) -> None:
        """Take click's arguments and the examples: lines that begin with `realsim`."""
        super().__init__(name, **attrs)
        self.examples = tuple(examples)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the examples as they are typed, unwrapped."""
        super().format_epilog(ctx, formatter)
        if self.examples:
            with formatter.section("Examples"):
                formatter.write("".join(f"  {line}\n" for line in self.examples))


class Command(Exemplified):
    """A command that takes its old names, and names the variable that gave a wrong value."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the arguments; a value that a variable gave is refused with the variable's name."""
        renamed = take_old_variables(self, _path(ctx))
        end = args.index("--") if "--" in args else len(args)
        for k, word in enumerate(args[:end]):
            old, equals, value = word.removeprefix("--").partition("=")
            if word.startswith("--") and old in renamed:
                args = [*args[:k], f"--{renamed[old]}{equals}{value}", *args[k + 1 :]]
                say_renamed(f"--{old}", f"--{renamed[old]}")
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            if error.option_name == "--config":
                told = f"{error.message} It goes before the command: realsim --config FILE COMMAND."
                raise click.UsageError(told, ctx) from error
            raise
        except click.BadParameter as error:
            error.message = in_words(error)  # pyright: ignore[reportAttributeAccessIssue]
            option = error.param
            if not isinstance(option, click.Option):
                raise
            if ctx.get_parameter_source(option.name) is not ParameterSource.ENVIRONMENT:
                raise
            told = f"{error.message} The variable {option.envvar} says so."
            raise click.BadParameter(told, ctx=ctx, param=option) from error


def in_words(error: click.BadParameter) -> str:
    """Return what click says of a value, with plain names of what is accepted."""
    told = error.message.replace("a valid integer range", "a whole number")
    return told.replace("a valid float range", "a number")


class Group(Exemplified, click.Group):
    """A group whose commands are imported when they are asked for."""

    def __init__(
        self,
        name: str | None = None, *, late: Mapping[str, str] | None = None,
        by_default: str | None = None, **attrs: Any,
    ) -> None:  # fmt: skip
        """Take click's arguments, and the commands that are loaded late.

        Args:
            name: of the group.
            late: `module:attribute` of a command by its name, in the order of the help.
            by_default: the command that needs no name: `realsim school SESSION` runs `run`.
            attrs: click's, and the examples.
        """
        super().__init__(name, **attrs)
        self.late, self.by_default = dict(late or {}), by_default

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Put the default command before arguments that begin with none and ask for no help."""
        known = (*self.commands, *ctx.help_option_names)
        if self.by_default and (
            args[0] not in known
            if args
            else not any(p.required for p in self.commands[self.by_default].params)
        ):
            args = [self.by_default, *args]
        return super().parse_args(ctx, args)

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all commands, in the order in which they are used."""
        return [*(name for name in self.commands if name not in self.late), *self.late]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a command; the first time it is imported and its variables are named."""
        known = self.commands.get(cmd_name)
        if known is None and cmd_name in self.late:
            module, attribute = self.late[cmd_name].split(":")
            known = getattr(import_module(module), attribute)
            assert isinstance(known, click.Command)
            self.commands[cmd_name] = known
        if known is not None:
            _name_variables(known, (*_path(ctx), cmd_name))
        return known

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command, or say which one may be meant."""
        try:
            return super().resolve_command(ctx, args)
        except click.exceptions.NoSuchCommand as error:
            # click knows only the commands that are loaded.
            names = self.list_commands(ctx)
            raise click.exceptions.NoSuchCommand(
                error.command_name, possibilities=names, ctx=ctx
            ) from None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the names of the commands with the first sentence of each."""
        loaded = [(name, self.get_command(ctx, name)) for name in self.list_commands(ctx)]
        rows = [
            (name, command.get_short_help_str(limit=LONGEST_SENTENCE))
            for name, command in loaded
            if command is not None and not command.hidden
        ]
        if rows:
            with formatter.section("Commands"):
                formatter.write_dl(rows)


def old_names(command: click.Command, path: Sequence[str]) -> dict[str, str]:
    """Return the names that a command's options had before: old -> new, without dashes."""
    arm = {"robot": "arm"} if any(p.name == "arm" for p in command.params) else {}
    return arm | OLD_NAMES.get(" ".join(path), {})


def take_old_variables(command: click.Command, path: Sequence[str]) -> dict[str, str]:
    """Give variables of old names their new ones, with a note; return the options' old names."""
    renamed = old_names(command, path)
    for old, new in renamed.items():
        before, now = variable(path, old), variable(path, new)
        if before in os.environ and now not in os.environ:
            os.environ[now] = os.environ.pop(before)
            say_renamed(before, now)
    return renamed


def say_renamed(old: str, new: str) -> None:
    """Say that a name is used which will go."""
    click.echo(f"note: {old} is now called {new}; the next release knows only that.", err=True)


def variable(path: Sequence[str], option: click.Option | str) -> str:
    """Return the name of the environment variable of a command's option."""
    words = [ENVIRONMENT, *path, option if isinstance(option, str) else spelling(option)]
    return "_".join(words).replace("-", "_").upper()


def spelling(option: click.Option) -> str:
    """Return the name of an option as it is typed, without dashes: `depth-bias`."""
    return max(option.opts, key=len).lstrip("-")


def settable(command: click.Command) -> list[click.Option]:
    """Return the options of a command that a file or the environment may set."""
    return [
        p
        for p in command.params
        if isinstance(p, click.Option) and not p.is_eager and p.name not in ("help", "version")
    ]


def typed(option: click.Option, value: Any) -> list[Any]:
    """Return an option as it is typed: its name, and its values as they are."""
    word = max(option.opts, key=len)
    if option.is_flag:
        return [word] if value else list(option.secondary_opts[:1])
    if isinstance(value, list | tuple) and not option.multiple and option.nargs == 1:
        value = ",".join(map(str, value))  # pyright: ignore[reportUnknownArgumentType]
    each = value if option.multiple else (value,)
    return [w for one in each for w in (word, *(one if option.nargs > 1 else (one,)))]


def default_of(option: click.Option) -> Any:
    """Return the default of an option, None where there is none."""
    value = option.to_info_dict().get("default")
    if option.multiple and value is None:
        return []
    return list(value) if isinstance(value, tuple) else value  # pyright: ignore[reportUnknownArgumentType]


def walk(group: Group, path: tuple[str, ...] = ()) -> dict[tuple[str, ...], click.Command]:
    """Return every command below a group by its path, groups left out."""
    found: dict[tuple[str, ...], click.Command] = {}
    ctx = context_of(group, path)
    for name in group.list_commands(ctx):
        command = group.get_command(ctx, name)
        here = (*path, name)
        if isinstance(command, Group):
            found |= walk(command, here)
        elif command is not None:
            found[here] = command
    return found


def context_of(group: click.Group, path: Sequence[str]) -> click.Context:
    """Return a context as if the words of `path` had been typed before."""
    ctx = click.Context(group, info_name="realsim")
    for name in path:
        ctx = click.Context(group, info_name=name, parent=ctx)
    return ctx


def _path(ctx: click.Context) -> tuple[str, ...]:
    """Return the words that lead to a group, without the program's name."""
    if ctx.parent is None:
        return ()
    return (*_path(ctx.parent), ctx.info_name or "")


def _name_variables(command: click.Command, path: tuple[str, ...]) -> None:
    for option in settable(command):
        if option.envvar is None:
            option.envvar = variable(path, option)


Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]
"""What click.option returns."""
