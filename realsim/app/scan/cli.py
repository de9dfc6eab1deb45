"""The commands of `realsim scan`: object models into a library, to metric scale, and looked at.

`scale` and `sfm` live in modules of their own and are loaded when they are asked for.
"""

import sys
from pathlib import Path
from typing import Any

import click

from realsim.app.command import Group
from realsim.app.console import Console
from realsim.app.meanings import one_of
from realsim.app.option_values import FOLDER
from realsim.app.options import Has, command, options, rare

scan_command = Group(
    "scan",
    late={"scale": "realsim.app.scan.scale.cli:scale", "sfm": "realsim.app.scan.sfm.cli:sfm"},
    examples=("realsim scan import mug.stl --unit mm", "realsim scan list"),
    help="""Object models: meshes and scans into a library, at metric scale.

    A library is a folder of models as BOP has them (obj_000001.ply in millimetres and
    models_info.json), with convex parts, properties and pictures beside them; every stage reads it.
    """,
)
UNITS = one_of("m cm mm inch none")


@command(
    "import",
    "realsim scan import mug.stl --unit mm",
    "realsim scan import generated.obj --unit none --no-parts",
    group=scan_command,
)
@click.argument("meshes", metavar="MESH...", nargs=-1, required=True, type=FOLDER)
@options(
    library=Path("models"), name=Has("", "  [the file's]"),
    unit=Has(None, "; none: no metric scale  [as the file states]", UNITS),
    up=Has(None, "  [as the format says]"), mass=None, density=Has(None, "  [1000]"),
    overwrite=False,
)  # fmt: skip
@rare(id=Has(None, "  [the next free one]"), faces=200_000, no_parts=False)
def import_command(console: Console, **options: Any) -> None:
    """Read, repair and measure meshes, and add them to the library.

    MESH is a GLB, OBJ, PLY, STL, OFF or USD file. Its unit is stated by the file or by --unit,
    never guessed; a generated mesh has none: --unit none puts it into LIBRARY/unscaled, and
    `realsim scan scale` finds its size.

    Exit codes: 0 done, 1 done but a person should look at a model, 2 a mesh cannot be used.
    """
    from realsim.app.scan.importing import ImportRequest, run_scan_import

    code = run_scan_import(ImportRequest(**options), console)
    if code:
        sys.exit(code)


@command("list", "realsim scan list", "realsim scan list demo/session/models", group=scan_command)
@click.argument("library", type=FOLDER, default=Path("models"))
def list_command(console: Console, library: Path) -> None:
    """List the models of a library: the folder `models` by default."""
    from realsim.app.scan.library import list_library

    list_library(library, console)


@command("show", "realsim scan show models mug", group=scan_command)
@click.argument("library", type=FOLDER)
@click.argument("name")
def show_command(console: Console, library: Path, name: str) -> None:
    """Show everything that is known of a model: NAME is its name, its id, or its file.

    Its picture is made where the library has none.
    """
    from realsim.app.scan.library import show_model

    show_model(library, name, console)


@command("check", "realsim scan check models", group=scan_command)
@click.argument("library", type=FOLDER, default=Path("models"))
def check_command(console: Console, library: Path) -> bool:
    """Say what of a library is missing, damaged, changed, or left over; nothing is changed.

    Exit codes: 0 sound, 1 not, 2 no library.
    """
    from realsim.app.scan.library import run_library_check

    return run_library_check(library, console)


@command("complete", "realsim scan complete demo/session/models", group=scan_command)
@click.argument("library", type=FOLDER)
@click.argument("names", nargs=-1)
@options(mass=Has(None, "; of one model"), density=Has(None, "  [as the library says]"))
def complete_command(
    console: Console, library: Path, names: tuple[str, ...], mass: float | None,
    density: float | None,
) -> bool:  # fmt: skip
    """Compute properties, convex parts and pictures for models of another program.

    NAMES are those without properties by default. Meshes and models_info.json are not changed.
    Convex parts take up to a minute of CPU time for each model.
    """
    from realsim.app.scan.importing import run_complete

    return run_complete(library, names, console, mass_kg=mass, density=density)
