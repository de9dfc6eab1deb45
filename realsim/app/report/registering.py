"""The section on registration: every object's verdict, probability and sigma; cameras; views.

Outlines in the photographs before and after registration, for sliders in the report.

Before: the poses that registration started from, through the cameras as robot and calibration
claim them. After: the registered poses, through the refined cameras. A pose or a camera that
registration did not change is the same in both.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from realsim.app.register import tables
from realsim.app.register.inputs import STARTS_FILE
from realsim.app.register.results import (
    Registered,
    claimed_cameras,
    is_same_pose,
    load_registered,
    sigmas,
    stand_alone,
)
from realsim.app.report import plots as drawing
from realsim.app.report.figures import Figure, count
from realsim.app.report.section import Section, drawn
from realsim.app.stages import registered_views, session_models
from realsim.arrays import Array, UInt8, evenly
from realsim.geometry import se3
from realsim.pages import VERDICT_KIND, Cell, View, counted
from realsim.records import ObjectModel, ObjectPose
from realsim.registration.judging.verdict import ACCEPT
from realsim.rendering.rays import PlacedMesh
from realsim.review.corrections import decision_on
from realsim.review.journal import ReviewState
from realsim.store import SessionStore

VIEWS = 3
"""Sliders in a report, spread over the session."""


def registration_pairs(store: SessionStore) -> tuple[list[View], str]:
    """Return before/after pairs of registered views, and in words what 'before' is.

    Both are empty where nothing tells what was before: no rough poses, no camera refined.

    Args:
        store: a session with a registered scene.
    """
    from realsim.store import load_scene

    scene, models = load_scene(store), session_models(store)
    after = [o for o in scene.objects if o.obj_id in models]
    started = _starts(store)
    claimed = claimed_cameras(store)
    told = registered_views(store)
    cameras = store.session.Ts_world_cam
    seen = [k for k in cameras if k in claimed and k in told]
    moved = [o for o in after if o.instance in started]
    refined = [k for k in seen if not is_same_pose(claimed[k], cameras[k])]
    if not seen or not after or not (moved or refined):
        return [], ""
    what: list[str] = []
    if moved:
        what.append(f"{len(moved)} of {len(after)} objects at the rough pose they started from")
    if refined:
        what.append(f"{len(refined)} of {len(seen)} cameras as robot and calibration claim them")
    kept = [PlacedMesh(o.instance, models[o.obj_id].mesh, o.T_world_obj) for o in after]
    before = [replace(p, T_world_obj=started.get(p.instance, p.T_world_obj)) for p in kept]
    pairs: list[View] = []
    for k in evenly(seen, VIEWS):
        pictures = {
            "before": _outlined(store, k, claimed[k], before),
            "registered": _outlined(store, k, cameras[k], kept),
        }
        pairs.append(View(f"view {k}", pictures))
    return pairs, f"Before: {', and '.join(what)}."


def _starts(store: SessionStore) -> dict[int, Array]:
    """Return the rough pose of every instance that was given one as a pose.

    Clicks, boxes and masks are no poses; they are left out.
    """
    told: Any = store.read_json(STARTS_FILE) if store.has(STARTS_FILE) else {}
    rows: list[Any] = told.get("starts", []) if isinstance(told, dict) else []
    found = [r for r in rows if isinstance(r, dict) and {"instance", "T_world_obj"} <= r.keys()]
    return {int(r["instance"]): se3.check_rigid(r["T_world_obj"], STARTS_FILE) for r in found}


def _outlined(
    store: SessionStore, index: int, T_world_cam: Array, placed: Sequence[PlacedMesh]
) -> UInt8:
    """Return a photograph with the outlines of objects at given poses, by instance colours."""
    from realsim.rendering.labels import LabelRenderer
    from realsim.rendering.overlay import draw_outlines

    ids = LabelRenderer(placed).render(store.session.intrinsics, T_world_cam).ids
    return draw_outlines(store.rgb(index), ids)


AGREE = (
    "Here: of all pixels in which the object is visible and depth was measured, over all views, "
    "the share whose depth fits its pose within the sensor's noise. Registration uses it."
)
PROBABILITY = (
    "That the object is right within 3 mm: from four views on by a formula of all its checks that "
    "was fitted to thousands of poses of known error; from fewer, the share of all poses that the "
    "views cannot tell apart."
)
SIGMA = (
    "Along, or about, the worst axis. Turns about an axis of revolution change nothing and are set "
    "aside."
)
PERSON_NOTE = "b: a person accepted it; the probability is the computed one."
PICTURES = (
    ("overlay.jpg", "Outlines in the colour of the verdict, through the refined cameras."),
    ("cameras.jpg", "The same edge before and after the cameras were refined."),
    ("residuals.jpg", "Depth against the scene: red in front of the model, blue behind it."),
    ("map.png", "The table from above."),
)


def registration_section(section: Section, store: SessionStore, state: ReviewState) -> None:
    """Fill the section on registration.

    Args:
        section: to fill.
        store: the session.
        state: what reviewers decided.
    """
    from realsim.app.register.files import finish_interrupted
    from realsim.app.stages import judged_scene, session_models

    finish_interrupted(store)
    if not store.has("registration/scene.json"):
        section.missing("The objects have not been registered.")
        return
    scene, models = judged_scene(store), session_models(store)
    stored = load_registered(store) if store.has("registration/report.json") else None
    result = stand_alone(scene) if stored is None else replace(stored, scene=scene)
    section.objects = [_object(o, models, state, result) for o in tables.worst_first(result)]
    _figures(section, result)
    verdicts = [o.verdict for o in scene.objects]
    told = [f"{verdicts.count(v)} {v}" for v in VERDICT_KIND if v in verdicts]
    told += [f"{len(result.not_placed)} not placed"] * bool(result.not_placed)
    section.headline = ", ".join(told) or "nothing was found"
    _findings(section, result, models)
    section.page.text(" ".join(t[0].upper() + t[1:] for t in _lines(result) if t))
    if scene.objects:
        _object_table(section)
        drawn(section, "the plots", lambda: _plots(section, result))
    if result.not_placed:
        section.page.table(tables.MISSING_HEADER, tables.missing_rows(result, models))
    _views(section, store, result, state)
    drawn(section, "the pictures", lambda: _pictures(section, store))
    if any(o.checks for o in scene.objects):  # a row a check: as columns they are too wide
        checks = tables.check_rows(scene.objects, models)
        section.page.table(*checks, folded="All checks of all objects")


def _lines(result: Registered) -> list[str]:
    if not result.report:
        return [tables.table_line(result)]
    return [
        tables.table_line(result),
        tables.camera_line(result),
        tables.depth_line(result),
        tables.odometry_line(result),
        tables.places_line(result),
    ]


def _object(
    o: ObjectPose, models: Mapping[int, ObjectModel], state: ReviewState, result: Registered
) -> dict[str, Any]:
    """Return an object as plain JSON values."""
    mm, deg = sigmas(o.covariance, models.get(o.obj_id))
    decision = decision_on(o, state)
    views = o.checks.get("views", float("nan"))
    p, agree = (o.checks.get(k, float("nan")) for k in ("probability", "agree"))
    px = [p_[o.instance].sigma_px for p_ in result.seen.values() if o.instance in p_]
    px = [v for v in px if np.isfinite(v)]
    return {
        "instance": o.instance,
        "obj_id": o.obj_id,
        "name": models[o.obj_id].name if o.obj_id in models else f"object {o.obj_id}",
        "verdict": o.verdict,
        "decided_by": "" if decision is None else decision.reviewer,
        "probability": _known(p),
        "agree": _known(agree),
        "sigma_mm": _known(mm),
        "sigma_deg": _known(deg),
        "sigma_px": _known(float(np.median(px)) if px else float("nan")),
        "views": _known(views),
        "reasons": list(o.reasons),
        "T_world_obj": o.T_world_obj.tolist(),
    }


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _figures(section: Section, result: Registered) -> None:
    rows = section.objects
    verdicts = [r["verdict"] for r in rows]
    section.add(
        count("registration.objects", len(rows)),
        *[count(f"registration.{v}", verdicts.count(v)) for v in ("accepted", "doubtful",
                                                                 "rejected")],
        count("registration.not_placed", len(result.not_placed)),
    )  # fmt: skip
    for name, key, worst in (
        ("probability_min", "probability", min),
        ("agree_min", "agree", min),
        ("sigma_mm_max", "sigma_mm", max),
        ("sigma_deg_max", "sigma_deg", max),
    ):
        values = [r[key] for r in rows if r[key] is not None]
        if values:
            section.add(Figure(name=f"registration.{name}", value=float(worst(values))))
    if result.cameras.refined:
        left = set(result.cameras.claimed) - set(result.cameras.refined)
        section.add(
            count("registration.views_used", len(result.cameras.refined)),
            count("registration.views_left_out", len(left)),
        )
    per_view = _view_sigmas(result)
    if per_view:
        middle = {k: float(np.median(v)) for k, v in sorted(per_view.items())}
        section.add(Figure("registration.view_sigma_px", float(np.median(list(middle.values())))))
        section.series["registration.view_sigma_px"] = {
            "view": list(middle), "value": [round(v, 5) for v in middle.values()],
        }  # fmt: skip
    found: Any = result.report.get("refinement") or {}
    moved: list[Any] = list((found.get("views") or {}).values())
    for name, key in (("camera_shift_mm", "shift_mm"), ("camera_turn_deg", "turn_deg")):
        if moved:
            value = float(np.median([m[key] for m in moved]))
            section.add(Figure(name=f"registration.{name}", value=value))
    if "hand_eye_mm" in found:
        section.add(Figure("registration.hand_eye_shift_mm", float(found["hand_eye_mm"])))
    plane = result.scene.plane
    if plane is not None:
        section.add(Figure(name="registration.plane_rms_mm", value=1e3 * plane.rms_m))


def _view_sigmas(result: Registered) -> dict[int, list[float]]:
    """Return view -> 1 sigma of its objects [px], of the views that have any."""
    rows = {
        k: [p.sigma_px for p in seen.values() if np.isfinite(p.sigma_px)]
        for k, seen in result.seen.items()
    }
    return {k: v for k, v in rows.items() if v}


def _findings(section: Section, result: Registered, models: Mapping[int, ObjectModel]) -> None:
    """Say what speaks against using the objects."""
    for row in section.objects:
        name = f"{row['instance']} {row['name']}"
        decided = f" by {row['decided_by']}" if row["decided_by"] else ""
        why = "; ".join(row["reasons"])
        if row["verdict"] == "rejected":
            text = f"Object {name} is rejected{decided}; it gets no labels. {why}"
            section.say("note" if decided else "bad", text.strip())
        elif row["verdict"] in ("doubtful", "unchecked"):
            section.say("warn", f"Object {name} is {row['verdict']}: {why or 'not checked'}")
    for missing in result.not_placed:
        name = tables.named(missing.instance, missing.obj_id, models)
        section.say("warn", f"Object {name} is not placed: {missing.reason}")
    for remark in result.remarks:
        where = "Scene" if remark.view is None else f"View {remark.view}"
        section.say("warn", f"{where}: {remark.words}")
    if result.scene.plane is None:
        section.say("warn", "No table was found under the objects.")


def _object_table(section: Section) -> None:
    """Add the table of the objects, worst first, with what its words mean."""
    header = [
        "object", "verdict", Cell(text="right [%]", hover=PROBABILITY),
        Cell(text="1 sigma [mm]", hover=SIGMA), Cell(text="[deg]", hover=SIGMA),
        Cell(text="depth agrees [%]", hover=AGREE, note="a"), "in views [px]", "views", "why",
    ]  # fmt: skip
    section.page.table(header, _object_rows(section.objects))
    section.page.text(
        f"a: {AGREE} The section on labels has a share of the same name of every frame by itself.",
        "foot",
    )
    if any(r["decided_by"] and r["verdict"] == "accepted" for r in section.objects):
        section.page.text(PERSON_NOTE, "foot")


def _object_rows(objects: Sequence[Any]) -> Iterator[list[object]]:
    for r in objects:
        note = "b" if r["decided_by"] and r["verdict"] == "accepted" else ""
        verdict = r["verdict"] + (f" by {r['decided_by']}" if r["decided_by"] else "")
        yield [
            f"{r['instance']} {r['name']}",
            Cell(text=verdict, kind=VERDICT_KIND[r["verdict"]]),
            Cell(text=_number(r["probability"], 100, 1), note=note),
            _number(r["sigma_mm"], 1, 2),
            _number(r["sigma_deg"], 1, 3),
            _number(r["agree"], 100, 1),
            _number(r["sigma_px"], 1, 2),
            _number(r["views"], 1, 0),
            "; ".join(r["reasons"]),
        ]


def _number(value: float | None, factor: float, digits: int) -> str:
    return "-" if value is None else f"{factor * value:.{digits}f}"


def _plots(section: Section, result: Registered) -> None:
    rows = section.objects
    plots: list[tuple[bytes, str]] = []
    names = [f"{r['instance']} {r['name']}" for r in rows]
    verdicts = [r["verdict"] for r in rows]
    if any(r["probability"] is not None for r in rows):
        values = [r["probability"] or 0.0 for r in rows]
        picture = drawing.probabilities(names, values, verdicts, ACCEPT)
        plots.append((picture, "Bars in the colour of the verdict."))
    if any(r["sigma_mm"] is not None for r in rows):
        mm = [r["sigma_mm"] if r["sigma_mm"] is not None else float("nan") for r in rows]
        plots.append((drawing.sigmas(names, mm, verdicts), "From the fit's own residuals."))
    per_view = _view_sigmas(result)
    left = sorted(set(result.cameras.claimed) - set(result.cameras.refined))
    if len(per_view) > 1:
        picture = drawing.view_uncertainty(per_view, left if result.cameras.refined else [])
        plots.append((picture, "Objects and camera together."))
    claimed, refined = result.cameras.claimed, result.cameras.refined
    if any(not is_same_pose(claimed[k], T) for k, T in refined.items() if k in claimed):
        picture = drawing.camera_moves(claimed, refined)
        plots.append((picture, "From where robot and calibration claim them to be."))
    section.page.plots(plots)


def _views(section: Section, store: SessionStore, result: Registered, state: ReviewState) -> None:
    """Add the views that took no part and why, and what is wrong with others."""
    used = set(result.cameras.refined)
    if used:
        excluded = state.excluded_views()
        left = [v for v in store.session.views if v.index not in used]
        rows: list[list[object]] = []
        for v in left:
            words = [r.words for r in result.remarks if r.view == v.index]
            if v.index in excluded:
                words.append(f"left out by {excluded[v.index].reviewer}: "
                             f"{excluded[v.index].comment}".rstrip(": "))  # fmt: skip
            elif v.T_world_cam is None:
                words.append("its camera has no pose")
            elif not store.has_depth(v.index):
                words.append("it has no depth")
            rows.append([v.index, "; ".join(words) or "it was not asked for (--views)"])
        section.page.heading("Views that took no part")
        if rows:
            section.page.table(["view", "why"], rows)
        else:
            section.page.text(f"None: {counted(len(used), 'view')} took part.")
    if result.remarks:
        section.page.heading("What is wrong with views, and with the scene")
        section.page.table(tables.VIEW_HEADER, tables.view_rows(result))


def _pictures(section: Section, store: SessionStore) -> None:
    """Add sliders of before and after where there is a before, and registration's own pictures."""
    pairs, before = registration_pairs(store)
    if pairs:
        section.page.heading("Before and after registration")
        section.page.text(before)
        section.page.sliders(pairs)
    folder: Path = store.folder / "registration/pictures"
    for name, caption in PICTURES:
        # The sliders show the outlines already.
        if (folder / name).is_file() and not (pairs and name == "overlay.jpg"):
            section.page.picture((folder / name).read_bytes(), caption)
