"""What is compared: sessions, or reports that `realsim report` stored as report.json."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, get_args

import numpy as np

from realsim.app.report.figures import Figure, figures_from_json
from realsim.app.report.section import READING, SEVERITIES
from realsim.app.report.session import DOCUMENT, hidden_of, report_of
from realsim.app.report.summary import SCHEMA, SCHEMA_VERSION, STATE_KIND, VERDICTS
from realsim.app.stages import open_session, session_models
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.pages import Page
from realsim.records import ObjectModel, Verdict
from realsim.untrusted.json_text import read_json
from realsim.untrusted.values import mapping, number, numbers, whole

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
    _text(_of(told, "session", "the report"), "'session'")
    for name, state in mapping(_of(told, "stages", "the report"), "'stages'").items():
        _one_of(state, tuple(STATE_KIND), f"'stages.{name:.60}'")
    for name, command in mapping(_of(told, "missing", "the report"), "'missing'").items():
        _text(command, f"'missing.{name:.60}'")
    for k, row in enumerate(_list(_of(told, "findings", "the report"), "'findings'")):
        _require_finding(row, f"'findings[{k}]'")
    figures = figures_from_json(_of(told, "figures", "the report"))
    for name in ALWAYS:
        _of(figures, name, "'figures'")
    return Source(
        label=label,
        verdict=_one_of(_of(told, "verdict", "the report"), tuple(VERDICTS), "'verdict'"),
        figures=figures,
        objects=_objects(_of(told, "objects", "the report")),
        series=_series(_of(told, "series", "the report")),
        models={},
    )


def _require_finding(row: Any, name: str) -> None:
    finding = mapping(row, name)
    _one_of(_of(finding, "severity", name), SEVERITIES, f"{name}.severity")
    for key in ("section", "text"):
        _text(_of(finding, key, name), f"{name}.{key}")


def _objects(value: Any) -> list[dict[str, Any]]:
    rows = [_object(row, f"'objects[{k}]'") for k, row in enumerate(_list(value, "'objects'"))]
    times = Counter(row["instance"] for row in rows)
    for instance, n in times.items():
        if n > 1:
            raise InputError(f"'objects' has the instance {instance} {n} times.")
    return rows


def _object(value: Any, where: str) -> dict[str, Any]:
    """Return an object's row with a rigid pose."""
    row = mapping(value, where)
    told = {key: _of(row, key, where) for key in (
        "instance", "obj_id", "name", "verdict", "probability", "sigma_mm", "sigma_deg",
        "T_world_obj",
    )}  # fmt: skip
    name = f"{where}.T_world_obj"
    rows = _list(told["T_world_obj"], name)
    if len(rows) != 4:
        raise InputError(f"{name} has {len(rows)} rows; 4 rows of 4 numbers are expected.")
    T = se3.check_rigid(np.stack([numbers(r, 4, f"a row of {name}") for r in rows]), name)
    return {
        "instance": whole(told["instance"], f"{where}.instance", 0, 2**31),
        "obj_id": whole(told["obj_id"], f"{where}.obj_id", 0, 2**31),
        "name": _text(told["name"], f"{where}.name"),
        "verdict": _one_of(told["verdict"], get_args(Verdict), f"{where}.verdict"),
        "probability": _known(told["probability"], f"{where}.probability", 0.0, 1.0),
        "sigma_mm": _known(told["sigma_mm"], f"{where}.sigma_mm", 0.0),
        "sigma_deg": _known(told["sigma_deg"], f"{where}.sigma_deg", 0.0),
        "T_world_obj": T.tolist(),
    }


def _series(value: Any) -> dict[str, Any]:
    series = mapping(value, "'series'")
    found: dict[str, Any] = {}
    for name in SERIES_BY_VIEW:
        if name in series:
            where = f"'series.{name}'"
            row = mapping(series[name], where)
            listed = _list(_of(row, "view", where), f"{where}.view")
            views = [whole(v, f"{where}.view", 0, 2**31) for v in listed]
            values = numbers(_of(row, "value", where), len(views), f"{where}.value")
            found[name] = {"view": views, "value": values.tolist()}
    for name in SERIES_OF_SHARES:
        if name in series:
            found[name] = numbers(series[name], None, f"'series.{name}'").tolist()
    return found


# --- single values ----------------------------------------------------------------------------


def _of(row: Mapping[str, Any], key: str, where: str) -> Any:
    if key not in row:
        raise InputError(f"{where} has no '{key}'.")
    return row[key]


def _known(value: Any, name: str, low: float, high: float = float("inf")) -> float | None:
    """Return a number, or None for null: not known."""
    return None if value is None else number(value, name, low, high)


def _list(value: Any, name: str) -> list[Any]:
    if not isinstance(value, list):
        _refuse(value, name, "a list")
    return value  # pyright: ignore[reportUnknownVariableType]


def _text(value: Any, name: str) -> str:
    """Return a text; an empty one, and any character, may stand in a report."""
    if not isinstance(value, str):
        _refuse(value, name, "a text")
    return value


def _one_of(value: Any, known: tuple[str, ...], name: str) -> str:
    if value not in known:
        _refuse(value, name, " or ".join(known))
    return value


def _refuse(value: Any, name: str, expected: str) -> NoReturn:
    is_single = value is None or isinstance(value, str | int | float)
    shown = repr(value)[:60] if is_single else f"a {type(value).__name__}"
    raise InputError(f"{name} is {shown}; {expected} is expected.")
