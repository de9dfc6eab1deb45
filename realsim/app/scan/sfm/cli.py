"""The command `realsim scan sfm`."""

import sys
from pathlib import Path
from typing import Any

import click

from realsim.app.command import Command
from realsim.app.options import FOLDER, JSON, QUIET, seed
from realsim.app.outputs import OutputFolder


@click.command(
    "sfm",
    cls=Command,
    examples=(
        "realsim scan sfm demo/session --no-dense",
        "realsim scan sfm demo/session --poses known --no-dense --text --out sfm",
    ),
)
@click.argument("images", type=FOLDER)
@click.option(
    "--out", type=OutputFolder(), default=None, help="Folder.  [SESSION/scans/sfm, IMAGES/sfm]"
)
@click.option(
    "--poses",
    type=click.Choice(["unknown", "known", "refined"]),
    default=None,
    help="How the robot's camera poses are used.  [refined where there are any]",
)
@click.option("--camera", type=FOLDER, default=None, help="File with known intrinsics.")
@click.option("--masks", type=FOLDER, default=None, help="Folder of masks, white = use.")
@click.option("--dense/--no-dense", default=None, help="Fuse depth into a mesh.  [if there is any]")
@click.option("--at", default="", help="The object whose mesh is wanted: x,y in world [m].")
@click.option("--text", is_flag=True, help="The COLMAP model as text, too.")
@seed("Of every random choice.")
@JSON
@QUIET
def sfm(images: Path, as_json: bool, quiet: bool, **options: Any) -> None:
    """Structure from motion at metric scale, and a mesh from the depth images.

    IMAGES is a session folder, or a folder of photographs. A session's camera poses bring the
    result to metres: 'refined' starts at them and adjusts them to the pictures, unless two halves
    of the scene would do so differently; 'known' keeps them; 'unknown' maps without them and
    aligns the result, which shows whether robot and pictures agree. Photographs alone have no
    metric scale.

    Exit codes: 0 accepted, 1 done but doubtful or rejected, 2 something given cannot be used.
    """
    from realsim.app.console import Console
    from realsim.app.option_values import point_of
    from realsim.app.scan.sfm.run import SfmRequest, run_scan_sfm

    at = point_of(options.pop("at"))
    console = Console(quiet=quiet, as_json=as_json)
    if not run_scan_sfm(SfmRequest(images=images, at=at, **options), console):
        sys.exit(1)
