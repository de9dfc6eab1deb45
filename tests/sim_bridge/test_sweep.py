"""Margins: how little friction and force a grasp survives."""

import numpy as np
import pytest

from held_boxes import held_box, held_from_above
from realsim.errors import InputError
from realsim.robots.hand import find_hand
from realsim_sim_bridge.school.sweep import SweepConfig, find_levels, run_sweep
from realsim_sim_bridge.slip.engines import make_engine, settings_of
from realsim_sim_bridge.slip.score import ScoreLimits
from realsim_sim_bridge.slip.slip_test import SlipConfig, run_slip_test
from realsim_sim_bridge.slip.world import SlipPhysics

GRAVITY = 9.81
PEAK = 11.6
"""Greatest acceleration that any of the stages asks the pads to carry on a centred box [m/s^2]."""
LEVELS = (1.0, 0.7, 0.5, 0.35, 0.2, 0.1, 0.05)


def measured(t, sweep, physics=None, engine="pybullet"):
    config = SlipConfig(physics=physics or SlipPhysics(), engine=settings_of(engine))
    engine = make_engine(config.engine)
    slips = run_slip_test(t, config, engine=engine)
    return run_sweep(t, slips, config, ScoreLimits(), find_hand(), engine, sweep)


# --- the search, on a law that is known --------------------------------------------------------


class Law:
    """Grasps that pass from a threshold on, and a count of how often each was tried."""

    def __init__(self, thresholds):
        self.thresholds = np.asarray(thresholds)
        self.tries = np.zeros(len(self.thresholds), dtype=int)

    def __call__(self, level, rows):
        self.tries[rows] += 1
        return np.where(level >= self.thresholds[rows], 1.0, 0.25)

    def known(self, own):
        return np.where(own >= self.thresholds, 1.0, 0.25)


@pytest.mark.parametrize("own", [1.0, 0.3, 0.01])
def test_all_searches_find_the_same_least_level(own):
    thresholds = np.random.default_rng(3).uniform(0.0, 1.3, 60)
    found = {}
    for search in ("descent", "bisect", "every"):
        law = Law(thresholds)
        found[search] = find_levels(law, law.known(own), own, LEVELS, search)
        ladder = found[search].levels
        # The smallest level above the threshold, by definition.
        above = np.where(ladder >= thresholds[:, None], ladder, np.inf)
        assert np.array_equal(found[search].least, above.min(axis=1))
        assert not found[search].exceptions.any()
        most = {"descent": len(LEVELS), "bisect": 3, "every": len(LEVELS)}[search]
        assert law.tries.max() <= most
    passed = [f.passed for f in found.values()]
    assert all(np.array_equal(p, passed[0]) for p in passed)


def test_the_own_level_is_not_tried_again_and_counts_in_the_share_only_if_listed():
    law = Law([0.0, 0.4, 9.0])
    found = find_levels(law, law.known(0.8), 0.8, LEVELS, "every")
    assert 0.8 in found.levels and law.tries.tolist() == [len(LEVELS)] * 3
    assert found.share_survived(LEVELS) == pytest.approx([1.0, 3 / 7, 0.0])
    assert found.least.tolist() == [0.05, 0.5, np.inf]


def test_a_grasp_that_passes_below_a_level_at_which_it_fails_is_an_exception():
    def run(level, rows):
        return np.where((level == 0.5) & (rows == 1), 0.25, 1.0)

    every = find_levels(run, np.ones(3), 1.0, LEVELS, "every")
    assert every.exceptions.tolist() == [False, True, False]
    assert every.passed[1].sum() == len(LEVELS) - 1 and every.least[1] == 0.05
    # Descending stops at the gap: the margin is that of the unbroken run.
    assert find_levels(run, np.ones(3), 1.0, LEVELS, "descent").least.tolist() == [0.05, 0.7, 0.05]


def test_levels_that_do_not_descend_are_refused():
    for levels in ((), (0.5, 0.5), (1.0, 0.0), (np.nan,)):
        for name in ("frictions", "forces_n", "stiffness_factors"):
            with pytest.raises(InputError, match=name):
                SweepConfig(**{name: levels})


# --- the physics, on a box that Coulomb's law is solved for -------------------------------------


@pytest.mark.parametrize(("engine", "mass"), [("pybullet", 0.125), ("mujoco", 0.5)])
def test_the_least_friction_and_force_are_coulomb_s(engine, mass):
    if engine == "mujoco":
        pytest.importorskip("mujoco")
    # Two pads carry 2 mu F. Below the weight the box falls, above the peak load it stays; between
    # it slides for a moment, which may stay below 2 cm.
    force_n, friction = 20.0, 0.25
    weight, peak = mass * GRAVITY, mass * PEAK
    frictions = (peak * 4, peak * 1.05, weight * 0.9, weight * 0.5)
    sweep = SweepConfig(
        frictions=tuple(load / (2 * force_n) for load in frictions),
        forces_n=tuple(load / (2 * friction) for load in frictions),
        search="every",
    )
    physics = SlipPhysics(force_n=force_n, friction=friction)
    found = measured(held_from_above(held_box(mass)), sweep, physics, engine)
    assert found.friction.least == pytest.approx([peak * 1.05 / (2 * force_n)])
    assert found.force.least == pytest.approx([peak * 1.05 / (2 * friction)])
    assert found.measures()["margin"] == pytest.approx([0.5])
    # A face that covers the pads is held by the same friction, however soft they are.
    assert found.stiffness.levels == pytest.approx([5e5, 3e5, 2e5, 1.2e5])
    assert found.measures()["stiffness_share"] == pytest.approx([1.0])
    assert not found.friction.exceptions.any() and not found.force.exceptions.any()


def test_pads_that_cannot_be_and_forces_that_press_them_through_are_left_out():
    pytest.importorskip("mujoco")
    own = SlipPhysics(force_n=20.0).with_pads(3e4)
    sweep = SweepConfig(frictions=(1.0,), forces_n=(70.0, 20.0), stiffness_factors=(50.0, 1.0, 0.3))
    found = measured(held_from_above(held_box(0.2)), sweep, own, "mujoco")
    assert found.stiffness.levels.tolist() == [3e4] and found.force.levels.tolist() == [20.0]
    bare = measured(held_from_above(held_box(0.2)), sweep, SlipPhysics(pads=None), "mujoco")
    assert bare.stiffness.scores.shape == (1, 1) and not np.isnan(bare.stiffness.scores).any()


def test_off_centre_grasps_and_heavy_objects_need_more():
    sweep = SweepConfig(frictions=(1.0, 0.5, 0.25, 0.12, 0.06, 0.03), forces_n=(20.0, 10.0, 5.0))
    physics = SlipPhysics(force_n=20.0)
    by_mass = {}
    for mass in (0.15, 0.6):
        t = held_from_above(held_box(mass, length=0.14), off_m=(0.0, 0.03, 0.055))
        by_mass[mass] = measured(t, sweep, physics, "mujoco").measures()
        least, margin = by_mass[mass]["least_friction"], by_mass[mass]["margin"]
        assert np.all(np.diff(least) >= 0) and least[2] > least[0]
        assert np.all(np.diff(margin) <= 0) and margin[2] < margin[0]
    assert np.all(by_mass[0.6]["least_friction"] >= 2 * by_mass[0.15]["least_friction"])
    assert np.all(by_mass[0.6]["least_force_n"] >= by_mass[0.15]["least_force_n"])
    assert np.all(by_mass[0.6]["margin"] < by_mass[0.15]["margin"])
