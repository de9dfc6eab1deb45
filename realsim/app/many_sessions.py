"""A command on several sessions: each is a task, on processes of this machine or on a cluster."""

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from realsim.app.command import typed
from realsim.app.console import Console
from realsim.app.outputs import OutputFile, OutputFolder
from realsim.app.pipeline.chain import SCENE, Command, Ended, run_command
from realsim.errors import InputError
from realsim.many import Outcome, PoolConfig, Sent, Task, Worked, at_most, open_pool, run_many

OWN = ("workers", "address", "as_json", "quiet")
"""Options of the command that runs all; the others go to each session's."""


def one_session(sessions: Sequence[Path], where: PoolConfig, *, whole: bool = False) -> Path:
    """Return the only session; of several, run the current command on each, and end with its code.

    A session that fails is named and the others go on: exit code 1. Run again, the command itself
    knows what is done.

    Args:
        sessions: what the user typed.
        where: where they are worked on.
        whole: whether the command cannot divide one session among machines: with an address it
            goes to one of them.

    Raises:
        InputError: one is given twice, or an option names one output for all.
    """
    if len(sessions) == 1 and not (whole and where.address):
        return sessions[0]
    ctx = click.get_current_context()
    names = [str(s.resolve()) for s in sessions]
    twice = [n for k, n in enumerate(names) if n in names[:k]]
    if twice:
        raise InputError(f"'{twice[0]}' is given twice; two runs in one folder would mix.")
    console = Console(quiet=ctx.params["quiet"], as_json=ctx.params["as_json"])
    path = ctx.command_path.split()[1:]
    words = (*path, SCENE, *_typed(ctx))
    ends: dict[str, Ended] = {}
    failed: dict[str, str] = {}

    with console.stage(path[0], f"{len(sessions)} sessions") as tick:

        def keep(outcome: Outcome) -> None:
            end: Ended | None = outcome.value
            if end is not None and end.is_done:
                ends[outcome.task.name] = end
            else:
                failed[outcome.task.name] = outcome.why if end is None else end.told
            tick(len(ends) + len(failed), len(sessions))

        tick(0, len(sessions))
        tasks = [
            Task(name=str(s), fn=run_in_session, args=(path[0], words, Worked(s.resolve())))
            for s in sessions
        ]
        with open_pool(at_most(where, len(tasks))) as pool:
            run_many(tasks, pool, keep)
    codes = {name: end.code for name, end in ends.items()}
    console.say(f"{len(ends)} of {len(sessions)} sessions done")
    for name, why in failed.items():
        console.warn(f"{name}: {why}")
    for name in [name for name, code in codes.items() if code]:
        console.warn(f"{name}: a check failed; run the command on it alone to see which.")
    console.result({"done": codes, "failed": failed})
    sys.exit(1 if failed or any(codes.values()) else 0)


def run_in_session(stage: str, words: tuple[Any, ...], session: Path) -> Ended:
    """Run a command on a session, in a process of its own.

    Args:
        stage: its name.
        words: as they are typed behind `realsim`; `SCENE` stands for the session.
        session: the folder.
    """
    command = Command(stage=stage, words=tuple(map(str, words)))
    with tempfile.TemporaryDirectory(prefix="realsim_session_") as folder:
        return run_command(command, session, Path.cwd(), Path(folder) / "log")


def _typed(ctx: click.Context) -> list[Any]:
    """Return the options that were given, as words; files that they name travel.

    Raises:
        InputError: one names an output, which all sessions would write.
    """
    words: list[Any] = ["--quiet"]
    for option in ctx.command.params:
        name = option.name or ""
        if isinstance(option, click.Argument) or name in OWN:
            continue
        value = ctx.params.get(name)
        if ctx.get_parameter_source(name) is ParameterSource.DEFAULT or value is None:
            continue
        spelled = max(option.opts, key=len)
        if isinstance(option.type, OutputFile | OutputFolder):
            raise InputError(
                f"{spelled} '{value}' is one place, and several sessions are given; leave it away, "
                "or run them one by one."
            )
        if isinstance(option, click.Option):
            words += map(_word, typed(option, value))
    if any(p.name == "workers" for p in ctx.command.params):
        words += ["--workers", "1"]
    return words


def _word(value: Any) -> Any:
    """Return a value as it is typed; what is there as a file or folder is sent."""
    if isinstance(value, Path):
        return Sent(value.resolve()) if value.exists() else str(value.absolute())
    return str(value)
