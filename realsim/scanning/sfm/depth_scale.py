"""A second scale, independent of the arm: measured depth at the reconstruction's sparse points."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.geometry.depth import edge_mask
from realsim.geometry.robust import MAD_TO_SIGMA
from realsim.scanning.sfm.config import TrustConfig
from realsim.scanning.sfm.result import DepthScale, Geometry

Array = NDArray[np.float64]
EDGE_SHARE = 0.03
"""Depth that changes by more than this share within the margin is an edge: 12 mm at 0.4 m."""
EDGE_MARGIN_PX = 3
"""Flying pixels lie so near to an edge [px]."""
LEAST_IN_VIEW = 10
"""Points that a view needs for a median."""
LEAST_VIEWS = 3
"""Views that a spread needs."""
MEDIAN_OF_NORMAL = 1.2533
"""The median's standard error over the mean's, for normal errors."""


def depth_scale(
    geometry: Geometry,
    depth_of: Callable[[str], NDArray[np.float32] | None],
    config: TrustConfig,
) -> DepthScale | None:
    """Compare measured depth with the depth of the sparse points, both along z.

    The ratio is the median over the views of each view's median; its sigma comes from the spread
    of the views, whose errors are common to all their points, and the sensor's systematic part.

    Args:
        geometry: metric.
        depth_of: the depth image (H, W) [m] of a view by its name, None where there is none.
        config: the systematic part of the sigma.

    Returns:
        The comparison, None where fewer than 3 views have 10 points with depth.
    """
    ratios: list[float] = []
    apart: list[Array] = []
    pairs = 0
    for k, name in enumerate(geometry.names):
        depth = depth_of(name)
        if depth is None:
            continue
        own = geometry.cameras_of == k
        points = geometry.points[geometry.points_of[own]]
        z = se3.transform(se3.invert(geometry.Ts_world_cam[k]), points)[:, 2]
        measured = _at(depth, geometry.uv_px[own])
        use = (measured > 0) & (z > 0)
        if use.sum() < LEAST_IN_VIEW:
            continue
        ratio = float(np.median(measured[use] / z[use]))
        ratios.append(ratio)
        apart.append(measured[use] - ratio * z[use])
        pairs += int(use.sum())
    if len(ratios) < LEAST_VIEWS:
        return None
    values = np.array(ratios)
    middle = float(np.median(values))
    spread = MAD_TO_SIGMA * float(np.median(np.abs(values - middle)))
    random = MEDIAN_OF_NORMAL * spread / np.sqrt(len(values))
    systematic = config.depth_floor_percent / 100 * middle
    return DepthScale(
        ratio=middle,
        sigma=float(np.hypot(random, systematic)),
        pairs=pairs,
        views=len(values),
        spread_mm=1e3 * MAD_TO_SIGMA * float(np.median(np.abs(np.concatenate(apart)))),
    )


def _at(depth_m: NDArray[np.float32], uv_px: Array) -> Array:
    """Return the depth (K,) at the nearest pixels [m]; 0 at edges, holes and outside."""
    height, width = depth_m.shape
    measured = np.where(np.isfinite(depth_m), depth_m, 0).astype(np.float32)
    edge = edge_mask(measured, EDGE_SHARE * measured, EDGE_MARGIN_PX)
    u, v = np.round(uv_px).astype(np.int64).T
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    u, v = np.clip(u, 0, width - 1), np.clip(v, 0, height - 1)
    return np.where(inside & ~edge[v, u], measured[v, u], 0.0).astype(np.float64)
