"""What a registration found, as rows of tables and as words: for the console and for the page."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np

from realsim.app.console import Console
from realsim.app.register.results import Registered, sigmas
from realsim.json_values import json_value
from realsim.records import ObjectModel, ObjectPose

Rows = list[list[str]]
WORST_FIRST = {"rejected": 0, "doubtful": 1, "unchecked": 2, "accepted": 3}
OBJECT_HEADER = [
    "object", "verdict", "right [%]", "agree", "1 sigma [mm]", "[deg]", "in views [px]", "why",
]  # fmt: skip
MISSING_HEADER = ["not placed", "why"]
VIEW_HEADER = ["view", "what", "in words"]
NOISE_KEYS = ("noise_mm", "noise_deg")


def worst_first(result: Registered) -> list[ObjectPose]:
    """Return the objects, worst verdict first, then by the probability that they are right."""
    return sorted(
        result.scene.objects,
        key=lambda o: (
            WORST_FIRST[o.verdict],
            o.checks.get("probability", 0.0),
            o.checks.get("agree", 0.0),
            o.instance,
        ),
    )


def named(instance: int, obj_id: int, models: Mapping[int, ObjectModel]) -> str:
    """Return number and name of an instance; the name alone where it has no number."""
    name = models[obj_id].name if obj_id in models else f"object {obj_id}"
    return name if instance < 0 else f"{instance} {name}"


def object_rows(result: Registered, models: Mapping[int, ObjectModel]) -> Iterator[list[str]]:
    """Return the table of the objects, worst first; a dash is what is not known."""
    common = shared_reasons(result)
    for o in worst_first(result):
        mm, deg = sigmas(o.covariance, models.get(o.obj_id))
        px = [p[o.instance].sigma_px for p in result.seen.values() if o.instance in p]
        px = [x for x in px if np.isfinite(x)]
        why = [r for r in o.reasons if r not in common]
        if len(why) < len(o.reasons):
            why.append("see below")
        yield [
            named(o.instance, o.obj_id, models),
            o.verdict,
            _figure(100 * o.checks.get("probability", float("nan")), 1),
            _figure(o.checks.get("agree", float("nan")), 3),
            _figure(mm, 2),
            _figure(deg, 2),
            _figure(float(np.median(px)) if px else float("nan"), 2),
            "; ".join(why),
        ]


def shared_reasons(result: Registered) -> tuple[str, ...]:
    """Return reasons of several objects that are told once, as findings of the scene."""
    told = {r.words for r in result.remarks}
    counts = Counter(reason for o in result.scene.objects for reason in o.reasons)
    return tuple(reason for reason, n in counts.items() if n > 1 and reason in told)


def _figure(value: float, digits: int) -> str:
    """Return a number, or a dash for what is not known."""
    return f"{value:.{digits}f}" if np.isfinite(value) else "-"


def check_rows(
    objects: Sequence[ObjectPose], models: Mapping[int, ObjectModel]
) -> tuple[list[str], Rows]:
    """Return header and rows of every check: a row a check, a column an object."""
    checks = sorted({name for o in objects for name in o.checks})
    header = ["check", *[named(o.instance, o.obj_id, models) for o in objects]]
    rows = [
        [name, *[f"{o.checks[name]:.3g}" if name in o.checks else "-" for o in objects]]
        for name in checks
    ]
    return header, rows


def missing_rows(result: Registered, models: Mapping[int, ObjectModel]) -> Rows:
    """Return the table of what was not placed."""
    return [[named(n.instance, n.obj_id, models), n.reason] for n in result.not_placed]


def view_rows(result: Registered) -> Rows:
    """Return the table of what is wrong with views, and with the scene."""
    ordered = sorted(result.remarks, key=lambda r: (r.view is None, r.view or 0))
    return [
        ["scene" if r.view is None else str(r.view), r.kind.replace("_", " "), r.words]
        for r in ordered
    ]


def symmetry_lines(result: Registered) -> tuple[str, ...]:
    """Return a line per model whose symmetries matter here: found, or nearly there and doubted."""
    doubted = {
        o.obj_id for o in result.scene.objects if any("nearly symmetric" in r for r in o.reasons)
    }
    lines = {
        f"{o['name']}: {o['symmetry']}.": None
        for o in result.report.get("objects", [])
        if o.get("symmetry") and ("declares no" in o["symmetry"] or o["obj_id"] in doubted)
    }
    return tuple(lines)


def camera_line(result: Registered) -> str:
    """Return in one line what became of the cameras."""
    n = len(result.cameras.refined)
    found: dict[str, Any] = result.report.get("refinement", {})
    if "hand_eye_mm" not in found:
        few = "" if n == 0 else f" ({n} views)"
        return f"cameras were taken at their word{few}."
    each: list[dict[str, float]] = list(found.get("views", {}).values())
    mm, deg = (float(np.median([v[k] for v in each] or [0.0])) for k in ("shift_mm", "turn_deg"))
    together = f"{found['hand_eye_mm']:.2f} mm / {found['hand_eye_deg']:.2f} deg"
    line = (
        f"cameras moved by {together} together (hand-eye), {mm:.2f} mm / {deg:.2f} deg each "
        f"(median of {n} views)."
    )
    for name, still in found.get("fixed_cameras", {}).items():
        line += f" {name}, which stands still, by {still['shift_mm']:.2f} mm."
    if "common_sigma_mm" in found:
        line += (
            f" All objects may be off together by {found['common_sigma_mm']:.2f} mm / "
            f"{found['common_sigma_deg']:.2f} deg (1 sigma), each by itself by "
            f"{np.median(list(found['own_sigma_mm'].values()) or [0.0]):.2f} mm (median)."
        )
    return line


def odometry_line(result: Registered) -> str:
    """Return in one line what odometry says of the robot's poses; empty if it was not asked."""
    found: dict[str, Any] | None = result.report.get("kinematics")
    if not found:
        return ""
    # Not a number, and null once stored, where no pair could be aligned.
    mm, deg = (float(found[k]) if found[k] is not None else np.nan for k in NOISE_KEYS)
    noise = f"{_figure(mm, 1)} mm / {_figure(deg, 2)} deg a pair"
    if found["faults"]:
        return f"odometry from depth names {len(found['faults'])} faults (noise {noise})."
    return f"odometry from depth finds nothing gross against the robot's poses (noise {noise})."


def photograph_line(result: Registered) -> str:
    """Return in one line what the photograph of a single view said; empty where there is none."""
    found: dict[str, Any] = result.report.get("photograph") or {}
    if not found:
        return ""
    before, after = found["edge_px_before"], found["edge_px_after"]
    if not found["taken"]:
        return f"the photograph's edges settle nothing here ({before:.1f} px from the outlines)."
    u, v = found["beside_depth_px"]
    return (
        f"outlines lie {after:.2f} px from the photograph's edges (mean; {before:.2f} px by depth "
        f"alone); the photograph lies ({u:+.1f}, {v:+.1f}) px beside the depth."
    )


def depth_line(result: Registered) -> str:
    """Return in one line what was found of the depth camera; empty where nothing was."""
    found: dict[str, Any] = result.report.get("refinement", {})
    keys = ("depth_scale", "depth_scale_sigma", "depth_offset_per_m", "depth_offset_sigma_per_m")
    if not all(isinstance(found.get(k), float) for k in keys):
        return ""
    scale, scale_sd, offset, offset_sd = (float(found[k]) for k in keys)
    known: dict[str, Any] = result.report.get("asked", {}).get("depth_bias_taken_out", {})
    beyond = " beyond its calibration" if known.get("scale", 1.0) != 1.0 else ""
    return (
        f"depth bias found{beyond}: scale {100 * (scale - 1):+.3f} +- {100 * scale_sd:.3f} %, "
        f"offset {offset:+.4f} +- {offset_sd:.4f} 1/m."
    )


def table_line(result: Registered) -> str:
    """Return in one line what is known of the table."""
    plane = result.scene.plane
    if plane is None:
        why = str(result.report.get("plane", {}).get("reason", ""))
        return f"no table was found; poses are in world. {why}".strip()
    return f"table: RMS {1e3 * plane.rms_m:.2f} mm over {plane.inliers} points."


def summary_line(result: Registered) -> str:
    """Return how many objects have which verdict."""
    verdicts = [o.verdict for o in result.scene.objects]
    counts = [f"{verdicts.count(v)} {v}" for v in reversed(WORST_FIRST) if v in verdicts]
    if result.not_placed:
        counts.append(f"{len(result.not_placed)} not placed")
    return ", ".join(counts) or "nothing was found"


def places_line(result: Registered) -> str:
    """Return how many places were tried and rejected where nobody named the objects."""
    counts: Mapping[str, int] = result.report.get("rejected_places", {})
    if not counts:
        return ""
    return f"search: {sum(counts.values())} further places of {len(counts)} models were rejected."


def next_line(folder: Path, result: Registered) -> str:
    """Return what to do next."""
    if not result.is_usable:
        return (
            "next      look at the reasons above and at registration/register.html; a click helps "
            "most: --object ID@view3:640,360"
        )
    at = quote(str(folder))
    if result.not_placed or any(o.verdict != "accepted" for o in result.scene.objects):
        return f"next      realsim review {at}   (a person decides on what is not accepted)"
    return f"next      realsim school {at}   (or `realsim review` to look at it)"


def show_registered(
    folder: Path, result: Registered, models: Mapping[int, ObjectModel], console: Console
) -> None:
    """Print everything about a registration, worst first."""
    if result.scene.objects:
        title = f"Objects of {folder.resolve().name}: {summary_line(result)}"
        console.table(title, OBJECT_HEADER, object_rows(result, models))
    if result.not_placed:
        console.table("Not placed", MISSING_HEADER, missing_rows(result, models))
    if result.remarks:
        console.table("Views and scene", VIEW_HEADER, view_rows(result))
    lines = (
        table_line(result), camera_line(result), photograph_line(result), depth_line(result),
        odometry_line(result),
    )  # fmt: skip
    console.say(*filter(None, (*symmetry_lines(result), *lines, places_line(result))))
    console.say(next_line(folder, result))


def as_json(result: Registered, models: Mapping[int, ObjectModel]) -> dict[str, Any]:
    """Return what a program wants to know, as plain JSON values."""

    def of_object(o: ObjectPose) -> dict[str, Any]:
        mm, deg = sigmas(o.covariance, models.get(o.obj_id))
        return {
            "instance": o.instance,
            "obj_id": o.obj_id,
            "name": models[o.obj_id].name if o.obj_id in models else "",
            "verdict": o.verdict,
            "reasons": list(o.reasons),
            "probability": o.checks.get("probability"),
            "agree": o.checks.get("agree"),
            "sigma_mm": mm if np.isfinite(mm) else None,
            "sigma_deg": deg if np.isfinite(deg) else None,
            "T_world_obj": o.T_world_obj.tolist(),
        }

    return {
        "usable": result.is_usable,
        "objects": [of_object(o) for o in worst_first(result)],
        "not_placed": [
            {"instance": n.instance, "obj_id": n.obj_id, "reason": n.reason}
            for n in result.not_placed
        ],
        "findings": [asdict(r) for r in result.remarks],
        "cameras": camera_line(result),
        "common_sigma_mm": result.report.get("refinement", {}).get("common_sigma_mm"),
        "own_sigma_mm": result.report.get("refinement", {}).get("own_sigma_mm"),
        "common_sigma_deg": result.report.get("refinement", {}).get("common_sigma_deg"),
        "kinematics": json_value(result.report.get("kinematics")),
        "views": sorted(result.cameras.refined),
    }
