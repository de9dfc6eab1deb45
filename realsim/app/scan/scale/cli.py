"""`realsim scan scale`: its options."""

from typing import Any

import click

from realsim.app.console import Console
from realsim.app.option_values import FOLDER, point_of
from realsim.app.options import Has, command, json_file, options, rare
from realsim.app.outputs import OutputFolder

RESULT = OutputFolder(
    ("scale.json", "model.ply", "model.png", "scale.html", "residuals.png", "views.png",
     "candidates.png", "overlays.png"),
    own=("scale.json", ('"smallest_box_mm"', '"versions"')),
)  # fmt: skip


@command(
    "scale",
    "realsim scan scale tube.ply captured --at 0.50,-0.03",
    "realsim scan scale generated.obj --measured longest=120.4mm+-0.3mm --out scaled",
)
@click.argument("mesh")
@click.argument("session", type=FOLDER, required=False)
@options(
    at="", rough_size="", measured=(), between=(), only_views="",
    library=Has(None, ", to put the scaled model there  [nowhere]"),
    name=Has("", "  [that of the mesh]"), up=None, out=Has(None, "  [SESSION/scans/NAME]", RESULT),
    mass=None, overwrite=False,
)  # fmt: skip
@rare(
    start_file=None, json_file=json_file("scale", "sigma", "verdict"), id=None,
    density=Has(None, "  [1000]"), accept_doubtful=False,
)  # fmt: skip
def scale(console: Console, **options: Any) -> bool:
    """Find the metric scale of MESH in the depth images of SESSION.

    \b
    MESH     a mesh file of any unit, a mesh of the library without scale
             (NAME, or LIBRARY/unscaled/NAME), or the name or id of a model at
             metric scale, which is then checked
    SESSION  a calibrated session with depth; without one, --measured gives
             the scale

    \b
    What can be measured: longest (side of the smallest box), diameter (greatest
    distance of two points), x, y, z (the mesh's own axes), height (as it stands)

    Writes scale.json, scale.html, pictures and model.ply (mm) into SESSION/scans/NAME. Exit
    codes: 0 accepted, 1 doubtful, rejected or unchecked, 2 bad input.
    """  # noqa: D301 - click's own mark for lines that stay as they are
    from realsim.app.scan.scale.inputs import ScaleRequest
    from realsim.app.scan.scale.run import run_scale
    from realsim.scanning.scale.files import load_start
    from realsim.scanning.scale.measured import parse_length, parse_measurement

    start, size = options.pop("start"), options.pop("size")
    lengths = [*options.pop("measured"), *(f"between {t}" for t in options.pop("between"))]
    request = ScaleRequest(
        start=None if start is None else load_start(start),
        size_m=parse_length(size) if size else None, at=point_of(options.pop("at")),
        measured=tuple(parse_measurement(text) for text in lengths),
        json=options.pop("json_file"), **options,
    )  # fmt: skip
    return run_scale(request, console)
