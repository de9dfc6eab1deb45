"""What the stages found, as tables and notes on the console."""

from collections.abc import Mapping, Sequence

import numpy as np

from realsim.app.console import Console
from realsim.app.stages import session_models
from realsim.records import GraspSet, ObjectModel, Scene
from realsim.store import SessionStore


def show_scene(store: SessionStore, scene: Scene, console: Console) -> None:
    """Print what was registered, worst first, with the reasons for any doubt."""
    models = session_models(store)
    order = {"rejected": 0, "doubtful": 1, "unchecked": 2, "accepted": 3}
    rows: list[list[str]] = []
    for o in sorted(scene.objects, key=lambda o: (order[o.verdict], o.checks.get("agree", 0.0))):
        sigma = "-"
        if o.covariance is not None:
            sigma = f"{1e3 * np.sqrt(np.linalg.eigvalsh(o.covariance[3:, 3:])[-1]):.2f}"
        agree = o.checks.get("agree", float("nan"))
        rows.append([f"{o.instance} {models[o.obj_id].name}", o.verdict, f"{agree:.3f}", sigma,
                     "; ".join(o.reasons)])  # fmt: skip
    console.table(
        f"Objects of {scene.name}",
        ["object", "verdict", "agrees with depth", "sigma [mm]", "why"], rows,
    )  # fmt: skip


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
