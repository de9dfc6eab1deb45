"""The table, and the one object that stands on it, in depth images whose cameras are known."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.arrays import Array, Mask
from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.geometry.clouds import fit_plane_ransac, plane_frame, refine_plane
from realsim.geometry.depth import points_from_depth
from realsim.records import CameraIntrinsics, SupportPlane
from realsim.registration.evidence import DepthFrame, DepthNoise
from realsim.scanning.scale.config import TableConfig

COARSE_STRIDE = 8
"""Every eighth row and column finds a table and what stands on it."""
NEAR_AT_M = 0.1
"""An object whose middle is further than this from where it is said to be is another [m]."""
PLANE_POINTS = 20_000
"""Points of the random search; the refinement uses four times as many."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Footprint:
    """Where on the table the object stands, as a map of cells of the table's frame."""

    origin: Array
    """(2,) corner of cell (0, 0) in the table's frame [m]."""
    cell_m: float
    near: Mask
    """(X, Y) cells of the object and around it, where measured points above the table are its."""
    around: Mask
    """(X, Y) cells whose table is used."""
    box: Array
    """(2, 3) box of the object's points in the table's frame [m]."""


def find_table(
    intrinsics: CameraIntrinsics, frames: Sequence[DepthFrame], config: TableConfig, seed: int
) -> SupportPlane:
    """Return the plane that most of the measured points lie on, its z towards the cameras.

    Raises:
        DegenerateError: no plane carries enough of the points.
    """
    points = np.concatenate([
        se3.transform(f.T_world_cam, points_from_depth(f.depth_m, intrinsics, COARSE_STRIDE)[0])
        for f in frames
    ])  # fmt: skip
    if len(points) < 500:
        raise DegenerateError(
            f"the {len(frames)} depth images hold {len(points)} points at every {COARSE_STRIDE}th "
            "pixel; at least 500 are needed. Is the depth sensor's range right, and the unit?"
        )
    few = points[:: max(1, len(points) // PLANE_POINTS)]
    rng = np.random.default_rng(seed)
    normal, offset, _ = fit_plane_ransac(few, rng, config.tolerance_m)
    some = points[:: max(1, len(points) // (4 * PLANE_POINTS))]
    normal, offset, inliers = refine_plane(some, normal, offset, config.tolerance_m)
    cameras = np.stack([f.T_world_cam[:3, 3] for f in frames])
    if np.mean(cameras @ normal - offset) < 0:
        normal, offset = -normal, -offset
    share = float(np.mean(inliers))
    if share < config.least_share:
        raise DegenerateError(
            f"the largest plane carries {100 * share:.0f} % of the measured points; at least "
            f"{100 * config.least_share:.0f} % are needed. The object must stand on a flat table, "
            "and the camera poses must be those of these images."
        )
    rms = float(np.sqrt(np.mean(np.square(some[inliers] @ normal - offset))))
    T = plane_frame(normal, offset, some[inliers])
    return SupportPlane(T_world_table=T, rms_m=rms, inliers=int(np.count_nonzero(inliers)))


def find_object(
    intrinsics: CameraIntrinsics,
    frames: Sequence[DepthFrame],
    plane: SupportPlane,
    noise: DepthNoise,
    config: TableConfig,
    at: tuple[float, float] | None,
) -> Footprint:
    """Return where the object stands.

    Args:
        intrinsics: the camera.
        frames: depth images with camera poses.
        plane: the table.
        noise: of the depth.
        config: settings.
        at: (x, y) in world [m] near the object, where several stand there.

    Raises:
        DegenerateError: nothing stands on the table.
        InputError: several objects do, and `at` does not say which.
    """
    T_table_world = se3.invert(plane.T_world_table)
    aim = se3.transform(T_table_world, _aim(frames))[0]
    radius = _reach(frames)
    above: list[Array] = []
    for f in frames:
        points_cam, _ = points_from_depth(f.depth_m, intrinsics, COARSE_STRIDE // 2)
        p = se3.transform(T_table_world @ f.T_world_cam, points_cam)
        least = config.height_m + 3.0 * noise.sigma(points_cam[:, 2])
        reach = np.linalg.norm(p[:, :2] - aim[:2], axis=1) < radius
        above.append(p[(p[:, 2] > least) & reach])
    points = np.concatenate(above)
    if len(points) < config.least_points:
        raise DegenerateError(
            f"nothing stands on the table: only {len(points)} measured points lie more than "
            f"{1e3 * config.height_m:.0f} mm above it; at least {config.least_points} are needed. "
            "A flat or glassy object is not seen by the depth camera."
        )
    return _one_object(points, plane, config, at)


def _aim(frames: Sequence[DepthFrame]) -> Array:
    """Return the point (3,) nearest to all optical axes, in world [m]: what the views look at."""
    A, b = np.zeros((3, 3)), np.zeros(3)
    for f in frames:
        d = f.T_world_cam[:3, 2]
        M = np.eye(3) - np.outer(d, d)
        A += M
        b += M @ f.T_world_cam[:3, 3]
    # Parallel axes meet nowhere: a little weight keeps the point near the cameras.
    mean = np.mean([f.T_world_cam[:3, 3] for f in frames], axis=0)
    return np.linalg.solve(A + 1e-3 * np.eye(3), b + 1e-3 * mean)


def _reach(frames: Sequence[DepthFrame]) -> float:
    """Return how far from the views' middle an object may stand [m]: half the camera distance."""
    aim = _aim(frames)
    distances = [np.linalg.norm(f.T_world_cam[:3, 3] - aim) for f in frames]
    return float(max(0.15, 0.6 * np.median(distances)))


def _one_object(
    points: Array, plane: SupportPlane, config: TableConfig, at: tuple[float, float] | None
) -> Footprint:
    """Return the footprint of the only, or the wanted, cluster of points (N, 3) above the table."""
    from scipy import ndimage

    cell = config.cell_m
    pad = int(np.ceil((config.margin_m + config.bridge_m) / cell)) + 2
    origin = points[:, :2].min(0) - pad * cell
    index = np.floor((points[:, :2] - origin) / cell).astype(np.int64)
    shape = tuple(index.max(0) + pad + 1)
    counts = np.zeros(shape, dtype=np.int64)
    np.add.at(counts, (index[:, 0], index[:, 1]), 1)
    bridge = round(0.5 * config.bridge_m / cell)
    joined = _grown(counts > 1, bridge)
    found: Any = ndimage.label(joined, np.ones((3, 3)))
    labels, n = found
    sizes = ndimage.sum_labels(counts, labels, np.arange(1, n + 1)) if n else np.zeros(0)
    large = [k + 1 for k in range(n) if sizes[k] >= config.speck_share * sizes.max()]
    middles = [_middle(points[labels[index[:, 0], index[:, 1]] == k], plane) for k in large]
    if at is not None:
        gaps = [float(np.hypot(m[0] - at[0], m[1] - at[1])) for m in middles]
        if min(gaps) > NEAR_AT_M:
            raise InputError(
                f"nothing stands at x={at[0]:.3f}, y={at[1]:.3f} m: the nearest object is "
                f"{1e3 * min(gaps):.0f} mm away; {1e3 * NEAR_AT_M:.0f} mm are accepted. Objects "
                f"stand {_places(middles)}."
            )
        large = [large[int(np.argmin(gaps))]]
    if len(large) != 1:
        raise InputError(
            f"{len(large)} objects stand on the table: {_places(middles)}. Say which "
            "one is meant by --at x,y (in world), or capture it alone."
        )
    mine = labels == large[0]
    own = points[mine[index[:, 0], index[:, 1]]]
    box = np.stack([np.quantile(own, 0.002, axis=0), np.quantile(own, 0.998, axis=0)])
    box[0, 2] = 0.0
    near = _grown(mine, bridge)
    others = joined & ~mine
    close = _grown(mine, round(config.clear_m / cell))
    around = _grown(mine, round(config.margin_m / cell))
    around &= ~close & ~_grown(others, bridge + 1)
    return Footprint(origin=origin, cell_m=cell, near=near & ~others, around=around, box=box)


def _places(middles: Sequence[tuple[float, float, float]]) -> str:
    """Return where objects stand, for a message."""
    return "; ".join(f"at x={m[0]:.3f}, y={m[1]:.3f} m ({1e3 * m[2]:.0f} mm tall)" for m in middles)


def _middle(points: Array, plane: SupportPlane) -> tuple[float, float, float]:
    """Return x, y in world and the height over the table of a cluster [m]."""
    height = float(np.quantile(points[:, 2], 0.99))
    x, y, _ = se3.transform(plane.T_world_table, np.median(points, axis=0))[0]
    return float(x), float(y), height


def _grown(cells: Mask, radius: int) -> Mask:
    """Return the cells (X, Y) and all within `radius` of them."""
    import cv2

    k = np.arange(-radius, radius + 1)
    disc = (k[:, None] ** 2 + k[None] ** 2 <= radius**2 + 0.5).astype(np.uint8)
    return np.asarray(cv2.dilate(cells.astype(np.uint8), disc) > 0, dtype=np.bool_)
