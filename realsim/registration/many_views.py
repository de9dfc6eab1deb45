"""Registration from four and more views: objects, cameras, table and depth bias together."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.records import SupportPlane
from realsim.records.calibration import DepthBias
from realsim.registration import evidence
from realsim.registration.blind import Kept, blind_motions, keep_start, nearest_to_start
from realsim.registration.body import Body
from realsim.registration.compare import Comparer, make_comparer, spread_frames
from realsim.registration.config import RegistrationConfig
from realsim.registration.intake import Intake
from realsim.registration.near_start import ASSIGN_M, assign_points, drop_height, fine_voxel
from realsim.registration.refinement.config import RefineConfig
from realsim.registration.refinement.refine import Refined, refine
from realsim.registration.refinement.uncertainty import SeenPose, object_covariance, seen_poses
from realsim.registration.solver import FINE, PoseFit, solve_pose
from realsim.registration.verify import FRAMES, RAYS
from realsim.registration.views import ViewPoints

CLOUD_POINTS = 400_000
"""Points of all views that are averaged into the objects' clouds at most."""
AGAIN_DEG = 3.0
"""An object that was turned back further than this about a fitted axis is refined again [deg]."""
AGAIN_ROUNDS = 2
"""Rounds in which it is."""
SHAPE_PIECES = 12.0
"""Independent pieces of a mesh's error."""
LEAST_SIGMA_MM, LEAST_SIGMA_DEG = 0.05, 0.01
"""What a calibration says of itself is not believed below this."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ManyViews:
    """What came of it."""

    refined: Refined
    poses: list[Array]
    kept: list[Kept]
    """Fits to the averaged cloud at the final poses, blind turns set back to the start's."""
    clouds: list[evidence.Cloud]
    """Each object's own points, corrected."""
    covariances: list[Array]
    """(6, 6) of each T_world_obj, right perturbation."""
    seen: list[list[SeenPose]]
    """Per object, its pose in every view of the camera in the hand."""
    frames: tuple[evidence.DepthFrame, ...]
    """Frames of the camera in the hand, with refined poses and the depth bias removed; read when
    asked."""
    views: tuple[ViewPoints, ...]
    """Points of these frames, then those of the cameras that stand still."""
    plane: SupportPlane | None
    arm_constant_m: float
    """1-sigma per axis of what the arm is off by everywhere: part of the covariances [m]."""

    @property
    def hand_views(self) -> tuple[ViewPoints, ...]:
        """The views of the camera in the hand."""
        return self.views[: len(self.frames)]

    @property
    def hand_cameras(self) -> Array:
        """(F, 4, 4) where the camera in the hand was."""
        return self.refined.cameras[: len(self.frames)]


def refine_config(config: RegistrationConfig) -> RefineConfig:
    """Return the constants of the refinement with what calibrations say of their sigmas."""
    p = config.refine.prior
    prior = replace(
        p,
        hand_eye_mm=_at_least(config.hand_eye_sigma_mm, LEAST_SIGMA_MM, p.hand_eye_mm),
        hand_eye_deg=_at_least(config.hand_eye_sigma_deg, LEAST_SIGMA_DEG, p.hand_eye_deg),
        view_mm=_at_least(config.arm_sigma_mm, LEAST_SIGMA_MM, p.view_mm),
        view_deg=_at_least(config.arm_sigma_deg, LEAST_SIGMA_DEG, p.view_deg),
    )
    # What is known of the bias has been taken out of the images; how sure it is remains.
    bias = DepthBias(covariance=config.bias.covariance)
    return replace(config.refine, prior=prior, bias=bias)


def _at_least(said: float | None, least: float, otherwise: float) -> float:
    """Return what was said, but never less than `least`; `otherwise` if nothing was said."""
    return otherwise if said is None else max(said, least)


def register_many(
    intake: Intake,
    bodies: Sequence[Body],
    claimed: Sequence[Body | None],
    plane: SupportPlane | None,
    config: RegistrationConfig,
    progress: Callable[[int, int], None] | None = None,
) -> ManyViews:
    """Return everything refined together.

    Args:
        intake: the frames.
        bodies: the objects; their start poses are right to a few millimetres.
        claimed: the same at the starts that somebody claimed, None = nobody did: turns that the
            points do not show stay as they were claimed.
        plane: the table, or None.
        config: settings.
        progress: called with (rounds done, rounds).

    Raises:
        DegenerateError: no point lies on any object or on the table.
    """
    rough = [b.T_start for b in bodies]
    constants = refine_config(config)
    refined, (frames, views), clouds, kept = _refine_once(
        intake, bodies, (rough, claimed), plane, constants, config, progress
    )
    turned = [_turn_deg(T, k.fit.T_world_obj) for T, k in zip(refined.poses, kept, strict=True)]
    unsure = [any(not a.declared for a in k.axes) for k in kept]
    if any(u and t > AGAIN_DEG for u, t in zip(unsure, turned, strict=True)):
        # An axis that was fitted is a little off, and so is what is turned far about it.
        rough = [k.fit.T_world_obj for k in kept]
        constants = replace(constants, rounds=AGAIN_ROUNDS)
        refined, (frames, views), clouds, kept = _refine_once(
            intake, bodies, (rough, claimed), plane, constants, config, None
        )
    back = [se3.invert(T) @ k.fit.T_world_obj for T, k in zip(refined.poses, kept, strict=True)]
    beyond = [
        _misfit_covariance(b, refined.misfit_m[k]) + _blind_covariance(b, kept[k].fit, config)
        for k, b in enumerate(bodies)
    ]
    # In world: what the arm is off by everywhere. Against the cameras it does not count.
    arm = np.diag(np.square([0.0, 0.0, 0.0, *[constants.prior.arm_constant_mm / 1e3] * 3]))
    covariances = [
        _turn_covariance(object_covariance(refined, b, k), S) + more + arm
        for k, (b, S, more) in enumerate(zip(bodies, back, beyond, strict=True))
    ]
    seen = [
        [
            replace(
                p, T_cam_obj=p.T_cam_obj @ S, covariance=_turn_covariance(p.covariance, S) + more
            )
            for p in of[: len(frames)]
        ]
        for of, S, more in zip(
            seen_poses(refined, bodies, intake.intrinsics), back, beyond, strict=True
        )
    ]
    return ManyViews(
        refined=refined, poses=[k.fit.T_world_obj for k in kept], kept=kept, clouds=clouds,
        covariances=covariances, seen=seen, frames=frames, views=views, plane=refined.plane,
        arm_constant_m=constants.prior.arm_constant_mm / 1e3,
    )  # fmt: skip


def _refine_once(
    intake: Intake,
    bodies: Sequence[Body],
    poses: tuple[Sequence[Array], Sequence[Body | None]],
    plane: SupportPlane | None,
    constants: RefineConfig,
    config: RegistrationConfig,
    progress: Callable[[int, int], None] | None,
) -> tuple[
    Refined,
    tuple[tuple[evidence.DepthFrame, ...], tuple[ViewPoints, ...]],
    list[evidence.Cloud],
    list[Kept],
]:
    """Return one refinement from rough poses, corrected frames and clouds, and the final poses."""
    rough, claimed = poses
    refined = refine(
        intake.intrinsics, intake.all_views, bodies, rough, plane, intake.noise, constants, progress
    )
    scale = float(refined.state.bias[0])
    hand = len(intake.frames)
    frames = tuple(
        evidence.correct_frame(f, T, DepthBias(scale=scale, offset_per_m=float(offset)))
        for f, T, offset in zip(
            intake.frames, refined.cameras[:hand], refined.state.offsets()[:hand], strict=True
        )
    )
    views = tuple(
        replace(v, T_world_cam=T, points=refined.state.corrected(v.points, k).astype(np.float32))
        for k, (v, T) in enumerate(zip(intake.all_views, refined.cameras, strict=True))
    )
    clouds = _clouds(intake, views, bodies, refined)
    comparer = comparer_on(intake, frames, refined.plane, bodies, refined.poses)
    kept = [
        _keep_blind(body, start, T, (cloud, comparer), config)
        for body, start, T, cloud in zip(bodies, claimed, refined.poses, clouds, strict=True)
    ]
    return refined, (frames, views), clouds, kept


def _keep_blind(
    body: Body,
    claimed: Body | None,
    T: Array,
    data: tuple[evidence.Cloud, Comparer],
    config: RegistrationConfig,
) -> Kept:
    """Return the refined pose with its blind turns as they were claimed."""
    cloud, comparer = data
    still = solve_pose(body, cloud, T, FINE[-1:]).at(T)
    if claimed is None:
        return Kept(fit=still, axes=(), report={})
    kept = keep_start(claimed, still, (cloud, comparer, None), config.covariance)
    if kept.report.get("start_kept"):
        axes = list(kept.axes)
        T = nearest_to_start(T, claimed.T_start, body.center_obj, axes)
    return replace(kept, fit=still.at(T))


def _turn_deg(T_a: Array, T_b: Array) -> float:
    """Return the angle between two poses [deg]."""
    return float(np.degrees(se3.angle(T_a[:3, :3].T @ T_b[:3, :3])))


def _turn_covariance(C: Array, S: Array) -> Array:
    """Return the covariance (6, 6) of T S from that of T: right perturbations."""
    Ad = se3.adjoint(se3.invert(S))
    return Ad @ C @ Ad.T


def comparer_on(
    intake: Intake,
    frames: Sequence[evidence.DepthFrame],
    plane: SupportPlane | None,
    bodies: Sequence[Body],
    poses: Sequence[Array] | Array,
) -> Comparer:
    """Return a comparer on the frames that look at the objects from directions far apart."""
    if len(bodies):
        center = np.mean([b.center(T) for b, T in zip(bodies, poses, strict=True)], axis=0)
    else:
        center = np.zeros(3) if plane is None else plane.T_world_table[:3, 3]
    chosen = [evidence.read_frame(f) for f in spread_frames(frames, center, FRAMES)]
    return make_comparer(intake.intrinsics, chosen, intake.noise, plane, RAYS)


def _misfit_covariance(body: Body, misfit_m: float) -> Array:
    """Return what a mesh that is off by `misfit_m` everywhere, in a few large pieces, adds.

    A wrong shape is wrong in the same way in all views: its error does not average out over points,
    only over the dozen or so independent pieces of a surface.
    """
    shift = misfit_m / np.sqrt(SHAPE_PIECES)
    turn = shift / max(body.radius_m, 1e-3)
    C = np.diag([turn**2] * 3 + [shift**2] * 3)
    Ad = se3.adjoint(se3.from_translation(body.center_obj))
    return Ad @ C @ Ad.T


def _blind_covariance(body: Body, fit: PoseFit, config: RegistrationConfig) -> Array:
    """Return what nothing determines: the points' noise makes a turn of a can look half known."""
    motions = blind_motions(body, fit, config.covariance)
    motions = motions / np.array([body.radius_m] * 3 + [1.0] * 3)[:, None]
    C = config.covariance.prior_m**2 * motions @ motions.T
    Ad = se3.adjoint(se3.from_translation(body.center_obj))
    return Ad @ C @ Ad.T


def _clouds(
    intake: Intake, views: Sequence[ViewPoints], bodies: Sequence[Body], refined: Refined
) -> list[evidence.Cloud]:
    """Return each object's averaged points, cameras and depth as refined."""
    total = sum(len(v.points) for v in views)
    every = max(1, -(-total // CLOUD_POINTS))
    parts = [_points_near(v, (bodies, refined.poses), every, v.noise(intake.noise)) for v in views]
    near: list[evidence.Cloud] = []
    for k, (body, T) in enumerate(zip(bodies, refined.poses, strict=True)):
        cloud = evidence.join_clouds([p[k] for p in parts])
        above = evidence.without_table(cloud, refined.plane, drop_height(body, refined.plane))
        near.append(evidence.average_cloud(above, T, fine_voxel(body)))
    return assign_points(bodies, list(refined.poses), near)


def _points_near(
    view: ViewPoints, objects: tuple[Sequence[Body], Array], every: int, noise: evidence.DepthNoise
) -> list[evidence.Cloud]:
    """Return of one view, per object, the points near it in world."""
    p = view.points[::every].astype(np.float64)
    world = se3.transform(view.T_world_cam, p)
    out: list[evidence.Cloud] = []
    for body, T in zip(*objects, strict=True):
        close = np.linalg.norm(world - body.center(T), axis=1) < body.radius_m + ASSIGN_M
        sigmas = noise.sigma(p[close, 2])
        out.append(evidence.seen_cloud(world[close], view.T_world_cam[:3, 3], sigmas))
    return out
