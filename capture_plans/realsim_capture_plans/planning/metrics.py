"""How good a plan is: everything that follows from the plan alone, as numbers, and their meaning.

`METRIC_MEANINGS` says what each key means, its unit, and what is good.
"""

import re
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from realsim.robots.kinematics import DhChain
from realsim_capture_plans.collision.model import GROUPS, CollisionModel
from realsim_capture_plans.planning import view_quality
from realsim_capture_plans.planning.record import CapturePlan
from realsim_capture_plans.planning.tour_time import TourTime
from realsim_capture_plans.planning.view_quality import Sensor, sensor_of

FULL_VIEWS = 256
"""Views of the plans that the goals are given for."""
SCALED = ("hole_deg", "hole_cap_deg", "hole_reachable_deg")
"""Goals that grow as the root of how many views fewer there are."""
OF_FULL_PLANS = (
    "parallax_max_deg", "travel_leading_rad", "travel_total_rad", "seconds", "seconds_total",
    "tour_over_bound",
)  # fmt: skip
"""Goals that say nothing about smaller plans."""
ROUNDING = 1e-4
"""A value this near to its goal meets it."""
UR_JOINTS = ("base", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3")
MOST_JOINTS = 9
"""Joints of other arms whose turns are explained."""


class Meaning(NamedTuple):
    """What one metric says."""

    text: str
    """In words."""
    unit: str
    """Unit of the value; empty for counts and shares."""
    good: str
    """What a plan of 256 views should have."""
    better: Literal["more", "less", "as asked"]
    """In which direction plans are better."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Goal:
    """What a value of one plan should be."""

    text: str
    """As people read it."""
    met: bool | None
    """Whether the value is so; None where it cannot be said."""


def goal_of(name: str, meaning: Meaning, value: float, plan: CapturePlan) -> Goal:
    """Return what a metric of this plan should be, and whether it is.

    What is good for 256 views is scaled where the number of views sets it (holes shrink with its
    root), and left open where it does not follow from it.
    """
    n = len(plan)
    limit, text = _limit(meaning.good, n, plan.config.clearance_m), meaning.good
    if limit is None:
        return Goal(text=text, met=None)
    sign, bound = limit
    if name in SCALED and abs(n - FULL_VIEWS) > FULL_VIEWS / 4:
        bound *= np.sqrt(FULL_VIEWS / n)
        text = f"{sign} {bound:.3g} (for {n} views)"
    elif name in OF_FULL_PLANS and n < FULL_VIEWS * 3 // 4:
        return Goal(text=f"{text} (256 views)", met=None)
    met = value <= bound + ROUNDING if sign in ("<", "<=") else value >= bound - ROUNDING
    return Goal(text=text, met=bool(met))


def _limit(good: str, views: int, clearance_m: float) -> tuple[str, float] | None:
    """Return sign and value of a goal in words, or None where it names none."""
    words = {
        "0, always": ("<=", 0.0),
        ">= the plan's clearance": (">=", clearance_m),
        "< 720 / views": ("<", 720.0 / views),
        "> half of them": (">", 0.5 * views),
        "> 0.9 of them": (">", 0.9 * views),
    }
    if good in words:
        return words[good]
    found = re.match(r"(<=|>=|<|>) ([0-9.]+)", good)
    return None if found is None else (found[1], float(found[2]))


def joint_names(chain: DhChain) -> tuple[str, ...]:
    """Return what the arm's joints are called: a UR's have names, others numbers from 1."""
    if chain.name.startswith("UR") and chain.joints == len(UR_JOINTS):
        return UR_JOINTS
    return tuple(f"joint_{k + 1}" for k in range(chain.joints))


def _words(name: str) -> str:
    return f"{'' if name.startswith('joint') else 'joint '}{name.replace('_', ' ')}"


_GROUP_TEXTS = {
    "self": "between the arm's own parts",
    "tool": "between the arm and its camera with the bracket",
    "table": "to the table",
    "scene": "to the keep-out box and the obstacles",
}

M = Meaning
METRIC_MEANINGS: dict[str, Meaning] = {
    "views": M("views of the plan", "", "as many as asked for", "as asked"),
    # --- where the views are ---------------------------------------------------------------
    "hole_deg": M("farthest place from any view, over the elevations that the plan was made for",
        "deg", "<= 8 (an ideal spiral of 256 from 15 to 90 deg has 7.7)", "less"),
    "hole_cap_deg": M("the same over all elevations from 15 deg up", "deg", "<= 8", "less"),
    "spacing_min_deg": M("least angle to the nearest other view", "deg", "> 3", "more"),
    "spacing_median_deg": M("middle angle to the nearest other view", "deg", "> 5", "more"),
    "radius_min_m": M("nearest camera to the centre", "m", ">= 0.25 (D405)", "as asked"),
    "radius_max_m": M("farthest camera from the centre", "m", "<= 0.45 (D405)", "as asked"),
    "parallax_median_deg": M("middle angle at the centre between consecutive views", "deg",
        "5 to 15", "as asked"),
    "parallax_max_deg": M("greatest angle at the centre between consecutive views", "deg", "< 60",
        "less"),
    # --- how far and how long ----------------------------------------------------------------
    "travel_leading_rad": M("sum of the leading joint's turns", "rad", "< 60", "less"),
    "travel_total_rad": M("sum of all joints' turns", "rad", "< 200", "less"),
    "largest_step_rad": M("greatest turn of a joint in one leg", "rad", "< 3.2", "less"),
    "seconds": M("moving, stop to stop, at the plan's speed and acceleration", "s", "< 190",
        "less"),
    "seconds_settling": M("waiting for the arm to stand still", "s", "0.3 a view", "less"),
    "seconds_total": M("moving and settling; exposures come on top", "s", "< 270", "less"),
    "moves_with_vias": M("moves that are not straight", "", "a few", "less"),
    # --- how near to trouble -----------------------------------------------------------------
    "colliding_legs": M("straight pieces on which the clearance is not kept", "", "0, always",
        "less"),
    "sigma_min": M("least singular value of the Jacobian at the worst view", "", ">= 0.05", "more"),
    "sigma_median": M("the same at the middle view", "", "> 0.15", "more"),
    "yoshikawa_min": M("Yoshikawa's manipulability sqrt(det J J^T) at the worst view", "",
        "> 0.005", "more"),
    "yoshikawa_median": M("the same at the middle view", "", "> 0.03", "more"),
    "limit_margin_deg": M("least distance of a joint to its limit, anywhere on the tour", "deg",
        "> 10", "more"),
    **{
        f"turn_{name}_deg": M(
            f"greatest turn of {_words(name)} away from home: winds up cables",
            "deg", "< 240", "less",
        )
        for name in (*UR_JOINTS, *(f"joint_{k + 1}" for k in range(MOST_JOINTS)))
    },
    **{
        f"clearance_{moves}{group}_m": M(
            f"least distance {_GROUP_TEXTS[group]}, {where}", "m", ">= the plan's clearance", "more"
        )
        for moves, where in (("", "at the views"), ("moves_", "along all moves"))
        for group in GROUPS
    },
    # --- what the camera sees ----------------------------------------------------------------
    "in_view_min": M("share of the scene's volume in the image, worst view", "", "> 0.6", "more"),
    "in_view_median": M("the same, middle view", "", "> 0.9", "more"),
    "overlap_min": M("share of the scene's volume in both of two consecutive views, worst pair", "",
        "> 0.5", "more"),
    "overlap_median": M("the same, middle pair", "", "> 0.85", "more"),
    "seen_by_min": M("views that have the worst-seen place of the scene's volume in the image", "",
        "> half of them", "more"),
    "seen_by_median": M("the same, middle place", "", "> 0.9 of them", "more"),
    "seen_from_min_deg": M("greatest angle between two views of a place, worst place", "deg",
        "> 90", "more"),
    "seen_from_median_deg": M("the same, middle place", "deg", "> 110", "more"),
    "depth_noise_median_m": M(
        "standard deviation of the depth at the centre, z^2 s / (f B), middle view", "m",
        "< 0.0010", "less"),
    "depth_noise_max_m": M("the same, worst view", "m", "< 0.0014", "less"),
    "nearest_depth_m": M("least depth of the scene's volume in an image", "m",
        ">= 0.10 (D405: nearer, it measures nothing)", "more"),
    # --- boards ------------------------------------------------------------------------------
    "roll_gap_deg": M("widest gap between the board's rolls about the optical axis", "deg",
        "< 720 / views", "less"),
    "tilt_min_deg": M("least angle between optical axis and board normal", "deg", "< 15", "less"),
    "tilt_max_deg": M("greatest angle between optical axis and board normal", "deg", "35 to 45",
        "as asked"),
    "distance_min_m": M("nearest, along the optical axis to the board", "m", "0.22", "as asked"),
    "distance_max_m": M("farthest, along the optical axis to the board", "m", "0.40", "as asked"),
    # --- known only when a plan is made ------------------------------------------------------
    "hole_reachable_deg": M("farthest direction that the arm reaches freely from any view", "deg",
        "<= 6", "less"),
    "tour_bound_s": M("no tour of these views can be shorter (Held and Karp)", "s", "near seconds",
        "as asked"),
    "tour_bound_two_nearest_s": M("a weaker bound: half of the two shortest moves at every view",
        "s", "near seconds", "as asked"),
    "tour_over_bound": M("seconds over tour_bound_s", "", "<= 1.22", "less"),
    "reachable_share": M("of the directions or board poses tried, those the arm reaches freely", "",
        "> 0.95", "more"),
}  # fmt: skip
"""Every key that `metrics.plan_metrics` returns, and what making a plan adds."""


__all__ = ["METRIC_MEANINGS", "Meaning", "plan_metrics"]
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
            for name, angle in zip(joint_names(plan.chain), turn.tolist(), strict=True)
        },
    }


def _dexterity(plan: CapturePlan) -> dict[str, float]:
    """Return how far from singular the views are.

    Yoshikawa (1985), Manipulability of robotic mechanisms: w = sqrt(det J J^T).
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
