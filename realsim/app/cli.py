"""The command line: one command per job, each imported only when it is asked for.

Exit codes: 0 done, 1 done but a check failed, 2 something given cannot be used, 130 interrupted,
141 the reader of the output has gone, 143 asked to end.
"""

import gc
import os
import signal
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from realsim import __version__
from realsim.app.command import COMMAND_KEY, Group
from realsim.app.front import COMMANDS, help_text
from realsim.errors import RealsimError

BROKEN_PIPE = 141
"""Exit code where the reader of the output has gone, as in `| head` (128 + SIGPIPE)."""
TERMINATED = 143
"""Exit code of a process that was asked to end (128 + SIGTERM), as shells count."""
TOLD = (click.Abort, KeyboardInterrupt, SystemError, RealsimError, ImportError, OSError)
"""What ends a command with a sentence, if it is no bug."""
NO_COLOUR = "--no-color"


class Realsim(Group):
    """All commands; `--no-color` may stand anywhere on the line."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Take out --no-color, and note whether little is to be said."""
        end = args.index("--") if "--" in args else len(args)
        if NO_COLOUR in args[:end]:
            os.environ["NO_COLOR"] = "1"  # for the processes that are started, too
            ctx.color = False
            args = [a for k, a in enumerate(args) if k >= end or a != NO_COLOUR]
        ctx.meta[QUIET_KEY] = "--quiet" in args
        ctx.meta[COMMAND_KEY] = tuple(args)
        return super().parse_args(ctx, args)

    def get_help(self, ctx: click.Context) -> str:
        """Return the help, commands by group."""
        return help_text().rstrip()

    def make_context(self, *given: Any, **more: Any) -> click.Context:
        """Read the line; `--help` writes already here."""
        with _pipes_passed_on():
            return super().make_context(*given, **more)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command."""
        with _pipes_passed_on():
            return super().invoke(ctx)


@contextmanager
def _pipes_passed_on() -> Generator[None]:
    """Keep click from ending with 1, which says that a check failed, where a reader has gone."""
    try:
        yield
    except BrokenPipeError:
        raise BrokenPipeError from None  # one without a number is not click's


QUIET_KEY = "realsim.quiet"
"""In the context: whether --quiet was typed."""


@click.group(
    "realsim", cls=Realsim, late=COMMANDS,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)  # fmt: skip
@click.option("--config", "config_file", type=click.Path(path_type=Path), multiple=True)
@click.option(NO_COLOUR, is_flag=True)
@click.version_option(__version__, prog_name="realsim")
@click.pass_context
def commands(ctx: click.Context, config_file: tuple[Path, ...], no_color: bool) -> None:
    """Turn robot captures into grasping data that you can trust."""
    from realsim.app.config.settings import apply_config

    if len(config_file) > 1:
        raise click.UsageError(f"--config names {len(config_file)} files; one is read. Give one.")
    apply_config(ctx, next(iter(config_file), None), quiet=bool(ctx.meta.get(QUIET_KEY)))


class Terminated(KeyboardInterrupt):
    """The process was asked to end (SIGTERM), as by a queue whose time is up."""


def _asked_to_end(number: int, frame: object) -> None:
    """End as after Ctrl-C: workers are ended, folders are left whole."""
    # `timeout` and queues ask twice; the second time must not break into the cleaning up.
    signal.signal(number, signal.SIG_IGN)
    raise Terminated


def main() -> None:
    """Run the command line; end with exit code 2 and one paragraph on bad input."""
    from realsim.app.completion import add_bash_completion
    from realsim.app.console import open_missing_streams

    # Looking for garbage among all that is imported costs a tenth of what draws; 700 is usual.
    gc.set_threshold(50_000)
    open_missing_streams()
    add_bash_completion()
    signal.signal(signal.SIGTERM, _asked_to_end)
    try:
        _run()
    except BrokenPipeError:
        # Python writes what is left when it ends; nobody reads it.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (sys.stdout, sys.stderr):
            try:
                stream.flush()
            except BrokenPipeError:
                os.dup2(nowhere, stream.fileno())
        sys.exit(BROKEN_PIPE)


def _run() -> None:
    try:
        commands(prog_name="realsim", standalone_mode=False)
        sys.stdout.flush()
    except click.exceptions.Exit as stop:
        sys.exit(stop.exit_code)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except BrokenPipeError:
        raise
    except TOLD as stop:
        # click puts its own in the place of the one that knows how far it came, Python where a
        # compiled loop is called, and compiled modules where they are loaded.
        reason: BaseException = stop
        while not isinstance(reason, KeyboardInterrupt) and reason.__cause__ is not None:
            reason = reason.__cause__
        if isinstance(reason, click.Abort | KeyboardInterrupt):
            told = str(reason) or "interrupted"
            click.echo(
                told if told.endswith(".") else f"{told}; the same command goes on from here.",
                err=True,
            )
            sys.exit(TERMINATED if isinstance(reason, Terminated) else 130)
        if isinstance(stop, KeyboardInterrupt | SystemError) or (text := refusal(stop)) is None:
            raise  # a bug: its place is wanted
        click.echo(f"error: {text}", err=True)
        sys.exit(2)


def refusal(error: Exception) -> str | None:
    """Return what is said of an error that the user can mend; None = it is a bug."""
    if isinstance(error, ImportError):
        if "cannot open shared object file" not in str(error):
            return None
        from realsim.interop import missing_library

        return str(missing_library(error.name or "a library", error))
    if isinstance(error, OSError):
        from realsim.store.atomic import FULL

        if error.errno in FULL:
            return (
                f"there is no room for {error.filename or 'what is written'} ({error.strerror}). "
                "Everything stored before is intact. Make room, then run the same command again."
            )
        where = f" ({error.filename})" if error.filename else ""
        return (
            f"the system refused a file operation: {error.strerror or error}{where}. "
            "Check that the path exists, that you may use it, and that the disk has room."
        )
    return str(error)
