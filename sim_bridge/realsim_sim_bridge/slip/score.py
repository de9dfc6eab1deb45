"""The quality score of a grasp, from the slips of its stages alone (GraspIT, equation 3).

    s = b - N(slip > 2 cm) / 12 - N(slip > 10 deg) / 12,   clamped to [0, 1]

b is 0.25 for every stage passed in a row; N counts the executed stages whose slip is too large. A
lost object has slipped without bound (inf), so it counts in both. It is one attempt at the nominal
pose, force and friction. Closing has no limits unless they are asked for: how far fingers turn an
object on the table says nothing about whether a real hand holds it
(docs/decisions/0045-closing-as-it-happens.md). `score_paper` is the paper's own rule.
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from realsim.arrays import Array, Mask
from realsim.errors import InputError
from realsim.records import STAGES, GraspSet


@dataclass(frozen=True, kw_only=True, slots=True)
class ScoreLimits:
    """When a stage has failed, and what that costs."""

    slip_m: float = 0.02
    """Largest slip of the object relative to the gripper in a stage [m]; the paper's."""
    slip_deg: float = 10.0
    """Largest rotation relative to the gripper in a stage [deg]; the paper's."""
    penalty: float = 1.0 / 12.0
    """What each excess costs; the paper's."""
    close_slip_m: float | None = None
    """Largest slip while the fingers close [m]; None = any, as long as the object is not lost."""
    close_slip_deg: float | None = None
    """Largest rotation while the fingers close [deg]; None = any."""

    @classmethod
    def paper(cls) -> "ScoreLimits":
        """Return the paper's limits: those of the later stages hold in closing, too."""
        return cls(close_slip_m=cls().slip_m, close_slip_deg=cls().slip_deg)

    def by_stage(self) -> tuple[Array, Array]:
        """Return the largest slips (4,) [m] and rotations (4,) [rad] of the stages."""
        first = (self.close_slip_m, self.close_slip_deg)
        close_m, close_deg = (np.inf if limit is None else limit for limit in first)
        later = len(STAGES) - 1
        return (
            np.array([close_m, *[self.slip_m] * later]),
            np.radians([close_deg, *[self.slip_deg] * later]),
        )

    def rule(self) -> str:
        """Return in words which rule makes the score."""
        first = ((self.close_slip_m, "m"), (self.close_slip_deg, "deg"))
        close = " and ".join(f"{limit:g} {unit}" for limit, unit in first if limit is not None)
        return (
            f"equation 3 on four stages of one nominal attempt; a stage fails beyond "
            f"{self.slip_m:g} m or {self.slip_deg:g} deg, closing "
            + (f"beyond {close}" if close else "only where the object is lost or a finger is free")
        )


def score_stages(
    slip_m: Array, slip_rad: Array, tried: Mask, limits: ScoreLimits
) -> tuple[Array, Array]:
    """Return base scores (N,) and scores (N,) of per-stage slips; NaN where not tried.

    Args:
        slip_m: (N, 4) [m]; NaN = not executed, inf = lost.
        slip_rad: (N, 4) [rad]; likewise.
        tried: (N,) whether the grasp was judged at all; one without a trajectory was (it has 0).
        limits: when a stage has failed.
    """
    far, turned, in_a_row = _failed(slip_m, slip_rad, limits)
    base = in_a_row / len(STAGES)
    # A stage that was not executed costs nothing.
    score = base - limits.penalty * (far.sum(axis=1) + turned.sum(axis=1))
    nan = np.full(len(base), np.nan)
    return np.where(tried, base, nan), np.where(tried, np.clip(score, 0.0, 1.0), nan)


def score_paper(slip_m: Array, slip_rad: Array, tried: Mask) -> Array:
    """Return scores (N,) by the paper's table: 0.25 for every stage passed in a row, no more.

    Its limits hold in all stages, closing too; a stage that fails costs nothing besides, so that
    what fails the oscillation has 0.5, which the table counts as good.

    Args:
        slip_m: (N, 4) [m]; NaN = not executed, inf = lost.
        slip_rad: (N, 4) [rad]; likewise.
        tried: (N,) whether the grasp was judged at all.

    Returns:
        NaN where not tried, and where stricter limits stopped a grasp that the paper's do not.
    """
    far, turned, in_a_row = _failed(slip_m, slip_rad, ScoreLimits.paper())
    failed = (far | turned).any(axis=1) | (in_a_row == len(STAGES)) | np.isnan(slip_m[:, 0])
    return np.where(tried & failed, in_a_row / len(STAGES), np.nan)


def _failed(slip_m: Array, slip_rad: Array, limits: ScoreLimits) -> tuple[Mask, Mask, Array]:
    """Return what slipped too far (N, 4), turned too far (N, 4), and stages passed in a row (N,).

    What is lost (inf) is too far under any limit, what was not executed (NaN) under none.
    """
    limit_m, limit_rad = limits.by_stage()
    far = (slip_m > limit_m) | np.isinf(slip_m)
    turned = (slip_rad > limit_rad) | np.isinf(slip_rad)
    passed = np.isfinite(slip_m) & np.isfinite(slip_rad) & ~far & ~turned
    return far, turned, np.cumprod(passed, axis=1).sum(axis=1).astype(np.float64)


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
    return score_stages(grasp_set.slip_m, grasp_set.slip_rad, judged(grasp_set), limits)


def judged(grasp_set: GraspSet) -> Mask:
    """Return which grasps of a set were judged (N,): without a trajectory the score is 0."""
    executed = ~np.all(np.isnan(grasp_set.slip_m), axis=1)
    # With a trajectory but without slips the grasp was never tried.
    return executed | (~grasp_set.reachable & ~np.isnan(grasp_set.scores))


def limits_of(parameters: dict[str, Any]) -> ScoreLimits:
    """Return the score's limits that a GraspSet's parameters hold.

    Sets made before closing had limits of its own used those of the other stages there.

    Raises:
        InputError: they do not.
    """
    stored: Any = parameters.get("config", {}).get("score")
    names = set(asdict(ScoreLimits()))
    if not isinstance(stored, dict) or set(stored) not in (names, names - set(CLOSING)):
        raise InputError(
            "the grasp set's parameters hold no config.score with slip_m, slip_deg and penalty; "
            "it does not come from Robot School. Give the limits explicitly."
        )
    old: dict[str, Any] = {name: stored[name.removeprefix("close_")] for name in CLOSING}
    return ScoreLimits(**(old | stored))


CLOSING = ("close_slip_m", "close_slip_deg")
"""The limits of closing, which sets made before there were such lack."""
