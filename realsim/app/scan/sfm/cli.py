"""The command `realsim scan sfm`."""

from pathlib import Path
from typing import Any

import click

from realsim.app.console import Console
from realsim.app.option_values import FOLDER, point_of
from realsim.app.options import Has, command, options
from realsim.app.outputs import OutputFolder


@command(
    "sfm",
    "realsim scan sfm demo/session --no-dense",
    "realsim scan sfm demo/session --use-poses known --no-dense --text --out sfm",
)
@click.argument("images", type=FOLDER)
@options(
    out=Has(None, "  [SESSION/scans/sfm, IMAGES/sfm]", OutputFolder()),
    use_poses=Has(None, "  [refined where there are any]"), intrinsics=None, masks=None,
)  # fmt: skip
@click.option("--dense/--no-dense", default=None, help="Fuse depth into a mesh.  [if there is any]")
@options(at="", text=False, seed=0)
def sfm(console: Console, images: Path, at: str, **options: Any) -> bool:
    """Structure from motion at metric scale, and a mesh from the depth images.

    IMAGES is a session folder, or a folder of photographs. A session's camera poses bring the
    result to metres: 'refined' starts at them and adjusts them to the pictures, unless two halves
    of the scene would do so differently; 'known' keeps them; 'unknown' maps without them and
    aligns the result, which shows whether robot and pictures agree. Photographs alone have no
    metric scale.

    Exit codes: 0 accepted, 1 done but doubtful or rejected, 2 something given cannot be used.
    """
    from realsim.app.scan.sfm.run import SfmRequest, run_scan_sfm

    return run_scan_sfm(SfmRequest(images=images, at=point_of(at), **options), console)
