"""The labels of a session, whether they are those of its scene as reviewed, and new ones if not."""

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.app.console import Console
from realsim.app.stages import judged_scene, note, registered_views, require_sound, session_models
from realsim.many import Workers
from realsim.records import GraspSet, ObjectPose, Scene
from realsim.store import SessionStore, provenance
from realsim.store.cameras import open_cameras
from realsim.store.results import grasps_on
from realsim.untrusted.own_json import to_json

if TYPE_CHECKING:
    from realsim_sim_bridge.annotation.annotate import AnnotationSummary

OBJECTS_FILE = "annotations/objects.json"
MADE_FROM = (
    "rgb/*", "depth/*", "registration/scene.json", "registration/cameras.json", "models/*",
    "review/journal.jsonl", *(GRASPS := ("grasps/*.npz",)),
)  # fmt: skip
"""Files of a session that its labels are made of."""
SAME = 1e-9
"""Greatest difference of the numbers of two poses that are one."""


def annotate_session(
    store: SessionStore,
    console: Console,
    *,
    maps: str = "",
    workers: Workers = 1,
    check_depth: bool = True,
) -> "AnnotationSummary":
    """Write masks, poses, visibility and grasps of every frame that the objects are registered in.

    Frames of the session's further cameras (`store.cameras`) get the same scene; the summary is of
    the camera in the hand.

    Args:
        store: the session.
        console: where progress is shown.
        maps: 'all', 'none' or a list of maps; '' = instances, exact depth, and what is there:
            a map that somebody made is made anew, not lost.
        workers: who computes frames.
        check_depth: whether what the measured depth shows in front of an object leaves its mask.

    Raises:
        InputError: the session has not been registered, or there is no such map.
    """
    from realsim.store import load_grasps
    from realsim_sim_bridge.annotation.annotate import annotate
    from realsim_sim_bridge.annotation.config import (
        DEFAULT_MAPS,
        MAPS,
        AnnotationConfig,
        OccluderConfig,
        checked_maps,
        maps_of,
    )
    from realsim_sim_bridge.synthetic.scene import load_surroundings
    from realsim_sim_bridge.synthetic.write import exact_annotation

    there = (name for name in MAPS if any(store.path(f"labels/{name}").glob("*.png")))
    chosen = maps_of(maps) if maps else checked_maps((*DEFAULT_MAPS, *there))
    config = AnnotationConfig(maps=chosen, occluder=OccluderConfig(is_on=check_depth))
    surroundings = load_surroundings(store)
    if surroundings is not None:  # a synthetic session: everything is known
        config = exact_annotation(chosen)
    damaged = require_sound(store)
    scene = judged_scene(store)
    models = session_models(store, console)
    sets = load_grasps(store)
    grasps = grasps_of_scene(store, scene, sets, console)
    cameras = {name: c for name, c in open_cameras(store).items() if _is_placed(c)}
    wrong = {name: require_sound(camera) for name, camera in cameras.items()}

    def write(words: str, of: SessionStore, broken: list[str]) -> "AnnotationSummary":
        only = registered_views(of)
        with console.stage("annotate", f"{len(only)} frames{words}") as tick:
            return annotate(
                of, scene, models, grasps, config,
                only=only, progress=tick, workers=workers, surroundings=surroundings,
                damaged=broken,
            )  # fmt: skip

    for name, camera in cameras.items():
        write(f" of {name}", camera, wrong[name])
    summary = write("", store, damaged)
    asked = {"maps": ",".join(chosen) or "none", "check_depth": check_depth}
    note(store, "annotate", console, request=asked, config=config, inputs=MADE_FROM)
    return summary


def _is_placed(store: SessionStore) -> bool:
    """Return whether it is known where a further camera stands, in all of its views."""
    session = store.session
    return 0 < len(session.views) == len(session.Ts_world_cam)


def is_annotated(store: SessionStore) -> bool:
    """Return whether the session has labels of its own."""
    return store.has(OBJECTS_FILE)


def what_is_stale(store: SessionStore) -> str:
    """Return in which way the labels differ from the reviewed scene; '' = they do not."""
    for name, camera in open_cameras(store).items():
        if _is_placed(camera) and not is_annotated(camera):
            return f"camera {name} has none"
    labelled: dict[int, dict[str, Any]] = {
        row["instance"]: row for row in store.read_json(OBJECTS_FILE)["objects"]
    }
    for placed in judged_scene(store).objects:
        why = _difference(placed, labelled.pop(placed.instance, None))
        if why:
            return f"instance {placed.instance} {why}"
    if labelled:
        return f"instance {min(labelled)} is in the labels and no more in the scene"
    views = set(registered_views(store))
    there = {int(p.stem) for p in store.path("annotations").glob("[0-9]*.json")}
    if there != views:
        return f"view {min(there ^ views)} is labelled and left out, or the other way round"
    of_view = (_other_camera(s) for s in (store, *filter(_is_placed, open_cameras(store).values())))
    return next(filter(None, of_view), "")


def _other_camera(store: SessionStore) -> str:
    """Return which view's labels were made with another camera than the session has; '' = none."""
    lens = to_json(store.session.intrinsics)
    for view in store.session.views:
        path = f"annotations/{view.index:06d}.json"
        if not store.has(path) or view.T_world_cam is None:
            continue
        label = store.read_json(path)
        if label["camera"] != lens:
            return f"view {view.index} was labelled with another lens"
        if np.abs(np.array(label["T_world_cam"]) - view.T_world_cam).max() > SAME:
            return f"view {view.index} was labelled with its camera elsewhere"
    return ""


def other_grasps_shown(store: SessionStore) -> str:
    """Return what labelled frames show instead of the present grasps; '' = these, or no labels."""
    record = provenance.file_of("annotate")  # `realsim generate` writes none, and tries no grasps
    noted: dict[str, str] = store.read_json(record)["inputs"] if store.has(record) else {}
    was = {name: sha256 for name, sha256 in noted.items() if name.startswith("grasps/")}
    if not store.path("grasps/views").is_dir() or was == provenance.inputs_of(store, GRASPS):
        return ""
    return "still show the grasps of before" if was else "show no grasps yet"


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
    summary = annotate_session(store, console, maps=",".join(maps) or "none")
    if summary.left_out:
        console.say(f"note: {summary.notes[0]}")
    return True


def grasps_of_scene(
    store: SessionStore, scene: Scene, sets: list[GraspSet], console: Console
) -> list[GraspSet]:
    """Return the grasps of objects that are still in the scene; of others it is told."""
    kept = grasps_on(scene, sets)
    gone = [str(g.instance) for g in sets if g not in kept]
    if gone:
        console.warn(
            f"grasps of instance {', '.join(gone)} are left out: they were tried on an object that "
            f"is another, or no more there. `realsim school {store.folder} --restart` tries anew."
        )
    return kept
