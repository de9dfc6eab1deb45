"""What the stages found, as tables and notes on the console."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from realsim.app.console import Console
from realsim.app.stages import session_models
from realsim.formats.grasps.scene_grasps import labelled
from realsim.records import GraspSet, ObjectModel, Scene
from realsim.store import SessionStore


def show_scene(store: SessionStore, scene: Scene, console: Console) -> None:
    """Print what was registered, worst first, what was not, and what to do next.

    What only the session knows (pixels, cameras, findings) is left out where its scene is another.
    """
    from realsim.app.register.results import REPORT_FILE, load_registered, stand_alone
    from realsim.app.register.tables import show_registered

    stored = load_registered(store) if store.has(REPORT_FILE) else None
    known = stored is not None and stored.scene.name == scene.name
    result = replace(stored, scene=scene) if stored is not None and known else stand_alone(scene)
    show_registered(store.folder, result, session_models(store), console)


def show_grasps(store: SessionStore, sets: Sequence[GraspSet], console: Console) -> None:
    """Print the outcome of the Robot School per object."""
    models = session_models(store)
    console.table("Robot School", GRASP_HEADER, grasp_rows(sets, models))
    if line := p_hold_line(sets):
        console.say(line)
    for s in sets:
        if len(s) == 0:
            console.warn(f"{models[s.obj_id].name}: {why_no_grasp(s)}")


def p_hold_line(sets: Sequence[GraspSet]) -> str:
    """Return in one line how p_hold is distributed; empty where no set has one."""
    from realsim_sim_bridge.school.measure_statistics import p_hold_spread

    spread = p_hold_spread(sets)
    return "" if spread is None else spread.in_words


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


def _spread(s: GraspSet) -> str:
    """Return below which p_hold a tenth, half and nine tenths of the reached grasps are."""
    known = s.labels[labelled(s)]
    if s.label != "p_hold" or len(known) == 0:
        return "-"
    return ", ".join(f"{v:.2f}" for v in np.percentile(known, (10, 50, 90)))


GRASP_HEADER = [
    "object", "tried", "reachable", "lifted", "all four", "good", "mean score",
    "p_hold: tenth, median, ninth tenth",
]  # fmt: skip


def grasp_rows(sets: Sequence[GraspSet], models: Mapping[int, ObjectModel]) -> list[list[str]]:
    """Return the rows of the Robot School's table."""
    rows: list[list[str]] = []
    for s in sets:
        tried = np.isfinite(s.scores)
        mean = f"{np.mean(s.scores[tried]):.2f}" if tried.any() else "-"
        rows.append(
            [
                f"{s.instance} {models[s.obj_id].name}",
                str(int(tried.sum())),
                str(int(s.reachable.sum())),
                str(int(np.sum(s.base_scores[tried] >= 0.5))),
                str(int(np.sum(s.base_scores[tried] >= 1.0))),
                str(int(s.good.sum())),
                mean,
                _spread(s),
            ]
        )
    return rows
