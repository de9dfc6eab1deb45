"""Snapping one object to the measured depth: the registration's own refinement of it alone.

The cameras are held and the neighbours stay where they are: what they explain is not this object's,
and what they hide does not speak against it. As in a registration: search near the start, fit,
refine on the raw points, set turns that nothing shows back to the start's, and check by rendering.
"""

import os
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Int64
from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.records import ObjectModel, ObjectPose, Scene, SupportPlane
from realsim.records.calibration import DepthBias
from realsim.registration import near_start, verify
from realsim.registration.blind import keep_start, nearest_to_start, uncertainty
from realsim.registration.body import Body, make_body
from realsim.registration.compare import FRAMES, Comparer, spread_frames
from realsim.registration.config import RegistrationConfig
from realsim.registration.evidence import Cloud, average_cloud, without_table
from realsim.registration.refinement.config import CameraPrior, RefineConfig
from realsim.registration.refinement.refine import refine
from realsim.registration.solver import FINE, solve_pose
from realsim.review.placing.measured_views import (
    MOST_VIEWS,
    MeasuredViews,
    measured_views,
    usable_views,
)
from realsim.review.placing.placing import moved
from realsim.store import SessionStore

Progress = Callable[[int, int], None]
CACHE = "registration/cache"
"""Where a registration keeps what is derived from meshes."""
REACH_M = 0.045
"""Points this far beyond the object's bounding sphere are looked at [m]: the reach of a start."""
NEIGHBOUR_M = 0.004
"""Points this near to a neighbour's surface are the neighbour's while this object is searched."""
TOUCH_M = 0.01
"""Neighbours whose bounding spheres come this near may stand in the object [m]."""
LEAST_POINTS = 100
"""With fewer averaged points near it, the depth says nothing of an object."""
RAN_OFF_MM = 40.0
"""A fit that ends further away than this has found something else [mm]."""
SAME_MM, SAME_DEG = 0.3, 0.2
"""A smaller step is none."""
WORSE_SHARE = 0.005
"""The rendered gain may fall by this share without being worse: its own rounding."""
STAGES = 5
"""Number of stages of a snap, for its progress."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Snapped:
    """Where an object was snapped to, and what the depth says of it."""

    T_world_obj: Array
    """(4, 4); the start where the depth says nothing."""
    covariance: Array | None
    """(6, 6) of the right perturbation, rotation first [rad, m], cameras taken at their word; None
    where the depth says nothing."""
    checks: dict[str, float]
    """Checks of the snapped pose, the registration's: agree, gain, cover, hidden, ..."""
    checks_before: dict[str, float]
    """The same at the start."""
    moved_mm: float
    """How far the object's middle went [mm]."""
    turned_deg: float
    words: str
    """What happened, for a person."""
    is_better: bool
    """Whether the pose explains the depth at least as well as the start, and is no other place."""


class Snapper:
    """Snaps the objects of one session; images and what is derived from meshes are kept."""

    def __init__(
        self,
        store: SessionStore,
        scene: Scene,
        models: Mapping[int, ObjectModel],
        *,
        excluded_views: Sequence[int] = (),
        config: RegistrationConfig | None = None,
    ) -> None:
        """Take a session; nothing is read before the first snap.

        Args:
            store: the session.
            scene: where the objects stand; set `scene` anew when they were moved.
            models: by obj_id; set `models` anew when one was marked symmetric.
            excluded_views: not looked at.
            config: of the registration.
        """
        self.scene, self.models = scene, models
        self._store = store
        self._excluded = tuple(excluded_views)
        self._config = config or RegistrationConfig()
        self._views: MeasuredViews | None = None
        self._bodies: dict[int, Body] = {}
        self._lock = threading.Lock()

    def snap(
        self, instance: int, obj_id: int, T_start: ArrayLike, progress: Progress | None = None
    ) -> Snapped:
        """Return where the depth puts an object that is near its place.

        Args:
            instance: the object; the scene's pose of it does not matter.
            obj_id: what it is.
            T_start: (4, 4) T_world_obj from where it is snapped.
            progress: called with (steps done, steps).

        Raises:
            InputError: there is no such model, the pose is not rigid, or no view has both a camera
                pose and depth.
        """
        T = se3.check_rigid(T_start, f"the pose of instance {instance}")
        scene, models = self.scene, self.models
        if obj_id not in models:
            known = ", ".join(str(i) for i in sorted(models)) or "none"
            raise InputError(f"object {obj_id} has no model; these have one: {known}.")
        with self._lock:
            numbers = [] if self._views else usable_views(self._store, self._excluded)
            tick = _ticker(progress, len(numbers))
            if self._views is None:
                self._views = measured_views(self._store, numbers, scene, self._config, tick)
            start = ObjectPose(obj_id=obj_id, instance=instance, T_world_obj=T)
            others = [
                self._body(o, models[o.obj_id])
                for o in scene.objects
                if o.instance != instance and o.obj_id in models
            ]
            task = _task(
                self._views, self._body(start, models[obj_id]), others, scene.plane, self._config
            )
            tick()
            return _snapped(task, tick)

    def _body(self, placed: ObjectPose, model: ObjectModel) -> Body:
        """Return an object with what is derived from its mesh, which is done once."""
        known = self._bodies.get(placed.obj_id)
        if known is None or known.model.mesh is not model.mesh:
            folder = self._store.folder / CACHE
            kept = folder if folder.is_dir() and os.access(folder, os.W_OK) else None
            cells, samples = self._config.field_cells, self._config.samples
            known = self._bodies[placed.obj_id] = make_body(placed, model, cells, samples, kept)
        return replace(known, start=placed, model=model)  # which may have been marked symmetric


@dataclass(frozen=True, eq=False, slots=True)
class _Task:
    """One snap."""

    views: MeasuredViews
    config: RegistrationConfig
    plane: SupportPlane | None
    comparer: Comparer
    """On all views."""
    body: Body
    close: tuple[Body, ...]
    """The neighbours that may touch it, or own its points."""
    hiding: tuple[Body, ...]
    """Those and the ones that may hide it in a view that is rendered."""
    index: Int64
    """Measured points around it."""
    near: Cloud
    """Those within reach, less the table's."""

    def spread(self, n: int) -> Comparer:
        """Return the comparer on n frames that see the object from directions far apart."""
        frames = self.comparer.frames
        chosen = {f.index for f in spread_frames(frames, self.body.center(self.body.T_start), n)}
        pairs = zip(frames, self.comparer.edges, strict=True)
        kept = [(f, e) for f, e in pairs if f.index in chosen]
        return replace(
            self.comparer, frames=tuple(f for f, _ in kept), edges=tuple(e for _, e in kept)
        )

    def own(self, cloud: Cloud, T_world_obj: Array) -> Cloud:
        """Return of a cloud what is the object's at a pose and no neighbour's."""
        bodies = [self.body, *self.close]
        poses = [T_world_obj, *(o.T_start for o in self.close)]
        clouds = [cloud, *(_no_points(cloud) for _ in self.close)]
        return near_start.assign_points(bodies, poses, clouds)[0]

    def checks(self, T_world_obj: Array) -> dict[str, float]:
        """Return the registration's checks of the object at a pose, neighbours in place."""
        cloud = average_cloud(self.near, self.body.T_start, near_start.fine_voxel(self.body))
        own = self.own(cloud, T_world_obj)
        comparer = self.spread(verify.FRAMES)
        bodies = [self.body, *self.hiding]
        poses = [T_world_obj, *(o.T_start for o in self.hiding)]
        rays = verify.RAYS * _ray_share(comparer, bodies, poses)
        comparer = replace(comparer, rays=max(1, round(rays)))
        clouds = [own, *(_no_points(own) for _ in self.hiding)]
        found = verify.verify_objects(bodies, poses, clouds, comparer)[0]
        return {name: float(v) for name, v in found.checks.items() if np.isfinite(v)}


def _no_points(cloud: Cloud) -> Cloud:
    """Return a cloud of which nothing is left: a neighbour that is not asked."""
    return cloud.select(np.zeros(len(cloud.points), dtype=bool))


def _ray_share(comparer: Comparer, bodies: Sequence[Body], poses: Sequence[Array]) -> float:
    """Return by how much fewer rays are cast so that the first body gets as many as it should.

    All bodies are rendered at the stride of the smallest; a tiny neighbour would make it fine.
    """
    full = replace(comparer, rays=verify.RAYS)
    strides = [full.stride_of(b, T) for b, T in zip(bodies, poses, strict=True)]
    return (min(strides) / strides[0]) ** 2


def _task(
    views: MeasuredViews,
    body: Body,
    neighbours: Sequence[Body],
    plane: SupportPlane | None,
    config: RegistrationConfig,
) -> _Task:
    """Return the object, the neighbours that matter, and the measured points around it."""
    center = body.center(body.T_start)
    off = views.points - center.astype(np.float32)
    away2 = np.einsum("ij,ij->i", off, off)
    table_m = config.refine.points.table_margin_m
    index = np.flatnonzero(away2 < (body.radius_m + max(REACH_M, table_m)) ** 2)
    within = index[away2[index] < (body.radius_m + REACH_M) ** 2]
    near = without_table(views.cloud(within), plane, near_start.drop_height(body, plane))
    comparer = replace(views.comparer, plane=plane)
    balls = [(o.center(o.T_start), o.radius_m) for o in neighbours]
    ball = (center, body.radius_m)
    apart = [float(np.linalg.norm(c - center)) - r - body.radius_m for c, r in balls]
    close = tuple(o for o, gap in zip(neighbours, apart, strict=True) if gap < REACH_M)
    chosen = spread_frames(comparer.frames, center, verify.FRAMES)
    eyes = [f.T_world_cam[:3, 3] for f in chosen]
    hiding = tuple(
        o
        for o, b, gap in zip(neighbours, balls, apart, strict=True)
        if gap < TOUCH_M or any(_may_hide(b, ball, eye) for eye in eyes)
    )
    return _Task(views, config, plane, comparer, body, close, hiding, index, near)


def _may_hide(nearer: tuple[Array, float], farther: tuple[Array, float], eye: Array) -> bool:
    """Return whether a ball (centre, radius) may stand before another, seen from a point (3,)."""
    (a, r), (b, s) = nearer, farther
    to_a, to_b = a - eye, b - eye
    away, beyond = float(np.linalg.norm(to_a)), float(np.linalg.norm(to_b))
    if away <= r or beyond <= s:
        return True
    if away - r > beyond + s:
        return False
    between = np.arccos(np.clip(to_a @ to_b / (away * beyond), -1.0, 1.0))
    return bool(between < np.arcsin(r / away) + np.arcsin(s / beyond))


def _snapped(task: _Task, tick: Callable[[], None]) -> Snapped:
    """Return the result of all stages."""
    body, config, T_start = task.body, task.config, task.body.T_start
    free = _without_neighbours(task.near, task.close)
    coarse = average_cloud(free, T_start, near_start.coarse_voxel(body))
    if len(coarse.points) < LEAST_POINTS:
        taken = len(task.near.points) - len(free.points)
        return _nothing(body, task.checks(T_start), len(coarse.points), taken)
    fine = average_cloud(free, T_start, near_start.fine_voxel(body))
    few = task.spread(FRAMES)
    space = near_start.free_space_of(few) if len(task.views.views) < config.refine_from else None
    found = near_start.search(body, coarse, fine, few, space)
    tick()
    T = _refined(task, found.fit.T_world_obj)
    tick()
    mine = task.own(fine, T)
    still = solve_pose(body, mine, T, FINE[-1:]).at(T)
    kept = keep_start(body, still, (mine, few, space), config.covariance)
    if kept.report.get("start_kept"):
        T = nearest_to_start(T, T_start, body.center_obj, list(kept.axes))
    sure = uncertainty(body, still.at(T), task.views.stride_px, config.covariance)
    tick()
    stride = few.stride_of(body, T_start)
    before, after = (few.gain(body, pose, stride)[0] for pose in (T_start, T))
    checks = task.checks(T_start), task.checks(T)
    doubtful = verify.AGREE[0]
    told = _told(body, T, sure.covariance, checks, (before, after), doubtful)
    tick()
    return told


def _without_neighbours(cloud: Cloud, neighbours: Sequence[Body]) -> Cloud:
    """Return the points that no neighbour explains."""
    free = np.ones(len(cloud.points), dtype=bool)
    for other in neighbours:
        d = other.field.distance(cloud.points, se3.invert(other.T_start))
        free &= np.abs(d) > NEIGHBOUR_M
    return cloud.select(free)


def _refined(task: _Task, T_found: Array) -> Array:
    """Return the pose (4, 4) that the raw points say, cameras and depth held."""
    world = task.views.points[task.index].astype(np.float64)
    d = np.abs(task.body.field.distance(world, se3.invert(T_found)))
    mine = np.ones(len(world), dtype=bool)
    for other in task.close:
        e = np.abs(other.field.distance(world, se3.invert(other.T_start)))
        # What lies near both is the nearer one's, as in the registration.
        mine &= (d <= e) | (e > task.config.refine.points.reach_m)
    try:
        refined = refine(
            task.comparer.intrinsics, task.views.views_with(task.index[mine]), [task.body],
            [T_found], task.plane, task.comparer.noise, held_cameras(task.config.refine),
        )  # fmt: skip
    except DegenerateError:
        return T_found  # too few raw points near it: the fit to the averaged ones stands
    return se3.check_rigid(refined.poses[0], "the refined pose")


def held_cameras(config: RefineConfig) -> RefineConfig:
    """Return a refinement's constants with the cameras and the depth's bias held."""
    prior = CameraPrior(
        hand_eye_mm=1e-6, hand_eye_deg=1e-6, view_mm=1e-6, view_deg=1e-6, learn_views=False
    )
    return replace(config, prior=prior, fit_bias=False, bias=DepthBias.none())


def _ticker(progress: Progress | None, images: int) -> Callable[[], None]:
    """Return what counts the steps of a snap."""
    total, done = min(images, MOST_VIEWS) + STAGES, 0

    def tick() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    return tick


def _nothing(body: Body, checks: dict[str, float], points: int, taken: int) -> Snapped:
    """Return that the object was left where it is."""
    others = f"; {taken} more lie on other objects" if taken else ""
    words = (
        f"left where it is: the depth says nothing here. {points} averaged points lie within "
        f"{1e3 * REACH_M:.0f} mm of it ({LEAST_POINTS} are needed){others}. Place it nearer, or by "
        "three points."
    )
    return Snapped(
        T_world_obj=body.T_start.copy(), covariance=None, checks=checks, checks_before=checks,
        moved_mm=0.0, turned_deg=0.0, words=words, is_better=False,
    )  # fmt: skip


def _told(
    body: Body,
    T: Array,
    covariance: Array,
    checks: tuple[dict[str, float], dict[str, float]],
    gains: tuple[float, float],
    doubtful: float,
) -> Snapped:
    """Return the result with what happened in words.

    Args:
        body: the object at its start.
        T: (4, 4) where it is.
        covariance: (6, 6).
        checks: at the start, and there.
        gains: how much better than the bare table the two poses explain the depth.
        doubtful: share of agreeing pixels below which the registration doubts a pose.
    """
    step = moved(body.T_start, T, body.model.mesh)
    before, after = (100 * c.get("agree", 0.0) for c in checks)
    figures = (
        f"moved {step.mm:.1f} mm, {step.deg:.1f} deg; depth agrees at {after:.0f} % of its "
        f"pixels, {before:.0f} % before"
    )
    is_better = False
    if step.mm > RAN_OFF_MM:
        words = f"ran off: {figures}. It found something {step.mm:.0f} mm away; place it nearer."
    elif checks[1].get("n_pixels", 0.0) == 0.0:
        words = f"{figures}. No view sees it there: the depth says nothing."
    elif gains[1] < gains[0] - WORSE_SHARE * abs(gains[0]):
        words = f"went worse: {figures}. It explains the depth less well than the start did."
    else:
        is_better = True
        small = step.mm < SAME_MM and step.deg < SAME_DEG
        words = f"was in its place already: {figures}" if small else figures
        if after < 100 * doubtful:
            words += f". That is less than the {100 * doubtful:.0f} % of a pose that fits."
    return Snapped(
        T_world_obj=T, covariance=covariance, checks=checks[1], checks_before=checks[0],
        moved_mm=step.mm, turned_deg=step.deg, words=words, is_better=is_better,
    )  # fmt: skip
