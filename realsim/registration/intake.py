"""From depth images to what a registration works with: points, noise, table, sound views."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry.depth import check_depth
from realsim.records import CameraIntrinsics, SupportPlane
from realsim.records.calibration import DepthBias
from realsim.registration import evidence
from realsim.registration.config import RegistrationConfig
from realsim.registration.find_table import find_table, looked_at
from realsim.registration.odometry.cross_check import KinematicsCheck, check_kinematics
from realsim.registration.view_agreement import ViewFinding
from realsim.registration.view_checks import check_views
from realsim.registration.views import (
    FixedFrames,
    SampleConfig,
    ViewPoints,
    noise_of,
    sample_view,
    sample_views,
    still_depth,
    world_cloud,
)

SCENE_POINTS = 400_000
"""Points of all views that are averaged into the scene's cloud at most."""
SCENE_VOXEL_M = 0.003
"""Its voxels [m]."""
ABOVE_M = 0.003
"""Lower points are the table's [m]."""
DENSE_VIEWS = 48
"""With more views, every second point is enough: neighbours share their noise."""
FULL_WIDTH = 1280
"""Image width that the strides are for [px]; narrower images are thinned out less."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Intake:
    """What all steps of a registration start from."""

    intrinsics: CameraIntrinsics
    frames: tuple[evidence.DepthFrame, ...]
    """Sound frames in the order of their numbers, their depth's known bias taken out."""
    views: tuple[ViewPoints, ...]
    """Their trusted points."""
    noise: evidence.DepthNoise
    plane: SupportPlane | None
    no_plane: str
    """Why there is no plane."""
    findings: tuple[ViewFinding, ...]
    fixed: tuple[ViewPoints, ...] = ()
    """Cameras that stand still, one view each: they take part in the joint fit."""

    @property
    def all_views(self) -> tuple[ViewPoints, ...]:
        """The views of the camera in the hand, then the cameras that stand still."""
        return (*self.views, *self.fixed)

    @property
    def cameras(self) -> Array:
        """(F, 4, 4) where the cameras are said to be [m]."""
        return np.stack([f.T_world_cam for f in self.frames])


def sampling(intrinsics: CameraIntrinsics, frames: int, config: RegistrationConfig) -> SampleConfig:
    """Return how images of this size and number are thinned out."""
    share = min(1.0, intrinsics.width / FULL_WIDTH)
    full = config.sample.stride * (2 if frames > DENSE_VIEWS else 1)
    return replace(
        config.sample,
        stride=max(1, round(full * share)),
        edge_reach_px=max(1, round(config.sample.edge_reach_px * share + 0.49)),
    )


def take_in(
    intrinsics: CameraIntrinsics,
    frames: Sequence[evidence.DepthFrame],
    config: RegistrationConfig,
    gravity_up_world: ArrayLike | None = None,
    progress: Callable[[], None] | None = None,
    fixed: Sequence[FixedFrames] = (),
) -> Intake:
    """Return what the frames hold; every image is read once.

    Raises:
        InputError: there is no frame, two have the same number, an image is not the camera's, or
            no view is left.
    """
    ordered = evidence.in_order(frames)
    if not config.bias.is_none:
        ordered = [evidence.correct_frame(f, f.T_world_cam, config.bias) for f in ordered]
    check_depth(ordered[0].depth_m, intrinsics)
    noise = _noise(ordered, config)
    sample = sampling(intrinsics, len(ordered), config)
    views: list[ViewPoints] = []
    for frame in ordered:
        image = evidence.read_frame(frame)
        check_depth(image.depth_m, intrinsics)
        views.append(sample_view(intrinsics, image, noise, sample))
        if progress is not None:
            progress()
    first = find_table(views, noise, gravity_up_world=gravity_up_world)
    findings = check_views(views, first.plane, noise)
    for f in findings:
        if f.kind == "all_disagree" and len(views) >= config.refine_from:
            raise InputError(f"{f.words} Nothing was registered.")
    bad = {f.index for f in findings if f.exclude}
    keep = [k for k, v in enumerate(views) if v.index not in bad]
    if not keep:
        words = " ".join(f.words for f in findings if f.exclude)
        raise InputError(f"none of the {len(views)} views can be used. {words}")
    table = first
    if bad and first.plane is not None:
        kept = [views[k] for k in keep]
        table = find_table(kept, noise, gravity_up_world=gravity_up_world)
    return Intake(
        intrinsics=intrinsics, frames=tuple(ordered[k] for k in keep),
        views=tuple(views[k] for k in keep), noise=noise, plane=table.plane,
        no_plane=table.reason, findings=tuple(findings),
        fixed=tuple(_still_view(-1 - k, f, config) for k, f in enumerate(fixed)),
    )  # fmt: skip


def _still_view(index: int, frames: FixedFrames, config: RegistrationConfig) -> ViewPoints:
    """Return all images of a fixed camera as one view.

    Raises:
        InputError: its images are not the camera's, or hold next to nothing.
    """
    said = frames.camera
    try:
        depth = still_depth(frames.read())
        check_depth(depth, said.intrinsics)
        depth = said.bias.corrected(depth).astype(np.float32)
        camera = replace(
            said, noise=noise_of(depth), bias=DepthBias(covariance=said.bias.covariance)
        )
    except InputError as error:
        raise InputError(f"camera '{said.name}': {error}") from error
    frame = evidence.DepthFrame(index=index, depth_m=depth, T_world_cam=camera.T_world_cam)
    sample = sampling(camera.intrinsics, 1, config)
    return replace(sample_view(camera.intrinsics, frame, camera.noise, sample), fixed=camera)


def without_fixed(intake: Intake, least: int) -> Intake:
    """Return the intake of a fit that takes cameras at their word: without those that stand still.

    Args:
        intake: as it was taken in.
        least: views of all cameras that a joint fit needs.
    """
    if not intake.fixed:
        return intake
    names = ", ".join(v.fixed.name for v in intake.fixed if v.fixed is not None)
    words = (
        f"fixed cameras ({names}) take part where cameras and objects are fitted together, which "
        f"needs {least} views of all cameras; here the hand's views alone were used, as they are "
        "said to be."
    )
    note = ViewFinding(index=None, kind="fixed_cameras", words=words, exclude=False)
    return replace(intake, fixed=(), findings=(*intake.findings, note))


def check_odometry(
    intake: Intake, config: RegistrationConfig
) -> tuple[KinematicsCheck | None, ViewFinding | None]:
    """Return what the depth images alone say of the claimed camera poses, or why they cannot."""
    apart = neighbours_apart_deg(intake)
    if apart > config.odometry_deg:
        words = (
            f"odometry was not tried: the views lie {apart:.0f} degrees from their neighbours in "
            f"the median; at most {config.odometry_deg:.0f} are accepted. Capture more views."
        )
    else:
        fine = sampling(intake.intrinsics, 1, config)
        views = intake.views
        if views[0].area_px > fine.stride**2:
            views = sample_views(intake.intrinsics, intake.frames, intake.noise, fine)
        try:
            return check_kinematics(views, intake.plane), None
        except InputError as error:
            words = f"odometry was not tried: {error}"
    return None, ViewFinding(index=None, kind="odometry", words=words, exclude=False)


def neighbours_apart_deg(intake: Intake) -> float:
    """Return the median angle between a view's direction to the scene and its nearest one's [deg].

    Infinite of a single view.
    """
    if len(intake.views) < 2:
        return float("inf")
    away = looked_at(intake.views) - intake.cameras[:, :3, 3]
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    cosines = away @ away.T
    np.fill_diagonal(cosines, -1.0)
    return float(np.median(np.degrees(np.arccos(np.clip(cosines.max(1), -1.0, 1.0)))))


def _noise(
    frames: Sequence[evidence.DepthFrame], config: RegistrationConfig
) -> evidence.DepthNoise:
    """Return the noise of some frames; if these are empty, of all that are not."""
    try:
        return evidence.measure_noise(frames, config.evidence)
    except InputError:
        whole = [f for f in frames if np.any(f.depth_m > 0)]
        return evidence.measure_noise(whole or frames, config.evidence)


def scene_cloud(intake: Intake, cameras: Array, plane: SupportPlane | None) -> evidence.Cloud:
    """Return what stands on the table, all views together, averaged on voxels.

    Args:
        intake: the frames.
        cameras: (V, 4, 4) where the cameras are, in the order of `all_views`.
        plane: the table, whose own points are left out; or None.
    """
    views = intake.all_views
    total = sum(len(v.points) for v in views)
    every = max(1, -(-total // SCENE_POINTS))
    moved = [
        replace(v, points=v.points[::every], T_world_cam=T)
        for v, T in zip(views, cameras, strict=True)
    ]
    cloud = evidence.without_table(world_cloud(moved, intake.noise), plane, ABOVE_M)
    T = np.eye(4) if plane is None else plane.T_world_table
    return evidence.average_cloud(cloud, T, SCENE_VOXEL_M)
