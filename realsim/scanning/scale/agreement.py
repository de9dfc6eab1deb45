"""Does a scale and pose explain what the cameras measured? Rendered and compared, without truth.

Every ray of every view has a measured depth m and a rendered one z (the mesh or the table, what is
nearer). With l = max(-1, 1 - 2 ((m - z) / tau)^2) the gain is
    sum [l(mesh and table) - l(table alone)]  /  sum over the object's rays of [1 - l(table alone)]:
1 = every ray that met the object is explained and none that passed it is blocked; 0 = no better
than an empty table; negative = the mesh stands where the cameras looked through. Both a mesh that
is too large and one that is too small lose, which no distance of points to a surface can say.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.records import SupportPlane
from realsim.registration.plane import table_depth
from realsim.rendering.rays import rotated
from realsim.scanning.scale.evidence import LEAST_HEIGHT_M, ScanEvidence, ScanView
from realsim.scanning.scale.shape import ScanShape
from realsim.scanning.scale.state import State

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
TAU_M = 0.003
"""Depth difference that agrees whatever the noise [m]."""
TAU_SHAPE = 0.02
"""Plus, in the square, this share of the size: generated meshes are off by as much."""
TAU_SIGMAS = 1.5
"""Plus so many sigma of the depth."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Explained:
    """How well a state explains some views."""

    gain: float
    """Share of the object that is explained, see above."""
    agree: float
    """Share of the rays that meet the model and were measured whose depth agrees."""
    cover: float
    """Share of the rays that met the object whose depth agrees."""
    iou: float
    """Overlap of the rendered and the measured mask, over the rays that were measured."""
    view_agree: Array
    """(V,) agree of every view."""
    view_iou: Array
    """(V,) overlap of every view."""


def explain(
    shape: ScanShape,
    evidence: ScanEvidence,
    state: State,
    *,
    views: int | None = None,
    every: int = 1,
) -> Explained:
    """Return how well scale, pose and cameras explain the measured depth.

    Args:
        shape: the mesh.
        evidence: what was measured.
        state: scale, pose, cameras, table.
        views: only so many of the views, spread evenly; None = all.
        every: only every so many of their rays.
    """
    n = len(evidence.views)
    chosen = np.arange(n)
    if views is not None and views < n:
        chosen = np.unique(np.linspace(0, n - 1, views).round().astype(int))
    cameras = state.cameras(evidence.views)
    rows = [
        _one_view(shape, evidence, state, (evidence.views[k], cameras[k]), every) for k in chosen
    ]
    sums = np.array(rows)
    total = sums.sum(0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return Explained(
            gain=float(total[0] / max(total[1], 1e-9)),
            agree=float(total[2] / max(total[3], 1.0)),
            cover=float(total[4] / max(total[5], 1.0)),
            iou=float(total[6] / max(total[7], 1.0)),
            view_agree=sums[:, 2] / np.maximum(sums[:, 3], 1.0),
            view_iou=sums[:, 6] / np.maximum(sums[:, 7], 1.0),
        )


def tolerance(evidence: ScanEvidence, depth: Array) -> Array:
    """Return the depth difference that agrees (N,) at depths (N,) [m]."""
    constant = np.hypot(TAU_M, TAU_SHAPE * evidence.size_m)
    return constant + TAU_SIGMAS * evidence.noise.sigma(depth)


def _one_view(
    shape: ScanShape,
    evidence: ScanEvidence,
    state: State,
    view: tuple[ScanView, Array],
    every: int,
) -> tuple[float, ...]:
    """Return the sums of one view, every ray counting as the pixels that it stands for."""
    seen, T = view
    rays, depth = seen.rays[::every], seen.depth[::every]
    on_object = seen.is_object[::every]
    directions = rotated(rays, T[:3, :3])
    hit = shape.cast(T[:3, 3], directions, *state.pose).astype(np.float64)
    plane = SupportPlane(T_world_table=state.T_world_table)
    table = np.minimum(table_depth(plane, T, rays.astype(np.float64)), 1e3)
    model = hit < table
    # So near to the table measured points are not told from it: an open vessel's floor.
    origin = state.T_world_table[:3, 3]
    up = state.T_world_table[:3, 2]
    height = (T[:3, 3] - origin) @ up + np.where(model, hit, 0.0) * (directions @ up)
    z = np.minimum(hit, table)
    known = depth > 0
    m = depth * (1.0 + state.bias * depth)
    tau = tolerance(evidence, np.where(known, depth, 1.0))
    new = np.maximum(-1.0, 1.0 - 2.0 * np.square((m - z) / tau))
    old = np.maximum(-1.0, 1.0 - 2.0 * np.square((m - table) / tau))
    agrees = np.abs(m - z) < tau
    tall = model & (height > LEAST_HEIGHT_M + 3.0 * evidence.noise.sigma(np.where(known, m, 0.0)))
    area = seen.ray_area_px * every
    best = known & on_object
    return tuple(
        area * float(x)
        for x in (
            np.sum((new - old)[known]),
            np.sum((1.0 - old)[best]),
            np.count_nonzero(known & model & agrees),
            np.count_nonzero(known & model),
            np.count_nonzero(best & agrees & model),
            np.count_nonzero(best),
            np.count_nonzero(best & model),
            np.count_nonzero(known & (tall | on_object)),
        )
    )
