"""Register a scene: the pose of every object in every view, checked without ground truth.

1. Intake: every image thinned out once; the table; views that do not belong are left out.
2. Search: every object near its start, near a hint, or anywhere; known by name or not.
3. Fit: four and more views: objects, cameras, table and depth bias together. Fewer: the objects
   alone, with the cameras at their word.
4. What the points do not determine is set back to the start's value.
5. Covariance, checks, probability, verdict; the same for the paper's way, ICP in one view.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, ObjectModel, ObjectPose, Scene, names_of
from realsim.registration.body import Body, make_body
from realsim.registration.compare import Comparer
from realsim.registration.config import METHODS, RegistrationConfig
from realsim.registration.covariance import uncertainty
from realsim.registration.evidence import DepthFrame
from realsim.registration.few_views import begin, register_few, search_near
from realsim.registration.intake import Intake, take_in
from realsim.registration.judge import Judged, Poses, judged
from realsim.registration.judging.probability import CONTRAST_DECIDED
from realsim.registration.judging.unit_checks import unit_errors
from realsim.registration.many_views import ManyViews, comparer_on, register_many
from realsim.registration.near_rivals import Duel, duels
from realsim.registration.refinement.uncertainty import SeenPose
from realsim.registration.reports import (
    camera_report,
    common_report,
    object_report,
    plane_report,
    search_report,
)
from realsim.registration.result import Registration
from realsim.registration.search.find import find_objects
from realsim.registration.search.records import NotPlaced, Placed, Region, SearchResult, Wanted
from realsim.registration.single_view import fit_single_view, reference_frame
from realsim.registration.verify import verify_objects

__all__ = ["DepthFrame", "Registration", "RegistrationConfig", "register_scene"]

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]


def register_scene(
    name: str,
    intrinsics: CameraIntrinsics,
    frames: Sequence[DepthFrame],
    models: Mapping[int, ObjectModel],
    wanted: Sequence[ObjectPose] | Sequence[Wanted] | None,
    config: RegistrationConfig | None = None,
    *,
    gravity_up_world: ArrayLike | None = None,
    progress: Progress | None = None,
) -> Registration:
    """Return the pose of every object in world from all depth frames together.

    Args:
        name: of the scene.
        intrinsics: the camera of all frames.
        frames: depth images with camera poses; one is enough. Their order does not matter.
        models: known objects by obj_id.
        wanted: rough poses, right to about 30 mm and 20 deg; or objects with a hint or none where
            they are; None = find out which of the models are there.
        config: see there.
        gravity_up_world: (3,) up; helps to tell the table from a wall.
        progress: called with (steps done, steps).

    Raises:
        InputError: an object names an unknown model, numbers repeat, images do not fit the camera,
            nothing is wanted, or no view can be used.
    """
    config = config or RegistrationConfig()
    if config.method not in METHODS:
        raise InputError(f"the method is '{config.method}'; {' or '.join(METHODS)} is accepted.")
    asked = _asked(models, wanted, config)
    tick = _Ticker(progress, len(frames) + 2 * max(len(asked or ()), 1) + config.refine.rounds + 3)
    up = None if gravity_up_world is None else np.asarray(gravity_up_world, dtype=np.float64)
    intake = take_in(intrinsics, frames, config, up, tick)
    asked, refused = _in_units(models, asked, intake, config)
    work = _Work(name, intake, models, config, up, tick)
    found = _found(work, asked)
    missing = (*refused, *found.not_placed)
    if not found.bodies:
        return _nothing(work, found, missing)
    if len(intake.frames) >= config.refine_from and config.refine_cameras:
        return _with_many(work, found, missing)
    return _with_few(work, found, missing)


class _Ticker:
    """Counts steps for the progress callback."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress, self._done, self._total = progress, 0, total

    def __call__(self) -> None:
        """One more step is done."""
        self._done += 1
        if self._progress is not None:
            self._progress(min(self._done, self._total), self._total)

    def each(self, done: int, total: int) -> None:
        """One more step of an inner loop is done."""
        self()


@dataclass(frozen=True, eq=False, slots=True)
class _Work:
    """What every step of one registration needs."""

    name: str
    intake: Intake
    models: Mapping[int, ObjectModel]
    config: RegistrationConfig
    up: Array | None
    tick: _Ticker


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Found:
    """What the search found."""

    bodies: list[Body]
    """At the poses that were found."""
    claimed: list[Array | None]
    """(4, 4) what somebody claimed of each."""
    contrasts: list[float | None]
    rivals: list[Array | None]
    """(4, 4) the best near-symmetric rival of each pose."""
    reports: list[dict[str, Any]]
    not_placed: tuple[NotPlaced, ...]
    report: dict[str, Any]


def _asked(
    models: Mapping[int, ObjectModel],
    wanted: Sequence[ObjectPose] | Sequence[Wanted] | None,
    config: RegistrationConfig,
) -> list[Wanted] | None:
    """Return what is wanted, each checked against the models.

    Raises:
        InputError: nothing is wanted, an unknown model, or a number twice.
    """
    if not models:
        raise InputError("no object models were given; registration needs the objects' meshes.")
    if wanted is None:
        return None
    if not wanted:
        raise InputError("no start poses were given; give one per object instance.")
    if len({s.instance for s in wanted}) != len(wanted):
        raise InputError("two start poses have the same instance number.")
    asked: list[Wanted] = []
    for w in wanted:
        model = models.get(w.obj_id)
        if model is None:
            raise InputError(
                f"instance {w.instance} is of object {w.obj_id}, which is not among the "
                f"models: {names_of(list(models.values()))}."
            )
        if isinstance(w, ObjectPose):
            T = w.T_world_obj
            region = Region(
                center_world=se3.transform(T, model.mesh.bounds.mean(0)[None])[0],
                radius_m=config.start_radius_m, R_world_obj=T[:3, :3],
                turn_deg=config.start_turn_deg,
            )  # fmt: skip
            w = Wanted(obj_id=w.obj_id, instance=w.instance, region=region, T_start=T)  # noqa: PLW2901
        asked.append(w)
    return asked


def _in_units(
    models: Mapping[int, ObjectModel],
    asked: list[Wanted] | None,
    intake: Intake,
    config: RegistrationConfig,
) -> tuple[list[Wanted] | None, list[NotPlaced]]:
    """Return what can be sought, and what is off by a factor of a thousand."""
    depths = [np.median(v.points[:, 2]) for v in intake.views if len(v.points)]
    if asked is None or not depths:
        return asked, []
    eyes = intake.cameras[:, :3, 3]
    starts = [
        ObjectPose(
            obj_id=w.obj_id, instance=w.instance,
            T_world_obj=_middle_pose(intake) if w.T_start is None else w.T_start,
        )
        for w in asked
    ]  # fmt: skip
    errors = unit_errors(models, starts, eyes, float(np.median(depths)), config.judging.units)
    refused = [
        NotPlaced(obj_id=w.obj_id, instance=w.instance, reason=str(errors[w.instance]))
        for w in asked if w.instance in errors
    ]  # fmt: skip
    return [w for w in asked if w.instance not in errors], refused


def _middle_pose(intake: Intake) -> Array:
    """Return a pose (4, 4) in front of the first camera, for objects of which nothing is said."""
    view = next(v for v in intake.views if len(v.points))
    return se3.from_translation(np.median(view.world(), axis=0))


def _found(work: _Work, asked: list[Wanted] | None) -> _Found:
    """Return the objects near their final poses, whatever was known of them before."""
    intake, config = work.intake, work.config
    near_only = asked is not None and all(w.T_start is not None for w in asked)
    few = len(intake.frames) < config.refine_from
    if asked is not None and not asked:
        return _Found(
            bodies=[], claimed=[], contrasts=[], rivals=[], reports=[], not_placed=(), report={}
        )
    if config.method == "top-down" or (near_only and (few or intake.plane is None)):
        return _found_near(work, asked or [])
    if intake.plane is None:
        lost = [w for w in asked or () if w.T_start is None]
        reason = (
            f"no table was found ({intake.no_plane}), so it can be anywhere; give a rough pose "
            "(30 mm, 20 deg)."
        )
        missing = [NotPlaced(obj_id=w.obj_id, instance=w.instance, reason=reason) for w in lost]
        near = [w for w in asked or () if w.T_start is not None]
        if asked is None:
            raise DegenerateError(
                f"no table was found: {intake.no_plane} Without one, objects can only be "
                "registered from rough poses; name them with their poses."
            )
        found = _found_near(work, near)
        return replace(found, not_placed=(*found.not_placed, *missing))
    result = find_objects(
        intake.intrinsics, intake.frames, intake.views, intake.plane, intake.noise, work.models,
        asked, config.find, field_folder=config.field_folder, progress=work.tick.each,
    )  # fmt: skip
    return _as_found(work, result, asked)


def _as_found(work: _Work, result: SearchResult, asked: list[Wanted] | None) -> _Found:
    """Return what a search placed as bodies."""
    claims = {w.instance: w.T_start for w in asked or ()}
    placed: list[Placed] = sorted(result.placed, key=lambda p: p.instance)
    return _Found(
        bodies=[_body(work, p.obj_id, p.instance, p.T_world_obj) for p in placed],
        claimed=[claims.get(p.instance) for p in placed],
        contrasts=[p.contrast for p in placed],
        rivals=[p.T_rival for p in placed],
        reports=[search_report(p) for p in placed],
        not_placed=result.not_placed, report=dict(result.report),
    )  # fmt: skip


def _found_near(work: _Work, asked: list[Wanted]) -> _Found:
    """Return the objects at their claimed starts; where there are few views the fit searches."""
    T_starts = [w.T_start for w in asked]
    bodies = [
        _body(work, w.obj_id, w.instance, T)
        for w, T in zip(asked, T_starts, strict=True) if T is not None
    ]  # fmt: skip
    reports: list[dict[str, Any]] = [{} for _ in bodies]
    many = len(work.intake.frames) >= work.config.refine_from and work.config.refine_cameras
    if many and bodies and work.config.method == "joint":
        started = begin(work.intake, bodies, work.config, work.up)
        found = search_near(started, bodies, work.tick)
        reports = [f.report for f in found]
        bodies = [
            replace(b, start=replace(b.start, T_world_obj=f.fit.T_world_obj))
            for b, f in zip(bodies, found, strict=True)
        ]
    return _Found(
        bodies=bodies, claimed=list(T_starts), contrasts=[None] * len(bodies),
        rivals=[None] * len(bodies), reports=reports,
        not_placed=(), report={},
    )  # fmt: skip


def _body(work: _Work, obj_id: int, instance: int, T: Array) -> Body:
    """Return the body of an instance at a pose."""
    c = work.config
    start = ObjectPose(obj_id=obj_id, instance=instance, T_world_obj=T)
    return make_body(start, work.models[obj_id], c.field_cells, c.samples, c.field_folder)


def _claimed_bodies(found: _Found) -> list[Body]:
    """Return the bodies with the starts that somebody claimed, where somebody did."""
    return [
        b if T is None else replace(b, start=replace(b.start, T_world_obj=T))
        for b, T in zip(found.bodies, found.claimed, strict=True)
    ]


def _with_many(work: _Work, found: _Found, missing: tuple[NotPlaced, ...]) -> Registration:
    """Return the registration with everything refined together."""
    intake, config = work.intake, work.config
    claimed = _claimed_bodies(found)
    starts = [b if T is not None else None for b, T in zip(claimed, found.claimed, strict=True)]
    many = register_many(intake, found.bodies, starts, intake.plane, config, work.tick.each)
    fought = _fought(found, many, config)
    lost = [_is_lost(d) for d in fought]
    if any(lost):
        bodies = [
            b if d is None or not gone
            else replace(b, start=replace(b.start, T_world_obj=d.T_rival))
            for b, d, gone in zip(found.bodies, fought, lost, strict=True)
        ]  # fmt: skip
        rivals = [
            b.T_start if gone else R
            for b, R, gone in zip(found.bodies, found.rivals, lost, strict=True)
        ]
        found = replace(found, bodies=bodies, rivals=rivals)
        many = register_many(intake, bodies, starts, intake.plane, config)
        fought = _fought(found, many, config)
    contrasts = [
        c if d is None else d.contrast for c, d in zip(found.contrasts, fought, strict=True)
    ]
    comparer = comparer_on(intake, many.frames, many.plane, claimed, many.poses, config)
    uncertain = [
        uncertainty(b, k.fit, 1, config.covariance) for b, k in zip(claimed, many.kept, strict=True)
    ]
    given = Poses(
        bodies=claimed, poses=many.poses, clouds=many.clouds, covariances=list(many.covariances),
        blind=[len(u.unobservable) for u in uncertain], contrasts=contrasts,
        cameras=many.refined.cameras, plane=many.plane,
        with_starts=all(T is not None for T in found.claimed),
    )  # fmt: skip
    result = judged(intake, given, comparer, config)
    work.tick()
    numbers = [f.index for f in intake.frames]
    instances = [b.start.instance for b in claimed]
    seen = {
        number: {i: of[v] for i, of in zip(instances, many.seen, strict=True)}
        for v, number in enumerate(numbers)
    }
    extra = {"refinement": camera_report(many, numbers)}
    reports = [
        object_report(b, o, k, r, u)
        for b, o, k, r, u in zip(
            claimed, result.objects, many.kept, found.reports, uncertain, strict=True
        )
    ]
    cameras = dict(zip(numbers, many.refined.cameras, strict=True))
    return _registration(
        work, (found, missing), (given, result, comparer), (cameras, seen), (extra, reports)
    )


def _is_lost(fought: Duel | None) -> bool:
    """Return whether the rival is clearly the better pose."""
    contrast = None if fought is None else fought.contrast
    return contrast is not None and contrast < -CONTRAST_DECIDED


def _fought(found: _Found, many: ManyViews, config: RegistrationConfig) -> list[Duel | None]:
    """Return how every pose compares with its near-symmetric rival, cameras refined."""
    rivals = [
        None if R is None else T @ se3.invert(b.T_start) @ R
        for b, T, R in zip(found.bodies, many.refined.poses, found.rivals, strict=True)
    ]
    poses, misfits = list(many.refined.poses), list(many.refined.misfit_m[:-1])
    return duels(found.bodies, poses, rivals, many.clouds, misfits, config.rivals)


def _with_few(work: _Work, found: _Found, missing: tuple[NotPlaced, ...]) -> Registration:
    """Return the registration with the cameras at their word."""
    intake, config = work.intake, work.config
    few = register_few(intake, found.bodies, config, work.up, work.tick)
    claimed = _claimed_bodies(found)
    plane = few.plane if few.plane is not None else intake.plane
    poses = [k.fit.T_world_obj for k in few.kept]
    comparer = comparer_on(intake, intake.frames, plane, claimed, poses, config)
    uncertain = [
        uncertainty(b, k.fit, few.stride, config.covariance)
        for b, k in zip(claimed, few.kept, strict=True)
    ]
    given = Poses(
        bodies=claimed, poses=poses, clouds=few.clouds,
        covariances=[u.covariance for u in uncertain],
        blind=[len(u.unobservable) for u in uncertain], contrasts=found.contrasts,
        cameras=intake.cameras, plane=plane,
        with_starts=all(T is not None for T in found.claimed),
    )  # fmt: skip
    result = judged(intake, given, comparer, config)
    work.tick()
    reports = [
        object_report(b, o, k, {**r, **f.report}, u)
        for b, o, k, r, f, u in zip(
            claimed, result.objects, few.kept, found.reports, few.found, uncertain, strict=True
        )
    ]
    cameras = {f.index: f.T_world_cam for f in intake.frames}
    extra: dict[str, Any] = {"joint": few.history}
    return _registration(
        work, (found, missing), (given, result, comparer), (cameras, {}), (extra, reports)
    )


def _nothing(work: _Work, found: _Found, missing: tuple[NotPlaced, ...]) -> Registration:
    """Return the registration of a scene in which nothing was found."""
    scene = Scene(name=work.name, objects=(), plane=work.intake.plane)
    return Registration(
        scene=scene, single_view=scene,
        cameras={f.index: f.T_world_cam for f in work.intake.frames}, seen={},
        not_placed=missing, findings=work.intake.findings,
        report={"frames": [f.index for f in work.intake.frames], "objects": [],
                "plane": plane_report(work.intake.plane, work.intake.no_plane),
                "search": found.report},
    )  # fmt: skip


def _registration(
    work: _Work,
    search: tuple[_Found, tuple[NotPlaced, ...]],
    results: tuple[Poses, Judged, Comparer],
    views: tuple[dict[int, Array], dict[int, dict[int, SeenPose]]],
    reports: tuple[dict[str, Any], list[dict[str, Any]]],
) -> Registration:
    """Return all parts together, with the paper's way beside them."""
    (found, missing), (given, result, comparer) = search, results
    intake, config = work.intake, work.config
    single, single_report = _single_view(work, given, comparer)
    work.tick()
    objects = tuple(result.objects)
    baseline = Scene(name=f"{work.name} (single view)", objects=tuple(single), plane=given.plane)
    if config.method == "top-down":
        scene = replace(baseline, name=work.name)
    else:
        scene = Scene(name=work.name, objects=objects, plane=given.plane)
    report = {
        "method": config.method,
        "frames": [f.index for f in intake.frames],
        "stride_px": round(float(np.sqrt(intake.views[0].area_px))),
        "noise_per_m": intake.noise.per_m,
        "plane": plane_report(given.plane, intake.no_plane),
        **common_report(given, objects, config),
        "search": found.report,
        "single_view": single_report,
        "not_placed": [
            {"obj_id": n.obj_id, "instance": n.instance, "reason": n.reason} for n in missing
        ],
        "findings": [
            {"kind": f.kind, "words": f.words} for f in (*intake.findings, *result.findings)
        ],
        **reports[0],
        "objects": reports[1],
    }
    return Registration(
        scene=scene, single_view=baseline, cameras=views[0], seen=views[1], not_placed=missing,
        findings=(*intake.findings, *result.findings), report=report,
    )  # fmt: skip


def _single_view(
    work: _Work, given: Poses, comparer: Comparer
) -> tuple[list[ObjectPose], dict[str, Any]]:
    """Return the baseline's poses and which frame it used; objects it cannot see are left out."""
    config, intake = work.config, work.intake
    if not (config.with_single_view or config.method == "top-down"):
        return [], {"frame": None, "not_fitted": []}
    center = np.mean([b.center(b.T_start) for b in given.bodies], axis=0)
    frame = reference_frame(intake.frames, given.plane, center)
    kept: list[int] = []
    poses: list[Array] = []
    missing: list[str] = []
    for i, body in enumerate(given.bodies):
        try:
            T = fit_single_view(body, intake.intrinsics, frame, config.single_view)
        except DegenerateError as error:
            missing.append(f"instance {body.start.instance}: {error}")
            continue
        kept.append(i)
        poses.append(T)
    checked = verify_objects(
        [given.bodies[i] for i in kept], poses, [given.clouds[i] for i in kept], comparer,
        config.verify,
    )  # fmt: skip
    objects = [
        ObjectPose(
            obj_id=given.bodies[i].start.obj_id, instance=given.bodies[i].start.instance,
            T_world_obj=T, checks=c.checks, verdict=c.verdict, reasons=c.reasons,
        )
        for i, T, c in zip(kept, poses, checked, strict=True)
    ]  # fmt: skip
    return objects, {"frame": frame.index, "not_fitted": missing}
