"""`realsim check`: its options."""

import sys
from pathlib import Path

import click

from realsim.app.command import Command
from realsim.app.options import FOLDER, JSON, QUIET


@click.command(
    "check",
    cls=Command,
    examples=(
        "realsim check demo/session",
        "realsim check demo/session --decode --json",
        "realsim check dataset",
    ),
)
@click.argument("session", type=FOLDER)
@click.option("--repair", is_flag=True, help="Move what is damaged to SESSION/damaged.")
@click.option("--decode", is_flag=True, help="Decode every image, too (slow).")
@JSON
@QUIET
def check_command(session: Path, repair: bool, decode: bool, as_json: bool, quiet: bool) -> None:
    """Verify every checksum of SESSION and say what is missing or damaged.

    Sessions inside it (calibration/capture) are checked, too. Nothing is changed without --repair,
    which takes out what is damaged, and only that: the views concerned can be captured again.

    SESSION may also be a BOP or GraspNet data set: masks, boxes, counts, poses and depth are held
    against each other, image against image, and against the rendered models; or any export of
    `realsim export`: its SHA256SUMS are verified.

    Exit codes: 0 sound, 1 damaged or contradictory, 2 none of these.
    """
    from realsim.app.check.session import run_check
    from realsim.app.console import Console

    console = Console(quiet=quiet, as_json=as_json)
    if not run_check(session, console, repair=repair, decode=decode):
        sys.exit(1)
