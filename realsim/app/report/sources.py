"""What is compared: sessions, or reports that `realsim report` stored as report.json."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from realsim.app.report.figures import Figure
from realsim.app.report.section import READING
from realsim.app.report.session import DOCUMENT, hidden_of, report_of
from realsim.app.report.stored import read_stored
from realsim.app.stages import open_session, session_models
from realsim.errors import InputError
from realsim.pages import Page
from realsim.records import ObjectModel

LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Source:
    """One side of a comparison."""

    label: str
    """A, B, ... and its name."""
    verdict: str
    figures: dict[str, Figure]
    objects: list[dict[str, Any]]
    series: dict[str, Any]
    models: Mapping[int, ObjectModel]
    """obj_id -> model; empty of a stored report."""

    @property
    def letter(self) -> str:
        """Return the letter alone."""
        return self.label.partition(" ")[0]


def sources_of(paths: Sequence[Path]) -> list[Source]:
    """Return what is to be compared.

    Raises:
        InputError: too many, neither session nor report, or a report that is damaged or of a
            newer version.
    """
    if len(paths) > len(LETTERS):
        raise InputError(f"{len(paths)} sessions: at most {len(LETTERS)} are compared at once.")
    names = _names(paths)
    return [
        _source(path, f"{letter} {name}")
        for path, letter, name in zip(paths, LETTERS, names, strict=False)
    ]


def _names(paths: Sequence[Path]) -> list[str]:
    """Return the shortest ends of the paths that tell them apart: never a whole path."""
    whole = [p.resolve() for p in paths]
    whole = [p.parent.parent if p.name == Path(DOCUMENT).name else p for p in whole]
    for n in (1, 2, 3):
        names = ["/".join(p.parts[1:][-n:]) for p in whole]
        if len(set(names)) == len(set(whole)):
            break
    return names


def _source(path: Path, label: str) -> Source:
    if path.is_file():
        stored = read_stored(path)
        return Source(
            label=label, verdict=stored.verdict, figures=stored.figures, objects=stored.objects,
            series=stored.series, models={},
        )  # fmt: skip
    if path.suffix.lower() == ".json" and not path.exists():
        raise InputError(f"the stored report '{path}' is not there.")
    store = open_session(path)
    report = report_of(store)
    document = report.document(Page(hidden=hidden_of(store)))
    try:
        models: Mapping[int, ObjectModel] = session_models(store)
    except READING:
        models = {}  # the report's sections say what is wrong with them
    return Source(
        label=label, verdict=report.verdict, figures=report.figures, objects=report.objects,
        series=document["series"], models=models,
    )  # fmt: skip
