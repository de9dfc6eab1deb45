"""`realsim doctor`: its options."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from realsim.app.console import Console
from realsim.app.option_values import FOLDER
from realsim.app.options import command, options

if TYPE_CHECKING:
    from realsim.app.doctor.machine import Finding


@command(
    "doctor",
    "realsim doctor",
    "realsim doctor demo/session --json",
    "realsim doctor --robot-host 192.168.1.10",
)
@click.argument("session", type=FOLDER, required=False)
@options(robot_host="")
@click.pass_context
def doctor_command(
    ctx: click.Context, console: Console, session: Path | None, robot_host: str
) -> bool:
    """Say what of this machine is fit for realsim, what is missing, and how to get it.

    Versions and libraries, memory, the disk of SESSION, settings, cameras, the robot. Nothing is
    changed. Every library is loaded in a process of its own.

    Exit codes: 0 nothing is wrong, 1 there is a problem.
    """
    from realsim.app.doctor.run import examine, show

    return show(examine(session, robot_host, console, _settings(ctx)), console)


def _settings(ctx: click.Context) -> "list[Finding]":
    """Return what is to be said of the file of settings."""
    from realsim.app.config.settings import config_file
    from realsim.app.doctor.machine import Finding
    from realsim.errors import InputError

    group, name = "Settings", "file of settings"
    try:
        file = config_file(ctx)
    except InputError as error:
        return [Finding(group=group, name=name, kind="problem", found=str(error),
                        todo="correct it, or take it away")]  # fmt: skip
    found = "none" if file is None else str(file.path)
    return [Finding(group=group, name=name, kind="ok", found=found)]
