"""The stages of the loop as they run on a session: read what is there, compute, write, show.

Each stage takes its input from the session's folder and leaves its result there, so that the
stages can be run one by one, by the demo, or again after an interruption.
"""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from realsim.app.console import Console
from realsim.errors import InputError
from realsim.records import GraspSet, HandEye, ObjectModel, ObjectPose, Scene
from realsim.store import SessionStore
from realsim.store.opening import require_header

if TYPE_CHECKING:
    from realsim_sim_bridge.annotation.annotate import AnnotationSummary

BOARD_VIEWS = "calibration/capture"
"""Where in a session the views of the tag board lie: a session of their own."""


def open_session(folder: Path) -> SessionStore:
    """Open a session, or say what is missing.

    Raises:
        InputError: the folder is not a session.
    """
    if not folder.is_dir():
        raise InputError(
            f"'{folder}' is not a folder; a session folder (one that holds session.json) is "
            "expected. `realsim demo` makes one in demo/session."
        )
    require_header(folder)
    if not (folder / "session.json").is_file():
        inner = sorted(p.parent.name for p in folder.glob("*/session.json"))
        hint = f" Did you mean {', '.join(str(folder / n) for n in inner)}?" if inner else ""
        raise InputError(
            f"'{folder}' holds no session.json, so it is not a session.{hint} Give a folder that "
            "`realsim demo` or `realsim upgrade` has filled, such as demo/session."
        )
    return SessionStore.open(folder)


def require_sound(store: SessionStore) -> list[str]:
    """Raise if what was captured is not what is on disk: a run refused is better than a view lost.

    Returns:
        Paths of files that are missing or changed and can be made again from what was captured.

    Raises:
        InputError: a photograph, a depth image or the list of views is missing or changed.
    """
    captured = ("rgb/", "depth/", "robot.jsonl")
    found = store.verify()
    faults = [f for f in found if f.path.startswith(captured)]
    if faults:
        named = "; ".join(f"{f.path} is {f.kind} ({f.found})" for f in faults[:3])
        more = f" and {len(faults) - 3} more" if len(faults) > 3 else ""
        raise InputError(
            f"session '{store.folder}' is not as it was captured: {named}{more}. Restore the files "
            "from a copy, or capture the views again; nothing was computed from what is left."
        )
    return [f.path for f in found]


def content_key(*parts: Any) -> str:
    """Return a hash of files (paths) and plain values: what a stage's result depends on."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, Path):
            digest.update(part.name.encode() + (part.read_bytes() if part.is_file() else b"-"))
        else:
            digest.update(json.dumps(part, sort_keys=True, default=str).encode())
    return digest.hexdigest()


def is_current(store: SessionStore, stage: str, key: str) -> bool:
    """Return whether this stage has already been done with these inputs."""
    path = store.folder / "stages" / f"{stage}.json"
    try:
        return path.is_file() and json.loads(path.read_text())["key"] == key
    except (ValueError, KeyError, TypeError):
        return False  # a damaged note is no note: the stage is done again


def mark_current(store: SessionStore, stage: str, key: str) -> None:
    """Note that this stage has been done with these inputs."""
    store.write_json(f"stages/{stage}.json", {"key": key})


def calibrate_session(store: SessionStore, console: Console) -> HandEye:
    """Calibrate the hand-eye from the board views and place every camera of the session.

    Raises:
        InputError: there are no board views, or no calibration/board.json.
        DegenerateError: the views do not determine the hand-eye.
    """
    from realsim.app.calibrate.board_views import read_board_views, write_results
    from realsim.store import load_hand_eye, save_hand_eye
    from realsim_calibration import calibrate_hand_eye_report

    folder = store.folder / BOARD_VIEWS
    if not (folder / "session.json").is_file():
        raise InputError(
            f"session '{store.folder}' has no board views: {folder} is missing. Capture the tag "
            "board first, or place the cameras by importing a calibration."
        )
    views_store = SessionStore.open(folder)
    require_sound(views_store)
    views = views_store.session.views
    key = content_key(
        folder / "robot.jsonl", store.folder / "calibration/board.json", folder / "session.json"
    )
    with console.stage("calibrate", f"{len(views)} board views") as tick:
        if is_current(store, "calibrate", key):
            hand_eye = load_hand_eye(store)
        else:
            seen, target, arm = read_board_views(store, views_store, tick)
            camera = views_store.session.intrinsics
            report = calibrate_hand_eye_report(seen, target, camera, arm=arm)
            hand_eye = report.hand_eye
            write_results(report, seen, store, views_store)
            save_hand_eye(store, hand_eye)
        place_cameras(store, hand_eye)
        mark_current(store, "calibrate", key)
    return hand_eye


def place_cameras(store: SessionStore, hand_eye: HandEye) -> None:
    """Write T_world_cam for every view that has a robot pose, robot errors corrected.

    Cameras that a registration has refined stay refined where the calibration says the same again.
    """
    from realsim.app.register.results import keep_refined

    cameras = {
        v.index: hand_eye.camera_poses(v.T_base_ee, v.joints)
        for v in store.session.views
        if v.T_base_ee is not None
    }
    store.set_cameras(hand_eye.intrinsics, keep_refined(store, cameras))


def save_starts(store: SessionStore, starts: Sequence[ObjectPose], source: str) -> None:
    """Write the rough poses that registration starts from."""
    rows = [
        {"obj_id": s.obj_id, "instance": s.instance, "T_world_obj": s.T_world_obj.tolist()}
        for s in starts
    ]
    store.write_json("registration/starts.json", {"source": source, "starts": rows})


_told: set[str] = set()
"""Notes on models that this process has told: the stages of a run read the same models."""


def session_models(store: SessionStore, console: Console | None = None) -> dict[int, ObjectModel]:
    """Read the object models of a session, symmetric as its reviewers marked them.

    What is missing of their looks is told once.

    Args:
        store: the session.
        console: where that is told; None = the terminal's standard error.
    """
    from rich.markup import escape

    from realsim.app.reviewed import review_of
    from realsim.formats.bop.models import load_models
    from realsim.review.symmetric import marked_models

    notes: list[str] = []
    models = marked_models(load_models(store.folder / "models", notes=notes), review_of(store))
    for note in notes:
        if note not in _told:
            _told.add(note)
            (console or Console(quiet=True)).warn(escape(note))
    return models


def take_models(store: SessionStore, library: Path, obj_ids: Sequence[int]) -> tuple[int, ...]:
    """Copy the models that a session needs and has not out of a library; return which.

    The session then has everything it needs in its own folder, whatever becomes of the library.

    Raises:
        InputError: no library there, or it has not all of them.
    """
    from realsim.models.library_reading import LibraryReader
    from realsim.models.library_session import copy_models

    return copy_models(LibraryReader.open(library), obj_ids, store.folder / "models")


def judged_scene(store: SessionStore) -> Scene:
    """Return the registered scene as its reviewers left it: their poses, their verdicts.

    A registration that was killed while it was put in place is put in place first.

    Raises:
        InputError: the session has not been registered.
    """
    from realsim.app.register.files import finish_interrupted
    from realsim.app.reviewed import review_of
    from realsim.review import reviewed_scene
    from realsim.store import load_scene

    finish_interrupted(store)
    if not store.has("registration/scene.json"):
        raise InputError(
            f"session '{store.folder}' is not registered yet: run "
            f"`realsim register {store.folder}` first."
        )
    return reviewed_scene(load_scene(store), review_of(store))


def registered_views(store: SessionStore) -> list[int] | None:
    """Return the views in which the objects are known; None = all.

    Those that took part in the registration, but for what a reviewer excluded since.
    """
    from realsim.app.register.results import load_cameras
    from realsim.app.reviewed import review_of

    record = load_cameras(store)
    excluded = review_of(store).excluded_views()
    if record is not None and record.refined:
        return sorted(set(record.refined) - set(excluded))
    if not excluded:
        return None
    return [v.index for v in store.session.views if v.index not in excluded]


def school_session(
    store: SessionStore,
    console: Console,
    *,
    grasps_per_object: int,
    seed: int = 0,
    workers: int = 2,
) -> list[GraspSet]:
    """Try grasps on every registered object in the Robot School and keep them in the session.

    Models that came from a library bring their convex parts, mass, centre of mass and inertia; they
    are taken as long as the session's mesh is the one they were computed of. Of other models the
    School makes the parts itself, and takes the mass from the mesh and its density.

    Raises:
        InputError: the session has not been registered, or has no supporting plane, or holds
            unfinished results of other parameters.
    """
    from realsim.app.school.inputs import SchoolRequest
    from realsim.app.school.run import run_in_session

    request = SchoolRequest(
        grasps=grasps_per_object, seed=seed, workers=workers, restart="finished"
    )
    return run_in_session(store, request, console).sets


def annotate_session(
    store: SessionStore,
    console: Console,
    *,
    maps: str = "",
    workers: int = 1,
    check_depth: bool = True,
) -> "AnnotationSummary":
    """Write masks, poses, visibility and grasps of every frame that the objects are registered in.

    Args:
        store: the session.
        console: where progress is shown.
        maps: 'all', 'none' or a list of maps; '' = instances and exact depth.
        workers: processes that compute frames.
        check_depth: whether what the measured depth shows in front of an object leaves its mask.

    Raises:
        InputError: the session has not been registered, or there is no such map.
    """
    from realsim.app.annotate.current import grasps_of_scene
    from realsim.store import load_grasps
    from realsim_sim_bridge.annotation.annotate import annotate
    from realsim_sim_bridge.annotation.config import (
        DEFAULT_MAPS,
        AnnotationConfig,
        OccluderConfig,
        maps_of,
    )
    from realsim_sim_bridge.synthetic.labelling import exact_annotation
    from realsim_sim_bridge.synthetic.surroundings import load_surroundings

    chosen = maps_of(maps) if maps else DEFAULT_MAPS
    config = AnnotationConfig(maps=chosen, occluder=OccluderConfig(is_on=check_depth))
    surroundings = load_surroundings(store)
    if surroundings is not None:  # a synthetic session: everything is known
        config = exact_annotation(chosen)
    damaged = require_sound(store)
    scene = judged_scene(store)
    models = session_models(store, console)
    sets = load_grasps(store.folder / "grasps")
    grasps = grasps_of_scene(store, scene, sets, console)
    only = registered_views(store)
    n = len(store.session.views) if only is None else len(only)
    with console.stage("annotate", f"{n} frames") as tick:
        return annotate(
            store, scene, models, grasps, config,
            only=only, progress=tick, workers=workers, surroundings=surroundings, damaged=damaged,
        )  # fmt: skip
