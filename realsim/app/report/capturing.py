"""The sections on the plan and on the capture."""

import json
from typing import Any

import numpy as np

from realsim.app.report import plots as drawing
from realsim.app.report.figures import Figure, count
from realsim.app.report.section import READING, Section, attempted, drawn
from realsim.arrays import evenly
from realsim.pages import counted
from realsim.store import SessionStore
from realsim.store.atomic import complete_lines

PLAN, LOG = "plan.json", "capture_log.jsonl"
THUMBNAIL_WIDTH_PX = 400
SHEET_VIEWS = 12
"""Thumbnails of the captured views."""


def plan_section(section: Section, store: SessionStore) -> None:
    """Fill the section on the plan."""
    if not store.has(PLAN):
        imported = store.session.views and not store.has(LOG)
        section.command = "" if imported else section.command
        section.missing("No plan is stored with the session.")
        return
    told: Any = store.read_json(PLAN)
    content: Any = told["content"]
    metrics: dict[str, float] = content.get("metrics", {})
    joints = len(content["joints"])
    tour = metrics.get("seconds_total")
    clearances = [v for k, v in metrics.items() if k.startswith("clearance_") and np.isfinite(v)]
    section.add(count("plan.views", joints))
    for name, value in (
        ("plan.tour_s", tour),
        ("plan.hole_deg", metrics.get("hole_deg")),
        ("plan.clearance_mm", 1e3 * min(clearances) if clearances else None),
        ("plan.in_view_min", metrics.get("in_view_min")),
    ):
        if value is not None and np.isfinite(value):
            section.add(Figure(name=name, value=float(value)))
    section.headline = f"{joints} views" + ("" if tour is None else f", tour of {tour:.0f} s")
    f = section.figures
    rows: list[list[object]] = [["kind, robot", f"{content.get('kind')}, {content.get('robot')}"]]
    for x in f.values():
        rows.append([x.meaning.text, f"{x.shown} {x.meaning.unit}".strip()])
    section.page.table(["figure", "value"], rows)
    drawn(section, "the coverage", lambda: _coverage(section, store, told))
    rest = [[name, f"{value:.4g}"] for name, value in sorted(metrics.items())]
    if rest:
        section.page.table(["figure", "value"], rest, folded="All figures of the plan")


def _coverage(section: Section, store: SessionStore, told: Any) -> None:
    poses = np.asarray(told["expected"]["Ts_base_cam"], dtype=np.float64).reshape(-1, 4, 4)
    center = np.asarray(told["content"]["center_world"], dtype=np.float64)
    there = {v.index for v in store.session.views}
    picture = drawing.coverage(poses, center, [k in there for k in range(len(poses))])
    section.page.plots([(picture, "Planned views around the middle of the scene.")])


def capture_section(section: Section, store: SessionStore) -> None:
    """Fill the section on the capture."""
    views = store.session.views
    if not views:
        section.missing("No view has been captured.")
        return
    i = store.session.intrinsics
    posed = len(store.session.Ts_world_cam)
    deep = sum(store.has_depth(v.index) for v in views)
    section.add(count("capture.views", len(views)))
    section.headline = counted(len(views), "view")
    planned = _planned(store)
    if planned is not None:
        lost = max(0, planned - len(views))
        section.add(count("capture.views_missing", lost))
        section.headline = f"{len(views)} of {planned} planned views"
        if lost:
            section.say("warn", f"Capture: {lost} of {planned} planned views are missing.")
    if deep < len(views):
        severity = "warn" if deep else "note"
        section.say(severity, f"Capture: {len(views) - deep} of {len(views)} views have no depth.")
    lens = "distorted lens" if i.is_distorted else "no distortion"
    rows: list[list[object]] = [
        ["camera", f"{i.width} x {i.height} px, fx {i.fx:.2f} px, fy {i.fy:.2f} px, {lens}"],
        ["depth unit", f"{1e3 * store.session.depth_unit_m:g} mm"],
        ["views with depth, with a camera pose", f"{deep}, {posed} of {len(views)}"],
    ]
    times = [v.time_s for v in views]
    if max(times) > min(times):
        section.add(Figure(name="capture.seconds", value=float(max(times) - min(times))))
        rows.append(["from the first to the last view", f"{max(times) - min(times):.1f} s"])
    section.page.table(["figure", "value"], rows)
    attempted(section, "the capture's log", lambda: _log(section, store))
    drawn(section, "the contact sheet", lambda: _sheet(section, store))


def _planned(store: SessionStore) -> int | None:
    """Return the number of views of the plan; None where there is none to be read."""
    try:
        told: Any = store.read_json(PLAN) if store.has(PLAN) else None
        return None if told is None else len(told["content"]["joints"])
    except READING:
        return None  # the section on the plan says what is wrong with it


def _log(section: Section, store: SessionStore) -> None:
    """Add what was measured while it was captured."""
    if not store.has(LOG):
        return
    events: list[Any] = [json.loads(line) for line in complete_lines(store.folder / LOG)]
    stored = {int(e["view"]): e for e in events if e.get("event") == "stored"}
    if not stored:
        return
    measured = {k: e.get("measured", {}) for k, e in sorted(stored.items())}
    settle = {k: float(e["settle_s"]) for k, e in sorted(stored.items()) if "settle_s" in e}
    retakes = sum(int(e.get("attempts", 1)) - 1 for e in stored.values())
    section.add(count("capture.retakes", retakes))
    plots: list[tuple[bytes, str]] = []
    is_drawn = section.pictures != "none"
    if settle:
        values = np.array(list(settle.values()))
        section.add(Figure(name="capture.settle_s", value=float(np.median(values))))
        if is_drawn:
            picture = drawing.settling(settle)
            plots.append((picture, "Measured between the stop and the photograph."))
    for name, key, pick in (
        ("capture.sharpness", "sharpness", np.median),
        ("capture.depth_fill", "depth_fill", np.median),
        ("capture.saturated", "saturated", np.max),
    ):
        seen = np.array([m[key] for m in measured.values() if m.get(key) is not None], np.float64)
        seen = seen[np.isfinite(seen)]
        if len(seen):
            section.add(Figure(name=name, value=float(pick(seen))))
    if is_drawn and any(measured.values()):
        plots.append((drawing.photographs(measured), "Measured when they were taken."))
    section.page.plots(plots)
    told = [[k, "; ".join([*map(str, e.get("retaken", ())), *map(str, e.get("notes", ()))])]
            for k, e in sorted(stored.items()) if e.get("retaken") or e.get("notes")]  # fmt: skip
    skipped = [e for e in events if e.get("event") == "skipped" and e.get("view") not in stored]
    left = [[e["view"], f"skipped: {e.get('reason', '')}"] for e in skipped]
    if told or left:
        section.page.table(["view", "noted while it was captured"], [*told, *left])
    ended = [e for e in events if e.get("event") == "ended"]
    if ended and not ended[-1].get("complete", True):
        section.say("warn", "Capture: the tour was not completed.")


def _sheet(section: Section, store: SessionStore) -> None:
    """Add thumbnails of views spread over the session."""
    from realsim.images import resized
    from realsim.rendering.overlay import contact_sheet, save_png

    indices = [v.index for v in store.session.views]
    if len(indices) < 2:
        return
    shown = evenly(indices, SHEET_VIEWS)
    small = [resized(store.rgb(k), THUMBNAIL_WIDTH_PX) for k in shown]
    sheet = contact_sheet(small, columns=4, captions=[f"view {k}" for k in shown])
    if section.pictures == "kept":
        save_png(store.folder / "reports/views.png", sheet)
    section.page.picture(sheet, f"{len(shown)} of {len(indices)} captured views")
