"""Upgrade a BOP dataset: find the table, refine the poses, try grasps, write labels and pictures.

The dataset itself is only read. Every scene becomes a session (which is a BOP scene) under
OUT/SPLIT/SCENE, so that all later commands (`realsim review`, `realsim report`) work on it.
"""

import contextlib
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.app.console import Console
from realsim.app.register import register_session
from realsim.app.show import why_no_grasp
from realsim.app.stages import (
    annotate_session,
    save_starts,
    school_session,
    session_models,
)
from realsim.app.upgrade_source import SceneSource, UpgradeConfig, prepare, world_starts
from realsim.errors import InputError, RealsimError
from realsim.formats.bop.scene import BopScene, BopSceneRef
from realsim.geometry import se3
from realsim.records import CaptureSession, GraspSet, ObjectModel, ObjectPose, Scene, View
from realsim.store import SessionStore
from realsim.store.atomic import write_json
from realsim.store.lock import only_run_in

Array = NDArray[np.float64]


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
    failed: dict[str, str]
    """Scene folder -> why it was left out."""


def run_upgrade(config: UpgradeConfig, dataset: Path, out: Path, console: Console) -> UpgradeResult:
    """Upgrade the scenes of a BOP dataset into `out`.

    Raises:
        InputError: no dataset, no such scene, unwritable or foreign output, or broken content.
    """
    from threadpoolctl import threadpool_limits

    from realsim.formats.bop.models import load_models, save_models
    from realsim.formats.bop.scene import find_scenes

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
    _refuse_what_cannot_be_written(out)
    done: list[UpgradedScene] = []
    failed: dict[str, str] = {}
    with threadpool_limits(limits=1):
        for ref in refs:
            console.say(f"scene {ref.scene_id} ({ref.folder.name})")
            try:
                source = prepare(ref, root, models, config)
            except RealsimError as error:
                # One broken scene of many is reported at the end; a single one ends the command.
                if len(refs) == 1:
                    raise
                failed[ref.folder.name] = str(error)
                console.say(f"scene {ref.folder.name} is left out: {error}")
                continue
            out.mkdir(parents=True, exist_ok=True)
            with only_run_in(out):
                done.append(_upgrade_scene(source, config, out, console))
    if not done:
        raise InputError(f"none of the {len(refs)} scenes can be used; the reasons stand above.")
    save_models(out / "models", models)
    _write_root_files(out, done)
    return UpgradeResult(out=out, scenes=done, failed=failed)


def _write_root_files(out: Path, done: list[UpgradedScene]) -> None:
    """Write what BOP's tools look for at a dataset's root: the camera and each split's targets."""
    session = done[0].store.session
    i = session.intrinsics
    camera = {"fx": i.fx, "fy": i.fy, "cx": i.cx, "cy": i.cy, "width": i.width, "height": i.height,
              "depth_scale": 1e3 * session.depth_unit_m}  # fmt: skip
    write_json(out / "camera.json", camera)
    targets: dict[str, list[dict[str, int]]] = {}
    for scene in done:
        folder = scene.store.folder
        number = int(folder.name) if folder.name.isdecimal() else 0
        for image, rows in scene.store.read_json("scene_gt.json").items():
            counts = Counter(int(row["obj_id"]) for row in rows)
            targets.setdefault(folder.parent.name, []).extend(
                {"scene_id": number, "im_id": int(image), "obj_id": o, "inst_count": n}
                for o, n in sorted(counts.items())
            )
    for split, rows in targets.items():
        write_json(out / f"{split}_targets_bop19.json", rows)


def _dataset_root(ref: BopSceneRef) -> Path:
    """Return the folder that holds the splits (and usually the models)."""
    return ref.folder.parent.parent


def _refuse_what_cannot_be_written(out: Path) -> None:
    """Raise if the output folder cannot be made or filled; nothing is left behind."""
    if out.exists() and not out.is_dir():
        raise InputError(f"--out '{out}' is a file; give a folder that may be made or filled.")
    known = not out.exists() or not any(out.iterdir()) or (out / "models").is_dir()
    if not known and not any(out.glob("*/*/session.json")):
        raise InputError(
            f"--out '{out}' is not empty and holds no upgrade. Choose another folder: nothing of "
            "yours is overwritten."
        )
    made = [p for p in (out, *out.parents) if not p.exists()]
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise InputError(
            f"--out '{out}' cannot be written ({error.strerror}); choose another folder or change "
            "its permissions."
        ) from error
    finally:
        for path in made:
            with contextlib.suppress(OSError):
                path.rmdir()


def _upgrade_scene(
    source: SceneSource, config: UpgradeConfig, out: Path, console: Console
) -> UpgradedScene:
    """Upgrade one scene, going on where an earlier run stopped."""
    from realsim.app.report import write_report
    from realsim.formats.bop.models import save_models

    ref, notes = source.bop.ref, list(source.notes)
    store = _copy_views(source.bop, source.Ts_world_cam, out / ref.split / ref.folder.name)
    save_models(store.folder / "models", source.models)
    starts = world_starts(source.annotations, source.Ts_world_cam)
    save_starts(store, starts, f"{config.start} of {ref.folder.name}")
    scene = register_session(store, console)
    notes += _registration_notes(store)
    grasps = school_session(
        store, console, grasps_per_object=config.grasps_per_object, seed=config.seed,
        workers=config.workers,
    )  # fmt: skip
    annotate_session(store, console)
    with console.stage("report"):
        write_report(store, None, notes=notes)
    moved = {o.instance: moved_from_start(o, starts, source.models) for o in scene.objects}
    return UpgradedScene(
        store=store, scene=scene, grasps=grasps, notes=notes,
        moved_mm={k: v[0] for k, v in moved.items()},
        moved_deg={k: v[1] for k, v in moved.items()},
        pictures=sorted((store.folder / "reports").glob("*.png")),
    )  # fmt: skip


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


def _registration_notes(store: SessionStore) -> list[str]:
    """Return what the registration found out about the scene as a whole."""
    report: dict[str, Any] = store.read_json("registration/report.json")
    notes: list[str] = []
    offset = report.get("common_offset_mm")  # only of objects that all had starts
    if offset is not None and offset["consistent"]:
        x, y, z = offset["offset_mm"]
        notes.append(
            f"all objects moved together by ({x:.1f}, {y:.1f}, {z:.1f}) mm from their start poses, "
            f"agreeing within {offset['spread_mm']:.1f} mm: the given poses are off as a whole, as "
            "those of a neighbouring frame, of a moved camera, or with a common depth error."
        )
    sinking = report.get("common_sinking")
    if sinking is not None and sinking["consistent"]:
        notes.append(
            f"the objects sink into the table by {-100 * sinking['share_of_height']:.1f} % of "
            "their height, all alike: the depth reads short, or the models are too large."
        )
    kept = [
        f"{o['name']} ({axis['fit_deg']:.0f} deg)"
        for o in report.get("objects", ())
        if o.get("blind", {}).get("start_kept")
        for axis in o["blind"]["axes"]
        if not axis["declared"] and abs(axis.get("fit_deg", 0.0)) >= 1.0
    ]
    if kept:
        notes.append(
            f"the depth cannot see how these are turned about their own axis: {', '.join(kept)}; "
            "the start's turn was kept (in brackets: what the fit alone would have turned)."
        )
    return notes


def moved_from_start(
    pose: ObjectPose, starts: list[ObjectPose], models: dict[int, ObjectModel]
) -> tuple[float, float]:
    """Return how far an object moved from its start: [mm] and [deg], nearest symmetry."""
    start = next(s for s in starts if s.instance == pose.instance)
    model = models[pose.obj_id]
    ends = pose.T_world_obj @ model.symmetries
    angles = se3.angle(se3.invert(start.T_world_obj) @ ends)
    k = int(np.argmin(angles))
    # At the middle of the box: a mesh's origin may lie beside it and swing with every turn.
    middle = model.mesh.bounds.mean(0)[None]
    step = se3.transform(ends[k], middle) - se3.transform(start.T_world_obj, middle)
    return 1e3 * float(np.linalg.norm(step)), float(np.degrees(angles[k]))


def show_upgrade(result: UpgradeResult, console: Console) -> None:
    """Print one table over all scenes, the notes, and the pictures."""
    rows: list[list[str]] = []
    for done in result.scenes:
        by_instance = {s.instance: s for s in done.grasps}
        names = {k: m.name for k, m in session_models(done.store).items()}
        for o in done.scene.objects:
            grasps = by_instance.get(o.instance)
            tried = 0 if grasps is None else int(np.isfinite(grasps.scores).sum())
            good = 0 if grasps is None else int(grasps.good.sum())
            name = names[o.obj_id]
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
        for s in done.grasps:
            if len(s) == 0:
                console.warn(f"{done.store.folder.name} object {s.obj_id}: {why_no_grasp(s)}")
        for o in done.scene.objects:
            if o.reasons:
                console.warn(f"{done.store.folder.name} object {o.obj_id}: {'; '.join(o.reasons)}")
        for note in done.notes:
            console.warn(f"scene {done.store.folder.name}: {note}")
        for picture in done.pictures:
            console.say(f"picture   {picture}")
    for name, reason in result.failed.items():
        console.warn(f"scene {name} was left out: {reason}")
    console.say(f"dataset   {result.out}")
