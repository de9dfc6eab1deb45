"""`realsim depth-fit`: its options."""

from pathlib import Path
from typing import Any

import click

from realsim.app.command import Command
from realsim.app.options import FOLDER, JSON, QUIET
from realsim.app.outputs import OutputFile

OUT = OutputFile({".json": (' sensor 1"',)}, "sensor", beside=(".png",))
CAMERAS = ("d405", "d415", "d435", "structured_light")
"""The depth cameras by name; a test holds them equal to the profiles', which are not imported
here."""


@click.command(
    "depth-fit",
    cls=Command,
    examples=(
        "realsim depth-fit wall --camera camera.json --unit 0.0001",
        "realsim depth-fit demo/session --views 0-3 --out table.json --json",
    ),
)
@click.argument("source", type=FOLDER)
@click.option("--profile", "profile_name", default="d405", show_default=True,
              type=click.Choice(CAMERAS), help="The kind of camera.")  # fmt: skip
@click.option("--simulator", default="disparity", show_default=True,
              type=click.Choice(["disparity", "stereo"]),
              help="The model in disparity space, or the stereo camera.")  # fmt: skip
@click.option("--out", type=OUT, default=None,
              help="The JSON; a picture is written beside it.  "
                   "[depth_sensor.json, stereo_sensor.json]")  # fmt: skip
@click.option("--views", default="", help="Only these views, such as 1-8.  [all, at most 12]")
@click.option(
    "--camera",
    type=FOLDER,
    default=None,
    help="File with the intrinsics, for a FOLDER.  [beside it, or the kind's]",
)
@click.option("--unit", "unit_m", type=float, default=None,
              help="Metres per count of a FOLDER's depth images.  [the profile's]")  # fmt: skip
@click.option("--baseline", "baseline_m", type=float, default=None,
              help="Distance of the eyes [m].  [the profile's]")  # fmt: skip
@JSON
@QUIET
def depth_fit(source: Path, as_json: bool, quiet: bool, **options: Any) -> None:
    """Fit the depth camera's noise and holes to frames of a wall or a bare table.

    \b
    SOURCE  a session with depth, or a folder of 16-bit depth images (PNG, NPY)

    Three to twelve frames from different distances and angles say the most; the plane should fill
    most of each. What the frames do not determine is said and kept from the profile. The file can
    be given wherever depth is simulated.
    """  # noqa: D301 - click's own mark for lines that stay as they are
    from realsim.app.console import Console
    from realsim.app.depth_fit.run import DepthFitRequest, run_depth_fit

    run_depth_fit(source, DepthFitRequest(**options), Console(quiet=quiet, as_json=as_json))
