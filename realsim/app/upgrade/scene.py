"""One scene of an upgrade: a session made of it, taken through every stage, and what came of it."""

from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from realsim import __version__, images
from realsim.app.annotate.current import annotate_session
from realsim.app.console import Console, Tick
from realsim.app.register.config import RegisterRequest
from realsim.app.register.pictures import bias_of
from realsim.app.register.results import Registered, with_objects
from realsim.app.register.run import run_register
from realsim.app.school.inputs import SchoolRequest
from realsim.app.school.run import run_in_session
from realsim.app.school.tables import why_no_grasp
from realsim.app.stages import note, save_starts
from realsim.app.upgrade.analytic import agreement_of, try_analytic
from realsim.app.upgrade.dataset import SceneJob, open_scene
from realsim.app.upgrade.files import NOTE, keep_imported
from realsim.app.upgrade.outcome import VIEWS, Outcome, decide
from realsim.app.upgrade.source import SceneSource, moved_from_start, prepare, world_starts
from realsim.formats.grasps.scene_grasps import executed
from realsim.geometry import se3
from realsim.records import CaptureSession, GraspSet, ObjectPose, Scene, View
from realsim.registration.compare import spread_frames
from realsim.registration.evidence import LazyFrame
from realsim.registration.photo import Picture
from realsim.store import SessionStore, provenance
from realsim.store.atomic import only_run_in
from realsim.untrusted.own_json import read_values

Record = dict[str, Any]
"""What came of a scene, as plain JSON values."""
RIGHT_M = 0.003
"""A pose's probability of being right, and so its verdict, speaks of this distance [m]."""
UNDECIDED: Record = {
    "outcome": "improved", "why": "no annotation in the images that took part", "depth_t": None,
    "photo_t": None, "agree_annotation": None, "agree_new": None, "edge_px_annotation": None,
    "edge_px_new": None, "visible": None, "proposed_mm": None, "T_world_obj_proposed": None,
}  # fmt: skip
"""Columns for an object whose annotation lies in no image that took part."""


class SceneConsole(Console):
    """Shows the stages of a scene where another console does, and keeps what the user must know."""

    def __init__(self, shown: Console | None) -> None:
        """Open the console; None shows nothing."""
        super().__init__(quiet=True)
        self.told: list[str] = []
        self._shown = shown

    @contextmanager
    def stage(self, name: str, note: str = "") -> Generator[Tick]:
        """Show a stage."""
        stage = super().stage if self._shown is None else self._shown.stage
        with stage(name, note) as tick:
            yield tick

    def say(self, *texts: str) -> None:
        """Leave it out: the record and the session have it."""

    def warn(self, *texts: str) -> None:
        """Keep one line that the user must not miss."""
        self.told += texts

    def table(self, title: str, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
        """Leave the table out."""


def read_source(job: SceneJob) -> SceneSource:
    """Read a scene and check all of it; nothing is written.

    Raises:
        InputError: something is missing or broken.
    """
    return prepare(open_scene(job.given), job.given, job.config)


def upgrade_scene(job: SceneJob, source: SceneSource, shown: Console | None) -> Record:
    """Upgrade one scene, going on where an earlier run stopped.

    Args:
        job: what and where.
        source: the scene, read and checked.
        shown: where progress is shown; None = nowhere.

    Raises:
        InputError: it cannot be registered or tried, another run is working on it, or its folder
            holds something else.
    """
    from realsim.app.report.session import report_of, write_report
    from realsim.formats.bop.models import save_models

    key, console = job.key, SceneConsole(shown)
    job.folder.mkdir(parents=True, exist_ok=True)
    with only_run_in(job.folder):
        store = _session_of(job, source)
        save_models(store.folder / "models", source.models)
        starts = world_starts(source.seen, source.Ts_world_cam)
        save_starts(store, starts, f"{job.config.start} of {job.ref.place}")
        result = run_register(
            store, console, RegisterRequest(), lambda found: settled(store, source, found, console)
        )
        scene = result.scene
        asked = SchoolRequest(
            grasps=job.config.grasps_per_object, seed=job.config.seed, where=job.workers,
            restart="finished",
        )  # fmt: skip
        grasps = run_in_session(store, asked, console).sets
        analytic = try_analytic(store, job, console) if job.config.analytic else []
        annotate_session(store, console)
        notes = [*source.notes, *registration_notes(store), *console.told]
        with console.stage("report"):
            write_report(store, report_of(store, pictures="kept", notes=notes))
        record = _record(job, source, store, scene, starts, grasps, notes)
        record["analytic"] = agreement_of(analytic)
        note(
            store, "upgraded", console, request=job.config, key=key,
            inputs={f"{provenance.GIVEN}scene": provenance.sha256_of(job.given.folder)},
        )  # fmt: skip
        store.write_json(NOTE, {"key": key, "record": record})
    return record


def settled(
    store: SessionStore, source: SceneSource, result: Registered, console: Console
) -> Registered:
    """Return a registration with the annotations in their places that it does not better.

    What became of each is in the report, by instance, under `upgrade`.

    Args:
        store: the session.
        source: the scene, its annotations as its images have them.
        result: what was registered.
        console: progress.
    """
    objects, cameras = result.scene.objects, result.cameras.refined
    # By the cameras as they are now: an annotation is a pose in its image.
    annotations = world_starts({k: source.seen[k] for k in source.seen if k in cameras}, cameras)
    if not annotations or not objects:
        return result
    middle = np.mean([a.T_world_obj[:3, 3] for a in annotations], axis=0)
    bias = bias_of(result)
    frames = [
        LazyFrame(k, T, lambda k=k: bias.corrected(store.depth_m(k)).astype(np.float32))
        for k, T in sorted(cameras.items())
    ]
    with console.stage("annotations against new poses", f"{len(annotations)} objects"):
        pictures = [
            Picture(
                intrinsics=store.session.intrinsics, depth_m=f.depth_m, T_world_cam=f.T_world_cam,
                rgb=store.rgb(f.index),
            )
            for f in spread_frames(frames, middle, VIEWS)
        ]  # fmt: skip
        outcomes = decide(pictures, source.models, annotations, objects, result.scene.plane)
    result = with_objects(result, tuple(_with_outcomes(objects, outcomes)))
    report = dict(result.report) | {"upgrade": {str(o.instance): o.as_json() for o in outcomes}}
    return replace(result, report=report)


def _with_outcomes(
    scene_objects: Sequence[ObjectPose], outcomes: Sequence[Outcome]
) -> Iterator[ObjectPose]:
    """Return the registered objects with the annotations that were kept in their places.

    A kept annotation within `RIGHT_M` of the new pose has that one's verdict; another one is
    unchecked, or doubtful where it looks wrong.
    """
    by = {o.instance: o for o in outcomes}
    for p in scene_objects:
        o = by.get(p.instance)
        if o is None:
            yield p
            continue
        near = o.evidence is not None and o.evidence.moved_m <= RIGHT_M
        if o.kind == "improved" or (near and not o.looks_wrong and p.verdict != "rejected"):
            yield replace(p, T_world_obj=o.T_world_obj)
            continue
        agree = {} if o.evidence is None else {"agree": o.evidence.agree[0]}
        yield replace(
            p, T_world_obj=o.T_world_obj, covariance=None, checks=agree,
            verdict="doubtful" if o.looks_wrong else "unchecked",
            reasons=(f"annotation kept: {o.words}",),
        )  # fmt: skip


def _session_of(job: SceneJob, source: SceneSource) -> SessionStore:
    """Copy the images of a scene into a session (only those that are not there yet)."""
    scene, folder = source.scene, job.folder
    if (folder / "session.json").is_file():
        store = SessionStore.open(folder)
    else:
        session = CaptureSession(
            name=job.ref.place.replace("/", " "), intrinsics=source.intrinsics,
            depth_unit_m=source.depth_unit_m,
        )  # fmt: skip
        extra: dict[str, Any] = {"source": f"{job.ref.kind} scene {scene.number}"}
        if scene.T_world_table is not None:
            extra["gravity_up_world"] = scene.T_world_table[:3, 2].tolist()
        store = SessionStore.create(folder, session, extra)
    keep_imported(store, job.ref, job.given, job.labels, source.digests)
    for index in source.indices:
        depth_file = scene.depth_file(index)
        if index not in store.completed and depth_file is not None:
            rgb = images.read_rgb(scene.colour_file(index))
            depth_m = images.read_depth(depth_file, source.depth_unit_m)
            store.add_view(View(index=index), rgb, depth_m)
    store.set_cameras(source.intrinsics, source.Ts_world_cam)
    return store


def _record(
    job: SceneJob,
    source: SceneSource,
    store: SessionStore,
    scene: Scene,
    starts: Sequence[ObjectPose],
    grasps: Sequence[GraspSet],
    notes: Sequence[str],
) -> Record:
    """Return what came of a scene."""
    sets = {s.instance: s for s in grasps}
    became: Record = store.read_json("registration/report.json").get("upgrade", {})

    def of_object(o: ObjectPose) -> Record:
        moved_mm, moved_deg = moved_from_start(o, starts, source.models)
        found = sets.get(o.instance)
        decided: Record = {**UNDECIDED, **became.get(str(o.instance), {})}
        T_proposed = decided.pop("T_world_obj_proposed")
        return {
            "instance": o.instance, "obj_id": o.obj_id, "name": source.models[o.obj_id].name,
            "verdict": o.verdict, "reasons": list(o.reasons), **decided,
            "agree": _number(o.checks.get("agree")),
            "probability": _number(o.checks.get("probability")),
            "moved_mm": round(moved_mm, 3), "moved_deg": round(moved_deg, 3),
            "grasps": _grasp_counts(found), "shown": _shown(source, store, o, T_proposed),
        }  # fmt: skip

    plane = scene.plane
    return {
        "place": job.ref.place, "version": __version__, "frames": len(source.indices),
        "start": job.config.start,
        "plane": None if plane is None else {
            "rms_mm": round(1e3 * plane.rms_m, 3), "points": plane.inliers,
        },
        "objects": [of_object(o) for o in scene.objects], "notes": list(notes),
        "pictures": sorted(
            p.relative_to(job.out).as_posix() for p in (store.folder / "reports").glob("*.png")
        ),
    }  # fmt: skip


def _number(value: float | None) -> float | None:
    """Return a number that JSON can hold."""
    return None if value is None or not np.isfinite(value) else round(float(value), 4)


def _grasp_counts(found: GraspSet | None) -> Record:
    """Return how many grasps of an object physics tried and are good, and why there is none.

    Grasps that collide or that the arm cannot reach are candidates, but were not tried.
    """
    if found is None:
        return {"candidates": 0, "tried": 0, "good": 0, "why_none": "its pose was rejected"}
    return {
        "candidates": len(found),
        "tried": int(executed(found).sum()),
        "good": int(found.good.sum()),
        "why_none": why_no_grasp(found) if len(found) == 0 else "",
    }


def _shown(
    source: SceneSource, store: SessionStore, pose: ObjectPose, T_proposed: Sequence[Any] | None
) -> Record | None:
    """Return the image that shows an object best, with its poses there: before, after, proposed.

    None = the images that it was registered in have no annotation of it.
    """
    cameras = store.session.Ts_world_cam
    visible = _visible_fractions(store, pose)
    best: tuple[float, int] | None = None
    for index, rows in source.seen.items():
        if index in cameras and any(s.instance == pose.instance for s in rows):
            best = max(best or (-1.0, -1), (visible.get(index, 0.0), index))
    if best is None:
        return None
    index = best[1]
    before = next(s for s in source.seen[index] if s.instance == pose.instance)
    T_cam_world = se3.invert(cameras[index])
    proposed = None if T_proposed is None else (T_cam_world @ np.array(T_proposed)).tolist()
    return {
        "image": index, "T_cam_obj_before": before.T_cam_obj.tolist(),
        "T_cam_obj": (T_cam_world @ pose.T_world_obj).tolist(), "T_cam_obj_proposed": proposed,
    }  # fmt: skip


def _visible_fractions(store: SessionStore, pose: ObjectPose) -> dict[int, float]:
    """Return how much of an object each image shows; rejected ones have no label to tell it."""
    truth: Mapping[str, Any] = read_values(store.path("scene_gt.json"))
    info: Mapping[str, Any] = read_values(store.path("scene_gt_info.json"))
    out: dict[int, float] = {}
    for image, rows in truth.items():
        for row, about in zip(rows, info.get(image, ()), strict=False):
            if int(row["obj_id"]) == pose.obj_id:
                out[int(image)] = max(out.get(int(image), 0.0), float(about["visib_fract"]))
    return out


def registration_notes(store: SessionStore) -> Iterator[str]:
    """Return what the registration found out about the scene as a whole."""
    report: dict[str, Any] = store.read_json("registration/report.json")
    offset = report.get("common_offset_mm")  # only of objects that all had starts
    if offset is not None and offset["consistent"]:
        x, y, z = offset["offset_mm"]
        yield (
            f"all objects moved together by ({x:.1f}, {y:.1f}, {z:.1f}) mm from their start poses, "
            f"agreeing within {offset['spread_mm']:.1f} mm: the given poses are off as a whole, as "
            "those of a neighbouring frame, of a moved camera, or with a common depth error."
        )
    sinking = report.get("common_sinking")
    if sinking is not None and sinking["consistent"]:
        yield (
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
        yield (
            f"the depth cannot see how these are turned about their own axis: {', '.join(kept)}; "
            "the start's turn was kept (in brackets: what the fit alone would have turned)."
        )
