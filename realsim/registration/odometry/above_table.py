"""What of a view stands above the table, and where the view itself sees the table.

The table's points are useless to an alignment of points with points, but the plane through them is
the best measured thing of a view: it gives the camera's height, roll and pitch free of drift.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.geometry.clouds import fit_plane_ransac, refine_plane
from realsim.records import SupportPlane
from realsim.registration.odometry.kiss import thinned
from realsim.registration.views import ViewPoints

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class AboveTableConfig:
    """How a view is split into table and things."""

    height_m: float = 0.005
    """Points less than this above the table are the table's [m]: three sigma at 40 cm."""
    top_m: float = 0.40
    """Points higher than this belong to the room [m]."""
    max_range_m: float = 1.0
    """Points farther from the camera are not used [m]."""
    widths_m: tuple[float, ...] = (0.016, 0.004)
    """Half-widths of the layers in which the plane is refined one after the other [m]: the first
    catches a camera that is 3 cm off, the last is the table's flatness and the noise."""
    plane_stride: int = 4
    """Every which point the plane is refined with; 10 000 are plenty."""
    ransac_points: int = 3_000
    """Points of a random search for the plane."""
    ransac_triples: int = 200
    """Triples of it: finds a plane of 30 % of the points with p = 0.995."""
    least_share: float = 0.15
    """A plane with a smaller share of a view's points is not taken for the table."""
    map_spacing_m: float = 0.004
    """Edge of the voxels in which points are averaged that others are aligned to [m]."""
    source_spacing_m: float = 0.008
    """Likewise of the points that are aligned: half as many cost 1.5 times the accuracy."""
    least_points: int = 60
    """A view with fewer averaged points above the table cannot be aligned."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ViewCloud:
    """One view split into the table's plane and what stands on it, in camera axes."""

    index: int
    """Number of the view."""
    normal: Array | None
    """(3,) the table's normal towards the camera; None = no table is seen."""
    offset: float
    """normal . p of the table's points [m]; negative, it is minus the camera's height."""
    target: Array
    """(M, 3) averaged points above the table, for others to be aligned to [m]."""
    source: Array
    """(S, 3) coarser ones, to be aligned [m]."""


def without_plane(
    points_cam: Array, T_world_cam: Array, plane: SupportPlane, height_m: float
) -> Array:
    """Return the points (M, 3), in camera axes, more than `height_m` above the plane."""
    T_table_cam = se3.invert(plane.T_world_table) @ T_world_cam
    return points_cam[points_cam @ T_table_cam[2, :3] + T_table_cam[2, 3] > height_m]


def view_cloud(
    view: ViewPoints,
    plane: SupportPlane | None,
    config: AboveTableConfig,
    rng: np.random.Generator,
) -> ViewCloud:
    """Return the table and the things of one view.

    Args:
        view: its trusted points and where the camera is said to be.
        plane: the table in world, where the view's own is looked for first; None = the largest
            plane of the view.
        config: see there.
        rng: of the random search.
    """
    p = view.points.astype(np.float64)
    p = p[p[:, 2] < config.max_range_m]
    found = None
    if plane is not None:
        T_table_cam = se3.invert(plane.T_world_table) @ view.T_world_cam
        found = _refined(p, T_table_cam[2, :3], -float(T_table_cam[2, 3]), config)
    if found is None:
        found = _largest(p, config, rng)
    if found is None:
        things = np.zeros((0, 3))
        if plane is not None:
            things = without_plane(p, view.T_world_cam, plane, config.height_m)
        normal, offset = None, 0.0
    else:
        normal, offset = found
        height = p @ normal - offset
        things = p[(height > config.height_m) & (height < config.top_m)]
    target = thinned(things, config.map_spacing_m)
    return ViewCloud(
        index=view.index,
        normal=normal,
        offset=offset,
        target=target,
        source=thinned(target, config.source_spacing_m),
    )


def snapped(T_a_b: Array, a: ViewCloud, b: ViewCloud) -> Array:
    """Return the relative pose of two views, turned and lifted so that their tables coincide.

    b's things are turned about their centroid, so that what an alignment said of them holds.
    """
    if a.normal is None or b.normal is None or len(b.source) == 0:
        return T_a_b
    return on_plane(T_a_b, (a.normal, a.offset), (b.normal, b.offset), b.source.mean(0))


def on_plane(
    T_a_b: Array, plane_a: tuple[Array, float], plane_b: tuple[Array, float], about: Array
) -> Array:
    """Return T_a_b after the least turn and shift that bring b's plane onto a's.

    Args:
        T_a_b: (4, 4).
        plane_a: normal (3,) and offset in a's axes, n . p = offset [m].
        plane_b: likewise in b's.
        about: (3,) the point, in b's axes, that the turn leaves where it is [m].
    """
    n_a, n_b = plane_a[0], plane_b[0]
    turned = T_a_b[:3, :3] @ n_b
    axis = np.cross(turned, n_a)
    sine, cosine = float(np.linalg.norm(axis)), float(turned @ n_a)
    turn = se3.exp_so3(axis / sine * np.arctan2(sine, cosine)) if sine > 1e-12 else np.eye(3)
    R = turn @ T_a_b[:3, :3]
    center = se3.transform(T_a_b, about[None])[0]
    height = float(n_b @ about) - plane_b[1]
    center = center + (plane_a[1] + height - float(n_a @ center)) * n_a
    return se3.from_rt(R, center - R @ about)


def _refined(
    p: Array, normal: Array, offset: float, config: AboveTableConfig
) -> tuple[Array, float] | None:
    """Return the plane (normal, offset) near a given one, or None if the view has none there."""
    few = p[:: config.plane_stride]
    if len(few) < config.least_points:
        return None
    n, d = np.asarray(normal, dtype=np.float64), offset
    inliers = np.zeros(len(few), dtype=bool)
    for width in config.widths_m:
        n, d, inliers = refine_plane(few, n, d, width)
    if np.mean(inliers) < config.least_share or d > 0:
        return None
    return n, float(d)


def _largest(
    p: Array, config: AboveTableConfig, rng: np.random.Generator
) -> tuple[Array, float] | None:
    """Return the view's largest plane (normal towards the camera, offset), or None."""
    few = p[:: max(1, len(p) // config.ransac_points)]
    try:
        n, d, inliers = fit_plane_ransac(few, rng, config.widths_m[-1], config.ransac_triples)
    except DegenerateError:
        return None
    if np.mean(inliers) < config.least_share:
        return None
    return _refined(p, n, float(d), config) if d < 0 else _refined(p, -n, -float(d), config)
