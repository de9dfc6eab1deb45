"""The margin of a grasp: how little friction and force it survives, and pads of what stiffness.

A converged Coulomb simulation at 70 N and mu 1 holds almost anything that both fingers touch, so
one setting hardly tells one grasp from another; the weakest setting at which a grasp still passes
does (docs/decisions/0018-what-the-labels-mean.md). One quantity is swept at a time, the other stays
what the slip test had.

A sweep assumes that passing is monotone: a grasp that passes at a level passes at every higher one.
For sticking contacts that is Coulomb's law. It can fail while the fingers close, where a slippery
object slides into line and a rough one turns. `SweepConfig.search` "every" tries all levels and
`LevelScores.exceptions` counts the grasps that break the rule.

No such law holds for the pads' stiffness, which nobody knows to better than a factor: all of its
levels are tried, and what counts is at how many of them a grasp passes.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from realsim.arrays import Array, Int64, Mask, Rows
from realsim.errors import InputError
from realsim.robots.hand import Hand
from realsim_sim_bridge.slip.score import ScoreLimits
from realsim_sim_bridge.slip.slip_test import SlipConfig, Slips, SlipTrial, run_slip_test
from realsim_sim_bridge.slip.world import STIFFNESS_N_PER_M, Engine, SlipPhysics

Levels = tuple[float, ...]
RunLevel = Callable[[float, Rows], Array]
"""Returns the scores of some rows at a level."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SweepConfig:
    """The levels that are tried, and how."""

    frictions: tuple[float, ...] = (1.0, 0.7, 0.5, 0.35, 0.25, 0.17, 0.12, 0.085, 0.06, 0.04, 0.02)
    """Coulomb coefficients, descending, about a factor of 0.7 apart: what dry and oily hands differ
    by. Antipodal contacts tilted by 45 deg need 1, flat ones on 250 g at 70 N need 0.02."""
    forces_n: tuple[float, ...] = (70.0, 50.0, 35.0, 25.0, 17.0, 12.0, 8.5, 6.0, 4.0, 2.0, 1.0)
    """Force of each finger [N], descending: from the Franka Hand's continuous force down."""
    stiffness_factors: tuple[float, ...] = (2.5, 1.5, 1.0, 0.6)
    """Stiffness of the pads in units of the slip test's own, descending: about what hardness and
    thickness of silicone pads leave open (docs/decisions/0046-pad-stiffness.md). What no engine
    can press, or would be pressed through at the test's force, is left out."""
    search: Literal["descent", "bisect", "every"] = "bisect"
    """descent: level after level, with the grasps that still pass; bisect: 4 of 11 levels a grasp,
    the same answer where passing is monotone; every: all levels for all grasps. Of 240 grasps on
    six objects bisect and every find the same least level for 95 % by friction
    and 90 % by force; of those that pass at 70 N and friction 1, for 99 and 92 %."""

    def __post_init__(self) -> None:
        """Check that the levels are positive and descend.

        Raises:
            InputError: they do not.
        """
        for name in ("frictions", "forces_n", "stiffness_factors"):
            levels: tuple[float, ...] = getattr(self, name)
            falling = all(a > b for a, b in pairwise(levels))
            if not levels or not falling or not all(np.isfinite(v) and v > 0 for v in levels):
                raise InputError(
                    f"{name} of the sweep are {levels}; positive numbers in falling order are "
                    "accepted, such as (1.0, 0.5, 0.25)."
                )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LevelScores:
    """The scores of N grasps at L levels of one quantity."""

    levels: Array
    """(L,) descending: the configured ones, and the slip test's own."""
    scores: Array
    """(N, L) in [0, 1]; NaN = not run, as the levels around it tell the answer."""
    passed: Mask
    """(N, L) whether all four stages are passed: seen, or told by monotony where not run."""

    @property
    def least(self) -> Array:
        """(N,) the smallest level at which all four stages are passed; inf = at none tried."""
        smallest = np.where(self.passed, self.levels, np.inf)
        return smallest.min(axis=1, initial=np.inf)

    @property
    def exceptions(self) -> Mask:
        """(N,) grasps that were seen to pass at a level and to fail at a higher one."""
        run = ~np.isnan(self.scores)
        failed_higher = np.cumsum(run & ~self.passed, axis=1) > 0
        return np.any(run & self.passed & failed_higher, axis=1)

    def share_survived(self, of: tuple[float, ...]) -> Array:
        """Return the share (N,) of the levels `of` at which each grasp passes."""
        return self.passed[:, np.isin(self.levels, of)].mean(axis=1)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Sweep:
    """What the sweeps found."""

    config: SweepConfig
    friction: LevelScores
    """At the slip test's force."""
    force: LevelScores
    """At the slip test's friction."""
    stiffness: LevelScores
    """At the slip test's friction and force [N/m]; of bare fingers that one setting alone."""

    def measures(self) -> dict[str, Array]:
        """Return least_friction, least_force_n, margin and stiffness_share, each (N,).

        The margin is the mean of the two shares of levels survived: 1 = survives the least friction
        and the least force tried, 0 = none.
        """
        by_friction = self.friction.share_survived(self.config.frictions)
        by_force = self.force.share_survived(self.config.forces_n)
        return {
            "least_friction": self.friction.least,
            "least_force_n": self.force.least,
            "margin": (by_friction + by_force) / 2.0,
            "stiffness_share": self.stiffness.passed.mean(axis=1),
        }


def run_sweep(
    trial: SlipTrial,
    slips: Slips,
    config: SlipConfig,
    limits: ScoreLimits,
    geometry: Hand,
    engine: Engine,
    sweep: SweepConfig,
) -> Sweep:
    """Return the scores of a trial's grasps at every level that was tried.

    Args:
        trial: N grasps of an object.
        slips: what the slip test found of them with this config: the level to start from.
        config: the slip test's settings.
        limits: when a stage has failed.
        geometry: of the hand.
        engine: that of the slip test.
        sweep: the levels.
    """
    known = slips.scores(limits)[1]
    physics, pads = config.physics, config.physics.pads

    def along(
        of: Callable[[float], SlipPhysics], own: float, levels: Levels, search: str
    ) -> LevelScores:
        def run(level: float, rows: Rows) -> Array:
            at = replace(config, physics=of(level))
            tried = run_slip_test(trial.part(rows), at, limits, geometry, engine)
            return tried.scores(limits)[1]

        return find_levels(run, known, own, levels, search)

    most = np.inf if pads is None else pads.greatest_n
    forces = tuple(n for n in sweep.forces_n if n <= most)
    own, stiffnesses = 0.0, (0.0,)
    if pads is not None:
        own = pads.pad_stiffness_n_per_m
        least = max(STIFFNESS_N_PER_M[0], physics.force_n / pads.protrusion_m)
        tried = (own * factor for factor in sweep.stiffness_factors)
        stiffnesses = tuple(k for k in tried if least <= k <= STIFFNESS_N_PER_M[1])
    return Sweep(
        config=sweep,
        friction=along(
            lambda v: replace(physics, friction=v), physics.friction, sweep.frictions, sweep.search
        ),
        force=along(lambda v: replace(physics, force_n=v), physics.force_n, forces, sweep.search),
        stiffness=along(physics.with_pads, own, stiffnesses, "every"),
    )


def find_levels(
    run: RunLevel, known: Array, own: float, levels: tuple[float, ...], search: str
) -> LevelScores:
    """Return the scores along one quantity, trying as few levels as the search needs.

    Args:
        run: tries some of the grasps at a level.
        known: (N,) scores at `own`, which are not run again.
        own: the slip test's own level.
        levels: the levels to try, descending.
        search: "descent", "bisect" or "every".
    """
    ladder = np.array(sorted({*levels, own}, reverse=True))
    scores = np.full((len(known), len(ladder)), np.nan)
    scores[:, int(np.nonzero(ladder == own)[0][0])] = known
    while True:
        wanted = _next_levels(scores, search)
        if np.all(wanted < 0):
            break
        # One friction or force a world: the grasps that want the same level share it.
        for column in np.unique(wanted[wanted >= 0]).tolist():
            rows = np.nonzero(wanted == column)[0].astype(np.int64)
            scores[rows, column] = run(float(ladder[column]), rows)
    return LevelScores(levels=ladder, scores=scores, passed=_passed(scores))


def _bracket(scores: Array) -> tuple[Int64, Int64]:
    """Return (N,) the lowest level seen to pass (-1: none) and the next failed below it (L: none).

    Levels descend, so higher columns are weaker settings.
    """
    count = scores.shape[1]
    column = np.arange(count)
    passing = np.where(scores >= 1.0, column, -1).max(axis=1, initial=-1)
    failing = (scores < 1.0) & (column > passing[:, None])
    return passing, np.where(failing, column, count).min(axis=1, initial=count)


def _next_levels(scores: Array, search: str) -> Int64:
    """Return the column (N,) that each grasp is to be tried at next; -1 = it is known."""
    if search == "every":
        open_levels = np.isnan(scores)
        return np.where(open_levels.any(axis=1), open_levels.argmax(axis=1), -1)
    passing, failing = _bracket(scores)
    if search == "bisect":
        middle = (passing + failing) // 2
        return np.where(failing - passing > 1, middle, -1)
    # Down from the lowest that passes; where nothing passes yet, up from the highest that fails.
    step = np.where(passing >= 0, passing + 1, failing - 1)
    return np.where(failing - passing > 1, step, -1)


def _passed(scores: Array) -> Mask:
    """Return (N, L) what was seen, and by monotony what was not.

    A level that was not run is passed where a lower level is. Where every level was run this is
    what was seen.
    """
    passing, _ = _bracket(scores)
    told = np.arange(scores.shape[1]) <= passing[:, None]
    return np.where(np.isnan(scores), told, scores >= 1.0)
