"""What is compared: sessions, or reports that `realsim report` stored as report.json."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from realsim.app.report.figures import Figure, figures_from_json
from realsim.app.report.section import READING, Severity, State
from realsim.app.report.session import DOCUMENT, hidden_of, report_of
from realsim.app.report.summary import SCHEMA, SCHEMA_VERSION
from realsim.app.stages import open_session, session_models
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.pages import Page
from realsim.records import ObjectModel, Verdict
from realsim.untrusted.json_text import read_json
from realsim.untrusted.own_json import from_json, to_json
from realsim.untrusted.values import mapping, numbers

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
        return read_stored(path, label)
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


# --- a stored report.json: a file that anybody may have changed ---
#
# Every field is checked, those too that a comparison does not use: a report that is damaged in one
# place is not trusted in another.

MOST_BYTES = 64e6
"""Largest report [bytes]; that of 24 views and 5 objects has 0.05 MB."""
ALWAYS = ("report.bad", "report.warnings")
"""Figures of every report, whatever has been run."""
SERIES_BY_VIEW = ("calibration.view_rms_px", "registration.view_sigma_px")
"""Series with a value a view."""
SERIES_OF_SHARES = ("school.scores", "school.p_hold", "labels.visibility")
"""Series of values between 0 and 1."""


Number = Annotated[int, Meta(ge=0, le=2**31)]
Sigma = Annotated[float, Meta(ge=0)] | None
"""None = not known."""
Row = Annotated[list[float], Meta(min_length=4, max_length=4)]


@dataclass(frozen=True, slots=True)
class _Finding:
    severity: Severity
    section: str
    text: str


@dataclass(frozen=True, slots=True)
class _Object:
    instance: Number
    obj_id: Number
    name: str
    verdict: Verdict
    probability: Annotated[float, Meta(ge=0, le=1)] | None
    sigma_mm: Sigma
    sigma_deg: Sigma
    T_world_obj: Annotated[list[Row], Meta(min_length=4, max_length=4)]


@dataclass(frozen=True, slots=True)
class _ByView:
    view: list[Number]
    value: list[float]


@dataclass(frozen=True, slots=True)
class _Stored:
    """What `realsim.app.report.summary.Report.document` writes."""

    session: str
    verdict: Literal["bad", "look", "unfinished", "sound"]
    figures: dict[str, Any]
    missing: dict[str, str]
    stages: dict[str, State]
    findings: list[_Finding]
    objects: list[_Object]
    series: dict[str, Any]


def read_stored(path: Path, label: str) -> Source:
    """Return a stored report; figures and series that this version does not know are left out.

    Args:
        path: the file.
        label: what the report is called.

    Raises:
        InputError: it is missing, no report, of a newer version, or a field is not as
            `realsim report` writes it; names file and field.
    """
    told = read_json(path, most_bytes=MOST_BYTES)
    if not isinstance(told, dict) or told.get("schema") != SCHEMA:
        raise InputError(
            f"'{path}' is no stored report; a session's folder, or its reports/report.json, is "
            "expected."
        )
    version = told.get("schema_version")
    if type(version) is not int or not 1 <= version <= SCHEMA_VERSION:
        raise InputError(
            f"'{path}' has the version {version!r:.60}; this realsim reads 1 to {SCHEMA_VERSION}."
        )
    try:
        return _checked(mapping(told, "the report"), label)
    except InputError as error:
        raise InputError(f"'{path}' is damaged: {error} Write the report again.") from error


def _checked(told: Mapping[str, Any], label: str) -> Source:
    stored = from_json(told, _Stored, "the report")
    figures = figures_from_json(stored.figures)
    for name in ALWAYS:
        if name not in figures:
            raise InputError(f"'figures' has no '{name}'.")
    times = Counter(o.instance for o in stored.objects)
    for instance, n in times.items():
        if n > 1:
            raise InputError(f"'objects' has the instance {instance} {n} times.")
    return Source(
        label=label,
        verdict=stored.verdict,
        figures=figures,
        objects=[_row(o, k) for k, o in enumerate(stored.objects)],
        series=_series(stored.series),
        models={},
    )


def _row(o: _Object, k: int) -> dict[str, Any]:
    """Return an object's row with a rigid pose."""
    T = se3.check_rigid(o.T_world_obj, f"'objects[{k}].T_world_obj'")
    return to_json(o) | {"T_world_obj": T.tolist()}


def _series(series: Mapping[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name in SERIES_BY_VIEW:
        if name in series:
            row = from_json(series[name], _ByView, f"'series.{name}'")
            values = numbers(row.value, len(row.view), f"'series.{name}.value'")
            found[name] = {"view": row.view, "value": values.tolist()}
    for name in SERIES_OF_SHARES:
        if name in series:
            found[name] = numbers(series[name], None, f"'series.{name}'").tolist()
    return found
