"""`realsim capture`: its options."""

from typing import Any

import click

from realsim.app.console import Console
from realsim.app.options import Has, command, options, rare
from realsim.app.outputs import GOES_ON


@command(
    "capture",
    "realsim capture mugs --plan plan.json --simulated --only-views 0-3",
    "realsim capture mugs --plan plan.json --robot-host 192.168.1.10 --dry-run",
    "realsim capture mugs --plan plan.json --robot-host 192.168.1.10",
)
@click.argument("out", type=GOES_ON)
@options(
    plan=Has(required=True), arm=Has(None, "  [the plan's]"), robot_host="", simulated=False,
    camera_serial=Has(None, "  [the only one]"), board=Has("", ": capture board views"),
    dry_run=False, only_views="", retake="",
)  # fmt: skip
@rare(
    fixed_cameras="", speed=Has(None, "  [1]"), settle=Has(None, "  [the plan's]"), no_input=False,
    seed=Has(0, ", of the simulated lab"), objects=Has(5, " of the simulated lab"),
)  # fmt: skip
def capture_command(console: Console, **options: Any) -> bool:
    """Drive a plan and store its views in the session OUT; the same command goes on after a stop.

    Keys: p pause, r redo the last view, s skip, q stop, space go on.

    Exit codes: 0 done, 1 views are missing at the end, 2 bad input.
    """
    from realsim.app.capture.run import CaptureRequest, run_capture

    return run_capture(CaptureRequest(**options), console)
