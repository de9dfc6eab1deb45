"""The quality score of a grasp, from the slips of its stages alone (GraspIT, equation 3).

    s = b - N(slip > 2 cm) / 12 - N(slip > 10 deg) / 12,   clamped to [0, 1]

b is 0.25 for every stage passed in a row; N counts the executed stages whose slip is too large. A
lost object has slipped without bound (inf), so it counts in both.
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.records import STAGES, GraspSet

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class ScoreLimits:
    """When a stage has failed, and what that costs."""

    slip_m: float = 0.02
    """Largest slip of the object relative to the gripper in a stage [m]; the paper's."""
    slip_deg: float = 10.0
    """Largest rotation relative to the gripper in a stage [deg]; the paper's."""
    penalty: float = 1.0 / 12.0
    """What each excess costs; the paper's."""


def score_stages(
    slip_m: Array, slip_rad: Array, tried: NDArray[np.bool_], limits: ScoreLimits
) -> tuple[Array, Array]:
    """Return base scores (N,) and scores (N,) of per-stage slips; NaN where not tried.

    Args:
        slip_m: (N, 4) [m]; NaN = not executed, inf = lost.
        slip_rad: (N, 4) [rad]; likewise.
        tried: (N,) whether the grasp was judged at all; one without a trajectory was (it has 0).
        limits: when a stage has failed.
    """
    with np.errstate(invalid="ignore"):
        far, turned = slip_m > limits.slip_m, slip_rad > np.radians(limits.slip_deg)
    passed = np.isfinite(slip_m) & np.isfinite(slip_rad) & ~far & ~turned
    in_a_row = np.cumprod(passed, axis=1).sum(axis=1)
    base = in_a_row / len(STAGES)
    # NaN > limit is False: a stage that was not executed costs nothing.
    score = base - limits.penalty * (far.sum(axis=1) + turned.sum(axis=1))
    nan = np.full(len(base), np.nan)
    return np.where(tried, base, nan), np.where(tried, np.clip(score, 0.0, 1.0), nan)


def recompute_scores(grasp_set: GraspSet, limits: ScoreLimits | None = None) -> tuple[Array, Array]:
    """Return base scores (N,) and scores (N,) from what is stored in the set alone.

    Args:
        grasp_set: a set from Robot School.
        limits: other limits than those the set was made with; None = its own.

    Raises:
        InputError: the set does not carry the limits of its score.
    """
    if limits is None:
        limits = limits_of(grasp_set.parameters)
    executed = ~np.all(np.isnan(grasp_set.slip_m), axis=1)
    # Without a trajectory the score is 0; with one but without slips the grasp was never tried.
    tried = executed | (~grasp_set.reachable & ~np.isnan(grasp_set.scores))
    return score_stages(grasp_set.slip_m, grasp_set.slip_rad, tried, limits)


def limits_of(parameters: dict[str, Any]) -> ScoreLimits:
    """Return the score's limits that a GraspSet's parameters hold.

    Raises:
        InputError: they do not.
    """
    stored: Any = parameters.get("config", {}).get("score")
    if not isinstance(stored, dict) or set(stored) != set(asdict(ScoreLimits())):
        raise InputError(
            "the grasp set's parameters hold no config.score with slip_m, slip_deg and penalty; "
            "it does not come from Robot School. Give the limits explicitly."
        )
    return ScoreLimits(**stored)
