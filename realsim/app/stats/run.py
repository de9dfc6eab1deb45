"""`realsim stats`: read sessions one by one, count, show, write table, CSV, JSON and page.

A row for our data set in the paper's two tables of comparison with other data sets.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from realsim.app.console import Console
from realsim.app.export.sources import session_folders
from realsim.app.stats import statistics
from realsim.app.stats.statistics import Cell, SessionFacts, Statistics, session_facts
from realsim.errors import InputError, RealsimError
from realsim.json_values import json_value
from realsim.many import Outcome, Sent, Task, Workers, at_most, open_pool, run_many
from realsim.pages import Page
from realsim.store import atomic

YES, PARTLY, NO = "yes", "partly", "no"
LANDSCAPE_HEADER = (
    "data set", "year", "scenes", "frames", "depth", "masks", "6-DoF poses + CAD",
    "object properties", "physics-tried grasps", "slip scores", "real and simulated",
    "robot motions",
)  # fmt: skip
LANDSCAPE = (
    ("NYU-Depth V2", "2012", "464", "1,499", YES, YES, NO, NO, NO, NO, NO, NO),
    ("LineMod", "2013", "15", "15k", YES, YES, YES, PARTLY, NO, NO, NO, NO),
    ("YCB-Video", "2018", "92", "134k", YES, YES, YES, PARTLY, NO, NO, NO, NO),
    ("GraspNet-1B", "2020", "190", "97k", YES, YES, YES, PARTLY, PARTLY, NO, NO, NO),
    ("ACRONYM", "2020", "-", "-", NO, NO, YES, PARTLY, YES, PARTLY, NO, NO),
    ("GraspIT", "2026", "1,135", "316k", YES, YES, YES, YES, YES, YES, YES, PARTLY),
)
"""GraspIT, table "Dataset Landscape"; its column of photorealistic assets, which no count can tell,
and the data sets of demonstrations are left out."""
GRASPS_HEADER = (
    "data set", "objects", "grasps", "by physics", "reach", "score levels (possible)",
    "images", "real and simulated",
)  # fmt: skip
GRASPS = (
    ("Cornell", "240", "5.1k", NO, NO, "1", YES, NO),
    ("Jacquard", "11k", "1.1M", NO, NO, "1", YES, NO),
    ("GraspNet-1B", "88", "1.1B", NO, NO, "10", YES, NO),
    ("ACRONYM", "8.8k", "17.7M", PARTLY, NO, "2", NO, NO),
    ("GraspIT", "7.4k", "2.3M", YES, YES, "5", YES, YES),
)
"""GraspIT, table "Grasping Dataset Comparison"."""
AS_PRINTED = "The other data sets' rows are as the paper has them; its two tables differ in places."
LANDSCAPE_TEXT = f"yes: all sessions have it; partly: some have it. {AS_PRINTED}"
GRASPS_TEXT = f"Score levels: how many base scores there can be, not how many occur. {AS_PRINTED}"
BASE_SCORES = 5
"""0, 1/4, 1/2, 3/4 and 1: one for each stage of physics that a grasp stands."""


def landscape_row(stats: Statistics) -> tuple[str, ...]:
    """Return our row of the landscape: what all sessions have, some have, or none has."""
    sessions = stats.sessions
    return (
        "these sessions", "", f"{len(sessions):,}", f"{sum(s.frames for s in sessions):,}",
        _all(stats, "depth"), _all(stats, "mask_visib"),
        _of([bool(s.objects) and "models" in s.has for s in sessions]),
        _all(stats, "objects"), _all(stats, "grasps"), _all(stats, "grasps"), _both(stats),
        _all(stats, "trajectories"),
    )  # fmt: skip


def grasps_row(stats: Statistics) -> tuple[str, ...]:
    """Return our row of the comparison of grasps."""
    school = stats.school
    levels = BASE_SCORES if school.judged else 0
    return (
        "these sessions", f"{school.objects:,}", f"{school.candidates:,}", _all(stats, "grasps"),
        _all(stats, "trajectories"), str(levels), _of([s.frames > 0 for s in stats.sessions]),
        _both(stats),
    )  # fmt: skip


def _all(stats: Statistics, what: str) -> str:
    return _of([what in s.has for s in stats.sessions])


def _of(there: list[bool]) -> str:
    return YES if all(there) else PARTLY if any(there) else NO


def _both(stats: Statistics) -> str:
    """Return whether there are real and simulated scenes, or physics on real ones."""
    kinds = {s.kind for s in stats.sessions}
    tried = any(s.kind == "real" and "grasps" in s.has for s in stats.sessions)
    return YES if len(kinds) > 1 else PARTLY if tried else NO


HEADER = ("property", "here", "in the paper")
PAPER_TEXT = (
    "Rows that begin with 'nominal', and the tables of sessions and objects below, use the nominal "
    "score. The other rows on grasps use the paper's limits, score_paper."
)
TABLES = ("statistics.csv", "sessions.csv", "objects.csv")
PAGE, DOCUMENT = "statistics.html", "statistics.json"


def run_stats(
    sources: Sequence[Path],
    out: Path | None,
    json_file: Path | None,
    console: Console,
    where: Workers = 1,
) -> Statistics:
    """Show the statistics of sessions, and write them where that was asked for.

    A session that cannot be read is named and left out: of a hundred, one is always damaged.

    Args:
        sources: sessions, or folders of sessions.
        out: folder for statistics.csv, sessions.csv, objects.csv, statistics.json and .html.
        json_file: file for the JSON document alone.
        console: where tables go.
        where: who reads the sessions.

    Raises:
        InputError: no session there, one given twice, or none that can be read.
    """
    folders = _folders(sources)
    if out is not None and out.exists() and not out.is_dir():
        raise InputError(f"--out '{out}' is a file; give a folder.")
    facts: list[SessionFacts] = []
    left_out: list[str] = []
    with console.stage("read", f"{len(folders)} sessions") as tick:
        by = {str(folder): folder for folder in folders}

        def keep(outcome: Outcome) -> None:
            folder = by[outcome.task.name]
            if outcome.error is None:
                facts.append(replace(outcome.value, name=folder.resolve().name, folder=folder))
            elif len(folders) == 1 or not isinstance(outcome.error, RealsimError):
                raise outcome.error
            else:
                left_out.append(f"{folder} is left out: {outcome.error}")
            tick(len(facts) + len(left_out), len(folders))

        tasks = [Task(name=n, fn=session_facts, args=(Sent(f),)) for n, f in by.items()]
        with open_pool(at_most(where, len(tasks))) as pool:
            run_many(tasks, pool, keep, in_order=True)
    stats = statistics.statistics_of(facts)
    notes = [*left_out, *statistics.same_content(stats)]
    rows = statistics.all_rows(stats)
    console.table(f"Statistics of {_sessions(stats)}", HEADER, rows)
    console.warn(*notes)
    document = document_of(stats, left_out)
    console.result(document, json_file)
    if out is not None:
        _write_all(out, stats, document, notes, console)
    return stats


def _sessions(stats: Statistics) -> str:
    n = len(stats.sessions)
    return "one session" if n == 1 else f"{n} sessions"


def _folders(sources: Sequence[Path]) -> list[Path]:
    """Return the folders of all sessions, each once."""
    found: dict[Path, Path] = {}
    for source in sources:
        folders = session_folders(source) if source.is_dir() else []
        if not folders:
            raise InputError(
                f"'{source}' holds no session; a session (session.json) or a folder of sessions, "
                "up to two levels deep, is expected. Data sets of others: `realsim import` first."
            )
        for folder in folders:
            if folder.resolve() in found:
                raise InputError(f"'{folder}' is given twice; it would count twice.")
            found[folder.resolve()] = folder
    return list(found.values())


def document_of(stats: Statistics, left_out: Sequence[str] = ()) -> dict[str, Any]:
    """Return everything as plain JSON values; null = not known.

    Args:
        stats: of all sessions that could be read.
        left_out: what is said of the others.
    """
    return {
        "notes": [*left_out, *statistics.same_content(stats)],
        "statistics": {name: here for name, here, _ in statistics.all_rows(stats)},
        "school": stats.school.to_json(),
        "sessions": _records(statistics.SESSION_HEADER, statistics.session_table(stats)),
        "objects": _records(statistics.OBJECT_HEADER, statistics.object_table(stats)),
        "landscape": dict(zip(LANDSCAPE_HEADER, landscape_row(stats), strict=True)),
        "grasps": dict(zip(GRASPS_HEADER, grasps_row(stats), strict=True)),
    }


def _records(header: Sequence[str], rows: Iterable[Sequence[Cell]]) -> list[dict[str, Any]]:
    """Return table rows as JSON objects, with null for what is not known."""
    return [json_value(dict(zip(header, row, strict=True))) for row in rows]


def _write_all(
    out: Path, stats: Statistics, document: dict[str, Any], notes: list[str], console: Console
) -> None:
    out.mkdir(parents=True, exist_ok=True)
    tables: tuple[tuple[Sequence[str], Iterable[Sequence[Cell]]], ...] = (
        (HEADER, statistics.all_rows(stats)),
        (statistics.SESSION_HEADER, statistics.session_table(stats)),
        (statistics.OBJECT_HEADER, statistics.object_table(stats)),
    )
    atomic.write_json(out / DOCUMENT, document)  # first: by it the folder is known as ours
    for name, (header, rows) in zip(TABLES, tables, strict=True):
        atomic.write_bytes(out / name, atomic.csv_bytes(header, rows))
    _write_page(out / PAGE, stats, notes)
    for name in (*TABLES, DOCUMENT, PAGE):
        console.say(f"written   {out / name}")


def _write_page(path: Path, stats: Statistics, notes: list[str]) -> None:
    from realsim.app.stats.plots import figures

    frames = sum(s.frames for s in stats.sessions)
    page = Page(
        title="Statistics",
        about=f"{_sessions(stats)}, {frames:,} frames, {stats.school.candidates:,} grasps",
    )
    for note in notes:
        page.text(note, "note")
    for title, width_px, pictures in figures(stats):
        page.section(title)
        page.pictures(pictures, width_px=width_px, kind="plots")
    page.section("Statistics, row by row as in the paper", PAPER_TEXT)
    page.table(HEADER, statistics.all_rows(stats))
    page.section("Beside other data sets", LANDSCAPE_TEXT)
    page.table(LANDSCAPE_HEADER, [*LANDSCAPE, landscape_row(stats)])
    page.section("Grasps beside those of other data sets", GRASPS_TEXT)
    page.table(GRASPS_HEADER, [*GRASPS, grasps_row(stats)])
    page.section("Sessions")
    page.table(_words(statistics.SESSION_HEADER), _shown(statistics.session_table(stats)))
    page.section("Objects")
    page.table(_words(statistics.OBJECT_HEADER), _shown(statistics.object_table(stats)))
    atomic.write_bytes(path, page.encode())


def _words(header: Sequence[str]) -> list[str]:
    """Return names of columns that break into lines."""
    return [name.replace("_", " ") for name in header]


def _shown(rows: Iterable[Sequence[Cell]]) -> list[list[str]]:
    def cell(value: Cell) -> str:
        if isinstance(value, float):
            return statistics.NOTHING if math.isnan(value) else f"{value:.3f}"
        return str(value)

    return [[cell(c) for c in row] for row in rows]
