"""`realsim calibrate`: its options."""

import sys
from pathlib import Path

import click

from realsim.app.command import Command
from realsim.app.options import FOLDER, JSON, QUIET, arm
from realsim.app.outputs import GOES_ON


@click.command(
    "calibrate",
    cls=Command,
    examples=(
        "realsim calibrate demo/session",
        "realsim calibrate photos --board aprilgrid:7x5,tag=30mm,gap=10mm --poses poses.csv",
        "realsim calibrate lab --cameras wrist=hand,left=fixed --board table.json --poses arm.csv",
    ),
)
@click.argument("source", type=FOLDER)
@click.option("--board", default="", help="Target: one line (see `realsim board`) or a file.")
@click.option("--poses", type=FOLDER, default=None, help="Pose file or folder.  [SOURCE]")
@click.option("--reading", default="", help="How poses are read: rotvec,m  quat_xyzw,mm  ...")
@click.option("--key", default="", help="Entry of the pose file, where there are several.")
@click.option("--board-poses", type=FOLDER, default=None, help="Camera poses instead of images.")
@click.option("--camera", type=FOLDER, default=None, help="File with known intrinsics.")
@click.option("--cameras", default="", help="Several: wrist=hand,left=fixed; a folder each.")
@click.option("--held-board", default="", help="With --cameras: target that the arm carries.")
@click.option("--moved-board", default="", help="With --cameras: target that a person moves.")
@click.option("--eye-to-hand", is_flag=True, help="The camera stands still, the target moves.")
@arm("Name or folder; found out where joints are given.")
@click.option(
    "--out",
    type=GOES_ON,
    default=Path("calibration"),
    show_default=True,
    help="Folder.",
)
@click.option("--clock-offset", default="auto", help="Of the camera: auto, off, seconds.")
@click.option("--live", is_flag=True, help="Watch SOURCE for new views and say when to stop.")
@click.option("--check", is_flag=True, help="Does it still hold? Of a registered session.")
@click.option("--tolerance", default=1.0, show_default=True, help="With --check: mm at objects.")
@JSON
@QUIET
def calibrate_command(
    source: Path, live: bool, check: bool, tolerance: float, as_json: bool, quiet: bool,
    **options: object,
) -> None:  # fmt: skip
    """Calibrate lens and hand-eye: SOURCE is a session, or a folder of images with poses.

    A session may have board views only: calibrate before the board is taken away, and once more
    when the objects are captured, which places the cameras of their views.

    With --check nothing is calibrated: a registered session says whether the camera still sits in
    the hand as it was calibrated.

    Exit codes: 0 done, 1 a check of the result is bad (or the camera moved), 2 bad input.
    """
    from realsim.app.calibrate.run import require_used, run_calibrate
    from realsim.app.console import Console

    console = Console(quiet=quiet, as_json=as_json)
    require_used(check, live, tolerance, options)
    if check:
        from realsim.app.calibrate.check import run_check

        if not run_check(source, console, tolerance):
            sys.exit(1)
        return
    if not run_calibrate(source, console, live=live, **options):
        sys.exit(1)
