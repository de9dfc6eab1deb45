"""Register a scene: the pose of every object in every view, checked without ground truth.

1. Intake: every image thinned out once; the table; views that do not belong are left out.
2. Search: every object near its start, near a hint, or anywhere; known by name or not.
3. Fit: four and more views: objects, cameras, table and depth bias together. Fewer: the objects
   alone, with the cameras at their word.
4. What the points do not determine is set back to the start's value.
5. Covariance, checks, probability, verdict; the same for the paper's way, ICP in one view.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, ObjectModel, ObjectPose, Scene
from realsim.registration import finding, reports, second_look
from realsim.registration.blind import Kept, Uncertainty, uncertainty
from realsim.registration.body import Body, moved_body
from realsim.registration.compare import spread_frames
from realsim.registration.config import METHODS, RegistrationConfig
from realsim.registration.evidence import DepthFrame
from realsim.registration.few_views import few_around, register_few, with_photograph
from realsim.registration.intake import check_odometry, take_in, without_fixed
from realsim.registration.judge import Defect, Poses, judge_objects
from realsim.registration.judging.verdict import CONTRAST_DECIDED
from realsim.registration.many_views import ManyViews, comparer_on, register_many
from realsim.registration.near_rivals import PRINT_VIEWS, Duel, duel, duels_by_print
from realsim.registration.refinement.uncertainty import SeenPose
from realsim.registration.registered import (
    Registration,
    finding_report,
    is_wrong,
    missing_report,
    with_rejected,
    without_inventions,
)
from realsim.registration.rivals_around import Around, integrated
from realsim.registration.search.records import NotPlaced, Wanted
from realsim.registration.top_down import not_seen, top_down_poses
from realsim.registration.views import FixedFrames, ViewPoints

__all__ = ["DepthFrame", "Registration", "RegistrationConfig", "register_scene"]


def register_scene(  # noqa: PLR0913 - the inputs, and two ways to follow them
    name: str,
    intrinsics: CameraIntrinsics,
    frames: Sequence[DepthFrame],
    models: Mapping[int, ObjectModel],
    wanted: Sequence[ObjectPose] | Sequence[Wanted] | None,
    config: RegistrationConfig | None = None,
    *,
    fixed: Sequence[FixedFrames] = (),
    gravity_up_world: ArrayLike | None = None,
    progress: finding.Progress | None = None,
    told: Callable[[str], None] | None = None,
) -> Registration:
    """Return the pose of every object in world from all depth frames together.

    Args:
        name: of the scene.
        intrinsics: the camera of all frames, the one in the hand.
        frames: depth images with camera poses; one is enough. Their order does not matter.
        models: known objects by obj_id.
        wanted: rough poses, right to about 30 mm and 20 deg; or objects with a hint or none where
            they are; None = find out which of the models are there.
        config: settings.
        fixed: cameras that stand still: one view more each for the joint fit.
        gravity_up_world: (3,) up; helps to tell the table from a wall.
        progress: called with (steps done, steps).
        told: called with words for what is being done.

    Raises:
        InputError: an object names an unknown model, numbers repeat, images do not fit the camera,
            nothing is wanted, or no view can be used.
    """
    config = config or RegistrationConfig()
    if config.method not in METHODS:
        raise InputError(f"the method is '{config.method}'; {' or '.join(METHODS)} is accepted.")
    asked = finding.wanted_objects(models, wanted)
    sought = len(models if asked is None else asked)
    tick = finding.Ticker(progress, len(frames) + 2 * sought + config.refine.rounds + 3, told)
    up = None if gravity_up_world is None else np.asarray(gravity_up_world, dtype=np.float64)
    intake = take_in(intrinsics, frames, config, up, tick, fixed)
    asked, refused = finding.in_units(models, asked, intake)
    if asked is None:
        models, refused = finding.models_in_units(models, intake)
    kinematics = None
    if config.odometry:
        kinematics, why_not = check_odometry(intake, config)
        if why_not is not None:
            intake = replace(intake, findings=(*intake.findings, why_not))
    task = finding.SceneTask(name, intake, models, config, up, tick, kinematics, {})
    if asked is not None:
        task = task.symmetric(w.obj_id for w in asked)
    result = _sought(task, asked, tuple(refused))
    return result if asked is not None else without_inventions(result)


def _sought(
    task: finding.SceneTask, asked: list[Wanted] | None, refused: tuple[NotPlaced, ...]
) -> Registration:
    """Return what was found, fitted and judged."""
    found = finding.seek_objects(task, asked)
    missing = (*refused, *found.not_placed)
    if not found.bodies:
        return _nothing(task, found, missing)
    many = len(task.intake.all_views) >= task.config.refine_from and task.config.refine_cameras
    if not many:
        task = replace(task, intake=without_fixed(task.intake, task.config.refine_from))
        return _registration(task, found, missing, _fit_few(task, found))
    before = task.intake.plane
    task, found, fit = _fit_many(task, found, asked or ())
    if before is not None and task.intake.plane is None:
        # What was sought on a table that is not there is sought again.
        task, found, fit = _fit_many(task, finding.seek_objects(task, asked), asked or ())
    missing = (*refused, *found.not_placed)
    result = _registration(task, found, missing, fit)
    bad = {o.instance for o in result.scene.objects if is_wrong(o)}
    if not bad or len(bad) == len(found.bodies):
        return result
    # What is not there must not pull the cameras.
    task, rest, fit = _fit_many(task, finding.without_objects(found, bad), ())
    return with_rejected(_registration(task, rest, missing, fit), result, bad)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Fit:
    """Objects at their final poses, not yet judged."""

    poses: Poses
    frames: Sequence[DepthFrame]
    """Frames with the cameras and the depth as they are now known."""
    views: tuple[ViewPoints, ...]
    """Points of the frames."""
    fixed: tuple[ViewPoints, ...]
    """Points of the cameras that stand still."""
    kept: list[Kept]
    uncertain: list[Uncertainty]
    searches: list[dict[str, Any]]
    """Per object how it was found, as JSON values."""
    seen: dict[int, dict[int, SeenPose]]
    """See `Registration`."""
    findings: list[Defect]
    """What does not fit the objects."""
    report: dict[str, Any]
    """Report of what all objects have in common, as JSON values."""


def _fit_many(
    task: finding.SceneTask, found: finding.FoundObjects, asked: Sequence[Wanted]
) -> tuple[finding.SceneTask, finding.FoundObjects, _Fit]:
    """Return everything refined together, without a table and views that the fit contradicts.

    The objects are those given and the flat ones that only refined views show.
    """
    intake, config = task.intake, task.config
    many = register_many(intake, found.bodies, _starts(found), intake.plane, config, task.tick.each)
    looked = intake
    # Of what nobody named, a model may have been laid into one place many times.
    found_models = {b.model.obj_id: b.model for b in found.bodies}
    wanted = [task.models[w.obj_id] for w in asked] or list(found_models.values())
    if many.plane is not None and not second_look.is_beside_objects(
        many, found.bodies, many.plane, wanted
    ):
        looked = replace(looked, plane=None, no_plane=second_look.NO_TABLE)
    moves = second_look.camera_moves(many, found.bodies)
    if odd := second_look.odd_views(looked, moves, config.refine_from):
        looked = second_look.without_views(looked, odd)
    if looked is not intake:
        intake, task = looked, replace(task, intake=looked)
        many = register_many(intake, found.bodies, _starts(found), intake.plane, config)
    if (more := finding.with_flat(task, found, many, asked)) is not None:
        found = more
        many = register_many(intake, found.bodies, _starts(found), intake.plane, config)
    claimed, starts = finding.claimed_bodies(found), _starts(found)
    fought = _duels(found, many)
    if any(_is_lost(d) for d in fought):
        found = _with_rivals(found, fought)
        many = register_many(intake, found.bodies, starts, intake.plane, config)
        fought = _duels(found, many)
    contrasts, printed = _print_duels(task, found, many, fought)
    if any(_is_lost(d) for d in printed):
        found = _with_rivals(found, printed)
        many = register_many(intake, found.bodies, starts, intake.plane, config)
    uncertain = [
        uncertainty(b, k.fit, 1, config.covariance) for b, k in zip(claimed, many.kept, strict=True)
    ]
    poses = Poses(
        bodies=claimed, poses=many.poses, clouds=many.clouds, covariances=list(many.covariances),
        blind=[len(u.unobservable) for u in uncertain],
        contrasts=contrasts,
        cameras=many.refined.cameras, plane=many.plane,
        table_off_m=float(many.refined.misfit_m[-1]),
        known=found.findings, with_starts=all(T is not None for T in found.claimed),
    )  # fmt: skip
    numbers = [f.index for f in intake.frames]
    moved = second_look.far_moved(second_look.camera_moves(many, claimed), config)
    return task, found, _Fit(
        poses=poses, frames=many.frames, views=many.hand_views,
        fixed=many.views[len(many.frames):], kept=many.kept, uncertain=uncertain,
        searches=found.reports,
        seen={
            number: {
                b.start.instance: of[v] for b, of in zip(claimed, many.seen, strict=True)
            }
            for v, number in enumerate(numbers)
        },
        findings=[*moved, *second_look.views_off(intake, many, claimed)],
        report={"refinement": reports.camera_report(many, claimed, numbers)},
    )  # fmt: skip


def _starts(found: finding.FoundObjects) -> list[Body | None]:
    """Return the bodies at the starts that somebody claimed; None = nobody did."""
    claimed = zip(finding.claimed_bodies(found), found.claimed, strict=True)
    return [None if T is None else body for body, T in claimed]


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


def _duels(found: finding.FoundObjects, many: ManyViews) -> list[Duel | None]:
    """Return how every pose compares with its near-symmetric rival, cameras refined."""
    poses, misfits = many.refined.poses, many.refined.misfit_m[:-1]
    rivals = _moved_rivals(found, poses)
    return [
        None if R is None else duel(b, T, R, cloud, float(m))
        for b, T, R, cloud, m in zip(found.bodies, poses, rivals, many.clouds, misfits, strict=True)
    ]


def _moved_rivals(found: finding.FoundObjects, poses: Iterable[Array]) -> list[Array | None]:
    """Return the rival of every object that has one, moved as the object was."""
    return [
        None if R is None else T @ se3.invert(b.T_start) @ R
        for b, T, R in zip(found.bodies, poses, found.rivals, strict=True)
    ]


def _print_duels(
    task: finding.SceneTask,
    found: finding.FoundObjects,
    many: ManyViews,
    fought: Sequence[Duel | None],
) -> tuple[list[float | None], list[Duel | None]]:
    """Return the contrasts, those that depth leaves open settled by the print, and its duels."""
    contrasts = [
        _contrast(c, d, k) for c, d, k in zip(found.contrasts, fought, many.kept, strict=True)
    ]
    bodies = [moved_body(b, T) for b, T in zip(found.bodies, many.poses, strict=True)]
    rivals = _moved_rivals(found, many.poses)
    middle = np.mean([b.center(b.T_start) for b in bodies], axis=0)
    some = tuple(spread_frames(many.frames, middle, PRINT_VIEWS))
    intake = replace(task.intake, frames=some, plane=many.plane)
    return duels_by_print(bodies, rivals, contrasts, intake, task.config)


def _with_rivals(
    found: finding.FoundObjects, fought: Sequence[Duel | None]
) -> finding.FoundObjects:
    """Return the objects with poses and rivals exchanged where the rival is the better one."""
    bodies, rivals = list(found.bodies), list(found.rivals)
    for n, d in enumerate(fought):
        if d is not None and _is_lost(d):
            rivals[n] = bodies[n].T_start
            bodies[n] = moved_body(bodies[n], d.T_rival)
    return replace(found, bodies=bodies, rivals=rivals)


def _fit_few(task: finding.SceneTask, found: finding.FoundObjects) -> _Fit:
    """Return the objects fitted with the cameras at their word."""
    intake, config = task.intake, task.config
    contrasts, fought = duels_by_print(found.bodies, found.rivals, found.contrasts, intake, config)
    found = replace(_with_rivals(found, fought), contrasts=contrasts)
    few = register_few(intake, found.bodies, config, task.up, task.tick)
    claimed = finding.claimed_bodies(found)
    intake, few, photo = with_photograph(intake, few, claimed, config)
    kept, tried = few.kept, list[Around]()
    if len(intake.frames) < config.refine_from:
        tried = few_around(intake, few, claimed, found.claimed, photo)
        kept = [replace(k, fit=a.fit) for k, a in zip(kept, tried, strict=True)]
    uncertain = [
        uncertainty(b, k.fit, few.stride, config.covariance)
        for b, k in zip(claimed, kept, strict=True)
    ]
    covariances = [u.covariance for u in uncertain]
    if photo is not None and photo.taken:
        covariances = photo.covariances
    poses = Poses(
        bodies=claimed, poses=[k.fit.T_world_obj for k in kept], clouds=few.clouds,
        covariances=[
            integrated(b, C, tried[k]) if tried else C
            for k, (b, C) in enumerate(zip(claimed, covariances, strict=True))
        ],
        around=tried,
        blind=[len(u.unobservable) for u in uncertain], contrasts=found.contrasts,
        cameras=intake.cameras, plane=few.plane if few.plane is not None else intake.plane,
        known=found.findings, with_starts=all(T is not None for T in found.claimed),
    )  # fmt: skip
    return _Fit(
        poses=poses, frames=intake.frames, views=intake.views, fixed=(), kept=kept,
        uncertain=uncertain,
        searches=[{**r, **f.report} for r, f in zip(found.reports, few.found, strict=True)],
        seen={}, findings=[], report={"joint": few.history, **reports.photo_report(photo)},
    )  # fmt: skip


def _nothing(
    task: finding.SceneTask, found: finding.FoundObjects, missing: tuple[NotPlaced, ...]
) -> Registration:
    """Return the registration of a scene in which nothing was found."""
    scene = Scene(name=task.name, objects=(), plane=task.intake.plane)
    return Registration(
        scene=scene, single_view=scene,
        cameras={f.index: f.T_world_cam for f in task.intake.frames},
        fixed_cameras=_said(task.intake.fixed), seen={}, not_placed=missing,
        findings=task.intake.findings,
        report={"frames": [f.index for f in task.intake.frames], "objects": [],
                "plane": reports.plane_report(task.intake.plane, task.intake.no_plane),
                "search": found.report},
    )  # fmt: skip


def _registration(
    task: finding.SceneTask, found: finding.FoundObjects, missing: tuple[NotPlaced, ...], fit: _Fit
) -> Registration:
    """Return the objects judged, with the paper's way beside them."""
    given, intake, config = fit.poses, task.intake, task.config
    comparer = comparer_on(intake, fit.frames, given.plane, given.bodies, given.poses)
    judgement = judge_objects(
        replace(intake, views=fit.views, fixed=fit.fixed), given, comparer, config
    )
    task.tick()
    single, single_report = top_down_poses(task, given, comparer)
    task.tick()
    objects = second_look.unsure(judgement.objects, fit.findings)
    scene = Scene(name=task.name, objects=objects, plane=given.plane)
    baseline = Scene(name=f"{task.name} (single view)", objects=tuple(single), plane=given.plane)
    cameras = {f.index: T for f, T in zip(intake.frames, given.cameras, strict=False)}
    still = _said(fit.fixed or intake.fixed)
    seen = fit.seen
    if config.method == "top-down":
        scene = replace(baseline, name=task.name)
        # The paper carries its poses to the other views by the cameras as they are claimed.
        cameras, seen = {f.index: f.T_world_cam for f in intake.frames}, {}
        still = _said(intake.fixed)
        missing = (*missing, *not_seen(given, single, single_report))
    gross = () if task.kinematics is None else task.kinematics.faults
    findings = (*intake.findings, *gross, *fit.findings, *judgement.findings)
    report = {
        "method": config.method,
        "frames": [f.index for f in intake.frames],
        "stride_px": round(float(np.sqrt(intake.views[0].area_px))),
        "noise_per_m": intake.noise.per_m,
        "plane": reports.plane_report(given.plane, intake.no_plane),
        **reports.common_report(given, objects),
        "search": found.report,
        "single_view": single_report,
        "not_placed": missing_report(missing),
        "findings": finding_report(findings),
        "kinematics": None if task.kinematics is None else task.kinematics.as_json(),
        **fit.report,
        "objects": [
            {**reports.object_report(*one), "symmetry": task.symmetry_words.get(one[1].obj_id, "")}
            for one in zip(
                given.bodies, objects, fit.kept, fit.searches, fit.uncertain, strict=True
            )
        ],
    }
    return Registration(
        scene=scene, single_view=baseline, cameras=cameras, fixed_cameras=still, seen=seen,
        not_placed=missing, findings=findings, report=report,
    )  # fmt: skip


def _said(fixed: Sequence[ViewPoints]) -> dict[str, Array]:
    """Return where the cameras that stand still are, by name."""
    return {v.fixed.name: v.T_world_cam for v in fixed if v.fixed is not None}
