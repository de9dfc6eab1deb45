"""Half of the views against the other half: does each find the same pose?

A right pose is the bottom of a basin that any half of the views finds again within the noise. A
pose that is held by a few views, or by points that belong to a neighbour, moves.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Int64, Mask
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.mesh import box_corners
from realsim.records import CameraIntrinsics, SupportPlane
from realsim.registration.body import Body
from realsim.registration.evidence import Cloud, DepthNoise, join_clouds, seen_cloud
from realsim.registration.judging.ownership import make_claims, owners
from realsim.registration.judging.surface_residuals import thinning
from realsim.registration.solver import FINE, solve_pose
from realsim.registration.views import ViewPoints

REACH_M = 0.012
"""Points further from every surface are not used [m]: a solver step's widest kernel."""
POINTS = 6_000
"""About so many points of an object and half are fitted: 60 ns each and step."""
LEAST_POINTS = 50
"""An object with fewer in a half cannot be fitted there."""
AGREE_M = 0.003
"""A point of an unused view agrees within this of the surface [m]; plus 1.5 sigma_z."""
AGREE_SIGMAS = 1.5
"""See `AGREE_M`."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class HeldOut:
    """What the halves say of one object."""

    shift_mm: float
    """Greatest distance of a corner of its box between the two halves' poses [mm]; NaN = a half
    did not see it."""
    agree: float
    """Share of the points near the object, of views that were not used, that lie on its surface
    at the pose which the other half found; NaN = there are none."""
    Ts_world_obj: Array
    """(2, 4, 4) the halves' poses."""

    def checks(self) -> dict[str, float]:
        """Return the figures by the names the report uses."""
        return {"held_out_shift_mm": self.shift_mm, "held_out_agree": self.agree}


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class OwnedPoints:
    """The points of all views that lie nearest to one object."""

    cloud: Cloud
    views: Int64
    """(N,) which view each is of."""


def box_shift_m(body: Body, T_a: Array, T_b: Array) -> float:
    """Return the greatest distance [m] of a corner of the body's box between two poses."""
    corners = box_corners(*body.model.mesh.bounds)
    apart = se3.transform(T_a, corners) - se3.transform(T_b, corners)
    return float(np.linalg.norm(apart, axis=1).max())


def halves(views: int) -> tuple[Int64, Int64]:
    """Return the even and the odd views: neighbours in time, so both see all sides.

    Raises:
        InputError: there are not two views.
    """
    if views < 2:
        raise InputError(f"{views} views cannot be halved; a held-out test needs two or more.")
    return np.arange(0, views, 2), np.arange(1, views, 2)


def owned_points(
    bodies: Sequence[Body],
    poses: Sequence[Array],
    intrinsics: CameraIntrinsics,
    views: Sequence[ViewPoints],
    Ts_world_cam: Array,
    noise: DepthNoise,
    plane: SupportPlane | None,
) -> list[OwnedPoints]:
    """Return per object the points nearest to it, thinned out to what two halves need."""
    step = thinning(bodies, poses, (intrinsics, views, Ts_world_cam), 2 * POINTS)
    claims = make_claims(bodies, poses, plane, REACH_M)
    parts: list[list[tuple[Cloud, Int64]]] = [[] for _ in bodies]
    for v, (view, T) in enumerate(zip(views, Ts_world_cam, strict=True)):
        seen = view.points[v % step :: step].astype(np.float64)
        points, sigmas = se3.transform(T, seen), noise.sigma(seen[:, 2])
        owner = owners(claims, points)
        for k, part in enumerate(parts):
            mine = np.flatnonzero(owner == k)
            cloud = seen_cloud(points[mine], T[:3, 3], sigmas[mine])
            part.append((cloud, np.full(len(mine), v)))
    result: list[OwnedPoints] = []
    for part in parts:
        cloud, of = join_clouds([c for c, _ in part]), np.concatenate([n for _, n in part])
        every = slice(None, None, max(1, len(of) // (2 * POINTS)))
        result.append(OwnedPoints(cloud=cloud.select(every), views=of[every]))
    return result


def held_out(
    bodies: Sequence[Body], poses: Sequence[Array], owned: Sequence[OwnedPoints], views: int
) -> list[HeldOut]:
    """Return what each object's two halves say of each other.

    Every object is fitted alone, from its final pose, on its points of the views of one half.

    Args:
        bodies: the objects.
        poses: their final T_world_obj (4, 4).
        owned: their points, as `owned_points` returns them.
        views: how many views there are.

    Raises:
        InputError: there are not two views.
    """
    first, second = halves(views)
    results: list[HeldOut] = []
    for body, T, mine in zip(bodies, poses, owned, strict=True):
        T_a, T_b = _fitted(body, T, mine, first), _fitted(body, T, mine, second)
        both = bool(np.all(np.isfinite(T_a)) and np.all(np.isfinite(T_b)))
        results.append(
            HeldOut(
                shift_mm=1e3 * box_shift_m(body, T_a, T_b) if both else float("nan"),
                agree=_unused_agree(body, mine, ((T_a, second), (T_b, first))),
                Ts_world_obj=np.stack([T_a, T_b]),
            )
        )
    return results


def _fitted(body: Body, T_world_obj: Array, owned: OwnedPoints, used: Int64) -> Array:
    """Return the pose (4, 4) that an object's points of some views say; NaN = too few."""
    cloud = owned.cloud.select(np.isin(owned.views, used))
    if len(cloud.points) < LEAST_POINTS:
        return np.full((4, 4), np.nan)
    return solve_pose(body, cloud, T_world_obj, FINE).T_world_obj


def _unused_agree(body: Body, owned: OwnedPoints, tests: Sequence[tuple[Array, Int64]]) -> float:
    """Return the share of points that agree, each tested with the pose its view was not used for.

    Args:
        body: the object.
        owned: its points.
        tests: pairs of a pose (4, 4) and the views (N,) to test it on.
    """
    agree: list[Mask] = []
    for T, unused in tests:
        cloud = owned.cloud.select(np.isin(owned.views, unused))
        if np.all(np.isfinite(T)) and len(cloud.points):
            d = np.abs(body.field.distance(cloud.points, se3.invert(T)))
            agree.append(d <= AGREE_M + AGREE_SIGMAS * cloud.sigmas)
    return float(np.mean(np.concatenate(agree))) if agree else float("nan")
