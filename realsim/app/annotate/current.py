"""Whether a session's labels are those of its scene as it is reviewed, and new ones if not."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from realsim.app.console import Console
from realsim.app.stages import annotate_session, judged_scene, registered_views
from realsim.records import GraspSet, ObjectPose, Scene
from realsim.store import SessionStore

OBJECTS_FILE = "annotations/objects.json"
SAME = 1e-9
"""Greatest difference of the numbers of two poses that are one."""


def is_annotated(store: SessionStore) -> bool:
    """Return whether the session has labels of its own."""
    return store.has(OBJECTS_FILE)


def what_is_stale(store: SessionStore) -> str:
    """Return in which way the labels differ from the reviewed scene; '' = they do not."""
    labelled: dict[int, dict[str, Any]] = {
        row["instance"]: row for row in store.read_json(OBJECTS_FILE)["objects"]
    }
    for placed in judged_scene(store).objects:
        why = _difference(placed, labelled.pop(placed.instance, None))
        if why:
            return f"instance {placed.instance} {why}"
    if labelled:
        return f"instance {min(labelled)} is in the labels and no more in the scene"
    known = registered_views(store)
    views = {v.index for v in store.session.views} if known is None else set(known)
    there = {int(p.stem) for p in store.path("annotations").glob("[0-9]*.json")}
    if there != views:
        return f"view {min(there ^ views)} is labelled and left out, or the other way round"
    return ""


def _difference(placed: ObjectPose, row: Mapping[str, Any] | None) -> str:
    if row is None:
        return "is not in the labels"
    if row["obj_id"] != placed.obj_id:
        return f"is object {placed.obj_id}, in the labels object {row['obj_id']}"
    if row["verdict"] != placed.verdict:
        return f"is {placed.verdict}, in the labels {row['verdict']}"
    moved = np.abs(np.array(row["T_world_obj"]) - placed.T_world_obj).max() > SAME
    return "was moved" if moved else ""


def refresh_labels(store: SessionStore, console: Console) -> bool:
    """Compute the labels anew where a review or a registration has changed the scene since.

    The same maps as before are written. A session that was never labelled is left alone.

    Returns:
        Whether anything was computed.
    """
    if not is_annotated(store) or not store.has("registration/scene.json"):
        return False
    why = what_is_stale(store)
    if not why:
        return False
    console.say(f"the labels of {store.folder} are older than its scene ({why}): computed anew.")
    parts = sorted(store.path("annotations").glob("[0-9]*.json"))
    maps = json.loads(parts[0].read_text())["maps"] if parts else []
    annotate_session(store, console, maps=",".join(maps) or "none")
    return True


def grasps_of_scene(
    store: SessionStore, scene: Scene, sets: list[GraspSet], console: Console
) -> list[GraspSet]:
    """Return the grasps of objects that are still in the scene; of others it is told."""
    there = {o.instance: o.obj_id for o in scene.objects}
    kept = [g for g in sets if there.get(g.instance) == g.obj_id]
    gone = [str(g.instance) for g in sets if there.get(g.instance) != g.obj_id]
    if gone:
        console.warn(
            f"grasps of instance {', '.join(gone)} are left out: they were tried on an object that "
            f"is another, or no more there. `realsim school {store.folder} --restart` tries anew."
        )
    return kept
