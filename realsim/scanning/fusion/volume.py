"""Depth images averaged into a truncated signed distance on a grid around the object.

The grid lies in the table's frame. A voxel's signed distance to the surface that one view sees is
(depth at its pixel - its own depth), positive in front. Two things differ from the textbook
(Curless & Levoy 1996): the distance is taken along the surface's normal (times the
cosine between ray and normal, known from the round before), and every view weighs
cos^2 / sigma_z^2, so that the average is that of least variance. Voxels are projected through the
lens model into the raw image, nearest pixel: nothing is resampled or interpolated over an edge.
At edges of the depth, where pixels are not trusted, a view still sees through what lies in front
of all that is around; that word counts only where too few views measured anything.
"""

from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Array32, Int64, UInt8
from realsim.compiled import njit
from realsim.geometry.distance_field import sample
from realsim.geometry.point_loops import move, turn
from realsim.scanning.fusion.evidence import Crops, pixel_of
from realsim.scanning.fusion.result import FusionConfig

NEAREST_M = 0.02
"""Nothing nearer to a camera than this is seen [m]."""
LEAST_SLOPE = 0.3
"""Gradient below which a fused distance has no direction: cut off, or between two surfaces."""
SMOOTH_CELLS = 1.0
"""Gaussian radius over which the surface that views are aligned to is smoothed [cells]."""
SEEN_MANY = 250
"""Views are counted up to here (8 bits)."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Volume:
    """The fused distances."""

    origin: Array
    """(3,) position of node (0, 0, 0) in the table's frame [m]."""
    cell: float
    """[m]."""
    distance: Array32
    """(X, Y, Z) mean signed distance, positive outside, cut off at the truncation [m]; NaN where
    too few views looked."""
    seen: UInt8
    """(X, Y, Z) number of views that say something about the voxel."""


@njit(inline="always")
def _one_view(  # noqa: PLR0911 - seven ways to see nothing, in a row
    view: tuple[Array32, Int64, Array],
    lens: tuple[Array, Array],
    node: tuple[float, float, float],
    normal: tuple[float, float, float, float],
    limits: tuple[float, float, float],
) -> tuple[float, float, bool]:
    """Return the distance of a node along the normal one view sees, its weight, and if at edges.

    A weight of 0 says nothing.

    Args:
        view: trusted depth, its first pixel, and the table's pose in the camera.
        lens: the camera and the noise, as in `Crops`.
        node: in the table's frame [m].
        normal: outward, any length, and its length; 0 = not known.
        limits: truncation [m], least cosine, edge of a voxel [m].
    """
    depth, corner, T = view
    camera, noise = lens
    x, y, z = node
    gx, gy, gz, length = normal
    truncation, least_cos, cell = limits
    cx, cy, cz = move(T, x, y, z)
    if cz < NEAREST_M:
        return 0.0, 0.0, False
    u, v = pixel_of(camera, cx, cy, cz)
    u, v = u - corner[0], v - corner[1]
    if u < 0 or v < 0 or u >= depth.shape[1] or v >= depth.shape[0]:
        return 0.0, 0.0, False
    d = depth[v, u]
    if d == 0.0:
        return 0.0, 0.0, False
    edge = bool(d < 0.0)
    d = abs(d)
    # Along the ray: a difference along z is longer by the ray's own angle to the axis.
    ray = np.sqrt(cx * cx + cy * cy + cz * cz)
    s = (d - cz) * ray / cz
    cosine = 1.0
    if edge:
        # Only what lies well in front of all that is around is known: free.
        if s < truncation:
            return 0.0, 0.0, False
    elif length > 0.0:
        mx, my, mz = turn(T, gx, gy, gz)
        cosine = -(mx * cx + my * cy + mz * cz) / (ray * length)
        if cosine < least_cos:
            # Edge-on, or the far side of a wall: it can only say that it saw through.
            if s < 2.0 * truncation:
                return 0.0, 0.0, False
            cosine = 0.5
    along = s * cosine
    if along < -truncation or s < -2.0 * truncation:
        return 0.0, 0.0, False
    sigma = max(noise[1], noise[0] * d * d)
    weight = cosine * cosine / (sigma * sigma)
    if along < -cell:
        # Behind the surface a view's word fades: the far side may be near.
        weight *= (along + truncation) / (truncation - cell)
    return min(along, truncation), weight, edge


@njit
def _fuse(
    crops: tuple[Array32, Int64, tuple[Array, Array]],
    Ts_cam_table: Array,
    origin: Array,
    before: tuple[Array32, Array, float],
    limits: tuple[float, float, float],
    needed: int,
    out: tuple[Array32, UInt8],
) -> None:
    """Fill the mean distance and the number of views of every node."""
    depths, corners, lens = crops
    grid, grid_origin, grid_cell = before
    distance, seen = out
    truncation, _, cell = limits
    oriented = grid.shape[0] > 1
    for i, j, k in np.ndindex(distance.shape):
        x, y, z = origin[0] + i * cell, origin[1] + j * cell, origin[2] + k * cell
        # Outward normal of the surface nearest to the node, from the round before.
        gx, gy, gz, length = 0.0, 0.0, 0.0, 0.0
        if oriented:
            _, gx, gy, gz = sample(grid, grid_origin, grid_cell, x, y, z)
            length = np.sqrt(gx * gx + gy * gy + gz * gz)
            if not length > LEAST_SLOPE:  # NaN too
                length = 0.0
        total, weight, count, through = 0.0, 0.0, 0, 0
        for f in range(len(depths)):
            along, w, edge = _one_view(
                (depths[f], corners[f], Ts_cam_table[f]), lens, (x, y, z), (gx, gy, gz, length),
                limits,
            )  # fmt: skip
            if edge and w > 0.0:
                through += 1
            elif w > 0.0:
                total += w * along
                weight += w
                count += 1
        if count < needed and through > 0:
            # Beside a silhouette: nothing was measured here, but it was looked through.
            total, weight, count = truncation, 1.0, count + through
        seen[i, j, k] = min(count, SEEN_MANY)
        distance[i, j, k] = total / weight if weight > 0.0 else np.nan


def fused_volume(
    crops: Crops,
    Ts_cam_table: Array,
    box: tuple[Array, Array, float],
    before: Volume | None,
    config: FusionConfig,
) -> Volume:
    """Return the fused distances on a grid of the table's frame.

    Args:
        crops: the depth.
        Ts_cam_table: (F, 4, 4) poses of the table in the cameras.
        box: least and greatest corner (3,) and the edge of a cell [m]. Along z the nodes lie at
            half cells, so that the plane is midway between two layers.
        before: fused distances of the round before, for the normals; None in the first.
        config: settings.
    """
    low, high, cell = box
    first = np.floor(low / cell)
    shape = (np.ceil(high / cell) - first + 1).astype(int)
    origin = cell * (first + np.array([0.0, 0.0, 0.5]))
    distance = np.empty(tuple(shape), np.float32)
    seen = np.zeros(tuple(shape), np.uint8)
    if before is None:
        oriented = (np.zeros((1, 1, 1), np.float32), np.zeros(3), 1.0)
    else:
        oriented = (before.distance, before.origin, before.cell)
    needed = least_views(config, len(Ts_cam_table))
    _fuse(
        (crops.depths, crops.corners, (crops.camera, crops.noise)),
        np.ascontiguousarray(Ts_cam_table), origin, oriented,
        (max(config.truncation_m, 2 * cell), config.least_cos, cell), needed, (distance, seen),
    )  # fmt: skip
    distance[seen < needed] = np.nan
    return Volume(origin=origin, cell=cell, distance=distance, seen=seen)


def least_views(config: FusionConfig, frames: int) -> int:
    """Return how many views a node needs to be known, of this many."""
    return config.least_views if frames >= 4 * config.least_views else 1


def smoothed(distance: Array32) -> Array32:
    """Return distances averaged over a Gaussian of one cell; NaN where there were none."""
    from scipy import ndimage

    known = ~np.isnan(distance)
    total = ndimage.gaussian_filter(np.where(known, distance, np.float32(0)), SMOOTH_CELLS)
    weight = ndimage.gaussian_filter(known.astype(np.float32), SMOOTH_CELLS)
    return np.where(known, total / np.maximum(weight, np.float32(1e-6)), np.float32(np.nan))
