"""The verdict over a reconstruction, and the reasons for it.

A second scale, independent of the arm: measured depth at the reconstruction's sparse points.
"""

from collections.abc import Callable, Iterator
from typing import Literal

import numpy as np

from realsim.arrays import Array, Array32
from realsim.geometry import se3
from realsim.geometry.depth import edge_mask
from realsim.geometry.robust import mad_sigma
from realsim.records import Verdict
from realsim.scanning.sfm.alignment import baseline_m
from realsim.scanning.sfm.config import AlignmentConfig, SfmConfig, TrustConfig
from realsim.scanning.sfm.result import DepthScale, Geometry, SfmResult

Finding = tuple[Literal["doubtful", "rejected"], str]
UNIT_FACTORS = (1e-4, 1e-3, 1e-2, 0.1, 10.0, 100.0, 1e3, 1e4)
UNIT_MARGIN = 0.05
"""A ratio this near to a power of ten is a wrong unit."""
FEW_MATCHES = 30
"""A view with fewer verified matches in its best pair is called weak."""


def _finding(text: str, level: Literal["doubtful", "rejected"] = "doubtful") -> Finding:
    """Return what speaks against a result, and how much."""
    return level, text


def judge(result: SfmResult, config: SfmConfig) -> tuple[Verdict, tuple[str, ...]]:
    """Return the verdict and why it is not 'accepted'."""
    findings = [
        *_registration(result, config.trust),
        *_scale(result, config),
        *_geometry(result, config.alignment),
        *_depth(result.depth, config.trust),
    ]
    levels = {level for level, _ in findings}
    verdict: Verdict = (
        "rejected" if "rejected" in levels else "doubtful" if "doubtful" in levels else "accepted"
    )
    return verdict, tuple(text for _, text in findings)


def weak_views(result: SfmResult) -> tuple[str, ...]:
    """Return the images whose best pair has few verified matches."""
    best = dict.fromkeys(range(len(result.matching.names)), 0)
    for i, j, _, verified in result.matching.pairs:
        best[i], best[j] = max(best[i], verified), max(best[j], verified)
    return tuple(n for k, n in enumerate(result.matching.names) if best[k] < FEW_MATCHES)


def shown(names: tuple[str, ...], most: int = 6) -> str:
    """Return a list of names for a sentence."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _registration(result: SfmResult, trust: TrustConfig) -> Iterator[Finding]:
    """Look at how many views and points there are, and how well they fit."""
    total, registered = len(result.matching.names), len(result.geometry.names)
    share, points = registered / total, len(result.geometry.points)
    if share < trust.registered_share:
        level = "rejected" if share < trust.least_share else "doubtful"
        weak = weak_views(result)
        why = f" Few matches: {shown(weak)}." if weak else ""
        yield _finding(
            f"only {registered} of {total} views found a place; missing: "
            f"{shown(result.unregistered)}.{why} Put newspaper or the tag board under the "
            "object, or take views nearer to one another (15 deg).",
            level,
        )
    rest = tuple(n for n in result.models[1:] if n >= 3)
    if rest:
        yield _finding(
            f"the views fall into {1 + len(rest)} parts of {result.models[0]}, "
            f"{', '.join(map(str, rest))} views that share too few matches; the first is used. "
            "Views between the parts would join them."
        )
    if points < trust.min_points:
        yield _finding(
            f"only {points} points were found ({trust.min_points} are the least): the surface "
            "has too little texture, or the poses do not agree with the pictures.",
            "rejected",
        )
    if result.reprojection_px > trust.reprojection_px:
        yield _finding(
            f"the median reprojection error is {result.reprojection_px:.2f} px (at most "
            f"{trust.reprojection_px} px is good): blurred pictures, wrong intrinsics"
            + (", or wrong robot poses." if result.poses != "unknown" else ".")
        )


def _scale(result: SfmResult, config: SfmConfig) -> Iterator[Finding]:
    """Look at the metric scale and at the robot's agreement."""
    trust = config.trust
    if not result.is_metric:
        yield _finding(
            "there is no metric scale: no robot poses were given, so the unit is COLMAP's own. "
            "Give a calibrated session, or scale the model by `realsim scan scale`."
        )
        return
    if not result.sigma_percent <= trust.sigma_percent:
        level = "rejected" if not result.sigma_percent <= 4 * trust.sigma_percent else "doubtful"
        yield _finding(
            f"the scale is known to {result.sigma_percent:.2f} % only (1 sigma; "
            f"{trust.sigma_percent} % is good): more views, farther apart, would help.",
            level,
        )
    if result.alignment is None:
        return
    views = result.alignment.views
    share = len(result.outliers) / len(views)
    if result.outliers:
        level = "rejected" if share >= 0.5 else "doubtful"
        told = tuple(
            f"{v.name} ({v.offset_mm:.1f} mm, {v.turn_deg:.2f} deg)" for v in views if v.outlier
        )
        if share > trust.outlier_share or level == "rejected":
            yield _finding(
                f"{len(told)} of {len(views)} views disagree with their robot pose: "
                f"{shown(told)}. Either the pictures hold too little to place them, or "
                "the mount slipped, the images are paired with other views' poses, or the "
                "hand-eye is wrong.",
                level,
            )
        else:
            yield _finding(
                "the robot's pose and the pictures disagree beyond both their errors: "
                f"{shown(told)}."
            )
    middle = float(np.median([v.offset_mm for v in views]))
    if middle > trust.residual_mm:
        yield _finding(
            f"the cameras lie {middle:.1f} mm from the robot's in the median view (at most "
            f"{trust.residual_mm} mm is good): the poses or the reconstruction are bent."
        )


def _geometry(result: SfmResult, config: AlignmentConfig) -> Iterator[Finding]:
    """Name arrangements of the cameras that leave something open."""
    g = result.geometry
    spread = baseline_m(g.Ts_world_cam)
    local = se3.transform(se3.invert(g.Ts_world_cam), g.points)[..., 2]
    distance = float(np.median(np.abs(local))) if len(g.points) else float("nan")
    if spread[0] < config.min_baseline_ratio * distance:
        yield _finding(
            f"the cameras' spread is {spread[0] / distance:.1%} of the distance to the scene: "
            f"nearly a turn on the spot. {config.min_baseline_ratio:.0%} is the least."
        )
    elif len(spread) > 1 and spread[1] < config.min_line_ratio * spread[0]:
        yield _finding(
            "all cameras stand on a line: how the scene is turned about it rests on the "
            "robot's orientations alone. Add views off the line."
        )


def _depth(depth: DepthScale | None, trust: TrustConfig) -> Iterator[Finding]:
    """Compare the two metres."""
    if depth is None or abs(depth.ratio - 1) <= trust.depth_sigmas * depth.sigma:
        return
    factor = next((f for f in UNIT_FACTORS if abs(depth.ratio / f - 1) < UNIT_MARGIN), None)
    told = f"measured depth is {depth.ratio:.4g} +- {depth.sigma:.2g} times the reconstruction's"
    if factor is not None:
        yield _finding(
            f"{told}, a factor of {factor:g}: the depth unit or the unit of the robot's poses "
            "is wrong. Set the session's depth unit (0.001 = millimetres, 0.0001 = a D405).",
            "rejected",
        )
        return
    level = "doubtful" if abs(depth.ratio - 1) < 0.05 else "rejected"
    yield _finding(
        f"{told}, {abs(depth.ratio - 1) / depth.sigma:.0f} sigmas from 1: a bias of the depth "
        "camera, wrong intrinsics, depth not aligned with colour, or wrong robot poses.",
        level,
    )


# --- the depth images' scale ---------------------------------------------------------------------


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
    geometry: Geometry, depth_of: Callable[[str], Array32 | None], config: TrustConfig
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
    spread = mad_sigma(values - middle)
    random = MEDIAN_OF_NORMAL * spread / np.sqrt(len(values))
    systematic = config.depth_floor_percent / 100 * middle
    return DepthScale(
        ratio=middle,
        sigma=float(np.hypot(random, systematic)),
        pairs=pairs,
        views=len(values),
        spread_mm=1e3 * mad_sigma(np.concatenate(apart)),
    )


def _at(depth_m: Array32, uv_px: Array) -> Array:
    """Return the depth (K,) at the nearest pixels [m]; 0 at edges, holes and outside."""
    height, width = depth_m.shape
    measured = np.where(np.isfinite(depth_m), depth_m, 0).astype(np.float32)
    edge = edge_mask(measured, EDGE_SHARE * measured, EDGE_MARGIN_PX)
    u, v = np.round(uv_px).astype(np.int64).T
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    u, v = np.clip(u, 0, width - 1), np.clip(v, 0, height - 1)
    return np.where(inside & ~edge[v, u], measured[v, u], 0.0).astype(np.float64)
