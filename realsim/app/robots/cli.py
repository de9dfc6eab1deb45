"""`realsim robots`: the arms and hands that are known."""

from pathlib import Path

import click

from realsim.app.command import Group
from realsim.app.console import Console
from realsim.app.options import Has, command, options
from realsim.app.outputs import OutputFile

PAGE = OutputFile({".html": ("realsim robots",)}, "page")


@click.group(
    "robots",
    cls=Group,
    by_default="list",
    examples=("realsim robots", "realsim robots check my_arm", "realsim robots check panda"),
)
def robots_command() -> None:
    """Show the arms and hands that are known, and prove one of your own.

    \b
      realsim robots                 all that are found by name, and a page with their pictures
      realsim robots check FOLDER    is the description right? what is wrong is named

    A robot is a folder with a robot.toml (docs/how-to/your-own-arm.md, your-own-gripper.md). Put
    the folder above yours into REALSIM_ROBOTS, and they are found by name: --arm, --hand.
    """  # noqa: D301 - click's own mark for lines that stay as they are


@command("list", "realsim robots list", "realsim robots list --page all.html", group=robots_command)
@options(page=Has(Path("robots.html"), kind=PAGE))
def list_command(console: Console, page: Path) -> None:
    """List the arms and hands that are found by name, with a picture each."""
    from realsim.app.robots.run import list_robots

    list_robots(page, console)


@command(
    "check",
    "realsim robots check my_arm",
    "realsim robots check robotiq_2f85 --page hand.html",
    group=robots_command,
)
@click.argument("name", metavar="FOLDER")
@options(page=Has(kind=PAGE))
def check_command(console: Console, name: str, page: Path | None) -> bool:
    """Prove a robot's description: limits, frames, bodies, inverse kinematics; pads of a hand.

    FOLDER is a robot's folder, or the name of one that is found by name. Exit code 1 if something
    is wrong.
    """
    from realsim.app.robots.run import check_robot

    return check_robot(name, page, console)
