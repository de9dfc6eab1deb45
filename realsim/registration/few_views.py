"""Registration from one to three views: cameras are taken at their word.

Many starts around the given pose, each fitted, rendered and compared; then all objects together,
each point with the model it is nearest to. Free space keeps models out of what the cameras looked
through, because so few views leave much unseen.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.records import SupportPlane
from realsim.records.calibration import DepthBias
from realsim.registration import near_start
from realsim.registration.blind import Kept, keep_start
from realsim.registration.body import Body, moved_body
from realsim.registration.compare import FRAMES, Comparer, make_comparer, spread_frames
from realsim.registration.config import RegistrationConfig
from realsim.registration.evidence import (
    Cloud,
    Evidence,
    average_cloud,
    correct_frame,
    gather,
    read_frame,
    without_table,
)
from realsim.registration.intake import Intake
from realsim.registration.photo import Picture
from realsim.registration.photo_fit import PhotoFit, photo_fit
from realsim.registration.refinement.refine import area_at
from realsim.registration.rivals_around import AROUND_RAYS, OFFSET_NOISES, Around, Images, around
from realsim.registration.table_planes import find_support_plane

REGATHER_M = 0.012
"""If an object moved further than this, its points are collected again around its new pose."""
ALIKE = 0.9
"""Depth and photograph that agree less on an object are told of."""


@dataclass(frozen=True, eq=False, slots=True)
class NearTask:
    """What every step needs."""

    intake: Intake
    plane: SupportPlane | None
    evidence: Evidence
    config: RegistrationConfig

    def comparer(self, center: Array) -> Comparer:
        """Return a comparer on some frames spread around `center`."""
        chosen = [read_frame(f) for f in spread_frames(self.intake.frames, center, FRAMES)]
        return make_comparer(self.intake.intrinsics, chosen, self.evidence.noise, self.plane)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FewViews:
    """What came of it."""

    kept: list[Kept]
    clouds: list[Cloud]
    """Each object's own points."""
    found: list[near_start.BestStart]
    history: list[dict[str, Any]]
    plane: SupportPlane | None
    stride: int


def begin(
    intake: Intake, bodies: Sequence[Body], config: RegistrationConfig, up: Array | None
) -> NearTask:
    """Return the points near the bodies' starts, and the plane under them."""
    evidence = gather(intake.intrinsics, intake.frames, bodies, config.evidence)
    centers = np.stack([b.center(b.T_start) for b in bodies])
    cameras = intake.cameras[:, :3, 3]
    distance = float(np.median(np.linalg.norm(cameras - centers.mean(0), axis=1)))
    sigma = float(evidence.noise.sigma(np.array([distance]))[0])
    plane, _ = find_support_plane(evidence.support, centers, cameras, config.plane, sigma, up)
    return NearTask(intake, plane, evidence, config)


def search_near(
    work: NearTask, bodies: Sequence[Body], tick: Callable[[], None]
) -> list[near_start.BestStart]:
    """Return of every body the pose near its start that explains the images best."""
    return [
        _search_one(work, body, near, tick)
        for body, near in zip(bodies, work.evidence.near, strict=True)
    ]


def register_few(
    intake: Intake,
    bodies: Sequence[Body],
    config: RegistrationConfig,
    up: Array | None,
    tick: Callable[[], None],
) -> FewViews:
    """Return the poses of bodies from their starts.

    Args:
        intake: the frames.
        bodies: the objects at their starts.
        config: settings.
        up: (3,) direction up in world, or None.
        tick: called after each object.
    """
    work = begin(intake, bodies, config, up)
    found = search_near(work, bodies, tick)
    kept, clouds, history = _joint(work, bodies, found)
    return FewViews(
        kept=kept, clouds=clouds, found=found, history=history, plane=work.plane,
        stride=work.evidence.stride,
    )  # fmt: skip


def with_photograph(
    intake: Intake, few: FewViews, bodies: Sequence[Body], config: RegistrationConfig
) -> tuple[Intake, FewViews, PhotoFit | None]:
    """Return everything of a single view brought together with its photograph; None = it has none.

    Args:
        intake: the frames.
        few: the fits.
        bodies: the objects.
        config: settings.
    """
    (frame, *more) = intake.frames
    if more or frame.read_rgb is None:
        return intake, few, None
    picture = Picture(
        intrinsics=intake.intrinsics, depth_m=frame.depth_m, T_world_cam=frame.T_world_cam,
        rgb=frame.read_rgb(),
    )  # fmt: skip
    together = max(1.0, config.covariance.correlation_area_px / few.stride**2)
    fit = photo_fit(picture, bodies, [k.fit for k in few.kept], together, intake.noise)
    if not fit.taken:
        return intake, few, fit
    bias = DepthBias(scale=1.0, offset_per_m=fit.offset_per_m)
    T = frame.T_world_cam

    def moved(points_world: Array) -> Array:
        points = se3.transform(se3.invert(T), points_world)
        return se3.transform(T, points / (1.0 + fit.offset_per_m * points[:, 2:]))

    (view,) = intake.views
    scale = 1.0 + fit.offset_per_m * view.points[:, 2:]
    plane = few.plane if few.plane is not None else intake.plane
    if plane is not None:
        centers = [b.center(X) for b, X in zip(bodies, fit.poses, strict=True)]
        plane = _moved_plane(plane, moved, np.mean(centers, axis=0))
    corrected = replace(
        intake, frames=(correct_frame(frame, T, bias),), plane=plane,
        views=(replace(view, points=(view.points / scale).astype(np.float32)),),
    )  # fmt: skip
    kept = [replace(k, fit=k.fit.at(X)) for k, X in zip(few.kept, fit.poses, strict=True)]
    clouds = [replace(c, points=moved(c.points)) for c in few.clouds]
    return corrected, replace(few, kept=kept, clouds=clouds, plane=plane), fit


def _moved_plane(
    plane: SupportPlane, moved: Callable[[Array], Array], middle: Array
) -> SupportPlane:
    """Return a plane whose points near the middle (3,) were moved."""
    T = plane.T_world_table
    at = se3.transform(se3.invert(T), middle[None])[0] * [1.0, 1.0, 0.0]
    corners = at + 0.1 * np.array([[1.0, 0, 0], [-0.5, 0.8, 0], [-0.5, -0.8, 0]])
    a, b, c = moved(se3.transform(T, corners))
    up = np.cross(b - a, c - a)
    up /= np.linalg.norm(up)
    back = T.copy()
    # The turn is tiny: its sine is its angle.
    back[:3, :3] = se3.exp_so3(np.cross(T[:3, 2], up)) @ T[:3, :3]
    off = float((np.mean([a, b, c], axis=0) - T[:3, 3]) @ up)
    back[:3, 3] = T[:3, 3] + off * up
    return replace(plane, T_world_table=back)


def few_around(
    intake: Intake,
    few: FewViews,
    bodies: Sequence[Body],
    claimed: Sequence[Array | None],
    photo: PhotoFit | None,
) -> list[Around]:
    """Return what the images say of every pose and those around it, all others where they are.

    Args:
        intake: the frames.
        few: the fits.
        bodies: the objects.
        claimed: (4, 4) starts that somebody claimed; None = a search found them.
        photo: what the photograph says; None = there is none.
    """
    taken = photo if photo is not None and photo.taken else None
    comparer = make_comparer(
        intake.intrinsics, [read_frame(f) for f in intake.frames], intake.noise,
        few.plane if few.plane is not None else intake.plane,
        AROUND_RAYS,
    )  # fmt: skip
    offset = OFFSET_NOISES * intake.noise.per_m
    images = Images(
        comparer=comparer, area_px=area_at(intake.intrinsics.width),
        offset_per_m=offset if taken is None else taken.offset_sigma_per_m,
    )  # fmt: skip
    edges = [None] * len(bodies) if taken is None else taken.edges
    agreements = [(1.0, "")] * len(bodies) if taken is None else taken.agreements
    at = [(b, k.fit.T_world_obj) for b, k in zip(bodies, few.kept, strict=True)]
    tried = [
        around(b, k.fit, cloud, [*at[:n], *at[n + 1 :]], start, edge, images)
        for n, (b, k, cloud, start, edge) in enumerate(
            zip(bodies, few.kept, few.clouds, claimed, edges, strict=True)
        )
    ]  # fmt: skip
    return [
        replace(a, probability=a.probability * left, unlike=words if left < ALIKE else "")
        for a, (left, words) in zip(tried, agreements, strict=True)
    ]


def _search_one(
    work: NearTask, body: Body, near: Cloud, tick: Callable[[], None]
) -> near_start.BestStart:
    """Return the best hypothesis of one object, its neighbours not yet considered."""
    center = body.center(body.T_start)
    comparer = work.comparer(center)
    free_space = near_start.free_space_of(comparer)
    above = without_table(near, work.plane, near_start.drop_height(body, work.plane))
    coarse = average_cloud(above, body.T_start, near_start.coarse_voxel(body))
    fine = average_cloud(above, body.T_start, near_start.fine_voxel(body))
    found = near_start.search(body, coarse, fine, comparer, free_space)
    tick()
    return found


def _joint(
    work: NearTask, bodies: Sequence[Body], found: Sequence[near_start.BestStart]
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
    if max(moved) > REGATHER_M:
        there = [moved_body(b, T) for b, T in zip(bodies, poses, strict=True)]
        near = gather(work.intake.intrinsics, work.intake.frames, there, config.evidence).near
    clouds = [
        average_cloud(
            without_table(cloud, work.plane, near_start.drop_height(body, work.plane)),
            body.T_start,
            near_start.fine_voxel(body),
        )
        for body, cloud in zip(bodies, near, strict=True)
    ]
    comparers = [work.comparer(b.center(T)) for b, T in zip(bodies, poses, strict=True)]
    spaces = [near_start.free_space_of(c) for c in comparers]
    fits, own, history = near_start.joint_fit(bodies, poses, clouds, (comparers, spaces))
    kept = [
        keep_start(body, fit, data, config.covariance)
        for body, fit, data in zip(
            bodies, fits, zip(own, comparers, spaces, strict=True), strict=True
        )
    ]
    return kept, own, history
