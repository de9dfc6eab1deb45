"""A second engine's verdict on the same grasps, and how far both agree.

The engines share the geometry, the loads and the stages, and differ in contact model, solver and
time step. Where both say the same, the label does not hang on one solver: of grasps whose two
verdicts agreed, a greater share was right by a third simulator's labels in all four pairings tried.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array
from realsim.records import GraspSet
from realsim.robots.hand import Hand
from realsim_sim_bridge.school.measure_statistics import joined
from realsim_sim_bridge.slip.score import ScoreLimits
from realsim_sim_bridge.slip.slip_test import SlipConfig, Slips, SlipTrial, run_slip_test
from realsim_sim_bridge.slip.world import Engine

Z_95 = 1.959964
"""Standard deviations within which 95 % of a normal distribution lie."""
EXACT = 1e-9
"""Scores that differ by less are the same: sums of quarters and twelfths."""


def cross_check(
    trial: SlipTrial,
    slips: Slips,
    config: SlipConfig,
    limits: ScoreLimits,
    geometry: Hand,
    second: Engine,
) -> dict[str, Array]:
    """Return what a second engine says of the grasps of a trial.

    Args:
        trial: N grasps of an object.
        slips: what the first engine found.
        config: the slip test's settings, the same for both.
        limits: when a stage has failed.
        geometry: of the hand.
        second: the other engine.

    Returns:
        second_score, second_base_score and confidence (N,), second_slip_m and second_slip_rad
        (N, 4), as `realsim.records.MEASURES` tells. The confidence is 1 - |difference of the
        scores|.
    """
    seen = run_slip_test(trial, config, limits, geometry, second)
    _, first_score = slips.scores(limits)
    base, score = seen.scores(limits)
    return {
        "second_score": score,
        "second_base_score": base,
        "second_slip_m": seen.slip_m,
        "second_slip_rad": seen.slip_rad,
        "confidence": 1.0 - np.abs(first_score - score),
    }


@dataclass(frozen=True, kw_only=True, slots=True)
class Agreement:
    """How far two engines agree about the same grasps."""

    count: int
    """Grasps that both judged by physics."""
    both_held: int
    only_first: int
    """Held by the first engine, lost by the second."""
    only_second: int
    both_lost: int
    same_score: int
    """Grasps with the same score: the same stage and the same excesses."""
    mean_confidence: float
    """NaN where there are none."""

    @property
    def agree(self) -> int:
        """Grasps with the same label."""
        return self.both_held + self.both_lost

    @property
    def share(self) -> float:
        """Share of the grasps with the same label; NaN where there are none."""
        return self.agree / self.count if self.count else float("nan")

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the share."""
        return wilson_interval(self.agree, self.count)


def wilson_interval(successes: int, trials: int, z: float = Z_95) -> tuple[float, float]:
    """Return the interval of a share (Wilson 1927); (0, 1) without trials.

    With p = k/n it is (p + z^2/2n +- z sqrt(p(1-p)/n + z^2/4n^2)) / (1 + z^2/n). Unlike the normal
    one it stays within [0, 1] and does not vanish at p = 0 or 1.
    """
    if trials == 0:
        return 0.0, 1.0
    p, square = successes / trials, z * z / trials
    middle = p + square / 2.0
    half = z * np.sqrt(p * (1.0 - p) / trials + square / (4.0 * trials))
    low, high = (middle - half) / (1.0 + square), (middle + half) / (1.0 + square)
    return float(np.clip(low, 0.0, p)), float(np.clip(high, p, 1.0))


def agreement(first: Array, second: Array) -> Agreement:
    """Return how far scores (N,) of two engines agree; a NaN of either leaves a grasp out.

    A grasp is held where it passes all four stages, which is the score 1.
    """
    both = ~np.isnan(first) & ~np.isnan(second)
    a, b = first[both], second[both]
    held, second_held = a >= 1.0, b >= 1.0
    return Agreement(
        count=len(a),
        both_held=int(np.sum(held & second_held)),
        only_first=int(np.sum(held & ~second_held)),
        only_second=int(np.sum(~held & second_held)),
        both_lost=int(np.sum(~held & ~second_held)),
        same_score=int(np.sum(np.abs(a - b) < EXACT)),
        mean_confidence=float(np.mean(1.0 - np.abs(a - b))) if len(a) else float("nan"),
    )


def agreement_of(sets: Iterable[GraspSet]) -> Agreement:
    """Return how far two engines agree over several grasp sets; those without are left out."""
    checked = [s for s in sets if "second_score" in s.measures]
    return agreement(
        joined(s.scores for s in checked), joined(s.measures["second_score"] for s in checked)
    )
