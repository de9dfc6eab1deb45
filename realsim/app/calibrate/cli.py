"""`realsim calibrate`: its options."""

from pathlib import Path
from typing import Any

from realsim.app.console import Console
from realsim.app.options import SOURCE, Has, command, options, rare
from realsim.app.outputs import GOES_ON


@command(
    "calibrate",
    "realsim calibrate demo/session",
    "realsim calibrate photos --board aprilgrid:7x5,tag=30mm,gap=10mm --poses poses.csv",
    "realsim calibrate lab --cameras wrist=hand,left=fixed --board table.json --poses arm.csv",
)
@SOURCE
@options(
    board="", poses=Has(None, "  [SOURCE]"), reading="", intrinsics=None, eye_to_hand=False,
    arm=Has(None, "; found out where joints are given"), cameras=None,
    out=Has(Path("calibration"), kind=GOES_ON), live=False, check=False, tolerance=1.0,
)  # fmt: skip
@rare(key="", board_poses=None, held_board="", moved_board="", clock_offset="auto")
def calibrate_command(
    console: Console, source: Path, live: bool, check: bool, tolerance: float, **options: Any
) -> bool:
    """Calibrate lens and hand-eye: SOURCE is a session, or a folder of images with poses.

    A session may have board views only: calibrate before the board is taken away, and once more
    when the objects are captured, which places the cameras of their views.

    With --check nothing is calibrated: a registered session says whether the camera still sits in
    the hand as it was calibrated.

    Exit codes: 0 done, 1 a check of the result is bad (or the camera moved), 2 bad input.
    """
    from realsim.app.calibrate.run import require_used, run_calibrate

    require_used(check, live, tolerance, options)
    if check:
        from realsim.app.calibrate.check import run_check

        return run_check(source, console, tolerance)
    return run_calibrate(source, console, live=live, **options)
