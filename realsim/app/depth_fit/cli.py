"""`realsim depth-fit`: its options."""

from pathlib import Path
from typing import Any

import click

FOLDER = click.Path(path_type=Path)
CAMERAS = ("d405", "d415", "d435", "structured_light")
"""The depth cameras by name; a test holds them equal to the profiles', which are not imported
here."""


@click.command("depth-fit")
@click.argument("source", type=FOLDER)
@click.option("--profile", "profile_name", default="d405", show_default=True,
              type=click.Choice(CAMERAS), help="The kind of camera.")  # fmt: skip
@click.option("--simulator", default="disparity", show_default=True,
              type=click.Choice(["disparity", "stereo"]),
              help="The model in disparity space, or the stereo camera.")  # fmt: skip
@click.option("--out", type=FOLDER, default=None,
              help="The JSON; a picture is written beside it.  "
                   "[depth_sensor.json, stereo_sensor.json]")  # fmt: skip
@click.option("--views", default="", help="Only these views, such as 1-8.  [all, at most 12]")
@click.option("--camera", type=FOLDER, default=None, help="File with the intrinsics, for a FOLDER.")
@click.option("--unit", "unit_m", type=float, default=None,
              help="Metres per count of a FOLDER's depth images.  [the profile's]")  # fmt: skip
@click.option("--baseline", "baseline_m", type=float, default=None,
              help="Distance of the eyes [m].  [the profile's]")  # fmt: skip
@click.option("--quiet", is_flag=True, help="No progress bars.")
def depth_fit(source: Path, quiet: bool, **options: Any) -> None:
    """Fit the depth camera's noise and holes to frames of a wall or a bare table.

    \b
    SOURCE  a session with depth, or a folder of 16-bit depth PNGs of a plane

    Three to twelve frames from different distances and angles say the most; the plane should fill
    most of each. What the frames do not determine is said and kept from the profile. The file can
    be given wherever depth is simulated.
    """  # noqa: D301 - click's own mark for lines that stay as they are
    from realsim.app.console import Console
    from realsim.app.depth_fit.run import DepthFitRequest, run_depth_fit

    run_depth_fit(source, DepthFitRequest(**options), Console(quiet=quiet))
