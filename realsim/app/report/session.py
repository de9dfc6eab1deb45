"""One self-contained HTML page a session: what was done, how good it is, and the pictures.

Beside it report.json holds the same figures for programs. The same session gives the same bytes.
"""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

from realsim.app.console import StageTime
from realsim.app.report.calibration import calibration_section
from realsim.app.report.capturing import capture_section, plan_section
from realsim.app.report.labelling import labels_section
from realsim.app.report.registering import registration_section
from realsim.app.report.reviewing import review_section, review_state
from realsim.app.report.schooling import school_section
from realsim.app.report.section import READING, Pictures, Section, built, counted
from realsim.app.report.storage import files_section, settings_section
from realsim.app.report.summary import Report, truth_section, write_summary
from realsim.app.truth import LoopErrors
from realsim.pages import Page, Picture
from realsim.store import SessionStore

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
