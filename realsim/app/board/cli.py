"""`realsim board`: printed calibration targets."""

from pathlib import Path
from typing import Any

import click

from realsim.app.console import Console
from realsim.app.options import Has, command, options
from realsim.app.outputs import OutputFolder


@command(
    "board",
    "realsim board aprilgrid:6x4,tag=30mm,gap=10mm --out boards",
    "realsim board charuco:5x7,square=33mm,marker=20mm,dict=APRILTAG_36h11 --paper A3",
)
@click.argument("what", metavar="TARGET")
@options(
    out=Has(Path("boards"), kind=OutputFolder()), paper="A4", preview=False, cut_marks=False,
    overwrite=False,
)  # fmt: skip
def board_command(console: Console, what: str, out: Path, paper: str, **options: Any) -> None:
    """Print a calibration target: a PDF at exact scale with a ruler, and its target file.

    TARGET is one line, or a target file:

    \b
      aprilgrid:6x4,tag=30mm,gap=10mm           AprilTags, 6 columns x 4 rows
      charuco:5x7,square=33mm,marker=20mm,dict=APRILTAG_36h11
      chessboard:9x6,square=20mm                inner corners
      circles:9x9,pitch=18mm,large-origin
      tag:7,size=80mm                           one AprilTag
    """  # noqa: D301 - click's own mark for lines that stay as they are
    from realsim_calibration.sheets.write import make_board

    files = make_board(what, out, paper, **options)
    console.say(*map(str, files))
    console.result({"target": what, "paper": paper, "files": list(files)})
