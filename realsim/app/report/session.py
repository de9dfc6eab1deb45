"""One self-contained HTML page a session: what was done, how good it is, and the pictures.

Beside it report.json holds the same figures for programs. The same session gives the same bytes.

The section on the review: who decided what, when, and what is still open.

The sections on files and checksums, and on versions and settings.

The section on the Robot School: stages, scores, slips, failures.
"""

import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from realsim import __version__
from realsim.app.console import StageTime
from realsim.app.report import plots as drawing
from realsim.app.report.calibration import calibration_section
from realsim.app.report.capturing import capture_section, plan_section
from realsim.app.report.figures import MEDIAN_SCATTER, Figure, count, mean_error, share
from realsim.app.report.labelling import labels_section
from realsim.app.report.registering import registration_section
from realsim.app.report.section import READING, Pictures, Section, attempted, built, drawn
from realsim.app.report.summary import Report, truth_section, write_summary
from realsim.app.reviewed import review_of
from realsim.app.school.tables import p_hold_line, school_table, why_no_grasp
from realsim.app.truth import LoopErrors
from realsim.formats.grasps.scene_grasps import labelled
from realsim.pages import Cell, Page, Picture, counted
from realsim.records import GraspSet
from realsim.review.journal import JOURNAL_FILE, Entry, ReviewState, read, replay
from realsim.store import SessionStore
from realsim.store.check_report import CheckReport
from realsim.store.session_check import check_session, read_lists

SLIPS_NOTE = (
    "p_hold: probability that a robot lifts the object and holds it; the label to use where there "
    "is one. Score, one nominal attempt: 0.25 for each stage passed, less 1/12 for each stage in "
    "which the object slipped by more than the bound. Shares: of the tried grasps, ± 1 sigma of "
    "the binomial."
)
MEASURED = (
    "school.mean_score", "school.mean_p_hold", "school.p_hold_entropy_bits", "school.slip_mm"
)  # fmt: skip
SHEET, SETTLED = "reports/school.html", "reports/settle.png"


def school_section(section: Section, store: SessionStore) -> None:
    """Fill the section on the Robot School."""
    from realsim.app.stages import session_models
    from realsim.store import load_grasps

    if not any((store.folder / "grasps").glob("*_obj*.npz")):
        section.missing("No grasp has been tried.")
        return
    sets, models = load_grasps(store), session_models(store)
    _figures(section, sets)
    f = section.figures
    if "school.good_share" in f:
        good, tried = f["school.good"].value, sum(int(np.isfinite(s.scores).sum()) for s in sets)
        section.headline = f"{good:.0f} good of {tried} tried grasps"
    else:
        section.headline = "no grasp could be tried"
        section.say("warn", "Robot School: no grasp could be tried.")
    for s in sets:
        if not s.good.any():
            name = models[s.obj_id].name if s.obj_id in models else f"object {s.obj_id}"
            why = "none of them is good" if np.isfinite(s.scores).any() else why_no_grasp(s)
            section.say("note", f"Robot School: {s.instance} {name} has no good grasp: {why}.")
    section.page.text(SLIPS_NOTE)
    section.page.table(*school_table(sets, models))
    if line := p_hold_line(sets):
        section.page.text(line)
    shares = [x for n, x in f.items() if n.endswith("_share") or n in MEASURED]
    rows = [[x.meaning.text, f"{x.shown} {x.meaning.unit}".strip()] for x in shares]
    if rows:
        section.page.table(["figure", "value"], rows)
    drawn(section, "the plots", lambda: _plots(section, sets))
    drawn(section, "the pictures", lambda: _pictures(section, store))


def _kept(sets: list[GraspSet]) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest slip [mm] and turn [deg] of every grasp that never lost its object."""
    mm = np.concatenate([1e3 * s.slip_m for s in sets]) if sets else np.zeros((0, 4))
    deg = np.concatenate([np.degrees(s.slip_rad) for s in sets]) if sets else np.zeros((0, 4))
    whole = np.isfinite(mm).all(1) & np.isfinite(deg).all(1)
    return mm[whole].max(1, initial=0.0), deg[whole].max(1, initial=0.0)


def _figures(section: Section, sets: list[GraspSet]) -> None:
    from realsim_sim_bridge.school.measure_statistics import p_hold_spread

    scores = np.concatenate([s.scores for s in sets])
    base = np.concatenate([s.base_scores for s in sets])
    reach = np.concatenate([s.reachable for s in sets])
    tried = np.isfinite(scores)
    good = int(np.sum(scores[tried] >= 0.5))
    section.add(
        count("school.candidates", len(scores)),
        count("school.good", good),
        count("school.objects_without_grasp", sum(not s.good.any() for s in sets)),
    )
    n = int(tried.sum())
    if n == 0:
        return
    scores, base, reach = scores[tried], base[tried], reach[tried]
    section.add(
        share("school.reachable_share", int(reach.sum()), n),
        share("school.close_share", int(np.sum(base >= 0.25)), n),
        share("school.pendulum_share", int(np.sum(base >= 1.0)), n),
        share("school.good_share", good, n),
        Figure(name="school.mean_score", value=float(scores.mean()), sigma=mean_error(scores)),
    )
    mm, _ = _kept(sets)
    if len(mm):
        sigma = MEDIAN_SCATTER * mean_error(mm)
        section.add(Figure("school.slip_mm", float(np.median(mm)), sigma))
    section.series["school.scores"] = [round(float(v), 4) for v in scores]
    if (p := p_hold_spread(sets)) is not None:
        told = np.concatenate([s.labels[labelled(s)] for s in sets if s.label == "p_hold"])
        section.add(
            Figure(name="school.mean_p_hold", value=p.mean, sigma=mean_error(told)),
            Figure(name="school.p_hold_entropy_bits", value=p.entropy_bits),
        )
        section.series["school.p_hold"] = [round(float(v), 4) for v in told]


def _plots(section: Section, sets: list[GraspSet]) -> None:
    base = np.concatenate([s.base_scores for s in sets])
    reach = np.concatenate([s.reachable for s in sets])
    tried = np.isfinite(base)
    if not tried.any():
        return
    failed = Counter(f.partition(":")[0] for s in sets for f in s.failures if f)
    picture = drawing.stages(int(tried.sum()), int(reach[tried].sum()), base[tried])
    plots = [
        (picture, "A grasp is tried even where the arm does not reach it."),
        (drawing.labels(sets), "Red: below 0.5. Without those that the arm does not reach."),
    ]
    mm, deg = _kept(sets)
    if len(mm):
        plots.append((drawing.slips(mm, deg), "Linear below 0.1, logarithmic above."))
    if failed:
        plots.append((drawing.failures(failed), "The first thing that stopped each grasp."))
    section.page.plots(plots)


def _pictures(section: Section, store: SessionStore) -> None:
    if store.has(SHEET):
        section.page.text(f"The grasps of every object, drawn: {SHEET}.")
    if store.path(SETTLED).is_file():
        section.page.picture(
            store.path(SETTLED).read_bytes(), "How the objects settled in the simulation."
        )


OWN = ("reports/", "stages/report.")
"""A report says nothing of its own files: it would differ from the next one."""
SHOWN = 30
LONGEST = 120
"""Characters of a setting that are shown."""


def files_section(section: Section, store: SessionStore) -> None:
    """Fill the section on files and checksums."""
    report = check_session(store.folder)
    lists = read_lists(store.folder)
    entries = {p: e for p, e in lists.entries.items() if not p.startswith(OWN)}
    total = sum(e.bytes for e in entries.values())
    found = [f for r in _all(report) for f in r.findings if not f.path.startswith(OWN)]
    damage = [f for f in found if f.is_damage]
    section.add(
        count("files.listed", len(entries)), count("files.damaged", len(damage)),
        Figure(name="files.megabytes", value=total / 1e6, sigma=0.0),
    )  # fmt: skip
    section.headline = f"{len(entries)} files, {total / 1e6:.0f} MB, " + (
        f"{len(damage)} damaged" if damage else "all as they were written"
    )
    if damage:
        names = ", ".join(f.path for f in damage[:3]) + (", ..." if len(damage) > 3 else "")
        section.say("bad", f"Files: {len(damage)} are missing or changed since they were written "
                    f"({names}). `realsim check SESSION` lists them.")  # fmt: skip
    folders: dict[str, list[int]] = {}
    for path, entry in entries.items():
        folder = path.split("/")[0] if "/" in path else "(session)"
        folders.setdefault(folder, []).append(entry.bytes)
    section.page.table(
        ["folder", "files with a checksum", "size [MB]"],
        [[name, len(sizes), f"{sum(sizes) / 1e6:.2f}"] for name, sizes in sorted(folders.items())],
    )
    if found:
        rows = [
            [f.path, Cell(text=f.kind, kind="bad" if f.is_damage else "off"), f.found]
            for f in sorted(found, key=lambda f: not f.is_damage)
        ]
        section.page.table(["file", "", "found"], rows[:SHOWN])
        if len(rows) > SHOWN:
            section.page.text(f"... and {len(rows) - SHOWN} more.")
    unproven = [p for p in report.unproven if not p.startswith(OWN)]
    if unproven:
        section.page.text(f"{len(unproven)} files of the session have no checksum.")


def _all(report: CheckReport) -> Iterator[CheckReport]:
    yield report
    for inner in report.inner:
        yield from _all(inner)


def settings_section(section: Section, store: SessionStore) -> None:
    """Fill the section on versions and settings."""
    header: Any = store.read_json("session.json")
    versions: Any = header.get("versions", {})
    section.headline = f"captured with realsim {versions.get('realsim', '?')}"
    rows = [["captured (UTC)", store.created], ["this report", f"realsim {__version__}"]]
    rows += [[f"captured with {name}", v] for name, v in sorted(versions.items())]
    rows += [[name, _short(value)] for name, value in sorted(store.extra.items())]
    section.page.table(["what", "value"], rows)
    attempted(section, "the settings", lambda: _settings(section, store))


def _settings(section: Section, store: SessionStore) -> None:
    """Add what the stages were asked for."""
    found: list[tuple[str, Any]] = []
    if store.has("plan.json"):
        found.append(("Settings of the plan", store.read_json("plan.json")["content"]["config"]))
    if store.has("registration/report.json"):
        report: Any = store.read_json("registration/report.json")
        found.append(("What registration was asked for", report.get("asked", {})))
    sets = sorted((store.folder / "grasps").glob("*_obj*.json"))
    if sets:
        told: Any = store.read_json(f"grasps/{sets[0].name}")
        found.append(("Settings of the Robot School", told["parameters"].get("config", {})))
        found.append(("Versions in the Robot School", told["parameters"].get("versions", {})))
    for title, values in found:
        rows = [[name, _short(v)] for name, v in _flat(values)]
        if rows:
            section.page.table(["setting", "value"], rows, folded=title)


def _flat(values: Any, before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted names and plain values."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{before}{name}.")
        else:
            yield f"{before}{name}", value


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."


CORRECTIONS = ("move", "swap", "symmetric")


def review_state(store: SessionStore) -> ReviewState:
    """Return what the journal adds up to; nothing where it cannot be read."""
    try:
        return review_of(store)
    except READING:
        return ReviewState()  # the section on the review says what is wrong with it


def review_section(
    section: Section, store: SessionStore, objects: Sequence[dict[str, Any]]
) -> None:
    """Fill the section on the review.

    Args:
        section: to fill.
        store: the session.
        objects: the placed objects as the section on registration has them.
    """
    undecided = [o for o in objects if o["verdict"] != "accepted" and not o["decided_by"]]
    decided = sum(bool(o["decided_by"]) for o in objects)
    if objects:
        section.add(count("review.decided", decided), count("review.open", len(undecided)))
    if not store.has(JOURNAL_FILE):
        section.missing("Nobody has reviewed it.")
        _open(section, undecided)
        return
    content = read(store.path(JOURNAL_FILE))
    state = replay(content.entries)
    standing = state.standing
    if content.damaged:
        lines = ", ".join(map(str, content.damaged))
        section.say("warn", f"Review: lines {lines} of the journal are not whole.")
    corrected = [e for e in standing if e.action in CORRECTIONS]
    excluded = state.excluded_views()
    section.add(
        count("review.corrections", len(corrected)), count("review.excluded_views", len(excluded))
    )
    people = sorted({e.reviewer for e in content.entries})
    section.headline = f"{decided} of {len(objects)} objects decided by {', '.join(people)}"
    if undecided:
        section.headline += f", {len(undecided)} open"
    _open(section, undecided)
    if corrected or excluded:
        section.page.text(
            "Corrections count when they are applied: `realsim register SESSION --from-review`."
        )
    ids = {e.id for e in standing}
    rows = [_row(e, ids) for e in content.entries]
    section.page.table(["when (UTC)", "who", "what", "about", "comment", "state"], rows)


def _open(section: Section, undecided: Sequence[dict[str, Any]]) -> None:
    if undecided:
        names = ", ".join(f"{o['instance']} {o['name']}" for o in undecided)
        section.page.text(f"Not accepted, and nobody has decided: {names}.")


def _row(e: Entry, standing: set[str]) -> list[object]:
    about = f"object {e.instance}" if e.instance is not None else ""
    if e.view is not None:
        about = f"view {e.view}"
    elif e.action == "symmetric":
        about = f"model {e.obj_id}: {e.symmetry}"
    elif e.action == "swap":
        about += f", is model {e.obj_id}"
    what = e.action + (f" ({e.how})" if e.how else "")
    taken = e.action != "undo" and e.id not in standing
    state = Cell(text="taken back", kind="off") if taken else ""
    return [e.time[:19].replace("T", " "), e.reviewer, what, about, e.comment, state]


PAGE, DOCUMENT = "reports/report.html", "reports/report.json"
Build = Callable[[Section], None]


def write_report(store: SessionStore, report: Report) -> Path:
    """Write SESSION/reports/report.html and report.json; return the path of the page.

    Args:
        store: the session.
        report: what `report_of` made of it.
    """
    page = page_of(store, report)
    data = page.encode(math.inf)
    store.write_json(DOCUMENT, page.document)
    store.write_bytes(PAGE, data)
    return store.folder / PAGE


def hidden_of(store: SessionStore) -> dict[str, str]:
    """Return the texts that must not stand in a report -> what stands there instead."""
    names = {str(store.folder.resolve()), str(store.folder.absolute())}
    return {name: "SESSION" for name in sorted(names, key=len, reverse=True)}


def report_of(
    store: SessionStore, errors: LoopErrors | None = None, pictures: Pictures = "none",
    notes: Sequence[str] = (), times: Sequence[StageTime] = (),
) -> Report:  # fmt: skip
    """Return the report of a session, its sections written.

    Args:
        store: the session.
        errors: the errors against the simulated lab's truth; None on real data.
        pictures: whether they are drawn, and kept as files in reports/, too.
        notes: what the reader must know first.
        times: cost of the stages of the run that made it.
    """
    if pictures == "kept":
        (store.folder / "reports").mkdir(exist_ok=True)
    hidden = hidden_of(store)
    sections: list[Section] = []

    def add(key: str, title: str, command: str, build: Build) -> Section:
        page = Page(hidden=hidden)
        run = f"realsim {command} SESSION" if command else ""
        section = built(
            Section(key=key, title=title, page=page, command=run, pictures=pictures), build
        )
        sections.append(section)
        return section

    state = review_state(store)
    if errors is not None:
        worst = max(errors.object_mssd_mm.values(), default=0.0)
        found = {**errors.figures(), "object_mssd_max_mm": worst}
        title = "Errors against the truth"
        add("truth", title, "", lambda s: truth_section(s, errors.rows(), found))
    add("calibration", "Calibration", "calibrate", lambda s: calibration_section(s, store))
    add("plan", "Plan", "", lambda s: plan_section(s, store))
    add("capture", "Capture", "capture", lambda s: capture_section(s, store))
    registered = add(
        "registration", "Registration", "register", lambda s: registration_section(s, store, state)
    )
    add("review", "Review", "review", lambda s: review_section(s, store, registered.objects))
    add("school", "Robot School", "school", lambda s: school_section(s, store))
    add("labels", "Labels", "annotate", lambda s: labels_section(s, store))
    add("files", "Files and checksums", "", lambda s: files_section(s, store))
    add("settings", "Versions and settings", "", lambda s: settings_section(s, store))
    return Report(
        name=store.session.name, about=_about(store), sections=tuple(sections), notes=notes,
        times=times,
    )  # fmt: skip


def page_of(store: SessionStore, report: Report) -> Page:
    """Return the page of a report; see `write_report`."""
    page = Page(title=report.name, about=report.about, hidden=hidden_of(store))
    page.document = report.document(page)
    write_summary(page, report, _first_picture(store))
    for section in report.sections:
        page.parts += section.page.parts
    if report.times:
        page.section("Cost of the run", folded=f"{sum(t.wall_s for t in report.times):.0f} s")
        rows = [[t.name, f"{t.cpu_s:.1f}", f"{t.wall_s:.1f}"] for t in report.times]
        page.table(["stage", "CPU [s]", "clock [s]"], rows)
    return page


def _first_picture(store: SessionStore) -> tuple[Picture | None, str]:
    """Return the picture that tells most of a session, and its caption."""
    drawn = store.folder / "registration/pictures/overlay.jpg"
    labelled = sorted((store.folder / "reports").glob("overlay_*.png"))
    try:
        if drawn.is_file():
            return drawn.read_bytes(), "The models' outlines in the colours of their verdicts."
        if labelled:
            return labelled[0].read_bytes(), "A frame with the outlines of its labels."
        if store.session.views:
            return store.rgb(store.session.views[0].index), "The first photograph."
    except READING:
        pass  # its section says what is wrong with it
    return None, ""


def _about(store: SessionStore) -> str:
    """Return one line on what the session is."""
    i = store.session.intrinsics
    lens = "distorted lens" if i.is_distorted else "no distortion"
    made = store.created[:16].replace("T", " ")
    views = counted(len(store.session.views), "view")
    return (
        f"{views}, {i.width} x {i.height} px, fx {i.fx:.1f} px, {lens}, "
        f"depth unit {1e3 * store.session.depth_unit_m:g} mm" + f", begun {made} UTC" * bool(made)
    )
