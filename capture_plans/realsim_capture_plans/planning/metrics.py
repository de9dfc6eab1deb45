"""How good a plan is: everything that follows from the plan alone, as numbers.

`METRIC_MEANINGS` says what each key means, its unit, and what is good.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim_capture_plans.collision.model import CollisionModel
from realsim_capture_plans.planning import view_quality
from realsim_capture_plans.planning.metric_meanings import JOINT_NAMES, METRIC_MEANINGS, Meaning
from realsim_capture_plans.planning.record import CapturePlan
from realsim_capture_plans.planning.tour_time import TourTime
from realsim_capture_plans.planning.view_quality import Sensor, sensor_of

__all__ = ["METRIC_MEANINGS", "Meaning", "plan_metrics"]
Array = NDArray[np.float64]
CAP_ELEVATION_DEG = (15.0, 90.0)
"""The cap that plans of different least elevations are compared on."""


def plan_metrics(
    plan: CapturePlan,
    model: CollisionModel | None = None,
    *,
    sensor: Sensor | None = None,
    board_normal: ArrayLike = (0.0, 0.0, 1.0),
) -> dict[str, float]:
    """Return how good a plan is; every value is finite, the keys are those of `METRIC_MEANINGS`.

    What does not exist is left out: the spacing of a single view, the clearance to an empty group,
    coverage of a calibration plan, rolls of any other.

    Args:
        plan: the plan; its own `metrics` are not looked at.
        model: what the moves are checked against; by default the plan's own.
        sensor: the camera; by default the nominal one of the plan's mount.
        board_normal: (3,) the board's normal in base, of a calibration plan.

    Raises:
        InputError: the mount's camera is not known and no sensor is given.
    """
    model = model or plan.collision_model()
    sensor = sensor or sensor_of(plan)
    found = {"views": float(len(plan))}
    if plan.kind == "calibration":
        found |= _board(plan, board_normal)
    else:
        found |= _coverage(plan)
    found |= _motion(plan) | _dexterity(plan) | _clearances(plan, model)
    found |= _sight(plan, sensor)
    return {name: value for name, value in found.items() if np.isfinite(value)}


def _coverage(plan: CapturePlan) -> dict[str, float]:
    """Return holes, spacing and radii of the views."""
    directions = plan.directions()
    radius = np.linalg.norm(plan.Ts_base_cam[:, :3, 3] - plan.center_world, axis=-1)
    found = {
        "hole_deg": view_quality.hole_deg(directions, plan.config.elevation_deg),
        "hole_cap_deg": view_quality.hole_deg(directions, CAP_ELEVATION_DEG),
        "radius_min_m": float(radius.min()),
        "radius_max_m": float(radius.max()),
    }
    if len(plan) > 1:
        spacing = view_quality.spacing_deg(directions)
        parallax = view_quality.parallax_deg(plan)
        found |= {
            "spacing_min_deg": float(spacing.min()),
            "spacing_median_deg": float(np.median(spacing)),
            "parallax_median_deg": float(np.median(parallax)),
            "parallax_max_deg": float(parallax.max()),
        }
    return found


def _board(plan: CapturePlan, normal: ArrayLike) -> dict[str, float]:
    """Return how the board is seen."""
    board = view_quality.board_views(plan, normal)
    return {
        "roll_gap_deg": board.roll_gap_deg,
        "tilt_min_deg": float(board.tilt_deg.min()),
        "tilt_max_deg": float(board.tilt_deg.max()),
        "distance_min_m": float(board.distance_m.min()),
        "distance_max_m": float(board.distance_m.max()),
    }


def _motion(plan: CapturePlan) -> dict[str, float]:
    """Return how far and how long the arm goes, and how near its joints come to their limits."""
    tour = TourTime.of(plan)
    corners = np.concatenate([plan.home[None], tour.goal])
    limits = plan.chain.limits
    margin = np.minimum(corners - limits.lower, limits.upper - corners).min()
    turn = np.degrees(np.abs(corners - plan.home).max(axis=0))
    settling = plan.config.settle_s * len(plan)
    return {
        "moves_with_vias": float(len({k for k, via in plan.vias if len(via)})),
        "travel_leading_rad": float(tour.leading_rad.sum()),
        "travel_total_rad": float(np.abs(tour.goal - tour.start).sum()),
        "largest_step_rad": float(tour.leading_rad.max()),
        "seconds": float(np.sum(tour.end_s - tour.begin_s)),
        "seconds_settling": settling,
        "seconds_total": tour.total_s,
        "limit_margin_deg": float(np.degrees(margin)),
        **{
            f"turn_{name}_deg": angle
            for name, angle in zip(JOINT_NAMES, turn.tolist(), strict=True)
        },
    }


def _dexterity(plan: CapturePlan) -> dict[str, float]:
    """Return how far from singular the views are.

    Yoshikawa (1985), Manipulability of robotic mechanisms: w = sqrt(det J J^T) = |det J|.
    """
    J = plan.chain.jacobian(plan.joints)
    sigma = np.linalg.svd(J, compute_uv=False)
    least, volume = sigma[:, -1], np.prod(sigma, axis=-1)
    return {
        "sigma_min": float(least.min()),
        "sigma_median": float(np.median(least)),
        "yoshikawa_min": float(volume.min()),
        "yoshikawa_median": float(np.median(volume)),
    }


def _clearances(plan: CapturePlan, model: CollisionModel) -> dict[str, float]:
    """Return colliding legs, and the least distance per group at the views and along all moves."""
    tour = TourTime.of(plan)
    step = plan.config.edge_step_rad
    free = model.edges_free(tour.start, tour.goal, step)
    at_views = model.clearance(plan.joints)
    on_moves = model.clearance(tour.samples(step).joints)
    return {
        "colliding_legs": float(np.sum(~free)),
        **{f"clearance_{group}_m": float(d.min()) for group, d in at_views.items()},
        **{f"clearance_moves_{group}_m": float(d.min()) for group, d in on_moves.items()},
    }


def _sight(plan: CapturePlan, sensor: Sensor) -> dict[str, float]:
    """Return what of the scene's volume the views see, how often, and how precisely."""
    points = view_quality.scene_points(plan)
    visible = view_quality.seen(plan, points, sensor)
    share, views_of_point = visible.mean(axis=1), visible.sum(axis=0)
    spread = view_quality.direction_spread_deg(plan, points, visible)
    noise = sensor.depth_noise(view_quality.centre_depth(plan))
    depth = view_quality.depth_of(plan, points)
    found = {
        "in_view_min": float(share.min()),
        "in_view_median": float(np.median(share)),
        "seen_by_min": float(views_of_point.min()),
        "seen_by_median": float(np.median(views_of_point)),
        "seen_from_min_deg": float(spread.min()),
        "seen_from_median_deg": float(np.median(spread)),
        "depth_noise_median_m": float(np.median(noise)),
        "depth_noise_max_m": float(noise.max()),
        "nearest_depth_m": float(depth[visible].min()) if np.any(visible) else np.nan,
    }
    if len(plan) > 1:
        both = (visible[1:] & visible[:-1]).mean(axis=1)
        found |= {"overlap_min": float(both.min()), "overlap_median": float(np.median(both))}
    return found
