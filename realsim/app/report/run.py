"""`realsim report`: one session's report, or several compared; checked against limits.

Limits on figures, for scripts: what must hold, and what of it is broken.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from realsim.app.console import Console
from realsim.app.report import compare_page
from realsim.app.report.figures import Figure, require_known, shown
from realsim.app.report.session import hidden_of, page_of, report_of, write_report
from realsim.app.report.sources import sources_of
from realsim.app.report.summary import VERDICTS
from realsim.errors import InputError
from realsim.pages import Page
from realsim.untrusted.toml_text import read_toml

FAIL_ON = re.compile(r"\s*([\w.]+)\s*([<>])\s*(\S+)\s*")
"""NAME<VALUE or NAME>VALUE."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Limit:
    """What a figure must keep; a limit that is exactly met is kept."""

    name: str
    least: float = -math.inf
    greatest: float = math.inf


def limit_of(text: str) -> Limit:
    """Return the limit of `--fail-on NAME<VALUE` or `NAME>VALUE`: the figure must not be so.

    Raises:
        InputError: not of this form, no such figure, or a value that is no finite number.
    """
    found = FAIL_ON.fullmatch(text)
    if found is None:
        raise InputError(
            f"--fail-on '{text}' cannot be read; NAME<VALUE or NAME>VALUE is expected, such as "
            "'registration.accepted<5' (quoted: < and > mean something to the shell)."
        )
    name, sign, value = found.groups()
    require_known(name)
    number = _number(value, f"--fail-on '{text}'")
    return Limit(name=name, least=number) if sign == "<" else Limit(name=name, greatest=number)


def read_limits(path: Path) -> list[Limit]:
    """Return the limits of a TOML file: figure = {min = ..., max = ...}.

    Names with dots may be quoted, or written as TOML's own tables: both mean the same.

    Raises:
        InputError: no such file, no TOML, an unknown figure, or a limit of another form or not
            finite.
    """
    try:
        _, told = read_toml(path)
    except InputError as error:
        raise InputError(f"--limits: {error}") from error
    limits = list(_limits(told, "", path))
    if not limits:
        raise InputError(
            f"--limits '{path}' names no figure; lines such as calibration.held_out_px = "
            "{max = 0.5} are expected."
        )
    return limits


def _limits(told: Mapping[str, Any], before: str, path: Path) -> Iterator[Limit]:
    for key, value in told.items():
        name = f"{before}{key}"
        if not isinstance(value, dict):
            require_known(name)
            raise InputError(
                f"--limits '{path}': {name} = {value!r} is no limit; {{max = ...}}, {{min = ...}} "
                "or both are expected."
            )
        rows: Mapping[str, Any] = value
        if rows and set(rows) <= {"min", "max"}:
            require_known(name)
            ends = {k: _number(v, f"--limits '{path}': {name}.{k}") for k, v in rows.items()}
            limit = Limit(
                name=name, least=ends.get("min", -math.inf), greatest=ends.get("max", math.inf)
            )
            if limit.least > limit.greatest:
                raise InputError(f"--limits '{path}': {name} has min above max.")
            yield limit
        elif rows:
            yield from _limits(rows, f"{name}.", path)
        else:
            raise InputError(f"--limits '{path}': {name} has neither min nor max.")


def _number(value: Any, what: str) -> float:
    try:
        if isinstance(value, bool):
            raise ValueError
        number = float(value)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what}: '{value!s:.60}' is no number.") from error
    if not math.isfinite(number):
        raise InputError(
            f"{what}: '{value!s:.60}' is no limit; a finite number is expected. Leave out the end "
            "that has none."
        )
    return number


def broken(limits: Sequence[Limit], figures: Mapping[str, Figure]) -> Iterator[str]:
    """Return in words which limits are not kept; one on a figure that is not there is not."""
    for limit in limits:
        figure = figures.get(limit.name)
        if figure is None:
            yield f"{limit.name} is not there: its stage has not been run, or says nothing."
            continue
        value = f"{limit.name} is {shown(figure.value, figure.sigma)} {figure.meaning.unit}".strip()
        if figure.value < limit.least:
            yield f"{value}, at least {limit.least:g} is asked for."
        if figure.value > limit.greatest:
            yield f"{value}, at most {limit.greatest:g} is asked for."


@dataclass(frozen=True, kw_only=True, slots=True)
class ReportRequest:
    """What was asked for."""

    sources: tuple[Path, ...]
    truth: Path | None = None
    out: Path | None = None
    limits: Path | None = None
    fail_on: tuple[str, ...] = ()
    fail_if_worse: bool = False


def run_report(request: ReportRequest, console: Console) -> bool:
    """Write a report, or compare several; return whether nothing failed.

    Raises:
        InputError: something given cannot be used.
    """
    limits = [limit_of(text) for text in request.fail_on]
    limits += read_limits(request.limits) if request.limits is not None else []
    if len(request.sources) == 1:
        if request.fail_if_worse:
            raise InputError("--fail-if-worse compares: give two sessions or more.")
        return _one(request, limits, console)
    if request.truth is not None:
        raise InputError("--truth belongs to one session; leave it out of a comparison.")
    return _several(request, limits, console)


MADE_FROM = (
    "session.json", "calibration/*.json", "registration/*.json", "review/journal.jsonl",
    "grasps/*.json", "annotations/*.json", "models/*",
)  # fmt: skip
"""Files of a session that its report is made of."""


def _one(request: ReportRequest, limits: Sequence[Limit], console: Console) -> bool:
    """Report one session."""
    from realsim.app.stages import note, open_session
    from realsim.app.truth import loop_errors

    if request.sources[0].suffix.lower() == ".json" and not request.sources[0].is_dir():
        raise InputError(_not_alone(request.sources[0]))
    store = open_session(request.sources[0])
    errors = None if request.truth is None else loop_errors(store, request.truth)
    if request.out is None:
        report = report_of(store, errors, "kept")
        path = write_report(store, report)
        asked = {"truth": request.truth}
        note(store, "report", console, request=asked, inputs=MADE_FROM)
    else:
        report = report_of(store, errors, "shown")
        path = _written(request.out, page_of(store, report))
    page = Page(hidden=hidden_of(store))
    failed = [f"bad: {page.plain(f.text)}" for f in report.findings if f.severity == "bad"]
    failed += [f"limit: {text}" for text in broken(limits, report.figures)]
    document = report.document(page) | {"failed": failed}
    console.result(document)
    if not (console.as_json or console.quiet):
        _say_one(console, document)
        console.say(f"report    {path}")
    console.warn(*failed)
    return not failed


def _not_alone(path: Path) -> str:
    """Return what is said of one file where a session is expected."""
    if not path.exists():
        return f"the file '{path}' is not there; give a session's folder, such as demo/session."
    return (
        f"'{path}' is a file; one report is made of a session's folder. A stored report.json can "
        "be compared: give a second one, or a session."
    )


def _say_one(console: Console, document: dict[str, Any]) -> None:
    """Print the verdict, what to look at, and what is missing."""
    console.say(f"{document['session']}: {VERDICTS[document['verdict']][0].lower()}")
    for f in document["findings"]:
        if f["severity"] == "warn":
            console.say(f"look at   {f['text']}")
    for command in document["missing"].values():
        console.say(f"missing   {command}")


def _several(request: ReportRequest, limits: Sequence[Limit], console: Console) -> bool:
    """Compare several sessions."""
    with console.stage("report", f"{len(request.sources)} sessions"):
        comparison = compare_page.comparison_of(sources_of(request.sources))
    failed = [
        f"limit: {s.label}: {text}"
        for s in comparison.sources
        for text in broken(limits, s.figures)
    ]
    if request.fail_if_worse:
        for other, d in comparison.worse:
            unit = f" {d.first.meaning.unit}".rstrip() if d.first is not None else ""
            failed.append(f"worse: {other.label}: {d.name} by {d.shown}{unit}")
    if request.out is not None:
        _written(request.out, compare_page.comparison_page(comparison))
    console.result(compare_page.as_json(comparison) | {"failed": failed})
    if not (console.as_json or console.quiet):
        _say_several(console, comparison)
        if request.out is not None:
            console.say(f"page      {request.out}")
    console.warn(*failed)
    return not failed


def _say_several(console: Console, c: compare_page.Comparison) -> None:
    """Print the tables."""
    for s in c.sources:
        console.say(f"{s.label}: {VERDICTS[s.verdict][0].lower()}")
    rows = list(compare_page.figure_rows(c, all_figures=False))
    if rows:
        console.table("Figures that differ", compare_page.figure_header(c), rows)
    else:
        console.say("every figure is the same.")
    for other, found in zip(c.sources[1:], c.objects, strict=True):
        if found:
            title = f"Objects of {c.sources[0].letter} and {other.letter}"
            console.table(title, compare_page.OBJECT_HEADER, compare_page.object_rows(found))


def _written(path: Path, page: Page) -> Path:
    from realsim.store import atomic

    atomic.write_bytes(path, page.encode(math.inf))
    return path
