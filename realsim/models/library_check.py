"""What of a model library is missing, damaged, changed, or left over; nothing is changed."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from realsim.errors import InputError
from realsim.formats.bop.models import load_models, model_file
from realsim.models import library_files as files
from realsim.models.library_commit import ADDING
from realsim.models.library_files import sha256
from realsim.models.library_reading import LibraryEntry, LibraryReader
from realsim.models.library_records import ModelProperties
from realsim.store import atomic

Kind = Literal["missing", "damaged", "changed", "orphan", "leftover", "foreign"]
PLACES = ((".", (".ply", ".png")), ("collision", (".obj",)), ("properties", (".json",)))
"""Folders of files that are named after an id, and their endings."""
HARMLESS: tuple[Kind, ...] = ("foreign", "leftover")
"""Findings with which a library is still sound."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LibraryFinding:
    """One thing that is not as it should be."""

    path: str
    """In the library."""
    kind: Kind
    """'orphan': no model of the library has this file; 'foreign': of another program."""
    text: str

    @property
    def is_harmless(self) -> bool:
        """Whether every model can be used all the same."""
        return self.kind in HARMLESS


def check_library(library: LibraryReader) -> list[LibraryFinding]:
    """Return everything that is not as it should be, by path.

    Raises:
        InputError: models_info.json is damaged.
    """
    entries = library.entries()
    found = [f for e in entries for f in _of_entry(library, e)]
    found += _orphans(library.folder, entries)
    found += [
        LibraryFinding(path=str(p.relative_to(library.folder)), kind="leftover",
                text="of a run that was killed; can be deleted")
        for p, _ in atomic.leftovers(library.folder) if ADDING not in p.parts
    ]  # fmt: skip
    if (library.folder / ADDING).is_dir():
        text = "of a run that was killed, or is adding a model now; the next one clears it"
        found.append(LibraryFinding(path=ADDING, kind="leftover", text=text))
    return sorted(found, key=lambda f: f.path)


def _of_entry(library: LibraryReader, entry: LibraryEntry) -> Iterator[LibraryFinding]:
    """Yield what is wrong with one model."""
    if entry.obj_id is None:
        place = f"{files.UNSCALED}/{entry.name}"
        report, mesh = f"{place}/{files.UNSCALED_REPORT}", f"{place}/{files.UNSCALED_MESH}"
    else:
        report, mesh = files.properties_file(entry.obj_id), model_file(entry.obj_id)
    if not (library.folder / mesh).is_file():
        yield LibraryFinding(path=mesh, kind="missing", text=f"the mesh of '{entry.name}'")
        return
    if entry.properties is not None:
        yield from _against_checksums(library.folder, entry.properties)
        return
    if (library.folder / report).is_file():
        yield LibraryFinding(path=report, kind="damaged", text=entry.problem)
    else:
        text = "not imported by realsim; `realsim scan complete` computes its properties"
        yield LibraryFinding(path=report, kind="foreign", text=text)
    if entry.obj_id is not None:
        try:
            load_models(library.folder, [entry.obj_id])
        except InputError as error:
            yield LibraryFinding(path=mesh, kind="damaged", text=str(error))


def _against_checksums(folder: Path, properties: ModelProperties) -> Iterator[LibraryFinding]:
    """Yield the files that are not those that the properties are of."""
    for name, expected in properties.files.items():
        path = folder / name
        if not path.is_file():
            yield LibraryFinding(path=name, kind="missing", text=f"of '{properties.name}'")
        elif sha256(path.read_bytes()) != expected:
            text = f"not what the properties of '{properties.name}' were computed of"
            yield LibraryFinding(path=name, kind="changed", text=text)


def _orphans(folder: Path, entries: list[LibraryEntry]) -> Iterator[LibraryFinding]:
    """Yield files in the library's places that no model has."""
    known = {e.obj_id for e in entries if e.obj_id is not None}
    names = {e.name for e in entries}
    for place, ends in PLACES:
        for path in sorted((folder / place).glob("obj_*")):
            number = path.stem[4:]
            if path.suffix in ends and number.isdecimal() and int(number) not in known:
                yield _orphan(folder, path)
    for path in sorted((folder / "pictures").glob("*.png")):
        if path.stem not in names:
            yield _orphan(folder, path)
    unscaled = folder / files.UNSCALED
    for path in sorted(unscaled.iterdir()) if unscaled.is_dir() else ():
        if not (path / files.UNSCALED_REPORT).is_file():
            yield _orphan(folder, path)


def _orphan(folder: Path, path: Path) -> LibraryFinding:
    text = "no model of the library has this file; can be deleted, or its model imported again"
    return LibraryFinding(path=str(path.relative_to(folder)), kind="orphan", text=text)
