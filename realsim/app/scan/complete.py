"""`realsim scan complete`: properties and convex parts for models of another program."""

from collections.abc import Sequence
from pathlib import Path

from realsim.app.console import Console, Tick
from realsim.app.scan.library import verdict_row
from realsim.errors import InputError, RealsimError
from realsim.models.library_prepare import Matter, PrepareConfig, Step
from realsim.models.library_reading import LibraryReader
from realsim.models.library_records import LibraryModel


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
