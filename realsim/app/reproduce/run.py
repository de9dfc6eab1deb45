"""A result made again from its record, in a folder of its own, and held against what is there."""

import shutil
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from realsim.app.console import Console, shortened
from realsim.app.export.card import CROISSANT_FILE
from realsim.app.reproduce.compare import FileDifference, compare_folders
from realsim.errors import InputError
from realsim.store import SessionStore, provenance
from realsim.store.provenance import Provenance, Run
from realsim.untrusted.own_json import read_object

ROOM = 1.2
"""Free space that is asked for, in units of what is copied."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Reproduced:
    """What came of making a result again."""

    stage: str
    files: int
    """Files compared."""
    differing: tuple[FileDifference, ...]
    other_versions: tuple[str, ...]
    """Versions that are not those of the record."""

    @property
    def equal(self) -> bool:
        """Whether every file is the same."""
        return not self.differing


def reproduce(folder: Path, stage: str, console: Console, workers: int = 1) -> Reproduced:
    """Make a result again and compare; what is there is only read.

    Args:
        folder: a session, or the folder of an export.
        stage: the session's stage; empty for a folder that is no session.
        console: progress goes there.
        workers: processes.

    Raises:
        InputError: there is no record, its stage or its inputs cannot be had again, or there is
            no room for a copy.
    """
    is_session = (folder / "session.json").is_file()
    record, run = _read(folder, stage, is_session)
    _require_again(folder, record, run)
    now = provenance.versions()
    other = tuple(
        f"{name} {was} -> {is_}" for name, was, is_ in provenance.differences(record.versions, now)
    )
    if other:
        console.warn(
            f"made with other versions ({'; '.join(other)}): results may differ for that alone."
        )
    if record.stage != (stage or "export"):
        raise InputError(
            f"the record of {stage or 'this folder'} says that it is of '{record.stage}': it was "
            f"changed or exchanged. Run {stage or 'the export'} again."
        )
    request = given_again(record.request, run.places)
    with tempfile.TemporaryDirectory(prefix="realsim-reproduce-") as temporary:
        place = Path(temporary)
        try:
            if record.stage == "export":
                again = _export(folder, request, place, console)
            else:
                again = _in_session(folder, record.stage, request, place, console, workers)
        except TypeError as error:
            if "argument" not in str(error):
                raise
            raise InputError(
                f"the record of {record.stage} asks for something that this realsim does not know "
                f"({error}); it was changed, or is of another version. Run it again."
            ) from error
        with console.stage("compare"):
            files, differing = compare_folders(folder, again)
    return Reproduced(stage=record.stage, files=files, differing=differing, other_versions=other)


def _read(folder: Path, stage: str, is_session: bool) -> tuple[Provenance, Run]:
    """Return the record that is meant.

    Raises:
        InputError: it is not said which, or there is none.
    """
    if not folder.is_dir():
        raise InputError(f"'{folder}' is no folder; give a session, or the folder of an export.")
    if is_session and not stage:
        there = sorted(
            p.stem for p in (folder / "stages").glob("*.json") if not p.name.endswith(".run.json")
        )
        raise InputError(
            f"'{folder}' is a session: say which stage to make again. It holds records of "
            f"{', '.join(there) or 'none'}; {', '.join(AGAIN)} can be made again."
        )
    if stage and not is_session:
        raise InputError(f"'{folder}' is no session and has one record; leave '{stage}' away.")
    name = provenance.file_of(stage) if stage else provenance.FOLDER_FILE
    if not is_session and not (folder / name).is_file():
        raise InputError(
            f"'{folder}' is no session and no export: it holds neither session.json nor {name}. "
            "Give a session with a stage, or the folder of an export."
        )
    if is_session and stage not in AGAIN:
        raise InputError(
            f"'{stage}' is not made again by this command; {', '.join(AGAIN)} are, and the folders "
            "of exports."
        )
    if not (folder / name).is_file():
        raise InputError(
            f"'{folder}' holds no {name}, so it is not known what its result was made of. Results "
            "of an earlier realsim have none: run the stage again."
        )
    return provenance.read(folder, stage)


def _require_again(folder: Path, record: Provenance, run: Run) -> None:
    """Raise if a result cannot be made again.

    Raises:
        InputError: it is of a stage that is not run again here, or its inputs have changed.
    """
    command = f" It was made by `realsim {' '.join(run.command)}`." if run.command else ""
    if record.stage != "export" and record.stage not in AGAIN:
        raise InputError(
            f"a result of {record.stage} is not made again by this command; {', '.join(AGAIN)} "
            f"and export are.{command}"
        )
    for field in ("from_review", "amended", "hand_held"):
        if record.request.get(field):
            raise InputError(
                f"this result of {record.stage} was made with {field.replace('_', '-')}, from a "
                f"state of the session that is no more there; it cannot be made again.{command}"
            )
    changed = provenance.changed_inputs(folder, record, run)
    if changed:
        listed = "".join(f"\n  {line}" for line in shortened(changed, 8, "and {} more"))
        raise InputError(
            f"{len(changed)} inputs of this result are not what they were (sha256):{listed}\n"
            f"Restore them, or run {record.stage} again.{command}"
        )


def given_again(request: Mapping[str, Any], places: Mapping[str, str]) -> dict[str, Any]:
    """Return the values of a request as they were given: paths in place, lists as tuples."""

    def value_of(value: Any, name: str) -> Any:
        if name in places:
            return Path(places[name])
        if isinstance(value, list):
            parts: list[Any] = value
            return tuple(value_of(part, f"{name}.{k}") for k, part in enumerate(parts))
        return value

    return {name: value_of(value, name) for name, value in request.items()}


# --- once more --------------------------------------------------------------------------------


def _in_session(
    folder: Path,
    stage: str,
    request: Mapping[str, Any],
    place: Path,
    console: Console,
    workers: int,
) -> Path:
    """Run a stage again in a copy of the session without its result; return the copy."""
    copy = place / folder.resolve().name
    _copy(folder, copy)
    again, results = AGAIN[stage]
    for pattern in results:
        for path in sorted(copy.glob(pattern)):
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()
    again(SessionStore.open(copy), request, console, workers)
    return copy


def _export(folder: Path, request: dict[str, Any], place: Path, console: Console) -> Path:
    """Export again, from copies of the sessions; return the new folder."""
    from realsim.app.export.run import run_export
    from realsim.app.export.target import ExportRequest

    copies: list[Path] = []
    for k, source in enumerate(request["sources"]):
        copy = place / "sources" / str(k) / source.resolve().name
        _copy(source, copy)
        copies.append(copy)
    out = place / "out" / _title(folder)
    request["sources"] = tuple(copies)
    run_export(ExportRequest(**request), out, console)
    return out


def _title(folder: Path) -> str:
    """Return what an export's folder was called when it was made: its card says it."""
    with suppress(InputError):
        name = read_object(folder / CROISSANT_FILE).get("name")
        if isinstance(name, str) and name == Path(name).name:
            return name
    return folder.resolve().name


def _copy(folder: Path, copy: Path) -> None:
    """Copy a folder without what is kept to be quicker.

    Raises:
        InputError: there is no room for it.
    """
    needed = sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())
    copy.parent.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(copy.parent).free
    if ROOM * needed > free:
        raise InputError(
            f"a copy of '{folder}' needs {ROOM * needed / 1e6:.0f} MB and {copy.parent} has "
            f"{free / 1e6:.0f}; set TMPDIR to a folder on another disk."
        )
    shutil.copytree(folder, copy, ignore=shutil.ignore_patterns("cache"))


def _register(
    store: SessionStore, request: Mapping[str, Any], console: Console, workers: int
) -> None:
    from realsim.app.register.config import RegisterRequest
    from realsim.app.register.run import run_register

    asked = {name: value for name, value in request.items() if name != "amended"}
    run_register(store, console, RegisterRequest(**asked))


def _school(
    store: SessionStore, request: Mapping[str, Any], console: Console, workers: int
) -> None:
    from realsim.app.school.inputs import SchoolRequest
    from realsim.app.school.run import run_in_session

    run_in_session(store, SchoolRequest(**request, where=workers), console)


def _annotate(
    store: SessionStore, request: Mapping[str, Any], console: Console, workers: int
) -> None:
    from realsim.app.annotate.current import annotate_session

    annotate_session(store, console, workers=workers, **request)


Again = Callable[[SessionStore, Mapping[str, Any], Console, int], None]
AGAIN: dict[str, tuple[Again, tuple[str, ...]]] = {
    "register": (_register, (
        "stages/register.*", "registration/scene*.json", "registration/views.json",
        "registration/single_view.json", "registration/report.json", "registration/pictures",
        "registration/register.html",
    )),
    "school": (_school, (
        "stages/school.*", "grasps/*.*", "grasps/trajectories", "reports/school*",
    )),
    "annotate": (_annotate, (
        "stages/annotate.*", "annotations", "mask", "mask_visib", "labels", "grasps/views",
        "scene_gt*.json",
    )),
}  # fmt: skip
"""Stage -> how it is run again, and the files of its result."""
