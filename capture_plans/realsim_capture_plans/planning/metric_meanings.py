"""What every metric of a plan means, in which unit, and what is good."""

import re
from dataclasses import dataclass
from typing import Literal

import numpy as np

from realsim_capture_plans.collision.model import GROUPS
from realsim_capture_plans.planning.record import CapturePlan

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
JOINT_NAMES = ("base", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3")


@dataclass(frozen=True, kw_only=True, slots=True)
class Meaning:
    """What one metric says."""

    text: str
    """In words."""
    unit: str
    """Of the value; empty for counts and shares."""
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


def _meaning(
    text: str, unit: str, good: str, better: Literal["more", "less", "as asked"]
) -> Meaning:
    return Meaning(text=text, unit=unit, good=good, better=better)


_GROUP_TEXTS = {
    "self": "between the arm's own parts",
    "tool": "between the arm and its camera with the bracket",
    "table": "to the table",
    "scene": "to the keep-out box and the obstacles",
}

METRIC_MEANINGS: dict[str, Meaning] = {
    "views": _meaning("views of the plan", "", "as many as asked for", "as asked"),
    # --- where the views are ---------------------------------------------------------------
    "hole_deg": _meaning(
        "farthest place from any view, over the elevations that the plan was made for",
        "deg", "<= 8 (an ideal spiral of 256 from 15 to 90 deg has 7.7)", "less",
    ),
    "hole_cap_deg": _meaning(
        "the same over all elevations from 15 deg up", "deg", "<= 8", "less"
    ),
    "spacing_min_deg": _meaning("least angle to the nearest other view", "deg", "> 3", "more"),
    "spacing_median_deg": _meaning("middle angle to the nearest other view", "deg", "> 5", "more"),
    "radius_min_m": _meaning("nearest camera to the centre", "m", ">= 0.25 (D405)", "as asked"),
    "radius_max_m": _meaning("farthest camera from the centre", "m", "<= 0.45 (D405)", "as asked"),
    "parallax_median_deg": _meaning(
        "middle angle at the centre between consecutive views", "deg", "5 to 15", "as asked"
    ),
    "parallax_max_deg": _meaning(
        "greatest angle at the centre between consecutive views", "deg", "< 60", "less"
    ),
    # --- how far and how long ----------------------------------------------------------------
    "travel_leading_rad": _meaning("sum of the leading joint's turns", "rad", "< 60", "less"),
    "travel_total_rad": _meaning("sum of all joints' turns", "rad", "< 200", "less"),
    "largest_step_rad": _meaning("greatest turn of a joint in one leg", "rad", "< 3.2", "less"),
    "seconds": _meaning(
        "moving, stop to stop, at the plan's speed and acceleration", "s", "< 190", "less"
    ),
    "seconds_settling": _meaning("waiting for the arm to stand still", "s", "0.3 a view", "less"),
    "seconds_total": _meaning(
        "moving and settling; exposures come on top", "s", "< 270", "less"
    ),
    "moves_with_vias": _meaning("moves that are not straight", "", "a few", "less"),
    # --- how near to trouble -----------------------------------------------------------------
    "colliding_legs": _meaning(
        "straight pieces on which the clearance is not kept", "", "0, always", "less"
    ),
    "sigma_min": _meaning(
        "least singular value of the Jacobian at the worst view", "", ">= 0.05", "more"
    ),
    "sigma_median": _meaning("the same at the middle view", "", "> 0.15", "more"),
    "yoshikawa_min": _meaning(
        "Yoshikawa's manipulability sqrt(det J J^T) at the worst view", "", "> 0.005", "more"
    ),
    "yoshikawa_median": _meaning("the same at the middle view", "", "> 0.03", "more"),
    "limit_margin_deg": _meaning(
        "least distance of a joint to its limit, anywhere on the tour", "deg", "> 10", "more"
    ),
    **{
        f"turn_{name}_deg": _meaning(
            f"greatest turn of joint {name.replace('_', ' ')} away from home: winds up cables",
            "deg", "< 240", "less",
        )
        for name in JOINT_NAMES
    },
    **{
        f"clearance_{group}_m": _meaning(
            f"least distance {_GROUP_TEXTS.get(group, group)}, at the views",
            "m", ">= the plan's clearance", "more",
        )
        for group in dict.fromkeys((*_GROUP_TEXTS, *GROUPS))
    },
    **{
        f"clearance_moves_{group}_m": _meaning(
            f"least distance {_GROUP_TEXTS.get(group, group)}, along all moves",
            "m", ">= the plan's clearance", "more",
        )
        for group in dict.fromkeys((*_GROUP_TEXTS, *GROUPS))
    },
    # --- what the camera sees ----------------------------------------------------------------
    "in_view_min": _meaning(
        "share of the scene's volume in the image, worst view", "", "> 0.6", "more"
    ),
    "in_view_median": _meaning("the same, middle view", "", "> 0.9", "more"),
    "overlap_min": _meaning(
        "share of the scene's volume in both of two consecutive views, worst pair", "",
        "> 0.5", "more",
    ),
    "overlap_median": _meaning("the same, middle pair", "", "> 0.85", "more"),
    "seen_by_min": _meaning(
        "views that have the worst-seen place of the scene's volume in the image", "",
        "> half of them", "more",
    ),
    "seen_by_median": _meaning("the same, middle place", "", "> 0.9 of them", "more"),
    "seen_from_min_deg": _meaning(
        "greatest angle between two views of a place, worst place", "deg", "> 90", "more"
    ),
    "seen_from_median_deg": _meaning("the same, middle place", "deg", "> 110", "more"),
    "depth_noise_median_m": _meaning(
        "standard deviation of the depth at the centre, z^2 s / (f B), middle view", "m",
        "< 0.0010", "less",
    ),
    "depth_noise_max_m": _meaning("the same, worst view", "m", "< 0.0014", "less"),
    "nearest_depth_m": _meaning(
        "least depth of the scene's volume in an image", "m",
        ">= 0.10 (D405: nearer, it measures nothing)", "more",
    ),
    # --- boards ------------------------------------------------------------------------------
    "roll_gap_deg": _meaning(
        "widest gap between the board's rolls about the optical axis", "deg", "< 720 / views",
        "less",
    ),
    "tilt_min_deg": _meaning(
        "least angle between optical axis and board normal", "deg", "< 15", "less"
    ),
    "tilt_max_deg": _meaning(
        "greatest angle between optical axis and board normal", "deg", "35 to 45", "as asked"
    ),
    "distance_min_m": _meaning(
        "nearest, along the optical axis to the board", "m", "0.22", "as asked"
    ),
    "distance_max_m": _meaning(
        "farthest, along the optical axis to the board", "m", "0.40", "as asked"
    ),
    # --- known only when a plan is made ------------------------------------------------------
    "hole_reachable_deg": _meaning(
        "farthest direction that the arm reaches freely from any view", "deg", "<= 6", "less"
    ),
    "tour_bound_s": _meaning(
        "no tour of these views can be shorter (Held and Karp)", "s", "near seconds", "as asked"
    ),
    "tour_bound_two_nearest_s": _meaning(
        "a weaker bound: half of the two shortest moves at every view", "s", "near seconds",
        "as asked",
    ),
    "tour_over_bound": _meaning("seconds over tour_bound_s", "", "<= 1.22", "less"),
    "reachable_share": _meaning(
        "of the directions or board poses tried, those the arm reaches freely", "", "> 0.95",
        "more",
    ),
}  # fmt: skip
"""Every key that `metrics.plan_metrics` returns, and what making a plan adds."""
