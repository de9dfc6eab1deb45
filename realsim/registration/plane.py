"""The support plane: what the objects stand on."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.geometry import se3
from realsim.geometry.clouds import fit_plane_ransac, plane_frame, refine_plane
from realsim.records import SupportPlane

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class PlaneConfig:
    """How the support plane is searched."""

    tolerance_m: float = 0.004
    """Points within this (plus the depth noise) belong to the plane: tables are flat to 2 mm."""
    iterations: int = 300
    """Random triples; finds a plane of 25 % of the points with p = 0.99."""
    points: int = 20_000
    """At most so many points are used by the random search; the refinement uses all."""
    attempts: int = 4
    """Planes tried, largest first, before there is said to be none."""
    least_share: float = 0.05
    """A plane with a smaller share of the points around the objects carries nothing."""
    gravity_cos: float = 0.9
    """Least cosine between the normal and the given up direction (26 deg)."""
    sunk_m: float = 0.02
    """How far an object's centre may lie below the plane (rough starts are off by 20 mm)."""
    seed: int = 0
    """Of the random search."""


def find_support_plane(
    points: ArrayLike,
    centers: ArrayLike,
    cameras: ArrayLike,
    config: PlaneConfig,
    noise_m: float,
    gravity_up_world: ArrayLike | None = None,
) -> tuple[SupportPlane | None, str]:
    """Return the plane that carries the objects, or None and why there is none.

    The largest plane of the points around the objects that has the cameras and the objects on one
    side and, if the up direction is given, agrees with it. Found by random triples, refined by
    re-weighted least squares (Tukey), its normal turned to the objects' side.

    Args:
        points: (N, 3) measured points around the objects but not on them, world [m].
        centers: (K, 3) the objects' centres at their start poses, world [m].
        cameras: (F, 3) camera positions, world [m].
        config: see there.
        noise_m: typical 1-sigma of a point [m].
        gravity_up_world: (3,) direction up, or None.
    """
    p = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    centers, cameras = np.asarray(centers, float), np.asarray(cameras, float)
    total = len(p)
    tolerance = config.tolerance_m + noise_m
    rng = np.random.default_rng(config.seed)
    for _ in range(config.attempts):
        if len(p) < max(50, config.least_share * total):
            return None, f"only {len(p)} of {total} points around the objects are left for a plane."
        few = p[:: max(1, len(p) // config.points)]
        normal, offset, _ = fit_plane_ransac(few, rng, tolerance, config.iterations)
        normal, offset, inliers = refine_plane(p, normal, offset, tolerance)
        if np.mean(cameras @ normal - offset) < 0:
            normal, offset = -normal, -offset
        if _carries(normal, offset, centers, config, gravity_up_world):
            if np.count_nonzero(inliers) < config.least_share * total:
                break
            rms = float(np.sqrt(np.mean(np.square(p[inliers] @ normal - offset))))
            T = plane_frame(normal, offset, p[inliers])
            n = int(np.count_nonzero(inliers))
            return SupportPlane(T_world_table=T, rms_m=rms, inliers=n), ""
        p = p[~inliers]
    return None, f"none of the {config.attempts} largest planes has the objects on its upper side."


def _carries(
    normal: Array,
    offset: float,
    centers: Array,
    config: PlaneConfig,
    gravity_up_world: ArrayLike | None,
) -> bool:
    """Return whether the plane can be what the objects stand on."""
    if gravity_up_world is not None:
        up = np.asarray(gravity_up_world, dtype=np.float64)
        if normal @ up / np.linalg.norm(up) < config.gravity_cos:
            return False
    heights = centers @ normal - offset
    return bool(np.min(heights, initial=np.inf) > -config.sunk_m)


def lowest_height(plane: SupportPlane, vertices: Sequence[Array] | Array, T: Array) -> float:
    """Return the height [m] of the lowest of the vertices (V, 3), mapped by T, above the plane."""
    T_table_obj = se3.invert(plane.T_world_table) @ T
    return float(np.min(se3.transform(T_table_obj, vertices)[:, 2]))


def table_depth(plane: SupportPlane, T_world_cam: Array, rays: NDArray[np.floating]) -> Array:
    """Return the depth (N,) [m] where camera rays (N, 3) of z = 1 meet the plane; inf = never."""
    T = se3.invert(plane.T_world_table) @ T_world_cam
    slope = rays @ T[2, :3]
    with np.errstate(divide="ignore", invalid="ignore"):
        z = -T[2, 3] / slope
    return np.where((z > 0) & np.isfinite(z), z, np.inf)
