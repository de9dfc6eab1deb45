"""`realsim robots`: its options."""

import sys
from pathlib import Path

import click

from realsim.app.command import Command, Group
from realsim.app.options import JSON, QUIET
from realsim.app.outputs import OutputFile

PAGE = OutputFile({".html": ("realsim robots",)}, "page")
"""A page of ours says so in its title."""


class ListByDefault(Group):
    """A group whose command `list` needs no name."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Put `list` where no command is named and no help is asked for."""
        if not args or (args[0] not in self.commands and args[0] not in ctx.help_option_names):
            args = ["list", *args]
        return super().parse_args(ctx, args)


@click.group(
    "robots",
    cls=ListByDefault,
    examples=("realsim robots", "realsim robots check my_arm", "realsim robots check panda"),
)
def ROBOTS() -> None:
    """Show the arms and hands that are known, and prove one of your own.

    \b
      realsim robots                 all that are found by name, and a page with their pictures
      realsim robots check FOLDER    is the description right? what is wrong is named

    A robot is a folder with a robot.toml (docs/how-to/your-own-arm.md, your-own-gripper.md). Put
    the folder above yours into REALSIM_ROBOTS, and they are found by name: --arm, --hand.
    """  # noqa: D301 - click's own mark for lines that stay as they are


@ROBOTS.command(
    "list", cls=Command, examples=("realsim robots list", "realsim robots list --page all.html")
)
@click.option(
    "--page", type=PAGE, default=Path("robots.html"), show_default=True, help="Page with pictures."
)
@JSON
@QUIET
def list_command(page: Path, as_json: bool, quiet: bool) -> None:
    """List the arms and hands that are found by name, with a picture each."""
    from realsim.app.console import Console
    from realsim.app.robots.run import list_robots

    list_robots(page, Console(quiet=quiet, as_json=as_json))


@ROBOTS.command(
    "check", cls=Command,
    examples=("realsim robots check my_arm", "realsim robots check robotiq_2f85 --page hand.html"),
)  # fmt: skip
@click.argument("name", metavar="FOLDER")
@click.option("--page", type=PAGE, default=None, help="Page with its pictures and all findings.")
@JSON
@QUIET
def check_command(name: str, page: Path | None, as_json: bool, quiet: bool) -> None:
    """Prove a robot's description: limits, frames, bodies, inverse kinematics; pads of a hand.

    FOLDER is a robot's folder, or the name of one that is found by name. Exit code 1 if something
    is wrong.
    """
    from realsim.app.console import Console
    from realsim.app.robots.run import check_robot

    if not check_robot(name, page, Console(quiet=quiet, as_json=as_json)):
        sys.exit(1)
