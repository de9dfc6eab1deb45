"""`realsim export` on the command line."""

from pathlib import Path
from typing import Any

import click

from realsim.app.command import Command
from realsim.app.option_values import numbers_of
from realsim.app.options import FOLDER, JSON, QUIET
from realsim.app.outputs import GOES_ON

FORMATS = (
    "bop", "graspnet", "colmap", "nerfstudio", "urdf", "mjcf", "usd", "graspit", "grasp-group",
    "acronym", "graspgen", "isaac", "hdf5", "parquet",
)  # fmt: skip


@click.command(
    "export",
    cls=Command,
    examples=(
        "realsim export demo/session --to bop --out as_bop",
        "realsim export dataset --to nerfstudio --out as_nerfstudio --scenes 1",
    ),
)
@click.argument("sources", type=FOLDER, nargs=-1, required=True, metavar="SOURCE...")
@click.option("--to", "target", required=True, type=click.Choice(FORMATS), metavar="FORMAT",
              help=f"{', '.join(FORMATS[:-1])} or {FORMATS[-1]}.")  # fmt: skip
@click.option(
    "--out",
    type=GOES_ON,
    required=True,
    help="Folder to fill; new, or to go on in.",
)
@click.option("--labels", default="auto", show_default=True,
              type=click.Choice(("auto", "annotated", "imported", "none")),
              help="Of a session: realsim's own, or those it came with.")  # fmt: skip
@click.option("--scenes", default="", help="Scene numbers, such as 1-3,7; all by default.")
@click.option("--split", default="", help="BOP's split to write.")
@click.option("--camera", default="", help="One of several cameras; GraspNet: kinect, realsense.")
@click.option("--models", type=FOLDER, default=None, help="Models of a data set without.")
@click.option("--colour", default="copy", show_default=True,
              type=click.Choice(("copy", "png", "jpeg")), help="Colour images.")  # fmt: skip
@click.option("--jpeg-quality", default=95, show_default=True, type=click.IntRange(1, 100),
              help="Of JPEG images.")  # fmt: skip
@click.option("--no-masks", is_flag=True, help="Leave the masks out.")
@click.option("--points", default=100_000, show_default=True, type=click.IntRange(0),
              help="Coloured points of a COLMAP model.")  # fmt: skip
@click.option("--shards", is_flag=True, help="BOP once more as tar shards (webdataset).")
@click.option(
    "--undistort", is_flag=True, help="As an ideal camera sees it; BOP, GraspNet: always."
)
@click.option("--keep-distortion", is_flag=True, help="BOP, GraspNet: the raw images.")
@click.option("--table-is-world", is_flag=True, help="Where no table is known: it is z = 0.")
@click.option("--least-score", default=0.0, show_default=True, type=click.FloatRange(0, 1),
              help="Leave out grasps of less p_hold, else score (isaac).")  # fmt: skip
@click.option("--name", default="", help="Of the data set, on its card.")
@click.option("--licence", default="", help="Of images and labels, on the card.")
@click.option("--models-licence", default="", help="Of the object models, on the card.")
@click.option("--attribution", default="", help="Whom to name, on the card.")
@JSON
@QUIET
def export_command(
    sources: tuple[Path, ...], out: Path, scenes: str, no_masks: bool, as_json: bool, quiet: bool,
    **options: Any,
) -> None:  # fmt: skip
    """Write sessions or data sets in another format, with a card and checksums.

    SOURCE is a session, a folder of sessions (of `realsim generate` or `upgrade`), a BOP or a
    GraspNet data set. Interrupted, the same command goes on where it stopped.
    """
    from realsim.app.console import Console
    from realsim.app.export.request import ExportRequest
    from realsim.app.export.run import run_export, show_export

    request = ExportRequest(
        sources=sources, scenes=numbers_of(scenes), masks=not no_masks, **options
    )
    console = Console(quiet=quiet, as_json=as_json)
    result = run_export(request, out, console)
    show_export(result, console)
    console.result(result)
