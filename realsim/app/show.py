"""What the stages found, as tables and notes on the console."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from realsim.app.console import Console
from realsim.app.stages import session_models
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
    for s in sets:
        if len(s) == 0:
            console.warn(f"{models[s.obj_id].name}: {why_no_grasp(s)}")


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


GRASP_HEADER = ["object", "tried", "reachable", "lifted", "all four", "good", "mean score"]


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
            ]
        )
    return rows
