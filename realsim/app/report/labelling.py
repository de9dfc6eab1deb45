"""The section on the labels: what is visible, what hides it, and frames to look at."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from realsim.app.report import plots as drawing
from realsim.app.report.figures import Figure, count
from realsim.app.report.section import Section, drawn
from realsim.pages import Cell, Picture
from realsim.store import SessionStore

OVERLAY_VIEWS = 4
"""Annotated photographs in a report: the first view and others spread over the session."""
GRASPS = 15
"""Grasps drawn in one of them: few, so that the outlines can be judged."""
AGREE = (
    "Here: in one frame, of the measured pixels inside an object's visible mask, the share whose "
    "depth fits the rendered one. What the depth shows in front of the object has left the mask "
    "before, so it says how good the label is, not how good the pose is."
)
NAMED = 12
"""Frames in a table; the rest is counted."""
FOUND = {"occluder": "something in front of it", "pose or occluder": "a wrong pose, or something"}
DROPPED = 0.05
"""Hidden share of an object from which a frame is named."""


def labels_section(section: Section, store: SessionStore) -> None:
    """Fill the section on the labels."""
    paths = sorted((store.folder / "annotations").glob("[0-9]*.json"))
    if not paths:
        section.missing("No frame has labels.")
        drawn(section, "the annotated photographs", lambda: _photographs(section, store))
        return
    frames: dict[int, Any] = {int(p.stem): store.read_json(f"annotations/{p.name}") for p in paths}
    rows = [(view, o) for view, frame in frames.items() for o in frame["objects"]]
    _figures(section, frames, rows)
    total = len(store.session.views)
    section.headline = f"{len(frames)} of {total} frames"
    flagged = int(section.figures["labels.frames_flagged"].value)
    if flagged:
        section.headline += f", {flagged} to look at"
        section.say("warn", f"Labels: {flagged} frames need a look: depth says that an object may "
                    "be elsewhere, or that something hides it.")  # fmt: skip
    section.page.text(
        "A label is what the camera sees of an object that stands where registration put it. Red "
        "to green grippers in the photographs: p_hold (else score) 0 to 1. Magenta: hidden by "
        "something that is not in the scene."
    )
    _object_table(section, frames)
    shares = np.array([o["visib_fract"] for _, o in rows if o["px_count_all"] > 0], np.float64)
    section.series["labels.visibility"] = [round(float(v), 4) for v in shares]
    if len(shares):
        said = "1 = no other object in front of it."
        drawn(section, "the plot", lambda: section.page.plots([(drawing.visibility(shares), said)]))
    _named_frames(section, rows)
    drawn(section, "the annotated photographs", lambda: _photographs(section, store))


def _figures(section: Section, frames: Mapping[int, Any], rows: list[tuple[int, Any]]) -> None:
    flagged = {
        view for view, o in rows if o["unknown_occluder"]["finding"] == "pose or occluder"
    } | {view for view, frame in frames.items() if frame.get("camera_inside")}
    section.add(count("labels.frames", len(frames)), count("labels.frames_flagged", len(flagged)))
    seen = [o for _, o in rows if o["px_count_all"] > 0]
    agree, hidden = _depth_figures(seen)
    if seen:
        mean = float(np.mean([o["visib_fract"] for o in seen]))
        section.add(Figure(name="labels.visibility_mean", value=mean, sigma=0.0))
    if hidden is not None:
        section.add(Figure(name="labels.hidden_by_unknown", value=hidden))
    if agree is not None:
        section.add(Figure(name="labels.depth_agree", value=agree))


def _depth_figures(objects: Sequence[Any]) -> tuple[float | None, float | None]:
    """Return how well depth agrees with labels (median), and the share hidden by unknown things."""
    agree = [o["depth"]["agree"] for o in objects if o["depth"]["agree"] is not None]
    rendered = sum(o["px_count_visib"] + o["px_hidden_by_unknown"] for o in objects)
    hidden = sum(o["px_hidden_by_unknown"] for o in objects)
    return float(np.median(agree)) if agree else None, hidden / rendered if rendered else None


def _object_table(section: Section, frames: Mapping[int, Any]) -> None:
    """Add one row an object: frames, visibility, agreement, what hides it."""
    header = [
        "object", "frames seen", "visible, mean [%]",
        Cell(text="depth agrees, median [%]", hover=AGREE, note="b"),
        "hidden by unknown [%]", "occluders found",
    ]  # fmt: skip
    section.page.table(header, _object_rows(frames))
    section.page.text(f"b: {AGREE}", "foot")


def _object_rows(frames: Mapping[int, Any]) -> Iterator[list[object]]:
    by: dict[int, list[Any]] = {}
    for frame in frames.values():
        for o in frame["objects"]:
            by.setdefault(int(o["instance"]), []).append(o)
    for instance, mine in sorted(by.items()):
        seen = [o for o in mine if o["px_count_visib"] > 0]
        (agree, _), (_, hidden) = _depth_figures(seen), _depth_figures(mine)
        names = {o["unknown_occluder"]["finding"] for o in mine} - {"none"}
        yield [
            f"{instance} {mine[0]['name']}",
            f"{len(seen)} of {len(mine)}",
            f"{100 * np.mean([o['visib_fract'] for o in seen]):.0f}" if seen else "-",
            "-" if agree is None else f"{100 * agree:.1f}",
            "-" if hidden is None else f"{100 * hidden:.2f}",
            "; ".join(sorted(names)) or "-",
        ]


def _named_frames(section: Section, rows: list[tuple[int, Any]]) -> None:
    """Add the frames in which something that is not in the scene hides an object."""
    told = [
        (view, o)
        for view, o in rows
        if o["unknown_occluder"]["finding"] == "pose or occluder"
        or o["unknown_occluder"]["share"] >= DROPPED
    ]
    told.sort(
        key=lambda r: (
            r[1]["unknown_occluder"]["finding"] != "pose or occluder",
            -r[1]["unknown_occluder"]["share"], r[0], r[1]["instance"],
        )
    )  # fmt: skip
    section.page.heading("Frames to look at")
    if not told:
        section.page.text("None: in no frame does the depth contradict a label.")
        return
    header = ["frame", "object", "found", "hides [%]", "in front by [mm]", "taken out of the mask"]
    section.page.table(header, [_named_row(*r) for r in told[:NAMED]])
    if len(told) > NAMED:
        section.page.text(f"... and {len(told) - NAMED} more.")


def _named_row(view: int, o: Any) -> list[object]:
    unknown = o["unknown_occluder"]
    gap = unknown["gap_m"]
    return [
        view,
        f"{o['instance']} {o['name']}",
        FOUND.get(unknown["finding"], unknown["finding"]),
        f"{100 * unknown['share']:.1f}",
        "-" if gap is None else f"{1e3 * gap:.0f}",
        "yes" if unknown["is_removed"] else "no",
    ]


def _photographs(section: Section, store: SessionStore) -> None:
    """Add annotated photographs spread over the session."""
    from realsim.app.stages import registered_views, session_models
    from realsim.arrays import evenly
    from realsim.rendering.overlay import save_png
    from realsim.store import load_grasps, load_scene
    from realsim_sim_bridge.annotation.pictures import overlay_pictures

    indices = [v.index for v in store.session.views]
    if not indices or not store.has("registration/scene.json"):
        return
    scene, models = load_scene(store), session_models(store)
    grasps = load_grasps(store)
    shown = evenly(registered_views(store) or indices, OVERLAY_VIEWS)
    folder = store.folder / "reports"
    is_kept = section.pictures == "kept"
    for path in folder.glob("overlay_*.png") if is_kept else ():
        path.unlink()  # of an earlier report, perhaps of views that took no part since
    section.page.heading("The annotated scene")
    pictures: list[tuple[Picture, str]] = []
    drawn = overlay_pictures(store, shown, scene, models, grasps, GRASPS)
    for index, picture in zip(shown, drawn, strict=True):
        if is_kept:
            save_png(folder / f"overlay_{index:06d}.png", picture)
        pictures.append((picture, f"view {index}"))
    section.page.pictures(pictures)
