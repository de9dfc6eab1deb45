"""Upgrade a BOP dataset: find the table, refine the poses, try grasps, write labels and pictures.

The dataset itself is only read. Every scene becomes a session (which is a BOP scene) under
OUT/SPLIT/SCENE, so that all later commands (`realsim review`, `realsim report`) work on it.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.app.console import Console
from realsim.app.stages import annotate_session, register_session, save_starts, school_session
from realsim.errors import InputError
from realsim.formats.bop import BopScene, BopSceneRef
from realsim.geometry import se3
from realsim.records import CaptureSession, GraspSet, ObjectModel, ObjectPose, Scene, View
from realsim.store import SessionStore

Array = NDArray[np.float64]
CAMERA_SPREAD_LIMIT_M = 0.010
"""Camera poses taken from the annotations of several objects may differ by so much, no more."""


@dataclass(frozen=True, kw_only=True, slots=True)
class UpgradeConfig:
    """How a dataset is upgraded."""

    start: str = "gt"
    """'gt' = the dataset's own annotations, else a folder name under keyframe_poses/."""
    scenes: tuple[int, ...] = ()
    """Scene numbers; none = all."""
    models: Path | None = None
    """Folder of the models, when it is not DATASET/models."""
    grasps_per_object: int = 60
    """Grasp candidates tried on each object, at most."""
    seed: int = 0
    """Seed of everything random."""
    workers: int = 2
    """Processes in the Robot School."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class UpgradedScene:
    """One scene after the upgrade."""

    store: SessionStore
    scene: Scene
    grasps: list[GraspSet]
    moved_mm: dict[int, float]
    """Distance of each object from its start [mm]."""
    moved_deg: dict[int, float]
    """Rotation of each object from its start, symmetries divided out [deg]."""
    notes: list[str]
    """What the user must know about this scene."""
    pictures: list[Path]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class UpgradeResult:
    """All scenes of an upgrade."""

    out: Path
    scenes: list[UpgradedScene]


def run_upgrade(config: UpgradeConfig, dataset: Path, out: Path, console: Console) -> UpgradeResult:
    """Upgrade the scenes of a BOP dataset into `out`.

    Raises:
        InputError: no dataset, no such scene, unwritable or foreign output, or broken content.
    """
    from threadpoolctl import threadpool_limits

    from realsim.formats.bop import find_scenes
    from realsim.formats.bop_models import load_models, save_models

    refs = find_scenes(dataset)
    if config.scenes:
        missing = set(config.scenes) - {r.scene_id for r in refs}
        if missing:
            raise InputError(
                f"scene {', '.join(map(str, sorted(missing)))} is not in '{dataset}'; it has "
                f"{', '.join(str(r.scene_id) for r in refs)}."
            )
        refs = [r for r in refs if r.scene_id in config.scenes]
    root = _dataset_root(refs[0])
    if out.resolve() == root.resolve() or root.resolve() in out.resolve().parents:
        raise InputError(
            f"--out '{out}' lies inside the dataset '{root}', which is only read; choose a folder "
            "outside it."
        )
    models = load_models(config.models or root / "models")
    _make_folder(out)
    save_models(out / "models", models)
    done: list[UpgradedScene] = []
    with threadpool_limits(limits=1):
        for ref in refs:
            console.say(f"scene {ref.scene_id} ({ref.folder.name})")
            done.append(_upgrade_scene(ref, root, models, config, out, console))
    return UpgradeResult(out=out, scenes=done)


def _dataset_root(ref: BopSceneRef) -> Path:
    """Return the folder that holds the splits (and usually the models)."""
    return ref.folder.parent.parent


def _make_folder(out: Path) -> None:
    """Make the output folder and prove that it can be written."""
    if out.exists() and not out.is_dir():
        raise InputError(f"--out '{out}' is a file; give a folder that may be made or filled.")
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe = out / ".write-probe.tmp"
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as error:
        raise InputError(
            f"--out '{out}' cannot be written ({error.strerror}); choose another folder or change "
            "its permissions."
        ) from error


def _upgrade_scene(
    ref: BopSceneRef,
    root: Path,
    models: dict[int, ObjectModel],
    config: UpgradeConfig,
    out: Path,
    console: Console,
) -> UpgradedScene:
    """Upgrade one scene, going on where an earlier run stopped."""
    from realsim.app.report import write_report
    from realsim.formats.bop import read_scene
    from realsim.formats.bop_models import save_models

    bop = read_scene(ref)
    annotations, notes = _start_poses(bop, root, models, config)
    Ts_world_cam = camera_poses(bop, annotations)
    store = _copy_views(bop, Ts_world_cam, out / ref.split / ref.folder.name)
    used = {obj for rows in annotations.values() for obj, _ in rows}
    absent = sorted(used - set(models))
    if absent:
        raise InputError(
            f"scene {ref.scene_id} names object {', '.join(map(str, absent))}, but the models "
            f"folder has no mesh for it; it has {', '.join(map(str, sorted(models)))}."
        )
    save_models(store.folder / "models", {k: models[k] for k in sorted(used)})
    starts = world_starts(annotations, Ts_world_cam)
    save_starts(store, starts, f"{config.start} of {ref.folder.name}")
    scene = register_session(store, console)
    notes += _registration_notes(store, bop)
    grasps = school_session(
        store, console, grasps_per_object=config.grasps_per_object, seed=config.seed,
        workers=config.workers,
    )  # fmt: skip
    annotate_session(store, console)
    with console.stage("report"):
        write_report(store, None, notes=notes)
    moved = {o.instance: moved_from_start(o, starts, models) for o in scene.objects}
    return UpgradedScene(
        store=store, scene=scene, grasps=grasps, notes=notes,
        moved_mm={k: v[0] for k, v in moved.items()},
        moved_deg={k: v[1] for k, v in moved.items()},
        pictures=sorted((store.folder / "reports").glob("*.png")),
    )  # fmt: skip


def _start_poses(
    bop: BopScene, root: Path, models: dict[int, ObjectModel], config: UpgradeConfig
) -> tuple[dict[int, list[tuple[int, Array]]], list[str]]:
    """Return {image: [(obj_id, T_cam_obj)]} to start from, and what must be said about it."""
    from realsim.formats.bop import read_keyframe_poses

    notes: list[str] = []
    if config.start == "gt":
        if not any(bop.ground_truth.values()):
            raise InputError(
                f"scene {bop.ref.scene_id} has no annotated object; nothing to start from. Give "
                "--start a folder of estimates under keyframe_poses/."
            )
        if bop.approximate:
            notes.append(
                f"its annotations come from {bop.ground_truth_file}, which calls itself "
                "approximate: they serve as a rough start only, and are not a reference."
            )
        rows = {k: [(a.obj_id, a.T_cam_obj) for a in v] for k, v in bop.ground_truth.items()}
        return rows, notes
    rows = {}
    for view in bop.session.views:
        found = read_keyframe_poses(root, bop.ref.scene_id, view.index, source=config.start)
        rows[view.index] = sorted(found.items())
    return rows, notes


def camera_poses(
    bop: BopScene, annotations: dict[int, list[tuple[int, Array]]]
) -> dict[int, Array]:
    """Return T_world_cam of every image: the dataset's own, or from objects that stand still.

    Without camera poses in the dataset, world is the first image's camera, and the others follow
    from the objects seen in both images: T_first_cam = T_first_obj @ T_obj_cam, averaged.

    Raises:
        InputError: the objects of two images do not agree on how the camera moved.
    """
    if bop.Ts_world_cam is not None:
        return bop.Ts_world_cam
    indices = [v.index for v in bop.session.views]
    first = dict(annotations[indices[0]])
    cameras = {indices[0]: np.eye(4)}
    for index in indices[1:]:
        shared = [(o, T) for o, T in annotations[index] if o in first]
        if not shared:
            raise InputError(
                f"image {index} of scene {bop.ref.scene_id} has no camera pose (cam_R_w2c) and no "
                f"object in common with image {indices[0]}; its place cannot be found."
            )
        Ts = np.stack([first[o] @ se3.invert(T) for o, T in shared])
        centre = np.median(Ts[:, :3, 3], axis=0)
        spread = float(np.max(np.linalg.norm(Ts[:, :3, 3] - centre, axis=1)))
        if spread > CAMERA_SPREAD_LIMIT_M:
            raise InputError(
                f"the annotations of images {indices[0]} and {index} of scene {bop.ref.scene_id} "
                f"disagree by {1e3 * spread:.0f} mm about how the camera moved (at most "
                f"{1e3 * CAMERA_SPREAD_LIMIT_M:.0f} mm): the objects were moved between them, or "
                "an annotation is wrong. Upgrade such images as scenes of their own."
            )
        cameras[index] = se3.from_rt(se3.mean_rotation(Ts[:, :3, :3]), centre)
    return cameras


def world_starts(
    annotations: dict[int, list[tuple[int, Array]]], Ts_world_cam: dict[int, Array]
) -> list[ObjectPose]:
    """Return one start per object of the scene, from the first image that shows it."""
    starts: list[ObjectPose] = []
    first = next(iter(annotations))
    for k, (obj_id, T_cam_obj) in enumerate(annotations[first]):
        T = Ts_world_cam[first] @ T_cam_obj
        starts.append(ObjectPose(obj_id=obj_id, instance=k, T_world_obj=T))
    known = {s.obj_id for s in starts}
    for index, rows in annotations.items():
        for obj_id, T_cam_obj in rows:
            if obj_id not in known:
                known.add(obj_id)
                T = Ts_world_cam[index] @ T_cam_obj
                starts.append(ObjectPose(obj_id=obj_id, instance=len(starts), T_world_obj=T))
    return starts


def _copy_views(bop: BopScene, Ts_world_cam: dict[int, Array], folder: Path) -> SessionStore:
    """Copy the images of a scene into a session (only those that are not there yet)."""
    if (folder / "session.json").is_file():
        store = SessionStore.open(folder)
    else:
        session = CaptureSession(
            name=f"{bop.ref.split} {bop.ref.folder.name}",
            intrinsics=bop.session.intrinsics,
            views=(),
            depth_unit_m=bop.session.depth_unit_m,
        )
        store = SessionStore.create(folder, session, {"source": f"BOP scene {bop.ref.scene_id}"})
    for view in bop.session.views:
        if view.index not in store.completed:
            store.add_view(View(index=view.index), bop.rgb(view.index), bop.depth_m(view.index))
    store.set_cameras(bop.session.intrinsics, Ts_world_cam)
    return store


def _registration_notes(store: SessionStore, bop: BopScene) -> list[str]:
    """Return what the registration found out about the start poses as a whole."""
    report: dict[str, Any] = store.read_json("registration/report.json")
    offset = report.get("common_offset_mm")
    if not offset or not offset.get("consistent"):
        return []
    x, y, z = offset["offset_mm"]
    return [
        f"all objects moved together by ({x:.1f}, {y:.1f}, {z:.1f}) mm from their start poses, "
        f"agreeing within {offset['spread_mm']:.1f} mm: the given poses look like those of "
        "another frame."
    ]


def moved_from_start(
    pose: ObjectPose, starts: list[ObjectPose], models: dict[int, ObjectModel]
) -> tuple[float, float]:
    """Return how far an object moved from its start: [mm] and [deg], nearest symmetry."""
    start = next(s for s in starts if s.instance == pose.instance)
    S = models[pose.obj_id].symmetries
    delta = se3.invert(start.T_world_obj) @ pose.T_world_obj @ S
    k = int(np.argmin(se3.angle(delta)))
    return 1e3 * float(np.linalg.norm(delta[k, :3, 3])), float(np.degrees(se3.angle(delta[k])))


def show_upgrade(result: UpgradeResult, console: Console) -> None:
    """Print one table over all scenes, the notes, and the pictures."""
    rows: list[list[str]] = []
    for done in result.scenes:
        by_instance = {s.instance: s for s in done.grasps}
        for o in done.scene.objects:
            grasps = by_instance.get(o.instance)
            tried = 0 if grasps is None else int(np.isfinite(grasps.scores).sum())
            good = 0 if grasps is None else int(grasps.good.sum())
            from realsim.app.stages import session_models

            name = session_models(done.store)[o.obj_id].name
            rows.append(
                [
                    f"{done.store.folder.name} {name}",
                    o.verdict,
                    f"{o.checks.get('agree', float('nan')):.2f}",
                    f"{done.moved_mm[o.instance]:.1f}",
                    f"{done.moved_deg[o.instance]:.1f}",
                    f"{good} of {tried}",
                ]
            )
    console.table(
        "Upgraded scenes",
        ["scene, object", "verdict", "agrees", "moved [mm]", "turned [deg]", "good grasps"], rows,
    )  # fmt: skip
    for done in result.scenes:
        plane = done.scene.plane
        if plane is not None:
            console.say(
                f"{done.store.folder.name}: supporting plane found, RMS "
                f"{1e3 * plane.rms_m:.1f} mm over {plane.inliers} points"
            )
        for o in done.scene.objects:
            if o.reasons:
                console.warn(f"{done.store.folder.name} object {o.obj_id}: {'; '.join(o.reasons)}")
        for note in done.notes:
            console.warn(f"scene {done.store.folder.name}: {note}")
        for picture in done.pictures:
            console.say(f"picture   {picture}")
    console.say(f"dataset   {result.out}")
