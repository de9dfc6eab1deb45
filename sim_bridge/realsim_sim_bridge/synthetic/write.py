"""Synthetic views of a placed scene, written as a session that every other command opens.

    session.json ... rgb/ depth/        as a capture leaves them; camera poses are exact
    models/                             the objects
    registration/scene.json             the objects' exact poses, all accepted
    synthetic/scene.json                where the scene comes from, what is wrong with views
    synthetic/surroundings.npz          table and floor, which hide things
    mask/ labels/ annotations/ ...      the label transfer, as `realsim annotate` writes it

Frames are computed by worker processes and written by this one in their order, so that a session
has the same bytes however many workers there were and however often it was interrupted.

One synthetic frame: the photograph, and the depth that a depth camera would report.

A frame's chance comes from (seed, number of the frame) alone, so its bytes do not depend on which
process renders it, or after which other frames.
"""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from realsim import images
from realsim.arrays import Array, UInt8, UInt16
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.distance_field import solid_angle_share
from realsim.interop import offer
from realsim.many import Outcome, Shared, Task, Workers, at_most, open_pool, run_many
from realsim.records import CameraIntrinsics, GraspSet, View
from realsim.rendering.depth_camera import DepthCamera
from realsim.rendering.depth_sensors.profiles import profile
from realsim.rendering.photo import PhotoRenderer
from realsim.store import SessionStore, save_scene
from realsim.store.atomic import only_run_in
from realsim_sim_bridge.annotation.annotate import annotate
from realsim_sim_bridge.annotation.config import AnnotationConfig, OccluderConfig
from realsim_sim_bridge.annotation.summary import AnnotationSummary
from realsim_sim_bridge.synthetic.claim import claimed_session, with_stored_models
from realsim_sim_bridge.synthetic.config import SyntheticConfig
from realsim_sim_bridge.synthetic.scene import SyntheticScene, save_surroundings

if TYPE_CHECKING:
    from realsim.rendering.photoreal import PhotorealRenderer

PHOTO, DEPTH = 0, 1
"""Streams of chance of a frame: another depth camera leaves the photograph as it is."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FrameJob:
    """What all frames of a session have in common."""

    synthetic: SyntheticScene
    intrinsics: CameraIntrinsics
    config: SyntheticConfig
    seed: int


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SyntheticFrame:
    """One frame as it is stored."""

    rgb: UInt8
    """(H, W, 3) encoded colours."""
    depth_counts: UInt16
    """(H, W) what the depth camera reports, in the session's unit; 0 = none."""
    rgb_cpu_s: float
    """Cost of the photograph [s]."""
    depth_cpu_s: float
    """Cost of the depth image [s]."""
    notes: tuple[str, ...] = ()
    """What the renderer wants a person to know: that it is slower than it could be, say."""


class FrameRenderer:
    """Renders the frames of one scene; what can be built once is built once."""

    def __init__(self, job: FrameJob) -> None:
        """Build renderer and depth camera.

        Raises:
            InputError: the photoreal renderer cannot run here; the message names the fallback.
        """
        self.job = job
        self._pictures = picture_source(job.synthetic, job.config)
        self._depth = depth_camera(job.synthetic, job.config)

    def render(self, index: int, T_world_cam: ArrayLike) -> SyntheticFrame:
        """Return frame `index`, seen from a pose (4, 4) [m]."""
        job = self.job
        began = time.process_time()
        photo = self._pictures.render(job.intrinsics, T_world_cam, self._chance(index, PHOTO))
        between = time.process_time()
        chance = self._chance(index, DEPTH)
        depth_m = self._depth.measure(job.intrinsics, T_world_cam, chance, photo)
        return SyntheticFrame(
            rgb=photo.rgb,
            depth_counts=images.depth_counts(depth_m, job.config.unit_m),
            rgb_cpu_s=between - began,
            depth_cpu_s=time.process_time() - between,
            notes=tuple(getattr(self._pictures, "notes", ())),
        )

    def _chance(self, index: int, stream: int) -> np.random.Generator:
        return np.random.default_rng([self.job.seed, index, stream])


def require_renderer(config: SyntheticConfig) -> None:
    """Refuse a renderer that is not installed, before anything is made for it.

    Raises:
        InputError: it is not; the message names what to install and the fallback.
    """
    if config.renderer == "photoreal" and find_spec("mitsuba") is None:
        raise InputError(
            f"the photoreal renderer needs Mitsuba, which is not installed. {offer('photo')}, or "
            "use the embedded renderer, which needs no extra (--renderer embedded)."
        )


def picture_source(
    synthetic: SyntheticScene, config: SyntheticConfig
) -> "PhotoRenderer | PhotorealRenderer":
    """Return the renderer that the config names."""
    placed = synthetic.placed()
    if config.renderer == "photoreal":
        from realsim.rendering.photoreal import PhotorealConfig, PhotorealRenderer

        return PhotorealRenderer(
            placed, synthetic.environment, PhotorealConfig(samples=config.samples)
        )
    return PhotoRenderer(placed, environment=synthetic.environment)


def depth_camera(synthetic: SyntheticScene, config: SyntheticConfig) -> DepthCamera:
    """Return the depth camera that the config names, before the scene.

    The noise model is told what only the scene knows: which surfaces the second eye cannot see, by
    rays to it, and which materials return too little light or mirror it away.
    """
    return DepthCamera(
        synthetic.placed(),
        config.depth_sensor(),
        profile=profile(config.profile),
        environment=synthetic.environment,
        exact_shadows=True,
        material_loss=True,
    )


# --- in another process -----------------------------------------------------------------------


def frame_of_job(job: FrameJob, index: int, T_world_cam: ArrayLike) -> SyntheticFrame:
    """Return a frame of a job; a worker builds its renderer at the first one."""
    return _renderer_of(job).render(index, T_world_cam)


@lru_cache(maxsize=1)
def _renderer_of(job: FrameJob) -> FrameRenderer:
    return FrameRenderer(job)


Progress = Callable[[int, int], None]
ABOUT_FILE = "synthetic/scene.json"
INSIDE_SHARE = 0.5
"""Share of the sphere about a point that a closed mesh around it fills is 1, beside it 0."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SyntheticSummary:
    """What was rendered."""

    folder: Path
    views: int
    """Views in the session, those of an earlier run included."""
    rendered: int
    """Views rendered by this run."""
    left_out: tuple[int, ...]
    """Instances that are not shown because they are rejected."""
    empty_views: tuple[int, ...]
    """Views in which no object is seen."""
    camera_inside: dict[int, tuple[int, ...]]
    """View -> instances that its camera stands inside of."""
    cpu_s: dict[str, float]
    """CPU time per frame by part [s]: rgb, depth, write, labels; of what this run did."""
    labels: AnnotationSummary
    """What the annotation says."""
    notes: tuple[str, ...] = ()
    """What the renderer wants a person to know."""


def exact_annotation(maps: tuple[str, ...]) -> AnnotationConfig:
    """Return the settings for a scene without error: no clearance, and nothing that is unknown."""
    return AnnotationConfig(plane_clearance_m=0.0, maps=maps, occluder=OccluderConfig(is_on=False))


def write_session(  # noqa: PLR0913, PLR0917 - the inputs of a session, all of them needed
    folder: Path | str,
    synthetic: SyntheticScene,
    intrinsics: CameraIntrinsics,
    Ts_world_cam: ArrayLike,
    config: SyntheticConfig | None = None,
    seed: int = 0,
    grasp_sets: Sequence[GraspSet] = (),
    progress: Progress | None = None,
    workers: Workers = 1,
    *,
    models_from: Path | None = None,
) -> SyntheticSummary:
    """Render views of a scene into a session, going on where an earlier run stopped.

    Args:
        folder: a new folder, or that of an earlier run with the same inputs.
        synthetic: what is seen.
        intrinsics: the raw (distorted) camera.
        Ts_world_cam: (N, 4, 4) camera in world [m]; more than an earlier run's are added to it.
        config: renderer and depth camera; None = the defaults.
        seed: of the noise; frame k's chance comes from (seed, k) alone.
        grasp_sets: scored grasps of the instances, which are projected into every frame.
        progress: called with (steps done, steps in all); a frame is two steps, picture and labels.
        workers: who renders; the bytes do not depend on it.
        models_from: a models folder whose files are copied as they are; None = written anew.

    Raises:
        InputError: the folder belongs to something else, or a renderer cannot run here.
        WorkerDiedError: a process ended in the middle; running again goes on from there.
    """
    config = config or SyntheticConfig()
    require_renderer(config)
    Ts = _checked_cameras(Ts_world_cam)
    folder = Path(folder)
    store = claimed_session(folder, synthetic, intrinsics, config, seed, list(Ts))
    with only_run_in(folder):
        stored = with_stored_models(synthetic, folder / "models", models_from)
        save_scene(store, stored.exact())
        save_surroundings(store, stored.surroundings)
        inside = cameras_inside(stored, Ts)
        total = 2 * len(Ts)
        job = FrameJob(synthetic=stored, intrinsics=intrinsics, config=config, seed=seed)
        spent = _write_frames(store, job, Ts, workers, lambda k: _tell(progress, k, total))
        began = _cpu_s()
        exact = stored.exact()
        shown = {o.instance for o in exact.objects}
        labels = annotate(
            store, exact, stored.models, [g for g in grasp_sets if g.instance in shown],
            exact_annotation(config.maps), workers=workers, surroundings=stored.surroundings,
            progress=lambda done, n: _tell(progress, len(Ts) + done, total),
        )  # fmt: skip
        if labels.views > labels.skipped:
            spent.parts["labels"] = (_cpu_s() - began) / (labels.views - labels.skipped)
        _write_about(store, synthetic, seed, inside, labels.empty_views)
    return SyntheticSummary(
        folder=folder, views=len(Ts), rendered=spent.frames, left_out=synthetic.left_out,
        empty_views=labels.empty_views, camera_inside=inside, cpu_s=spent.parts, labels=labels,
        notes=spent.notes,
    )  # fmt: skip


def _tell(progress: Progress | None, done: int, total: int) -> None:
    """Report progress to whoever wants to know."""
    if progress is not None:
        progress(done, total)


def _cpu_s() -> float:
    """Return the CPU time of this process and of its ended children [s]."""
    t = os.times()
    return t.user + t.system + t.children_user + t.children_system


def _checked_cameras(Ts_world_cam: ArrayLike) -> Array:
    """Return the cameras (N, 4, 4), at least one and all rigid."""
    Ts = np.asarray(Ts_world_cam, dtype=np.float64)
    if Ts.ndim != 3 or Ts.shape[1:] != (4, 4) or len(Ts) == 0:
        raise InputError(
            f"camera poses of shape {Ts.shape} were given; (N, 4, 4) with N of 1 or more is needed."
        )
    return se3.check_rigid(Ts, "T_world_cam of the synthetic views")


def cameras_inside(synthetic: SyntheticScene, Ts_world_cam: Array) -> dict[int, tuple[int, ...]]:
    """Return view -> instances whose mesh its camera stands inside of; other views are absent."""
    found: dict[int, list[int]] = {}
    for placed in synthetic.placed():
        if placed.instance < 0:
            continue
        eyes = se3.transform(se3.invert(placed.T_world_obj), Ts_world_cam[:, :3, 3])
        low, high = placed.mesh.bounds
        for k in np.flatnonzero(np.all((eyes > low) & (eyes < high), axis=1)):
            share = solid_angle_share(placed.mesh.vertices - eyes[k], placed.mesh.faces)
            if abs(share) > INSIDE_SHARE:
                found.setdefault(int(k), []).append(placed.instance)
    return {k: tuple(v) for k, v in sorted(found.items())}


# --- frames -----------------------------------------------------------------------------------


@dataclass(eq=False, slots=True)
class _Spent:
    """Frames rendered by this run, and what each part of one cost on average [s]."""

    frames: int
    parts: dict[str, float]
    notes: tuple[str, ...] = ()


def _write_frames(
    store: SessionStore, job: FrameJob, Ts: Array, workers: Workers, tick: Callable[[int], None]
) -> _Spent:
    """Render and write the frames that are not there yet."""
    completed = store.completed
    due = [k for k in range(len(Ts)) if k not in completed]
    tick(len(completed))
    if not due:
        return _Spent(0, {})
    parts = {"rgb": 0.0, "depth": 0.0, "write": 0.0}
    notes: tuple[str, ...] = ()
    shared, count = Shared(job), 0

    def keep(outcome: Outcome) -> None:
        nonlocal notes, count
        k, frame = due[count], outcome.found()
        began = time.process_time()
        view = View(index=k, T_world_cam=Ts[k], time_s=float(k))
        store.add_view(view, frame.rgb, depth_counts=frame.depth_counts)
        parts["write"] += time.process_time() - began
        parts["rgb"] += frame.rgb_cpu_s
        parts["depth"] += frame.depth_cpu_s
        notes, count = frame.notes, count + 1
        tick(len(completed) + count)

    tasks = (Task(name=f"frame {k}", fn=frame_of_job, args=(shared, k, Ts[k])) for k in due)
    try:
        with open_pool(at_most(workers, len(due))) as pool:
            run_many(tasks, pool, keep, in_order=True)
    finally:
        _renderer_of.cache_clear()  # a scene's structures can be hundreds of megabytes
    store.close()
    return _Spent(count, {name: cpu_s / count for name, cpu_s in parts.items()}, notes)


def _write_about(
    store: SessionStore,
    synthetic: SyntheticScene,
    seed: int,
    inside: dict[int, tuple[int, ...]],
    empty: Sequence[int],
) -> None:
    """Write where the scene comes from and what is wrong with views."""
    store.write_json(
        ABOUT_FILE,
        {
            "format_version": 1,
            "name": synthetic.name,
            "seed": seed,
            "provenance": {"poses": "simulated", **synthetic.provenance},
            "left_out": list(synthetic.left_out),
            "surroundings": len(synthetic.surroundings),
            "environment": synthetic.environment.name,
            "materials": {str(i): m.name for i, m in sorted(synthetic.materials.items())},
            "views_without_objects": list(empty),
            "camera_inside": {str(k): list(v) for k, v in inside.items()},
        },
    )
