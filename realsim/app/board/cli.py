"""`realsim board`: its options."""

from pathlib import Path

import click

from realsim.app.command import Command
from realsim.app.options import JSON, QUIET, overwrite
from realsim.app.outputs import OutputFolder


@click.command(
    "board",
    cls=Command,
    examples=(
        "realsim board aprilgrid:6x4,tag=30mm,gap=10mm --out boards",
        "realsim board charuco:5x7,square=33mm,marker=20mm,dict=APRILTAG_36h11 --paper A3",
    ),
)
@click.argument("what", metavar="TARGET")
@click.option(
    "--out", type=OutputFolder(), default=Path("boards"), show_default=True, help="Folder."
)
@click.option("--paper", default="A4", show_default=True, help="A5 to A0, letter, 300x400mm, auto.")
@click.option("--preview", is_flag=True, help="A PNG beside the PDF.")
@click.option("--cut-marks", is_flag=True, help="Where to cut the sheet.")
@overwrite("Replace a sheet of the same name.")
@JSON
@QUIET
def board_command(
    what: str, out: Path, paper: str, preview: bool, cut_marks: bool, overwrite: bool,
    as_json: bool, quiet: bool,
) -> None:  # fmt: skip
    """Print a calibration target: a PDF at exact scale with a ruler, and its target file.

    TARGET is one line, or a target file:

    \b
      aprilgrid:6x4,tag=30mm,gap=10mm           AprilTags, 6 columns x 4 rows
      charuco:5x7,square=33mm,marker=20mm,dict=APRILTAG_36h11
      chessboard:9x6,square=20mm                inner corners
      circles:9x9,pitch=18mm,large-origin
      tag:7,size=80mm                           one AprilTag
    """  # noqa: D301 - click's own mark for lines that stay as they are
    from realsim.app.console import Console
    from realsim_calibration.sheets import make_board

    console = Console(quiet=quiet, as_json=as_json)
    files = make_board(what, out, paper, preview=preview, cut_marks=cut_marks, overwrite=overwrite)
    for path in files:
        console.say(str(path))
    console.result({"target": what, "paper": paper, "files": list(files)})
