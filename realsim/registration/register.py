"""Register a scene: the pose of every object in every view, checked without ground truth.

1. Intake: every image thinned out once; the table; views that do not belong are left out.
2. Search: every object near its start, near a hint, or anywhere; known by name or not.
3. Fit: four and more views: objects, cameras, table and depth bias together. Fewer: the objects
   alone, with the cameras at their word.
4. What the points do not determine is set back to the start's value.
5. Covariance, checks, probability, verdict; the same for the paper's way, ICP in one view.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, ObjectModel, ObjectPose, Scene
from realsim.registration.blind import Kept
from realsim.registration.body import Body
from realsim.registration.compare import Comparer
from realsim.registration.config import METHODS, RegistrationConfig
from realsim.registration.covariance import uncertainty
from realsim.registration.evidence import DepthFrame
from realsim.registration.few_views import register_few
from realsim.registration.finding import (
    FoundObjects,
    Progress,
    Ticker,
    RegistrationTask,
    claimed_bodies,
    found_objects,
    in_units,
    models_in_units,
    wanted_objects,
)
from realsim.registration.intake import Intake, check_odometry, take_in
from realsim.registration.judge import Judged, Poses, judged
from realsim.registration.judging.probability import CONTRAST_DECIDED
from realsim.registration.many_views import ManyViews, comparer_on, register_many
from realsim.registration.near_rivals import Duel, duels
from realsim.registration.refinement.uncertainty import SeenPose
from realsim.registration.reports import (
    camera_report,
    common_report,
    object_report,
    plane_report,
)
from realsim.registration.result import Finding, Registration
from realsim.registration.search.records import NotPlaced, Wanted
from realsim.registration.single_view import fit_single_view, reference_frame
from realsim.registration.verify import verify_objects
from realsim.registration.view_checks import check_views

__all__ = ["DepthFrame", "Registration", "RegistrationConfig", "register_scene"]

Array = NDArray[np.float64]


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
    asked = wanted_objects(models, wanted, config)
    tick = Ticker(progress, len(frames) + 2 * max(len(asked or ()), 1) + config.refine.rounds + 3)
    up = None if gravity_up_world is None else np.asarray(gravity_up_world, dtype=np.float64)
    intake = take_in(intrinsics, frames, config, up, tick)
    asked, refused = in_units(models, asked, intake, config)
    if asked is None:
        models, refused = models_in_units(models, intake, config)
    kinematics = None
    if config.odometry:
        kinematics, why_not = check_odometry(intake, config)
        if why_not is not None:
            intake = replace(intake, findings=(*intake.findings, why_not))
    work = RegistrationTask(name, intake, models, config, up, tick, kinematics)
    found = found_objects(work, asked)
    missing = (*refused, *found.not_placed)
    if not found.bodies:
        return _nothing(work, found, missing)
    if len(intake.frames) >= config.refine_from and config.refine_cameras:
        return _with_many(work, found, missing)
    return _with_few(work, found, missing)


def _with_many(work: RegistrationTask, found: FoundObjects, missing: tuple[NotPlaced, ...]) -> Registration:
    """Return the registration with everything refined together."""
    intake, config = work.intake, work.config
    claimed = claimed_bodies(found)
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
        _contrast(c, d, k) for c, d, k in zip(found.contrasts, fought, many.kept, strict=True)
    ]
    comparer = comparer_on(intake, many.frames, many.plane, claimed, many.poses, config)
    uncertain = [
        uncertainty(b, k.fit, 1, config.covariance) for b, k in zip(claimed, many.kept, strict=True)
    ]
    given = Poses(
        bodies=claimed, poses=many.poses, clouds=many.clouds, covariances=list(many.covariances),
        blind=[len(u.unobservable) for u in uncertain], contrasts=contrasts,
        cameras=many.refined.cameras, plane=many.plane,
        known=found.findings, with_starts=all(T is not None for T in found.claimed),
    )  # fmt: skip
    result = judged(intake, given, comparer, config)
    off = _views_off(intake, many, claimed, config)
    result = replace(result, findings=[*off, *result.findings])
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


def _views_off(
    intake: Intake, many: ManyViews, bodies: Sequence[Body], config: RegistrationConfig
) -> list[Finding]:
    """Return the views that do not fit the registered objects, their cameras refined."""
    views = [
        replace(v, T_world_cam=T) for v, T in zip(intake.views, many.refined.cameras, strict=True)
    ]
    found = check_views(
        views, many.plane, intake.noise, config.judging.views, bodies=bodies,
        Ts_world_obj=many.poses,
    )  # fmt: skip
    known = {f.index for f in intake.findings}
    return [f for f in found if f.kind == "objects_off" and f.index not in known]


def _contrast(search: float | None, fought: Duel | None, kept: Kept) -> float | None:
    """Return how clearly a pose is better than its rival; None = it has none.

    Where the depth cannot see a turn and the claimed one was kept, a rival that is no worse is the
    same object turned unseen.
    """
    contrast = search if fought is None else fought.contrast
    unseen = bool(kept.report.get("start_kept"))
    if unseen and contrast is not None and abs(contrast) < CONTRAST_DECIDED:
        return None
    return contrast


def _is_lost(fought: Duel | None) -> bool:
    """Return whether the rival is clearly the better pose."""
    contrast = None if fought is None else fought.contrast
    return contrast is not None and contrast < -CONTRAST_DECIDED


def _fought(found: FoundObjects, many: ManyViews, config: RegistrationConfig) -> list[Duel | None]:
    """Return how every pose compares with its near-symmetric rival, cameras refined."""
    rivals = [
        None if R is None else T @ se3.invert(b.T_start) @ R
        for b, T, R in zip(found.bodies, many.refined.poses, found.rivals, strict=True)
    ]
    poses, misfits = list(many.refined.poses), list(many.refined.misfit_m[:-1])
    return duels(found.bodies, poses, rivals, many.clouds, misfits, config.rivals)


def _with_few(work: RegistrationTask, found: FoundObjects, missing: tuple[NotPlaced, ...]) -> Registration:
    """Return the registration with the cameras at their word."""
    intake, config = work.intake, work.config
    few = register_few(intake, found.bodies, config, work.up, work.tick)
    claimed = claimed_bodies(found)
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
        known=found.findings, with_starts=all(T is not None for T in found.claimed),
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


def _nothing(work: RegistrationTask, found: FoundObjects, missing: tuple[NotPlaced, ...]) -> Registration:
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
    work: RegistrationTask,
    search: tuple[FoundObjects, tuple[NotPlaced, ...]],
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
        # The paper carries its poses to the other views by the cameras as they are claimed.
        views = {f.index: f.T_world_cam for f in intake.frames}, {}
        missing = (*missing, *_not_seen(given, single, single_report))
    else:
        scene = Scene(name=work.name, objects=objects, plane=given.plane)
    gross = () if work.kinematics is None else work.kinematics.faults
    findings = (*intake.findings, *gross, *result.findings)
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
        "findings": [{"kind": f.kind, "words": f.words} for f in findings],
        "kinematics": None if work.kinematics is None else work.kinematics.as_json(),
        **reports[0],
        "objects": reports[1],
    }
    return Registration(
        scene=scene, single_view=baseline, cameras=views[0], seen=views[1], not_placed=missing,
        findings=findings, report=report,
    )  # fmt: skip


def _not_seen(
    given: Poses, single: Sequence[ObjectPose], report: Mapping[str, Any]
) -> list[NotPlaced]:
    """Return the objects that the single view could not be fitted to."""
    fitted = {o.instance for o in single}
    starts = [b.start for b in given.bodies if b.start.instance not in fitted]
    return [
        NotPlaced(obj_id=s.obj_id, instance=s.instance, reason=f"in view {report['frame']}: {why}")
        for s, why in zip(starts, report["not_fitted"], strict=True)
    ]


def _single_view(
    work: RegistrationTask, given: Poses, comparer: Comparer
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
