"""The stages of the loop as they run on a session: read what is there, compute, write, show.

Each stage takes its input from the session's folder and leaves its result there, so that the
stages can be run one by one, by the demo, or again after an interruption.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.app.console import Console
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import GraspSet, HandEye, ObjectModel, ObjectPose, Scene
from realsim.store import SessionStore

if TYPE_CHECKING:
    from realsim.registration.register import RegistrationConfig
    from realsim_sim_bridge.transfer import TransferSummary

BOARD_VIEWS = "calibration/capture"
"""Where in a session the views of the tag board lie: a session of their own."""
REGISTRATION_VIEWS = 48
"""At most so many views enter the registration, spread evenly: more cost memory, not accuracy,
as long as a constant hand-eye error limits the result (facts: 0.40 mm at 32, 0.29 mm at 256)."""


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
    if not (folder / "session.json").is_file():
        inner = sorted(p.parent.name for p in folder.glob("*/session.json"))
        hint = f" Did you mean {', '.join(str(folder / n) for n in inner)}?" if inner else ""
        raise InputError(f"'{folder}' holds no session.json, so it is not a session.{hint}")
    return SessionStore.open(folder)


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
    return path.is_file() and json.loads(path.read_text()).get("key") == key


def mark_current(store: SessionStore, stage: str, key: str) -> None:
    """Note that this stage has been done with these inputs."""
    store.write_json(f"stages/{stage}.json", {"key": key})


def calibrate_session(store: SessionStore, console: Console) -> HandEye:
    """Calibrate the hand-eye from the board views and place every camera of the session.

    Raises:
        InputError: there are no board views, or no calibration/board.json.
        DegenerateError: the views do not determine the hand-eye.
    """
    from realsim.store import load_board, load_hand_eye, save_hand_eye
    from realsim_calibration import BoardView, calibrate_hand_eye, detect_tags

    folder = store.folder / BOARD_VIEWS
    if not (folder / "session.json").is_file():
        raise InputError(
            f"session '{store.folder}' has no board views: {folder} is missing. Capture the tag "
            "board first, or place the cameras by importing a calibration."
        )
    views_store = SessionStore.open(folder)
    board = load_board(store)
    views = views_store.session.views
    key = content_key(
        folder / "robot.jsonl", store.folder / "calibration/board.json", folder / "session.json"
    )
    with console.stage("calibrate", f"{len(views)} board views") as tick:
        if is_current(store, "calibrate", key):
            hand_eye = load_hand_eye(store)
        else:
            seen: list[BoardView] = []
            for k, view in enumerate(views):
                if view.T_base_ee is None:
                    raise InputError(f"board view {view.index} has no robot pose.")
                found = detect_tags(views_store.rgb(view.index), board)
                seen.append(BoardView(index=view.index, T_base_ee=view.T_base_ee, detections=found))
                tick(k + 1, len(views))
            hand_eye = calibrate_hand_eye(seen, board, views_store.session.intrinsics)
            save_hand_eye(store, hand_eye)
        place_cameras(store, hand_eye)
        mark_current(store, "calibrate", key)
    return hand_eye


def place_cameras(store: SessionStore, hand_eye: HandEye) -> None:
    """Write T_world_cam = T_base_ee @ T_ee_cam for every view that has a robot pose."""
    cameras = {
        v.index: v.T_base_ee @ hand_eye.T_ee_cam
        for v in store.session.views
        if v.T_base_ee is not None
    }
    store.set_cameras(hand_eye.intrinsics, cameras)


def save_starts(store: SessionStore, starts: Sequence[ObjectPose], source: str) -> None:
    """Write the rough poses that registration starts from."""
    rows = [
        {"obj_id": s.obj_id, "instance": s.instance, "T_world_obj": s.T_world_obj.tolist()}
        for s in starts
    ]
    store.write_json("registration/starts.json", {"source": source, "starts": rows})


def load_starts(store: SessionStore) -> list[ObjectPose]:
    """Read the rough poses that registration starts from.

    Raises:
        InputError: there are none.
    """
    if not (store.folder / "registration/starts.json").is_file():
        raise InputError(
            f"session '{store.folder}' has no registration/starts.json: registration needs a rough "
            "pose (within about 2 cm and 20 degrees) for every object."
        )
    return [
        ObjectPose(
            obj_id=row["obj_id"],
            instance=row["instance"],
            T_world_obj=np.array(row["T_world_obj"]),
        )
        for row in store.read_json("registration/starts.json")["starts"]
    ]


def session_models(store: SessionStore) -> dict[int, ObjectModel]:
    """Read the object models of a session."""
    from realsim.formats.bop_models import load_models

    return load_models(store.folder / "models")


def register_session(store: SessionStore, console: Console) -> Scene:
    """Register every object from its rough start in the views of a session.

    Raises:
        InputError: no calibrated camera poses, no starts, or an object without a mesh.
    """
    from realsim.registration.register import DepthFrame, register_scene
    from realsim.store import load_scene, save_scene

    starts, models = load_starts(store), session_models(store)
    config = _registration_config(store)
    views = [v for v in store.session.views if v.T_world_cam is not None]
    if not views:
        raise InputError(
            f"no view of session '{store.folder}' has a camera pose yet: run "
            f"`realsim calibrate {store.folder}` first."
        )
    pick = np.unique(np.linspace(0, len(views) - 1, REGISTRATION_VIEWS).round().astype(int))
    chosen = [views[k] for k in pick]
    key = content_key(
        store.folder / "scene_camera.json", store.folder / "registration/starts.json",
        *sorted((store.folder / "models").iterdir()), asdict(config), [v.index for v in chosen],
    )  # fmt: skip
    with console.stage("register", f"{len(starts)} objects, {len(chosen)} views") as tick:
        if is_current(store, "register", key):
            return load_scene(store)
        frames = [
            DepthFrame(index=v.index, depth_m=store.depth_m(v.index), T_world_cam=v.T_world_cam)
            for v in chosen
            if v.T_world_cam is not None
        ]
        up = store.extra.get("gravity_up_world")
        result = register_scene(
            store.session.name, store.session.intrinsics, frames, models, starts,
            config,
            gravity_up_world=None if up is None else np.array(up), progress=tick,
        )  # fmt: skip
        save_scene(store, result.scene)
        save_scene(store, result.single_view, "registration/single_view.json")
        store.write_json("registration/report.json", result.report)
        mark_current(store, "register", key)
    return result.scene


def _registration_config(store: SessionStore) -> "RegistrationConfig":
    """Return the defaults, with the hand-eye's own uncertainty in the objects' covariance.

    An error of the hand-eye moves every object alike; the depth of one session cannot show it.
    """
    from realsim.registration.register import RegistrationConfig
    from realsim.store import load_hand_eye

    config = RegistrationConfig()
    if not store.has("calibration/hand_eye.json"):
        return config
    hand_eye, c = load_hand_eye(store), config.covariance
    covariance = replace(
        c,
        systematic_translation_m=float(
            np.hypot(c.systematic_translation_m, hand_eye.sigma_mm / 1e3)
        ),
        systematic_rotation_deg=float(np.hypot(c.systematic_rotation_deg, hand_eye.sigma_deg)),
    )
    return replace(config, covariance=covariance)


def judged_scene(store: SessionStore) -> Scene:
    """Return the registered scene with the reviewers' decisions in place of computed verdicts.

    Raises:
        InputError: the session has not been registered.
    """
    from realsim.review import replay, reviewed_scene
    from realsim.review.journal import JOURNAL_FILE, read
    from realsim.store import load_scene

    if not store.has("registration/scene.json"):
        raise InputError(
            f"session '{store.folder}' is not registered yet: run "
            f"`realsim register {store.folder}` first."
        )
    return reviewed_scene(load_scene(store), replay(read(store.path(JOURNAL_FILE)).entries))


def school_session(
    store: SessionStore,
    console: Console,
    *,
    grasps_per_object: int,
    seed: int = 0,
    workers: int = 2,
) -> list[GraspSet]:
    """Try grasps on every registered object in the Robot School and keep them in the session.

    Raises:
        InputError: the session has not been registered, or has no supporting plane.
    """
    from realsim.store import save_grasps
    from realsim_sim_bridge.school import SchoolConfig, run_school

    scene, models = judged_scene(store), session_models(store)
    config = SchoolConfig(max_candidates=grasps_per_object, seed=seed)
    with console.stage("school", f"up to {grasps_per_object} grasps an object") as tick:
        sets = run_school(
            scene, models, config, workers=workers, cache=store.folder / "grasps/cache",
            progress=tick,
        )  # fmt: skip
        stems = {save_grasps(store, grasp_set).stem for grasp_set in sets}
        for file in (store.folder / "grasps").glob("*.*"):
            if file.is_file() and file.stem not in stems:
                store.remove(f"grasps/{file.name}")  # of an object that has been rejected since
    return sets


def annotate_session(store: SessionStore, console: Console) -> "TransferSummary":
    """Write masks, poses, visibility and grasps of every frame.

    Raises:
        InputError: the session has not been registered.
    """
    from realsim.store import load_grasps
    from realsim_sim_bridge.transfer import annotate

    scene = judged_scene(store)
    with console.stage("annotate", f"{len(store.session.views)} frames") as tick:
        return annotate(
            store, scene, session_models(store), load_grasps(store.folder / "grasps"),
            progress=tick,
        )  # fmt: skip


def show_hand_eye(hand_eye: HandEye, console: Console) -> None:
    """Print the hand-eye and what speaks for it."""
    t, w = hand_eye.T_ee_cam[:3, 3] * 1e3, np.degrees(se3.log_so3(hand_eye.T_ee_cam[:3, :3]))
    rows = [
        ["camera in tool, translation [mm]", " ".join(f"{v:.2f}" for v in t)],
        ["camera in tool, rotation vector [deg]", " ".join(f"{v:.3f}" for v in w)],
        ["1 sigma (worst axis)", f"{hand_eye.sigma_mm:.3f} mm / {hand_eye.sigma_deg:.4f} deg"],
        ["reprojection of held-out views", f"{hand_eye.held_out_px:.3f} px"],
        ["views used / rejected", f"{len(hand_eye.view_indices)} / {len(hand_eye.rejected)}"],
    ]
    console.table("Hand-eye calibration", ["", "value"], rows)
    for index, reason in hand_eye.rejected:
        console.warn(f"board view {index} was not used: {reason}")


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
