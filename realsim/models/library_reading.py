"""A model library as its readers see it: what is listed, one model, its convex parts.

A models folder of any BOP dataset reads as a library, too: its models have no properties, and
their notes say so.

What of a model library is missing, damaged, changed, or left over; nothing is changed.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

from realsim.errors import InputError
from realsim.formats.bop.models import INFO_FILE, load_models, model_file
from realsim.models import library_files as files
from realsim.models.convex import parts_from_collision_obj
from realsim.models.library_files import (
    ADDING,
    finish_interrupted,
    read_info,
    read_properties,
    sha256,
)
from realsim.models.model_records import (
    ConvexParts,
    KnownSolid,
    LibraryModel,
    ModelProperties,
    UnscaledModel,
)
from realsim.store import atomic


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LibraryEntry:
    """A model as models_info.json and its properties list it; its mesh is not read."""

    obj_id: int | None
    """None: without metric scale, in unscaled/."""
    name: str
    info: Mapping[str, Any]
    """Its entry in models_info.json; empty where it is unscaled."""
    properties: ModelProperties | None
    problem: str = ""
    """Why there are no properties."""


def unscaled_sources(entries: Sequence[LibraryEntry]) -> set[str]:
    """Return the names of the models whose mesh without scale is kept in unscaled/.

    A model that has its scale from its file has no such source, whatever its name.
    """
    waiting = {e.name for e in entries if e.obj_id is None}
    scaled = {
        e.name
        for e in entries
        if e.obj_id is not None and e.properties is not None and e.properties.scale is not None
    }
    return waiting & scaled


class LibraryReader:
    """A folder of models that is only read; made by `open`."""

    def __init__(self, folder: Path) -> None:
        """Take over a folder that is a library; see `open`."""
        self.folder = folder

    @classmethod
    def open(cls, folder: Path | str) -> Self:
        """Open a library, or a BOP models folder of another program; finish what a kill left.

        Raises:
            InputError: the folder is no library.
        """
        folder = Path(folder)
        if not (folder / INFO_FILE).is_file():
            inner = [n for n in ("models", "models_eval") if (folder / n / INFO_FILE).is_file()]
            hint = f" Did you mean {', '.join(str(folder / n) for n in inner)}?" if inner else ""
            raise InputError(
                f"'{folder}' holds no {INFO_FILE}, so it is not a model library.{hint} "
                f"`realsim scan import MESH --library {folder}` makes one."
            )
        finish_interrupted(folder)
        return cls(folder)

    # --- what is there ------------------------------------------------------------------------

    def entries(self) -> list[LibraryEntry]:
        """Return every model, by id, then those without metric scale, by name.

        Raises:
            InputError: models_info.json is damaged.
        """
        found: list[LibraryEntry] = []
        for obj_id, info in sorted(read_info(self.folder).items()):
            properties, problem = self._properties(files.properties_file(obj_id))
            name = str(info.get("name", Path(model_file(obj_id)).stem))
            found.append(
                LibraryEntry(
                    obj_id=obj_id, name=name, info=info, properties=properties, problem=problem
                )
            )
        for report in sorted((self.folder / files.UNSCALED).glob(f"*/{files.UNSCALED_REPORT}")):
            properties, problem = self._properties(str(report.relative_to(self.folder)))
            found.append(
                LibraryEntry(
                    obj_id=None, name=report.parent.name, info={}, properties=properties,
                    problem=problem,
                )
            )  # fmt: skip
        return found

    def _properties(self, name: str) -> tuple[ModelProperties | None, str]:
        """Return the properties in a file, or None and why."""
        if not (self.folder / name).is_file():
            return None, f"{name} is missing: the models were not imported by realsim"
        try:
            return read_properties(self.folder / name), ""
        except InputError as error:
            return None, str(error)

    def find(self, wanted: str | int) -> int:
        """Return the id of a model by its id, its name, or its file.

        Raises:
            InputError: there is none; the message names those that are there.
        """
        text = str(wanted)
        entries = [e for e in self.entries() if e.obj_id is not None]
        stem = Path(text).stem
        for e in entries:
            is_named = text == e.name or text == str(e.obj_id)
            if e.obj_id is not None and (is_named or stem == Path(model_file(e.obj_id)).stem):
                return e.obj_id
        there = ", ".join(f"{e.name} ({e.obj_id})" for e in entries) or "none"
        waiting = ""
        if (self.folder / files.UNSCALED / text).is_dir():
            waiting = (
                f" It is there without metric scale: `realsim scan scale {text} SESSION --library "
                f"{self.folder}` finds it."
            )
        raise InputError(
            f"there is no model '{text}' in the library {self.folder}; there are: {there}.{waiting}"
        )

    def next_id(self) -> int:
        """Return the id after the greatest in use; those of orphaned files count as in use."""
        used = {*read_info(self.folder), 0}
        used |= {int(p.stem[4:]) for p in self.folder.glob("obj_*") if p.stem[4:].isdecimal()}
        return max(used) + 1

    def load(self, wanted: str | int) -> LibraryModel:
        """Return a model by its id, its name, or its file.

        What can be missing or damaged without harm (properties, parts) is named in the notes.

        Raises:
            InputError: there is none, or its mesh cannot be read.
        """
        obj_id = self.find(wanted)
        properties, parts, notes = self._known(obj_id)
        model = load_models(self.folder, [obj_id])[obj_id]
        return LibraryModel(model=model, parts=parts, properties=properties, notes=tuple(notes))

    def solid(self, obj_id: int) -> tuple[KnownSolid | None, str]:
        """Return matter and convex parts of a model without reading its mesh, or None and why.

        They count only while the mesh file is the one that they were computed of.
        """
        properties, parts, notes = self._known(obj_id)
        if properties is None or properties.matter is None or parts is None:
            return None, "; ".join(notes) or "it was imported without convex parts"
        return KnownSolid(parts=parts, matter=properties.matter), ""

    def _known(self, obj_id: int) -> tuple[ModelProperties | None, ConvexParts | None, list[str]]:
        """Return properties and parts, as far as they are there and of this mesh, and what not."""
        properties, problem = self._properties(files.properties_file(obj_id))
        if properties is None:
            return None, None, [problem]
        path = self.folder / model_file(obj_id)
        data = path.read_bytes() if path.is_file() else b""
        if properties.files.get(path.name) != sha256(data):
            problem = f"{path.name} has been changed since its properties were computed; import "
            return None, None, [problem + "it again with --overwrite"]
        if properties.convex is None:
            return properties, None, []
        parts, problem = self._parts(obj_id, properties)
        return properties, parts, [problem] if problem else []

    def _parts(self, obj_id: int, properties: ModelProperties) -> tuple[ConvexParts | None, str]:
        """Return the convex parts on disk, or None and why."""
        name, note = files.collision_file(obj_id), properties.convex
        path = self.folder / name
        data = path.read_bytes() if path.is_file() else b""
        if note is None or properties.files.get(name) != sha256(data):
            state = "has been changed since it was written" if data else "is missing"
            return None, f"{name} {state}; import the model again with --overwrite"
        parts = ConvexParts(
            parts=tuple(parts_from_collision_obj(data)),
            volume_ratio=note.volume_ratio,
            method=note.method,
            notes=note.notes,
        )
        return parts, ""

    def load_unscaled(self, name: str) -> UnscaledModel:
        """Return a model without metric scale.

        Raises:
            InputError: there is none of this name; the message names those that are there.
        """
        from realsim.models.reading import read_scan

        folder = self.folder / files.UNSCALED / name
        if not name or not (folder / files.UNSCALED_REPORT).is_file():
            there = [e.name for e in self.entries() if e.obj_id is None]
            raise InputError(
                f"there is no model '{name}' without metric scale in the library {self.folder}; "
                f"there are: {', '.join(there) or 'none'}. `realsim scan import MESH --unit none` "
                "adds one."
            )
        mesh = read_scan(folder / files.UNSCALED_MESH, "none", up="z").mesh
        properties = read_properties(folder / files.UNSCALED_REPORT)
        return UnscaledModel(name=name, mesh=mesh, properties=properties)


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
