"""The commands of `realsim scan`: object models into a library, to metric scale, and looked at.

`scale` and `sfm` live in modules of their own and are loaded when they are asked for.
"""

import sys
from pathlib import Path
from typing import Any

import click

from realsim.app.command import Command, Group
from realsim.app.options import FOLDER, JSON, QUIET, overwrite

SCAN = Group(
    "scan",
    late={
        "scale": "realsim.app.scan.scale.cli:scale",
        "sfm": "realsim.app.scan.sfm.cli:sfm",
    },
    examples=("realsim scan import mug.stl --unit mm", "realsim scan list"),
    help="""Object models: meshes and scans into a library, at metric scale.

    A library is a folder of models as BOP has them (obj_000001.ply in millimetres and
    models_info.json), with convex parts, properties and pictures beside them; every stage reads it.
    """,
)
LIBRARY = click.option(
    "--library", type=FOLDER, default=Path("models"), show_default=True, help="Folder of models."
)


@SCAN.command(
    "import",
    cls=Command,
    examples=(
        "realsim scan import mug.stl --unit mm",
        "realsim scan import generated.obj --unit none --no-parts",
    ),
)
@click.argument("meshes", metavar="MESH...", nargs=-1, required=True, type=FOLDER)
@LIBRARY
@click.option("--name", default="", help="Name of the model.  [the file's]")
@click.option("--id", "obj_id", type=int, default=None, help="Its BOP id.  [the next free one]")
@click.option(
    "--unit",
    default=None,
    type=click.Choice(["m", "cm", "mm", "inch", "none"]),
    help="What one unit of the file is; none: no metric scale.  [as the file states]",
)
@click.option(
    "--up",
    default=None,
    type=click.Choice(["x", "y", "z", "-x", "-y", "-z"]),
    help="The file's axis that points up.  [as the format says]",
)
@click.option("--density", type=float, default=None, help="[kg/m^3].  [1000]")
@click.option("--mass", type=float, default=None, help="As weighed [kg], instead of a density.")
@click.option(
    "--faces",
    type=click.IntRange(min=100),
    default=200_000,
    show_default=True,
    help="Faces to keep at most.",
)
@click.option("--no-parts", is_flag=True, help="No convex parts; the School makes them itself.")
@overwrite("Replace the model of this name or id.")
@JSON
@QUIET
def import_command(meshes: tuple[Path, ...], as_json: bool, quiet: bool, **options: Any) -> None:
    """Read, repair and measure meshes, and add them to the library.

    MESH is a GLB, OBJ, PLY, STL, OFF or USD file. Its unit is stated by the file or by --unit,
    never guessed; a generated mesh has none: --unit none puts it into LIBRARY/unscaled, and
    `realsim scan scale` finds its size.

    Exit codes: 0 done, 1 done but a person should look at a model, 2 a mesh cannot be used.
    """
    from realsim.app.console import Console
    from realsim.app.scan.importing import ImportRequest, run_scan_import

    console = Console(quiet=quiet, as_json=as_json)
    code = run_scan_import(ImportRequest(meshes=meshes, **options), console)
    if code:
        sys.exit(code)


@SCAN.command(
    "list", cls=Command, examples=("realsim scan list", "realsim scan list demo/session/models")
)
@click.argument("library", type=FOLDER, default=Path("models"))
@JSON
@QUIET
def list_command(library: Path, as_json: bool, quiet: bool) -> None:
    """List the models of a library: the folder `models` by default."""
    from realsim.app.console import Console
    from realsim.app.scan.library import list_library

    list_library(library, Console(quiet=quiet, as_json=as_json))


@SCAN.command("show", cls=Command, examples=("realsim scan show models mug",))
@click.argument("library", type=FOLDER)
@click.argument("name")
@JSON
@QUIET
def show_command(library: Path, name: str, as_json: bool, quiet: bool) -> None:
    """Show everything that is known of a model: NAME is its name, its id, or its file.

    Its picture is made where the library has none.
    """
    from realsim.app.console import Console
    from realsim.app.scan.library import show_model

    show_model(library, name, Console(quiet=quiet, as_json=as_json))


@SCAN.command("check", cls=Command, examples=("realsim scan check models",))
@click.argument("library", type=FOLDER, default=Path("models"))
@JSON
@QUIET
def check_command(library: Path, as_json: bool, quiet: bool) -> None:
    """Say what of a library is missing, damaged, changed, or left over; nothing is changed.

    Exit codes: 0 sound, 1 not, 2 no library.
    """
    from realsim.app.console import Console
    from realsim.app.scan.library import run_library_check

    if not run_library_check(library, Console(quiet=quiet, as_json=as_json)):
        sys.exit(1)


@SCAN.command("complete", cls=Command, examples=("realsim scan complete demo/session/models",))
@click.argument("library", type=FOLDER)
@click.argument("names", nargs=-1)
@click.option("--mass", type=float, default=None, help="As weighed [kg], of one model.")
@click.option("--density", type=float, default=None, help="[kg/m^3].  [as the library says]")
@JSON
@QUIET
def complete_command(
    library: Path, names: tuple[str, ...], mass: float | None, density: float | None,
    as_json: bool, quiet: bool,
) -> None:  # fmt: skip
    """Compute properties, convex parts and pictures for models of another program.

    NAMES are those without properties by default. Meshes and models_info.json are not changed.
    Convex parts take up to a minute of CPU time for each model.
    """
    from realsim.app.console import Console
    from realsim.app.scan.complete import run_complete

    console = Console(quiet=quiet, as_json=as_json)
    if not run_complete(library, names, console, mass_kg=mass, density=density):
        sys.exit(1)
