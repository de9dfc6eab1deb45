"""`realsim depth-fit`: its options."""

from pathlib import Path
from typing import Any

from realsim.app.console import Console
from realsim.app.option_values import DepthUnit
from realsim.app.options import SOURCE, Has, command, options
from realsim.app.outputs import OutputFile

OUT = OutputFile({".json": (' sensor 1"',)}, "sensor", beside=(".png",))


@command(
    "depth-fit",
    "realsim depth-fit wall --intrinsics camera.json --depth-unit 0.0001",
    "realsim depth-fit demo/session --only-views 0-3 --out table.json --json",
)
@SOURCE
@options(
    sensor="d405", simulator="disparity", only_views=Has("", "  [all, at most 12]"),
    out=Has(None, ", with a picture beside it  [depth_sensor.json, stereo_sensor.json]", OUT),
    intrinsics=Has(None, ", for a FOLDER  [beside it, or the sensor's]"),
    depth_unit=Has(None, " of a FOLDER  [the sensor's]", DepthUnit(1e-7, 0.02)),
    baseline=Has(None, "  [the sensor's]"),
)  # fmt: skip
def depth_fit_command(console: Console, source: Path, **options: Any) -> None:
    """Fit the depth camera's noise and holes to frames of a wall or a bare table.

    \b
    SOURCE  a session with depth, or a folder of 16-bit depth images (PNG, NPY)

    Three to twelve frames from different distances and angles say the most; the plane should fill
    most of each. What the frames do not determine is said and kept from the profile. The file can
    be given wherever depth is simulated.
    """  # noqa: D301 - click's own mark for lines that stay as they are
    from realsim.app.depth_fit.run import DepthFitRequest, run_depth_fit

    run_depth_fit(source, DepthFitRequest(**options), console)
