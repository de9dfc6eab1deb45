"""What stands on the table: the plane, the things on it, and the box around the wanted one."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.arrays import Array, Int32
from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, SupportPlane
from realsim.registration.evidence import DepthNoise
from realsim.registration.table_planes import PlaneConfig, find_support_plane
from realsim.scanning.fusion.evidence import cloud_stride, sparse_cloud
from realsim.scanning.fusion.result import FusionConfig, FusionFrame

CELL_M = 0.004
"""Cells in which things are told apart [m]."""
CELL_PX = 2.0
"""The same in points of the strided images, if they are coarser."""
LIFT_SIGMAS = 3.0
"""A point counts as above the table from so many sigmas of its height."""
LIFT_M = 0.003
"""Height that is added to that: poses are off by as much at the border of the region [m]."""
LEAST_VIEWS_OF_CELL = 3
"""A cell belongs to a thing if so many views have a point in it: flying pixels do not agree."""
LEAST_PLANE_SHARE = 0.15
"""A plane with a smaller share of the points is a side of something, not a table."""
CLEAR_RMS = 3.0
"""Points further from the plane than so many times its RMS are above or below it."""
TOP_BELOW = 0.5
"""With more of the points below, the plane is the top of something."""
TOP_SOME_BELOW = 0.1
"""The same if few of the points are above."""
TOP_ABOVE = 0.05
"""Points above are few if they are fewer than this share of those below."""
HOLES_SHARE = 0.05
"""From this share of pixels without depth the message on an empty table mentions transparency."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Region:
    """The plane and the box of the object on it."""

    plane: SupportPlane
    low: Array
    """(3,) least corner of the object in the table's frame [m]; z is 0."""
    high: Array
    """(3,) greatest corner [m]."""
    notes: tuple[str, ...] = ()


def find_region(
    intrinsics: CameraIntrinsics,
    frames: Sequence[FusionFrame],
    noise: DepthNoise,
    config: FusionConfig,
) -> Region:
    """Return the plane and the box of what stands on it.

    Raises:
        DegenerateError: no plane was found.
        InputError: nothing stands on it, or several things do and none was chosen.
    """
    points, depths, owners = sparse_cloud(frames, intrinsics, config)
    if len(points) == 0:
        near, far = config.depth_limits_m
        raise InputError(f"no depth lies within {near} to {far} m; is the unit of the depth right?")
    cameras = np.stack([f.T_world_cam for f in frames])
    plane = _found_plane(points, depths, cameras, noise, config)
    T_table_world = se3.invert(plane.T_world_table)
    focus = _focus(cameras, plane)
    local = se3.transform(T_table_world, points)
    near = np.linalg.norm(local[:, :2] - focus, axis=1) < config.reach_m
    lift = LIFT_M + LIFT_SIGMAS * noise.sigma(depths)
    above = near & (local[:, 2] > np.minimum(lift, 0.012)) & (local[:, 2] < config.reach_m)
    pitch = cloud_stride(intrinsics) * float(np.median(depths)) / intrinsics.fx
    cell = max(CELL_M, CELL_PX * pitch)
    things = _things(local[above], owners[above], (cell, len(frames)), config)
    low, high, notes = _chosen(things, plane, config, _holes_text(frames))
    low[2] = 0.0
    return Region(plane=plane, low=low, high=high, notes=notes)


def _found_plane(
    points: Array, depths: Array, cameras: Array, noise: DepthNoise, config: FusionConfig
) -> SupportPlane:
    """Return the largest plane below the cameras."""
    search = PlaneConfig(tolerance_m=config.plane_tolerance_m, least_share=LEAST_PLANE_SHARE)
    middle = np.median(points, axis=0)
    around = np.linalg.norm(points - middle, axis=1) < 1.5 * config.reach_m
    plane, why = find_support_plane(
        points[around], np.zeros((0, 3)), cameras[:, :3, 3], search,
        float(np.median(noise.sigma(depths))),
    )  # fmt: skip
    if plane is None:
        raise DegenerateError(
            f"no table was found in the depth: {why} An object must stand on a flat surface that "
            "is seen around it; or give the plane."
        )
    height = se3.transform(se3.invert(plane.T_world_table), points[around])[:, 2]
    clear = CLEAR_RMS * max(plane.rms_m, config.plane_tolerance_m)
    below, above = float(np.mean(height < -clear)), float(np.mean(height > clear))
    if below > TOP_BELOW or (below > TOP_SOME_BELOW and above < TOP_ABOVE * below):
        raise DegenerateError(
            f"no table was found in the depth: {100 * below:.0f} % of the points lie below the "
            f"largest flat surface and {100 * above:.0f} % above it: it is the top of something. "
            "An object must stand on a flat surface that is seen around it; or give the plane."
        )
    return plane


def _focus(cameras: Array, plane: SupportPlane) -> Array:
    """Return where (2,) on the plane the cameras look: the median of their axes' foot points."""
    T = se3.invert(plane.T_world_table) @ cameras
    down = T[:, 2, 2] < -0.05
    if not down.any():
        raise InputError(
            "no camera looks down on the plane; are the poses T_world_cam (camera to world), "
            "OpenCV's axes, z forward?"
        )
    step = -T[down, 2, 3] / T[down, 2, 2]
    feet = T[down, :2, 3] + step[:, None] * T[down, :2, 2]
    return np.median(feet, axis=0)


def _holes_text(frames: Sequence[FusionFrame]) -> str:
    """Return a remark on pixels without depth, if there are many."""
    share = float(np.mean([np.mean(f.depth_m[::4, ::4] <= 0) for f in frames]))
    if share < HOLES_SHARE:
        return ""
    return f" {100 * share:.0f} % of the pixels have no depth: is the object transparent or glossy?"


def _things(
    points: Array, owners: Int32, sizes: tuple[float, int], config: FusionConfig
) -> list[tuple[Array, Array]]:
    """Return the boxes (low, high) of the things among points above the table, largest first.

    Cells that enough views agree on, joined over gaps of up to `cluster_gap_m`.

    Args:
        points: (N, 3) in the table's frame [m].
        owners: (N,) their frames.
        sizes: edge of a cell [m] and the number of frames.
        config: settings.
    """
    from scipy import ndimage

    size, frames = sizes

    if len(points) == 0:
        return []
    origin = points.min(0) - size
    cells = ((points - origin) / size).astype(np.int64)
    shape = cells.max(0) + 2
    flat = np.ravel_multi_index(tuple(cells.T), tuple(shape))
    seen = np.unique(flat * frames + owners)
    cell, views = np.unique(seen // frames, return_counts=True)
    cell = cell[views >= min(LEAST_VIEWS_OF_CELL, max(1, frames // 3))]
    filled = np.zeros(tuple(shape), dtype=bool)
    filled.ravel()[cell] = True
    steps = max(1, round(config.cluster_gap_m / size / 2))
    # Things one above the other (a mug's rim whose wall no view saw) are one thing.
    columns = ndimage.binary_dilation(filled.any(axis=2), np.ones((3, 3)), iterations=steps)
    labelled: Any = ndimage.label(columns, np.ones((3, 3)))
    numbers, count = labelled
    boxes: list[tuple[int, Array, Array]] = []
    for number in range(1, count + 1):
        inside = np.argwhere(filled & (numbers == number)[..., None])
        low, high = origin + inside.min(0) * size, origin + (inside.max(0) + 1) * size
        if np.max(high - low) >= config.least_size_m and len(inside) >= 4:
            boxes.append((len(inside), low, high))
    boxes.sort(key=lambda b: -b[0])
    return [(low, high) for _, low, high in boxes]


def _chosen(
    things: list[tuple[Array, Array]], plane: SupportPlane, config: FusionConfig, holes: str
) -> tuple[Array, Array, tuple[str, ...]]:
    """Return the box of the wanted thing."""
    if not things:
        raise InputError(
            "nothing stands on the table where the cameras look: no three views agree on a point "
            f"above it.{holes} Put the object in the middle of the views."
        )
    names = [_name(low, high, plane) for low, high in things]
    if config.at_m is not None:
        x, y = config.at_m
        T = se3.invert(plane.T_world_table)
        # The point is meant on the table: along the world's z to the plane.
        z = -(T[2, 0] * x + T[2, 1] * y + T[2, 3]) / T[2, 2] if abs(T[2, 2]) > 1e-3 else 0.0
        at = se3.transform(T, [[x, y, z]])[0, :2]
        gap = [
            float(np.linalg.norm(np.maximum(np.maximum(lo[:2] - at, at - hi[:2]), 0)))
            for lo, hi in things
        ]
        best = int(np.argmin(gap))
        if gap[best] > 2 * config.cluster_gap_m:
            raise InputError(
                f"nothing stands at ({x:.3f}, {y:.3f}) m; on the table there are: "
                f"{'; '.join(names)}."
            )
    elif len(things) > 1:
        raise InputError(
            f"{len(things)} things stand on the table: {'; '.join(names)}. Scan one at a time, or "
            "say which by a point x,y in world [m] (--at, at_m)."
        )
    else:
        best = 0
    low, high = things[best]
    size = float(np.max(high - low))
    if size > config.greatest_size_m:
        raise InputError(
            f"what stands on the plane is {names[best]}: more than "
            f"{1e3 * config.greatest_size_m:.0f} mm. That is no object on a table but a wall, a "
            "shelf or a bin around it; give the plane and the place of the object (--at, at_m), or "
            "scan it on a free table."
        )
    rest = [n for i, n in enumerate(names) if i != best]
    notes = (f"also on the table, left out: {'; '.join(rest)}.",) if rest else ()
    return low.copy(), high.copy(), notes


def _name(low: Array, high: Array, plane: SupportPlane) -> str:
    """Return a thing's size and place for a message."""
    center = se3.transform(plane.T_world_table, ((low + high) / 2)[None])[0]
    size = 1e3 * (high - low)
    return (
        f"{size[0]:.0f} x {size[1]:.0f} x {high[2] * 1e3:.0f} mm at "
        f"({center[0]:.3f}, {center[1]:.3f}, {center[2]:.3f}) m"
    )
