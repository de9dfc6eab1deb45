"""What is compared: sessions, or reports that `realsim report` stored as report.json."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from realsim.app.report.figures import Figure, figures_from_json
from realsim.app.report.page import Page
from realsim.app.report.section import READING
from realsim.app.report.session import DOCUMENT, hidden_of, report_of
from realsim.app.report.summary import SCHEMA, SCHEMA_VERSION, VERDICTS
from realsim.app.stages import open_session, session_models
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import ObjectModel
from realsim.store.json_files import read_json_file

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
        InputError: too many, neither session nor report, or a report of a newer version.
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
        return _stored(path, label)
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


def _stored(path: Path, label: str) -> Source:
    """Read a stored report.

    Raises:
        InputError: it is none, or one of a newer version, or damaged.
    """
    told: Any = read_json_file(path)
    if not isinstance(told, dict) or told.get("schema") != SCHEMA:
        raise InputError(
            f"'{path}' is no stored report; a session's folder, or its {DOCUMENT}, is expected."
        )
    version = told.get("schema_version")
    if not isinstance(version, int) or not 1 <= version <= SCHEMA_VERSION:
        raise InputError(
            f"'{path}' has the version {version!r}; this realsim reads 1 to {SCHEMA_VERSION}."
        )
    try:
        objects = [_checked(o) for o in told["objects"]]
        verdict, series = str(told["verdict"]), dict(told["series"])
    except READING as error:
        raise InputError(f"'{path}' is damaged ({error!r}); write the report again.") from error
    if verdict not in VERDICTS:
        raise InputError(f"'{path}' has the verdict '{verdict}'; write the report again.")
    return Source(
        label=label, verdict=verdict, figures=figures_from_json(told.get("figures")),
        objects=objects, series=series, models={},
    )  # fmt: skip


def _checked(row: Any) -> dict[str, Any]:
    """Return an object's row with a rigid pose."""
    T = se3.check_rigid(np.asarray(row["T_world_obj"], dtype=np.float64), "T_world_obj")
    named = {k: row[k] for k in ("name", "verdict", "sigma_mm", "sigma_deg", "probability")}
    ids = {"instance": int(row["instance"]), "obj_id": int(row["obj_id"])}
    return {**named, **ids, "T_world_obj": T.tolist()}
