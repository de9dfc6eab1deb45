"""`realsim capture`: its options."""

import sys
from pathlib import Path
from typing import Any

import click

from realsim.app.command import Command
from realsim.app.option_values import numbers_of
from realsim.app.options import JSON, QUIET, PlanName, arm, seed
from realsim.app.outputs import GOES_ON


@click.command(
    "capture",
    cls=Command,
    examples=(
        "realsim capture mugs --plan plan.json --simulated --views 0-3",
        "realsim capture mugs --plan plan.json --robot-host 192.168.1.10 --dry-run",
        "realsim capture mugs --plan plan.json --robot-host 192.168.1.10",
    ),
)
@click.argument("out", type=GOES_ON)
@click.option("--plan", required=True, type=PlanName(),
              help="Plan file, or shipped:ur5_d405_hemisphere_256.")  # fmt: skip
@arm("Name or folder of the arm.  [the plan's]")
@click.option("--robot-host", default="", help="IP address of the arm's controller.")
@click.option("--simulated", is_flag=True, help="The simulated lab instead of a robot.")
@click.option("--camera", default=None, help="Serial number of the RealSense.  [the only one]")
@click.option("--fixed-cameras", default="", help="Grabbed with each view: left=SERIAL,...")
@click.option("--board", default="", help="Capture board views: target file, or one line.")
@click.option("--dry-run", is_flag=True, help="Drive at a quarter of the speed, store nothing.")
@click.option("--speed", type=float, default=None, help="Share of the plan's speed.  [1]")
@click.option("--settle", type=float, default=None, help="Wait after a move [s].  [the plan's]")
@click.option("--views", default="", help="Only these views, such as 1-3,7.")
@click.option("--retake", default="", help="Take these (1-3,7) again; earlier ones are kept aside.")
@click.option("--no-input", is_flag=True, help="Ask nobody: trouble ends the run.")
@seed("Of the simulated lab.")
@click.option("--objects", default=5, show_default=True, type=click.IntRange(1, 40),
              help="In the simulated lab.")  # fmt: skip
@JSON
@QUIET
def capture_command(
    out: Path, settle: float | None, views: str, retake: str, as_json: bool, quiet: bool,
    **options: Any,
) -> None:  # fmt: skip
    """Drive a plan and store its views in the session OUT; the same command goes on after a stop.

    Keys: p pause, r redo the last view, s skip, q stop, space go on.

    Exit codes: 0 done, 1 views are missing at the end, 2 bad input.
    """
    from realsim.app.capture.run import CaptureRequest, run_capture
    from realsim.app.console import Console

    request = CaptureRequest(
        out=out, settle_s=settle, views=numbers_of(views), retake=numbers_of(retake), **options
    )
    if not run_capture(request, Console(quiet=quiet, as_json=as_json)):
        sys.exit(1)
