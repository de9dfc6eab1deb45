"""Where a scene is looked at from: the views, the region about the objects, the first look."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Mask
from realsim.records import CameraIntrinsics, ObjectPose, View
from realsim.review.scene_list import VERDICT_ORDER

LOOK_NEARER = 0.8
"""Distance of the first look, as a share of the cameras' own."""
LOOK_RADII = 2.5
"""Distance taken for the cameras' own where there are none [radii of the region]."""
LOOK_DOWN_RAD = 0.6
"""Angle under which the first look sees the table [rad]."""


def worst_first(objects: Sequence[ObjectPose]) -> list[ObjectPose]:
    """Return the objects, worst verdict first, then by the smallest agreement with the depth."""
    rank = VERDICT_ORDER.index
    return sorted(objects, key=lambda o: (rank(o.verdict), o.checks.get("agree", 0.0), o.instance))


def strided(intrinsics: CameraIntrinsics, stride: int) -> CameraIntrinsics:
    """Return the camera of an image's every `stride`-th row and column; exact, lens included."""
    i = intrinsics
    return CameraIntrinsics(
        width=-(-i.width // stride), height=-(-i.height // stride), fx=i.fx / stride,
        fy=i.fy / stride, cx=i.cx / stride, cy=i.cy / stride, distortion=i.distortion,
    )  # fmt: skip


@dataclass(frozen=True, eq=False, slots=True)
class Region:
    """The ball of world that is looked at."""

    center: Array
    """(3,) [m]."""
    radius_m: float

    def holds(self, points: ArrayLike) -> Mask:
        """Return (N,) which points (N, 3) [m] are inside."""
        offset = np.asarray(points, dtype=np.float64) - self.center
        return np.sum(offset * offset, axis=-1) <= self.radius_m**2


def region_of(objects: Sequence[ObjectPose], views: Sequence[View], margin_m: float) -> Region:
    """Return the region about the objects; without objects, about where the cameras look.

    Args:
        objects: the objects.
        views: views with a camera pose.
        margin_m: how far beyond the outermost object's origin it reaches [m].
    """
    if objects:
        origins = np.array([o.T_world_obj[:3, 3] for o in objects])
        center = origins.mean(0)
        return Region(center, float(np.linalg.norm(origins - center, axis=1).max()) + margin_m)
    Ts = np.array([v.T_world_cam for v in views])
    # The point nearest to all optical axes, in the least-squares sense.
    across = np.eye(3) - Ts[:, :3, 2, None] * Ts[:, None, :3, 2]
    A, b = across.sum(0), (across @ Ts[:, :3, 3:4]).sum(0)[:, 0]
    center = np.linalg.lstsq(A, b, rcond=None)[0]
    distance = float(np.median(np.linalg.norm(Ts[:, :3, 3] - center, axis=1)))
    return Region(center, distance)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FirstLook:
    """Where a new browser's camera stands."""

    position: Array
    """(3,) [m]."""
    look_at: Array
    """(3,) what it looks at [m]."""
    up: Array
    """(3,) unit vector out of the table."""


def first_look(region: Region, views: Sequence[View], up: Array) -> FirstLook:
    """Return where a new browser's camera stands and what it looks at.

    It stands where the cameras stand, on the side of the first one, but nearer, so that no frustum
    is in the way. Without views it is the region's size that says how far.

    Args:
        region: what to look at.
        views: views with a camera pose.
        up: (3,) unit vector out of the table, in world.
    """
    eyes = np.array([v.T_world_cam for v in views]).reshape(-1, 4, 4)[:, :3, 3] - region.center
    offset = eyes[0] if views else np.zeros(3)
    horizontal = offset - up * (up @ offset)
    length = float(np.linalg.norm(horizontal))
    side = horizontal / length if length > 1e-6 else np.linalg.svd(up[None])[2][1]
    distance = LOOK_RADII * region.radius_m
    if views:
        distance = float(np.median(np.linalg.norm(eyes, axis=1)))
    direction = np.cos(LOOK_DOWN_RAD) * side + np.sin(LOOK_DOWN_RAD) * up
    position = region.center + LOOK_NEARER * distance * direction
    return FirstLook(position=position, look_at=region.center.copy(), up=up)
