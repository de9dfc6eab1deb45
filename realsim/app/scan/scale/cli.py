"""`realsim scan scale`: its options."""

import sys
from pathlib import Path
from typing import Any

import click

from realsim.app.command import Command
from realsim.app.option_values import numbers_of, point_of
from realsim.app.options import FOLDER, JSON, QUIET, json_file, overwrite
from realsim.app.outputs import OutputFolder

RESULT = OutputFolder(
    ("scale.json", "model.ply", "model.png", "scale.html", "residuals.png", "views.png",
     "candidates.png", "overlays.png"),
    own=("scale.json", ('"smallest_box_mm"', '"versions"')),
)  # fmt: skip
UP = click.Choice(["x", "y", "z", "-x", "-y", "-z"])


@click.command(
    "scale",
    cls=Command,
    examples=(
        "realsim scan scale tube.ply captured --at 0.50,-0.03",
        "realsim scan scale generated.obj --measured longest=120.4mm+-0.3mm --out scaled",
    ),
)
@click.argument("mesh")
@click.argument("session", type=FOLDER, required=False)
@click.option("--library", type=FOLDER, default=None, help="Put the scaled model there.  [nowhere]")
@click.option("--name", default="", help="Name of the result.  [that of the mesh]")
@click.option("--up", type=UP, default=None, help="The file's axis that points up.")
@click.option("--start", type=FOLDER, default=None, help="JSON with scale and T_world_obj.")
@click.option("--size", default="", help="Rough longest side, such as 90mm.")
@click.option("--at", default="", help="Where the object stands: x,y in world [m].")
@click.option("--measured", multiple=True, help="A length by caliper: longest=120.4mm+-0.3mm.")
@click.option("--between", multiple=True, help="Two points and a length: 'x,y,z x,y,z=95mm'.")
@click.option("--views", default="", help="Only these views, such as 1-24.")
@click.option("--out", type=RESULT, default=None, help="Folder.  [SESSION/scans/NAME]")
@json_file("scale.json once more.", "scale", "sigma", "verdict")
@click.option("--id", "obj_id", type=int, default=None, help="BOP id in the library.")
@click.option("--density", type=float, default=None, help="For the library [kg/m^3].  [1000]")
@click.option("--mass", type=float, default=None, help="As weighed [kg], instead of a density.")
@overwrite("Do it again, and replace what is there.")
@click.option("--accept-doubtful", is_flag=True, help="Into the library whatever the verdict.")
@JSON
@QUIET
def scale(mesh: str, session: Path | None, as_json: bool, quiet: bool, **options: Any) -> None:
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
    from realsim.app.console import Console
    from realsim.app.scan.scale.run import run_scale

    request = request_of(mesh, session, options)
    if not run_scale(request, Console(quiet=quiet, as_json=as_json)):
        sys.exit(1)


def request_of(mesh: str, session: Path | None, options: dict[str, Any]) -> Any:
    """Return the request of the options as they were typed.

    Raises:
        InputError: a length, a start file or a point cannot be read.
    """
    from realsim.app.scan.scale.inputs import ScaleRequest
    from realsim.scanning.scale.files import load_start
    from realsim.scanning.scale.measured import parse_length, parse_measurement

    lengths = [*options["measured"], *(f"between {text}" for text in options["between"])]
    return ScaleRequest(
        mesh=mesh,
        session=session,
        library=options["library"],
        name=options["name"],
        up=options["up"],
        start=None if options["start"] is None else load_start(options["start"]),
        size_m=parse_length(options["size"]) if options["size"] else None,
        at=point_of(options["at"]),
        measured=tuple(parse_measurement(text) for text in lengths),
        views=numbers_of(options["views"]),
        out=options["out"],
        overwrite=options["overwrite"],
        accept_doubtful=options["accept_doubtful"],
        json=options["json_file"],
        obj_id=options["obj_id"],
        density=options["density"],
        mass=options["mass"],
    )
