"""What Robot School found, as rows of tables and as words: for the console and for the page."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from realsim.app.console import Console
from realsim.arrays import Array
from realsim.json_values import json_value
from realsim.records import STAGES, GraspSet, ObjectModel
from realsim.robots.hand import FRANKA

Rows = list[list[str]]
Names = Mapping[int, ObjectModel]

SCHOOL_HEADER = [
    "object", "candidates", "reachable", "closed", "lifted", "shaken", "swung", "good", "score",
    "p_hold", "margin", "agree [%]",
]  # fmt: skip
MEASURED = 3
"""Number of its last columns that are left out where nothing has been measured."""
FILTER_HEADER = [
    "object", "turned", "in the table", "in the object", "in a neighbour", "free", "kept",
]  # fmt: skip
_FILTERS = ("turned", "hand_in_table", "hand_in_object", "hand_in_neighbour", "free", "kept")
REASON_HEADER = ["why a grasp stopped", "grasps", "share [%]"]
MOST_REASONS = 12
"""Reasons of one table; the rest are one row."""


def named(grasps: GraspSet, models: Names) -> str:
    """Return number and name of the set's object."""
    model = models.get(grasps.obj_id)
    return f"{grasps.instance} {model.name if model else f'object {grasps.obj_id}'}"


def school_table(sets: Sequence[GraspSet], models: Names) -> tuple[list[str], Rows]:
    """Return header and rows: one an object, and all of them together; a dash is not measured."""
    rows = [[named(s, models), *_figures([s])] for s in sets]
    if len(sets) > 1:
        rows.append(["all", *_figures(sets)])
    first = len(SCHOOL_HEADER) - MEASURED
    kept = [k for k in range(len(SCHOOL_HEADER)) if k < first or any(r[k] != "-" for r in rows)]
    return [SCHOOL_HEADER[k] for k in kept], [[row[k] for k in kept] for row in rows]


def _figures(sets: Sequence[GraspSet]) -> list[str]:
    """Return the figures of a row of the school's table."""
    from realsim_sim_bridge.school.cross_check import agreement_of
    from realsim_sim_bridge.school.measure_statistics import p_hold_spread

    spread = p_hold_spread(sets)
    base = _joined(sets, lambda s: s.base_scores)
    passed = [int(np.sum(base >= (k + 1) / len(STAGES))) for k in range(len(STAGES))]
    scores = _joined(sets, lambda s: s.scores)
    margins = _joined(sets, lambda s: s.measures.get("margin", np.zeros(0)))
    engines = agreement_of(sets)
    return [
        str(sum(len(s) for s in sets)),
        str(sum(int(s.reachable.sum()) for s in sets)),
        *map(str, passed),
        str(sum(int(s.good.sum()) for s in sets)),
        _mean(scores),
        "-" if spread is None else f"{spread.mean:.2f}",
        _mean(margins),
        f"{100 * engines.agree / engines.count:.0f}" if engines.count else "-",
    ]


def _joined(sets: Sequence[GraspSet], of: Callable[[GraspSet], Array]) -> Array:
    """Return one column of all sets (N,)."""
    return np.concatenate([np.zeros(0), *(of(s) for s in sets)])


def _mean(values: Array) -> str:
    """Return the mean of what was measured, or a dash."""
    known = values[~np.isnan(values)]
    return f"{known.mean():.2f}" if len(known) else "-"


def filter_rows(sets: Sequence[GraspSet], models: Names) -> Rows:
    """Return what each filter took of the candidates of each object."""
    counts = [(s, s.parameters.get("counts") or {}) for s in sets]
    return [[named(s, models), *[str(c.get(k, "-")) for k in _FILTERS]] for s, c in counts]


def reasons(sets: Sequence[GraspSet]) -> dict[str, int]:
    """Return how many grasps stopped for which reason, most first.

    Figures within a reason ("slipped 21.3 mm") do not make it another one.
    """
    counts = Counter(_kind(f) for s in sets for f in s.failures if f)
    return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))


def _kind(failure: str) -> str:
    """Return a failure without its figures."""
    stage, mark, why = failure.partition(": ")
    if mark and stage in STAGES and "slipped" in why and "turned" in why:
        return f"{stage}: the object slipped or turned too far"
    if failure.endswith("not simulated"):
        return f"{stage}: the object's weight is more than the grasp bears"
    return re.sub(r":[^:]*\d+\.\d+.*", "", failure)


def reason_rows(sets: Sequence[GraspSet]) -> Rows:
    """Return the table of why grasps stopped."""
    found = list(reasons(sets).items())
    total = max(1, sum(len(s) for s in sets))
    shown, rest = found[:MOST_REASONS], found[MOST_REASONS:]
    rows = [[why, str(n), f"{100 * n / total:.1f}"] for why, n in shown]
    if rest:
        others = sum(n for _, n in rest)
        rows.append([f"other reasons ({len(rest)})", str(others), f"{100 * others / total:.1f}"])
    return rows


LEVELS = (("least_friction", "frictions", "friction"), ("least_force_n", "forces_n", "force [N]"))
"""Measure of a sweep, the config's name of its levels, and what is swept."""


def survivors(s: GraspSet, measure: str, levels_of: str) -> tuple[Array, Array]:
    """Return the levels (L,) of a sweep, descending, and the share (L,) [%] of grasps that pass.

    Both are empty where the set was not swept.
    """
    least = s.measures.get(measure, np.zeros(0))
    least = least[~np.isnan(least)]
    if len(least) == 0:
        return np.zeros(0), np.zeros(0)
    sweep: dict[str, Any] = (s.parameters.get("config") or {}).get("sweep") or {}
    known = np.array(sweep.get(levels_of, []), dtype=np.float64)
    levels = np.unique(np.concatenate([known, least[np.isfinite(least)]]))[::-1]
    return levels, np.array([100.0 * np.mean(least <= v) for v in levels])


def level_tables(sets: Sequence[GraspSet], models: Names) -> Iterator[tuple[str, list[str], Rows]]:
    """Return for each swept quantity its name, and a table of the share [%] that pass by level."""
    for measure, levels_of, what in LEVELS:
        found = [(s, *survivors(s, measure, levels_of)) for s in sets]
        found = [(s, levels, share) for s, levels, share in found if len(levels)]
        if not found:
            continue
        every = np.unique(np.concatenate([levels for _, levels, _ in found]))[::-1]
        rows: Rows = []
        for s, levels, share in found:
            at = dict(zip(levels.tolist(), share.tolist(), strict=True))
            cells = [f"{at[v]:.0f}" if v in at else "-" for v in every.tolist()]
            rows.append([named(s, models), *cells])
        yield (what, ["object", *[f"{v:g}" for v in every]], rows)


def agreement_line(sets: Sequence[GraspSet]) -> str:
    """Return in one line how far two engines agree; empty where only one was asked."""
    from realsim_sim_bridge.school.cross_check import agreement_of

    found = agreement_of(sets)
    if found.count == 0:
        return ""
    low, high = found.interval
    return (
        f"Two engines agree on held or lost for {100 * found.share:.1f} % of {found.count} grasps "
        f"(95 % interval {100 * low:.1f} to {100 * high:.1f}): {found.both_held} held by both, "
        f"{found.only_first} by the first alone, {found.only_second} by the second alone."
    )


def p_hold_line(sets: Sequence[GraspSet]) -> str:
    """Return in one line how p_hold is distributed; empty where no set has one.

    The shipped calibration is of real trials of Franka's hand: of other hands the line says so.
    """
    from realsim_sim_bridge.school.measure_statistics import p_hold_spread

    spread = p_hold_spread(sets)
    if spread is None:
        return ""
    shipped = [s for s in sets if not (s.parameters.get("config") or {}).get("calibration")]
    others = sorted({s.hand[0] for s in shipped} - {FRANKA})
    return spread.in_words + (
        f" It was calibrated on real trials of Franka's hand alone: for {', '.join(others)} it is "
        "an estimate, good for an order rather than as a share."
    ) * bool(others)


def setting_lines(sets: Sequence[GraspSet]) -> list[str]:
    """Return what the labels hang on, a line for each setting: engine, force, friction, density."""
    densities: dict[str, set[str]] = {}
    for s in sets:
        slip: dict[str, Any] = (s.parameters.get("config") or {}).get("slip") or {}
        physics: dict[str, Any] = slip.get("physics") or {}
        if physics:
            at = (
                f"{s.hand[0]}, {physics['force_n']:g} N a finger, friction {physics['friction']:g}"
                f"{_pads_of(physics)}{_engine_of(s)}"
            )
            densities.setdefault(at, set()).add(f"{s.parameters.get('density', float('nan')):g}")
    return [
        f"Labels hold at {at}, density {', '.join(sorted(d, key=float))} kg/m^3 where not weighed."
        for at, d in densities.items()
    ] + _stiffness_lines(sets)


def _pads_of(physics: Mapping[str, Any]) -> str:
    """Return the pads' stiffness in words; empty where the set does not say it."""
    stiffness = (physics.get("pads") or {}).get("pad_stiffness_n_per_m")
    return "" if stiffness is None else f", pads of {1e-3 * stiffness:g} kN/m"


def _stiffness_lines(sets: Sequence[GraspSet]) -> list[str]:
    """Return in a line how many good grasps a sweep found to hang on the pads' stiffness."""
    share = _joined(sets, lambda s: s.measures.get("stiffness_share", np.full(len(s), np.nan)))
    passing = share[(_joined(sets, lambda s: s.scores) >= 1.0) & ~np.isnan(share)]
    if len(passing) == 0:
        return []
    always = int(np.sum(passing >= 1.0))
    return [
        f"Of {len(passing)} grasps that pass all stages {always} pass with pads of every stiffness "
        "that the sweep tried."
    ]


def _engine_of(s: GraspSet) -> str:
    """Return the engine as the set's versions name it; empty where they do not."""
    versions: dict[str, Any] = s.parameters.get("versions") or {}
    for name in ("mujoco", "pybullet"):
        if name in versions:
            return f", engine {name} {versions[name]}"
    return ""


def why_no_grasp(grasps: GraspSet) -> str:
    """Return in words what took all candidates of an object."""
    counts = grasps.parameters.get("counts") or {}
    if not counts.get("turned"):
        return f"not tried: {grasps.parameters.get('not_tried') or 'no antipodal pair fits'}"
    return (
        f"no candidate is free: of {counts['turned']}, {counts['hand_in_table']} would touch the "
        f"table, {counts['hand_in_object']} the object itself, {counts['hand_in_neighbour']} a "
        "neighbour"
    )


def not_tried(sets: Sequence[GraspSet], models: Names) -> Iterator[str]:
    """Return in words, of each object without tried grasps, why there are none."""
    for s in sets:
        if len(s) == 0:
            yield f"{named(s, models)}: {why_no_grasp(s)}"
        elif s.parameters.get("not_tried"):
            yield f"{named(s, models)}: not tried: {s.parameters['not_tried']}"


FAT, THIN = 1.10, 0.90
"""Convex parts of a larger or smaller share of the mesh's volume are named."""


def doubts(sets: Sequence[GraspSet], models: Names) -> Iterator[str]:
    """Return in words, of each object, what makes its labels doubtful: its shape, its volume."""
    for s in sets:
        convex: dict[str, Any] = s.parameters.get("convex") or {}
        ratio = float(convex.get("volume_ratio", 1.0))
        if ratio > FAT:
            yield (
                f"{named(s, models)}: its convex parts are {ratio:.2f} times as large as its mesh, "
                "so hollows are smaller and walls thicker than they are"
            )
        elif ratio < THIN:
            yield (
                f"{named(s, models)}: its convex parts are only {ratio:.2f} of its mesh: look for "
                "holes and inner walls, and repair it (`realsim scan import`)"
            )
        if s.parameters.get("watertight") is False:
            yield (
                f"{named(s, models)}: its mesh is not closed, so its mass is a guess: weigh it "
                "(`--weighed`) or repair it (`realsim scan import`)"
            )


SUMMARY_HEADER = ["property", "here", "in the paper"]


def show_school(sets: Sequence[GraspSet], models: Names, console: Console) -> None:
    """Print the outcome of a run."""
    console.table("Robot School", *school_table(sets, models))
    console.warn(*not_tried(sets, models), *doubts(sets, models))
    stopped = reason_rows(sets)
    if stopped:
        console.table("Why grasps stopped", REASON_HEADER, stopped)
    console.say(*filter(None, (*setting_lines(sets), agreement_line(sets), p_hold_line(sets))))


def as_json(sets: Sequence[GraspSet], models: Names) -> dict[str, Any]:
    """Return what a program wants to know, as plain JSON values."""
    from realsim.store.results import grasp_counts
    from realsim_sim_bridge.school.cross_check import agreement_of
    from realsim_sim_bridge.school.measure_statistics import p_hold_spread

    spread = p_hold_spread(sets)

    def of_set(s: GraspSet) -> dict[str, Any]:
        margins = s.measures.get("margin", np.zeros(0))
        scores = s.scores[~np.isnan(s.scores)]
        return {
            "instance": s.instance,
            "obj_id": s.obj_id,
            "name": named(s, models).partition(" ")[2],
            **grasp_counts(s),
            "mean_score": float(scores.mean()) if len(scores) else None,
            "mean_margin": float(np.nanmean(margins)) if np.isfinite(margins).any() else None,
            "not_tried": s.parameters.get("not_tried"),
            "filters": s.parameters.get("counts"),
        }

    found = agreement_of(sets)
    low, high = found.interval
    agree = {"count": found.count, "agree": found.agree, "share": found.share,
             "interval": [low, high]}  # fmt: skip
    return json_value(
        {
            "objects": [of_set(s) for s in sets],
            "reasons": reasons(sets),
            "agreement": agree if found.count else None,
            "p_hold": None if spread is None else asdict(spread),
            "settings": setting_lines(sets),
        }
    )
