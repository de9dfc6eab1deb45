"""Register a scene: from rough starts to the pose of every object, checked without ground truth.

1. Evidence: every frame's measured points near each object; the support plane around them.
2. Search: many starts around the given one, each fitted; rendered in several frames; best kept.
3. Joint fit: all objects together on all frames, each point to the model it is nearest to.
4. What the points do not determine is set back to the start's value.
5. Covariance, verification, and the same for the single-view baseline.
With one frame it is the same code with one frame.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.records import (
    CameraIntrinsics,
    ObjectModel,
    ObjectPose,
    Scene,
    SupportPlane,
    names_of,
)
from realsim.registration.blind import BlindConfig, Kept, keep_start
from realsim.registration.body import Body, make_body
from realsim.registration.compare import CompareConfig, Comparer, make_comparer, spread_frames
from realsim.registration.covariance import CovarianceConfig, Uncertainty, uncertainty
from realsim.registration.evidence import (
    Cloud,
    DepthFrame,
    Evidence,
    EvidenceConfig,
    averaged,
    check_frames,
    gather,
    without_table,
)
from realsim.registration.hypotheses import Found, SearchConfig, search
from realsim.registration.joint import JointConfig, joint_fit
from realsim.registration.plane import PlaneConfig, find_support_plane
from realsim.registration.single_view import SingleViewConfig, fit_single_view, reference_frame
from realsim.registration.solver import FreeSpace, SolverConfig
from realsim.registration.verify import (
    OffsetConfig,
    SinkingConfig,
    VerifyConfig,
    common_offset,
    common_sinking,
    verify_objects,
)

__all__ = ["DepthFrame", "Registration", "RegistrationConfig", "register_scene"]

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]


@dataclass(frozen=True, kw_only=True, slots=True)
class RegistrationConfig:
    """All constants of a registration."""

    field_cells: int = 96
    """Cells of a distance field along the object's longest side; 56 doubled the scale error."""
    samples: int = 600
    """Surface samples per object for free space and penetration."""
    free_space: bool = True
    """Whether models are kept out of space the cameras looked through."""
    field_folder: Path | None = None
    """Where distance fields are kept between runs; None = in memory only."""
    with_single_view: bool = True
    """Whether the single-view baseline is computed as well."""
    regather_m: float = 0.012
    """If an object moved further than this, its points are collected again around its new pose."""
    evidence: EvidenceConfig = field(default_factory=EvidenceConfig)
    plane: PlaneConfig = field(default_factory=PlaneConfig)
    compare: CompareConfig = field(default_factory=CompareConfig)
    search: SearchConfig = field(default_factory=SearchConfig)
    solver: SolverConfig = field(default_factory=SolverConfig)
    joint: JointConfig = field(default_factory=JointConfig)
    blind: BlindConfig = field(default_factory=BlindConfig)
    covariance: CovarianceConfig = field(default_factory=CovarianceConfig)
    verify: VerifyConfig = field(default_factory=VerifyConfig)
    offset: OffsetConfig = field(default_factory=OffsetConfig)
    sinking: SinkingConfig = field(default_factory=SinkingConfig)
    single_view: SingleViewConfig = field(default_factory=SingleViewConfig)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Registration:
    """A registered scene, its baseline, and how it came about."""

    scene: Scene
    """The joint fit: poses with covariance, checks, verdict, reasons; and the support plane."""
    single_view: Scene
    """The baseline: robust ICP in one reference frame, checked in the same way."""
    report: dict[str, Any]
    """Plain JSON values: per object the search, the residuals, what was rejected."""


def register_scene(
    name: str,
    intrinsics: CameraIntrinsics,
    frames: Sequence[DepthFrame],
    models: Mapping[int, ObjectModel],
    starts: Sequence[ObjectPose],
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
        starts: rough poses, right to about 30 mm and 20 deg.
        config: see there.
        gravity_up_world: (3,) up; helps to tell the table from a wall.
        progress: called with (steps done, steps).

    Raises:
        InputError: a start names an unknown model, numbers repeat, or images do not fit the camera.
    """
    config = config or RegistrationConfig()
    ordered = check_frames(frames, intrinsics)
    tick = _Ticker(progress, len(ordered) + 2 * len(starts) + 3)
    bodies = _bodies(models, starts, config)
    evidence = gather(intrinsics, ordered, bodies, config.evidence, tick.each)
    plane, no_plane = _plane(ordered, bodies, evidence, config, gravity_up_world)
    tick()

    work = _Work(intrinsics, ordered, plane, evidence, config)
    found = [
        _search_one(work, body, near, tick)
        for body, near in zip(bodies, evidence.near, strict=True)
    ]
    kept, clouds, history = _joint(work, bodies, found)
    tick()
    fits = [k.fit for k in kept]
    poses = [f.T_world_obj for f in fits]
    uncertain = [
        uncertainty(b, f, evidence.stride, config.covariance)
        for b, f in zip(bodies, fits, strict=True)
    ]
    comparer = work.comparer(_middle(bodies, poses), config.verify.frames, config.verify.rays)
    objects = _objects(bodies, poses, clouds, uncertain, comparer, config.verify)
    single, single_report = _single_view(work, bodies, clouds, comparer)
    tick()
    report = {
        "frames": [f.index for f in ordered],
        "plane": _plane_report(plane, no_plane),
        **_common_report(work, bodies, objects),
        "joint": history,
        "single_view": single_report,
        "objects": [
            _object_report(b, o, k, s.report, u)
            for b, o, k, s, u in zip(bodies, objects, kept, found, uncertain, strict=True)
        ],
    }
    return Registration(
        scene=Scene(name=name, objects=tuple(objects), plane=plane),
        single_view=Scene(name=f"{name} (single view)", objects=tuple(single), plane=plane),
        report=report,
    )


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

    intrinsics: CameraIntrinsics
    frames: list[DepthFrame]
    plane: SupportPlane | None
    evidence: Evidence
    config: RegistrationConfig

    def comparer(self, center: Array, n: int, rays: int) -> Comparer:
        """Return a comparer on n frames spread around `center`."""
        chosen = spread_frames(self.frames, center, n)
        config = replace(self.config.compare, rays=rays)
        return make_comparer(self.intrinsics, chosen, self.evidence.noise, self.plane, config)

    def free_space(self, frames: Sequence[DepthFrame]) -> FreeSpace | None:
        """Return the images that models may not stand in front of."""
        if not self.config.free_space:
            return None
        i, noise = self.intrinsics, self.evidence.noise
        return FreeSpace(
            depths=np.stack([f.depth_m for f in frames]).astype(np.float32),
            Ts_cam_world=np.stack([se3.invert(f.T_world_cam) for f in frames]),
            camera=np.concatenate([[i.fx, i.fy, i.cx, i.cy], i.distortion]),
            noise=(noise.per_m, noise.floor_m),
        )


def _bodies(
    models: Mapping[int, ObjectModel], starts: Sequence[ObjectPose], config: RegistrationConfig
) -> list[Body]:
    """Return the bodies of the starts, each checked against the models."""
    if not starts:
        raise InputError("no start poses were given; give one per object instance.")
    if len({s.instance for s in starts}) != len(starts):
        raise InputError("two start poses have the same instance number.")
    bodies: list[Body] = []
    for start in starts:
        model = models.get(start.obj_id)
        if model is None:
            raise InputError(
                f"instance {start.instance} is of object {start.obj_id}, which is not among the "
                f"models: {names_of(list(models.values()))}."
            )
        bodies.append(
            make_body(start, model, config.field_cells, config.samples, config.field_folder)
        )
    return bodies


def _plane(
    frames: Sequence[DepthFrame],
    bodies: Sequence[Body],
    evidence: Evidence,
    config: RegistrationConfig,
    gravity_up_world: ArrayLike | None,
) -> tuple[SupportPlane | None, str]:
    """Return the support plane around the objects, or None and why."""
    centers = np.stack([b.center(b.T_start) for b in bodies])
    cameras = np.stack([f.T_world_cam[:3, 3] for f in frames])
    distance = float(np.median(np.linalg.norm(cameras - centers.mean(0), axis=1)))
    noise = float(evidence.noise.sigma(np.array([distance]))[0])
    return find_support_plane(
        evidence.support, centers, cameras, config.plane, noise, gravity_up_world
    )


def _search_one(work: _Work, body: Body, near: Cloud, tick: Callable[[], None]) -> Found:
    """Return the best hypothesis of one object, its neighbours not yet considered."""
    config = work.config
    center = body.center(body.T_start)
    comparer = work.comparer(center, config.compare.frames, config.compare.rays)
    free_space = work.free_space(comparer.frames)
    above = without_table(near, work.plane, config.joint.drop_height(body, work.plane))
    coarse = averaged(above, body.T_start, config.joint.coarse_voxel(body))
    fine = averaged(above, body.T_start, config.joint.fine_voxel(body))
    found = search(body, coarse, fine, comparer, free_space, (config.search, config.solver))
    tick()
    return found


def _joint(
    work: _Work, bodies: Sequence[Body], found: Sequence[Found]
) -> tuple[list[Kept], list[Cloud], list[dict[str, Any]]]:
    """Return the fits of all objects together, the points of each, and the sweeps' history.

    What the points of an object do not determine is as it was at its start.
    """
    config = work.config
    poses = [f.fit.T_world_obj for f in found]
    moved = [
        np.linalg.norm(b.center(T) - b.center(b.T_start))
        for b, T in zip(bodies, poses, strict=True)
    ]
    near = work.evidence.near
    if max(moved) > config.regather_m:
        there = [
            replace(b, start=replace(b.start, T_world_obj=T))
            for b, T in zip(bodies, poses, strict=True)
        ]
        near = gather(work.intrinsics, work.frames, there, config.evidence).near
    clouds = [
        averaged(
            without_table(cloud, work.plane, config.joint.drop_height(body, work.plane)),
            body.T_start,
            config.joint.fine_voxel(body),
        )
        for body, cloud in zip(bodies, near, strict=True)
    ]
    comparers = [
        work.comparer(b.center(T), config.compare.frames, config.compare.rays)
        for b, T in zip(bodies, poses, strict=True)
    ]
    spaces = [work.free_space(c.frames) for c in comparers]
    fits, own, history = joint_fit(
        bodies, poses, clouds, (comparers, spaces), (config.joint, config.solver)
    )
    constants = (config.blind, config.covariance, config.solver)
    kept = [
        keep_start(body, fit, data, constants)
        for body, fit, data in zip(
            bodies, fits, zip(own, comparers, spaces, strict=True), strict=True
        )
    ]
    return kept, own, history


def _objects(
    bodies: Sequence[Body],
    poses: Sequence[Array],
    clouds: Sequence[Cloud],
    uncertain: Sequence[Uncertainty | None],
    comparer: Comparer,
    config: VerifyConfig,
) -> list[ObjectPose]:
    """Return the object poses with their checks and verdicts."""
    checked = verify_objects(bodies, poses, clouds, comparer, config)
    return [
        ObjectPose(
            obj_id=b.start.obj_id,
            instance=b.start.instance,
            T_world_obj=T,
            covariance=None if u is None else u.covariance,
            checks=c.checks if u is None else c.checks | {"blind_axes": float(len(u.unobservable))},
            verdict=c.verdict,
            reasons=c.reasons,
        )
        for b, T, c, u in zip(bodies, poses, checked, uncertain, strict=True)
    ]


def _single_view(
    work: _Work, bodies: Sequence[Body], clouds: Sequence[Cloud], comparer: Comparer
) -> tuple[list[ObjectPose], dict[str, Any]]:
    """Return the baseline's poses and which frame it used; objects it cannot see are left out."""
    if not work.config.with_single_view:
        return [], {"frame": None, "not_fitted": []}
    center = _middle(bodies, [b.T_start for b in bodies])
    frame = reference_frame(work.frames, work.plane, center)
    kept: list[int] = []
    poses: list[Array] = []
    missing: list[str] = []
    for i, body in enumerate(bodies):
        try:
            T = fit_single_view(body, work.intrinsics, frame, work.config.single_view)
        except DegenerateError as error:
            missing.append(f"instance {body.start.instance}: {error}")
            continue
        kept.append(i)
        poses.append(T)
    objects = _objects(
        [bodies[i] for i in kept], poses, [clouds[i] for i in kept], [None] * len(kept), comparer,
        work.config.verify,
    )  # fmt: skip
    return objects, {"frame": frame.index, "not_fitted": missing}


def _middle(bodies: Sequence[Body], poses: Sequence[Array]) -> Array:
    """Return the mean (3,) of the objects' centres in world [m]."""
    return np.mean([b.center(T) for b, T in zip(bodies, poses, strict=True)], axis=0)


def _plane_report(plane: SupportPlane | None, reason: str) -> dict[str, Any]:
    """Return the plane's quality, or why there is none."""
    if plane is None:
        return {"found": False, "reason": reason}
    return {"found": True, "rms_mm": 1e3 * plane.rms_m, "inliers": plane.inliers}


def _common_report(
    work: _Work, bodies: Sequence[Body], objects: Sequence[ObjectPose]
) -> dict[str, Any]:
    """Return what holds for all objects together, as JSON values."""
    config, evidence = work.config, work.evidence
    poses = [o.T_world_obj for o in objects]
    good = [o.verdict != "rejected" for o in objects]
    return {
        "stride_px": evidence.stride,
        "noise_per_m": evidence.noise.per_m,
        "common_offset_mm": common_offset(bodies, poses, good, config.offset),
        "common_sinking": common_sinking(bodies, poses, good, work.plane, config.sinking),
    }


def _object_report(
    body: Body, pose: ObjectPose, kept: Kept, search_report: dict[str, Any], u: Uncertainty
) -> dict[str, Any]:
    """Return what happened to one object, as JSON values."""
    fit = kept.fit
    T, T0 = pose.T_world_obj, body.T_start
    return {
        "instance": pose.instance,
        "obj_id": pose.obj_id,
        "name": body.model.name,
        "verdict": pose.verdict,
        "moved_mm": float(1e3 * np.linalg.norm(body.center(T) - body.center(T0))),
        "turned_deg": float(np.degrees(se3.angle(T0[:3, :3].T @ T[:3, :3]))),
        "points_used": fit.points,
        "points_offered": fit.offered,
        "residual_rms_mm": list(fit.history_mm),
        "variance_of_unit_weight": fit.variance,
        "unobservable": list(u.unobservable),
        "blind": kept.report,
        "sensitivities": list(u.sensitivities),
        "search": search_report,
    }
