"""`realsim check`: its options."""

from pathlib import Path

import click

from realsim.app.console import Console
from realsim.app.option_values import FOLDER
from realsim.app.options import command, options


@command(
    "check",
    "realsim check demo/session",
    "realsim check demo/session --decode --json",
    "realsim check dataset",
)
@click.argument("session", type=FOLDER)
@options(repair=False, decode=False)
def check_command(console: Console, session: Path, repair: bool, decode: bool) -> bool:
    """Verify every checksum of SESSION and say what is missing or damaged.

    Sessions inside it (calibration/capture) are checked, too. Nothing is changed without --repair,
    which takes out what is damaged, and only that: the views concerned can be captured again.

    SESSION may also be a BOP or GraspNet data set: masks, boxes, counts, poses and depth are held
    against each other, image against image, and against the rendered models; or any export of
    `realsim export`: its SHA256SUMS are verified.

    Exit codes: 0 sound, 1 damaged or contradictory, 2 none of these.
    """
    from realsim.app.check.session import run_check

    return run_check(session, console, repair=repair, decode=decode)
