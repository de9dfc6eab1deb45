"""`realsim scan import`: meshes into the library, with everything that was found said.

`realsim scan complete`: properties and convex parts for models of another program.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from realsim.app.console import Console, Tick
from realsim.app.scan.library import say_model, verdict_row
from realsim.errors import InputError, RealsimError
from realsim.models.library_prepare import Matter, PrepareConfig, Step
from realsim.models.library_reading import LibraryReader
from realsim.models.model_records import LibraryModel, ScanUnit, UpAxis

DONE, LOOK, UNUSABLE = 0, 1, 2


@dataclass(frozen=True, kw_only=True, slots=True)
class ImportRequest:
    """What `realsim scan import` was told."""

    meshes: tuple[Path, ...]
    library: Path = Path("models")
    name: str = ""
    obj_id: int | None = None
    unit: ScanUnit | None = None
    """None: what the file states."""
    up: UpAxis | None = None
    density: float | None = None
    """[kg/m^3]."""
    mass: float | None = None
    """[kg]."""
    faces: int = 200_000
    no_parts: bool = False
    overwrite: bool = False


def run_scan_import(request: ImportRequest, console: Console) -> int:
    """Import every mesh; one that cannot be used does not keep the others out.

    Returns:
        The exit code: 0 done, 1 a person should look at a model, 2 a mesh cannot be used.

    Raises:
        InputError: options that contradict each other, or one file that cannot be used.
    """
    _require_consistent(request)
    verdicts: list[str] = []
    rows: list[tuple[str, ...]] = []
    told: list[dict[str, object]] = []
    named: dict[str, Path] = {}
    for path in request.meshes:
        try:
            name = _name(path, request)
            if (first := named.setdefault(name, path)) != path:
                raise InputError(
                    f"it would be called '{name}', as {first} is. Import it by itself, with --name."
                )
            verdict, row, document = _import_one(path, request, console)
        except RealsimError as error:
            if len(request.meshes) == 1:
                raise
            console.warn(f"{path}: not imported: {error}")
            verdict, row = "unusable", (path.name, "", "", "", "", "unusable")
            document = {"verdict": verdict, "why": str(error)}
        verdicts.append(verdict)
        rows.append(row)
        told.append({"file": path, **document})
    console.result({"library": request.library, "meshes": told})
    if len(rows) > 1:
        header = ("model", "id", "size [mm]", "mass [g]", "parts", "verdict")
        console.table(f"{len(rows)} meshes", header, rows)
    if "unusable" in verdicts:
        return UNUSABLE
    return LOOK if "doubtful" in verdicts else DONE


def _require_consistent(request: ImportRequest) -> None:
    """Raise if the options contradict each other.

    Raises:
        InputError: names the options.
    """
    if len(request.meshes) > 1 and (request.name or request.obj_id or request.mass is not None):
        raise InputError(
            f"--name, --id and --mass are of one model, but {len(request.meshes)} meshes are "
            "given; import them one by one."
        )
    if request.mass is not None and request.density is not None:
        raise InputError("--mass and --density were both given; one follows from the other.")
    for option, value in (("--mass", request.mass), ("--density", request.density)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise InputError(f"{option} is {value:g}; a positive number is needed.")
    if request.unit == "none" and (request.mass is not None or request.obj_id is not None):
        raise InputError(
            "--mass and --id are of models with a metric scale; give them to `realsim scan scale`."
        )
    for path in request.meshes:
        if not path.is_file():
            kind = "is a folder" if path.is_dir() else "does not exist"
            raise InputError(f"{path} {kind}; a mesh file (glb, obj, ply, stl, usd) is expected.")


def _import_one(
    path: Path, request: ImportRequest, console: Console
) -> tuple[str, tuple[str, ...], dict[str, object]]:
    """Import one mesh, say what was found, and return its verdict, its row and its document."""
    from realsim.models import library_prepare as prepare
    from realsim.models.library import ModelLibrary
    from realsim.models.pictures import sheet_png
    from realsim.models.reading import read_scan
    from realsim.untrusted.own_json import to_json

    name = _name(path, request)
    _check_place(name, request)
    config = prepare.PrepareConfig(most_faces=request.faces, with_parts=not request.no_parts)
    steps = ("read", *prepare.STEPS, "picture")
    with console.stage("import", path.name) as tick:

        def step(which: prepare.Step) -> None:
            tick(steps.index(which), len(steps))

        tick(0, len(steps))
        scan = read_scan(path, request.unit, request.up)
        source, metric = prepare.source_of(scan, path.name), scan.unit != "none"
        if metric:
            matter = prepare.Matter(density=request.density, mass_kg=request.mass)
            made = prepare.prepare_mesh(scan.mesh, config, matter, source=source, step=step)
        else:
            made = prepare.prepare_unscaled(scan.mesh, config, source=source, step=step)
        tick(len(steps) - 1, len(steps))
        picture = sheet_png(made.mesh, made.properties, made.parts, name)
        library = ModelLibrary.create(request.library)
        if metric:
            kept = library.add(
                made, name, obj_id=request.obj_id, overwrite=request.overwrite, picture=picture
            )
            obj_id = kept.model.obj_id
        else:
            library.add_unscaled(made, name, overwrite=request.overwrite, picture=picture)
            obj_id = None
    say_model(console, library.folder, name, obj_id, made.mesh, made.properties)
    p = made.properties
    document: dict[str, object] = {"verdict": p.verdict, "name": name, "obj_id": obj_id}
    document["properties"] = to_json(p)
    return p.verdict, verdict_row(name, obj_id, p), document


def _name(path: Path, request: ImportRequest) -> str:
    """Return the model's name: as said, or of the file, with what a name cannot have as '_'."""
    from realsim.models.library_files import require_name

    if request.name:
        return require_name(request.name)
    name = re.sub(r"[^A-Za-z0-9_.+-]+", "_", path.stem).strip("._-+")
    return require_name(f"model_{name}" if name.isdigit() or not name else name)


def _check_place(name: str, request: ImportRequest) -> None:
    """Raise before the long work if the library will not take the model.

    Raises:
        InputError: the name or the id is taken, or the folder is no library.
    """
    from realsim.models.library import ModelLibrary

    folder = request.library
    if not folder.exists():
        return
    library = ModelLibrary.create(folder)
    if request.unit != "none":
        library.place_for(name, request.obj_id, overwrite=request.overwrite)
    else:
        library.unscaled_place_for(name, overwrite=request.overwrite)


__all__ = ["ImportRequest", "run_scan_import"]


def run_complete(
    folder: Path,
    names: Sequence[str],
    console: Console,
    *,
    mass_kg: float | None,
    density: float | None,
) -> bool:
    """Compute what is not known of models; return whether no person needs to look at any.

    Raises:
        InputError: no library, no such model, or a mass for several models.
    """
    from realsim.models.library_complete import COMPLETE_STEPS

    library, config = LibraryReader.open(folder), PrepareConfig()
    wanted = list(names)
    if not wanted:
        wanted = [str(e.obj_id) for e in library.entries() if e.obj_id and e.properties is None]
    if mass_kg is not None and len(wanted) != 1:
        raise InputError(f"--mass is of one model, but {len(wanted)} are completed.")
    if not wanted:
        console.say(f"every model in {folder} has its properties: there is nothing to complete.")
        console.result({"library": folder, "completed": [], "look": []})
        return True
    matter = None
    if mass_kg is not None or density is not None:
        matter = Matter(density=density, mass_kg=mass_kg)
    console.say(
        f"{len(wanted)} to complete: {', '.join(COMPLETE_STEPS)}, picture. Convex parts take "
        f"longest: up to {config.convex.time_limit_s:g} s of CPU time for each model."
    )
    looks, rows, fine = list[str](), list[tuple[str, ...]](), True
    for k, name in enumerate(wanted):
        try:
            found = _complete_one(
                library, name, (config, matter), f"{k + 1}/{len(wanted)}", console
            )
        except RealsimError as error:
            if len(wanted) == 1:
                raise
            looks.append(f"{name} was not completed: {error}")
            continue
        p = found.properties
        if p is not None:
            rows.append(verdict_row(found.model.name, found.model.obj_id, p))
            fine = fine and p.verdict == "accepted"
            looks += [f"{found.model.name} is {p.verdict}: {reason}" for reason in p.reasons]
    header = ("model", "id", "size [mm]", "mass [g]", "parts", "verdict")
    console.table(f"{len(rows)} of {len(wanted)} completed in {folder}", header, rows)
    for text in looks:
        console.say(f"LOOK: {text}")
    console.result({"library": folder, "completed": [row[0] for row in rows], "look": looks})
    return fine and len(rows) == len(wanted)


def _complete_one(
    library: LibraryReader,
    wanted: str,
    how: tuple[PrepareConfig, Matter | None],
    place: str,
    console: Console,
) -> LibraryModel:
    """Complete one model, show every step of it, and say in one line what was found."""
    from realsim.models.library_complete import COMPLETE_STEPS, complete
    from realsim.models.pictures import symmetry_text

    obj_id = library.find(wanted)
    name = next(e.name for e in library.entries() if e.obj_id == obj_id)
    with console.stage(f"complete {place}", name) as tick:
        shown: Tick = tick

        def step(which: Step) -> None:
            shown(COMPLETE_STEPS.index(which), len(COMPLETE_STEPS))

        found = complete(library, obj_id, *how, step=step)
    p, cost = found.properties, f"{console.times[-1].cpu_s:.0f} s of CPU time"
    if p is None:
        console.say(f"{place} {name}: {'; '.join(found.notes)}")
        return found
    parts = "no convex parts" if p.convex is None else f"{p.convex.parts} convex parts"
    console.say(f"{place} {name}: symmetries {symmetry_text(p)}, {parts}, {p.verdict}, {cost}")
    return found
