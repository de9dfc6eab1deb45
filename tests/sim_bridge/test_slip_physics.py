"""The slip test's physics: a box that must be held, Coulomb's limit, and the engine's traps."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.spatial import QhullError

from held_boxes import DOWN, held_box, held_from_above
from realsim.geometry import se3
from realsim.robots.hand import find_hand
from realsim_sim_bridge.school.sweep import SweepConfig, find_levels, run_sweep
from realsim_sim_bridge.slip.bullet_shapes import drawn_in
from realsim_sim_bridge.slip.bullet_world import BulletEngine
from realsim_sim_bridge.slip.engines import BulletSettings, MujocoSettings, make_engine, settings_of
from realsim_sim_bridge.slip.motion import (
    SlipMotion,
    lift_acceleration,
    oscillation_acceleration,
    pendulum_angle,
    pendulum_wrenches,
)
from realsim_sim_bridge.slip.score import ScoreLimits
from realsim_sim_bridge.slip.slip_test import SlipConfig, run_slip_test
from realsim_sim_bridge.slip.world import Closing, Replay, SlipPhysics
from refusals import refused


def trial(n=1, mass=0.125):
    return held_from_above(held_box(mass), [0.0] * n)


def simulated(physics=None, engine=None):
    """Return a config of which all stages are simulated: the engine is judged, not what is sure."""
    engine = engine or BulletSettings()
    return SlipConfig(physics=physics or SlipPhysics(), engine=engine, sure=None)


def run(physics=None, engine=None, **kwargs):
    return run_slip_test(trial(**kwargs), simulated(physics, engine))


def score(slips):
    return slips.scores(ScoreLimits())[1]


def test_the_box_is_held_through_all_stages_without_slip():
    slips = run()
    assert slips.failures == ("",) and score(slips)[0] == 1.0
    assert slips.slip_m.max() < 1e-3 and np.degrees(slips.slip_rad.max()) < 1.0


def test_a_bare_default_world_drops_the_same_box():
    default = SlipPhysics(pads=None, mass_floor_kg=0.0)
    patient = ScoreLimits(slip_m=0.04, slip_deg=360.0)
    config = simulated(default, BulletSettings(iterations=50, replay=Replay()))
    assert score(run_slip_test(trial(), config))[0] < 0.5
    # Even if turning and slipping are let pass, the box falls out before the end.
    slips = run_slip_test(trial(), config, patient)
    assert np.isinf(slips.slip_m).any() and "lost" in slips.failures[0]


def test_too_weak_a_squeeze_fails_in_the_lift_and_70_newton_hold():
    weak = run(SlipPhysics(friction=0.05, force_n=5.0))  # carries 0.5 N of 1.23 N
    assert weak.failures[0].startswith("lift") and score(weak)[0] < 0.25
    strong = run(SlipPhysics(friction=0.05))  # carries 7 N
    assert score(strong)[0] == 1.0 and strong.slip_m.max() < 1e-3


def test_light_objects_are_held_and_carry_their_true_weight():
    assert run(mass=0.013).slip_m.max() < 1e-3
    # 2 * 0.05 * 1 N = 0.1 N carries 13 g x 9.81 = 0.128 N no more, although the engine's mass is
    # raised 15 times.
    assert run(SlipPhysics(friction=0.05, force_n=1.0), mass=0.013).failures[0] != ""
    assert run(SlipPhysics(friction=0.05, force_n=4.0), mass=0.013).failures[0] == ""


def turned_trial(n, mass=0.125):
    """Return grasps of the cube that differ: off its middle, and about its closing axis."""
    k = np.arange(n)[:, None]
    Ts = se3.from_rt(DOWN @ se3.exp_so3(k * [0, 0.3, 0]), k * [0.004, 0.0, 0.002])
    return replace(trial(n, mass), Ts_obj_grasp=Ts, Ts_table_grasp=Ts)


def test_results_are_repeatable_to_the_bit():
    a, b = (run_slip_test(turned_trial(2), simulated()) for _ in range(2))
    assert np.array_equal(a.slip_m, b.slip_m) and np.array_equal(a.slip_rad, b.slip_rad)


@pytest.mark.slow
def test_no_grasp_depends_on_the_others_it_is_tried_with():
    every = simulated()  # a stage that is not simulated depends on nothing anyhow
    together = run_slip_test(turned_trial(4), every)
    backwards = run_slip_test(turned_trial(4).part(np.array([3, 2, 1, 0])), every)
    alone = run_slip_test(turned_trial(4).part(slice(2, 3)), every)
    small = replace(every, engine=BulletSettings(pairs_per_world=3))
    parted = run_slip_test(turned_trial(4), small)
    assert together.slip_m[:, 1:].max() > 0
    for name in ("slip_m", "slip_rad", "force_n", "duration_s"):
        whole = getattr(together, name)
        assert np.array_equal(whole[::-1], getattr(backwards, name))
        assert np.array_equal(whole[2:3], getattr(alone, name))
        assert np.array_equal(whole, getattr(parted, name))


def test_what_slips_in_a_fast_replay_is_judged_at_true_speed():
    # 2 x 0.05 x 13 N = 1.3 N carry 1.23 N of weight, and not the lift's 1.37 N.
    physics = SlipPhysics(friction=0.05, force_n=13.0)
    slow, fast = run(physics, BulletSettings.reference()), run(physics)
    assert slow.slip_m[0, 1] > 1e-3
    assert fast.slip_m[0, 1] == pytest.approx(slow.slip_m[0, 1], rel=0.05)


def test_every_setting_is_read_back_from_the_engine():
    t, physics, settings = trial(mass=0.013), SlipPhysics(friction=0.37), BulletSettings()
    with BulletEngine(settings).world(t.met(physics, find_hand()), t.grips(0.004)) as world:
        world.close(Closing())
        read = world.settings()
    assert read["object_friction"] == pytest.approx(0.37) and read["finger_friction"] == 1.0
    assert read["dt_s"] == pytest.approx(1 / 240) and read["iterations"] == settings.iterations
    assert read["object_mass_kg"] == pytest.approx(physics.mass_floor_kg)
    assert read["substeps"] == 0 and read["pad_stiffness_n_per_m"] == pytest.approx(2e5)
    assert read["force_n"] == pytest.approx(70.0, rel=0.02)


def test_states_put_back_go_on_alike():
    t = turned_trial(2)
    engine = BulletEngine(BulletSettings())
    pull = np.zeros((2, 60, 6))
    pull[:, :, 5] = -1.2
    with engine.world(t.met(SlipPhysics(), find_hand()), t.grips(0.004)) as world:
        world.close(Closing())
        before = world.states()
        first = world.play(pull, 20, 1.0).Ts_world_body
        world.put(before)
        assert np.allclose(world.states().twists, before.twists, atol=1e-15)
        again = world.play(pull, 20, 1.0).Ts_world_body
    assert np.allclose(first, again, atol=1e-9)


def test_a_hand_that_closes_on_nothing_fails_in_the_first_stage():
    beside = se3.from_rt(DOWN, [0.0, 0.0, 0.2])[None]
    slips = run_slip_test(replace(trial(), Ts_obj_grasp=beside))
    assert slips.failures[0] == "close: the fingers did not both touch the object"
    assert np.isinf(slips.slip_m[0, 0]) and np.isnan(slips.slip_m[0, 1:]).all()


def test_the_motions_end_at_rest_and_go_where_they_should():
    motion, dt = SlipMotion(), 1e-4
    for a, end in (
        (lift_acceleration(motion, dt), [0, 0, 0.2]),
        (oscillation_acceleration(motion, dt), [0, 0, 0]),
    ):
        speed = np.cumsum(a, axis=0) * dt
        path = np.cumsum(speed, axis=0) * dt
        assert np.allclose(speed[-1], 0, atol=1e-3) and np.allclose(path[-1], end, atol=1e-3)
    assert np.ptp(path[:, 0]) == pytest.approx(2 * motion.oscillation_m, rel=0.01)
    theta, speed, _ = pendulum_angle(motion, dt, -1.0, 0.5)
    assert theta.max() == pytest.approx(0.5) and theta.min() == pytest.approx(-1.0)
    full = pendulum_angle(motion, dt, -np.pi / 3, np.pi / 3)[1]
    assert np.abs(full).max() < 2.61  # the Panda's joint 5 [rad/s]


def test_inertial_forces_are_those_of_newton_in_the_world():
    # A mass fixed to the turning hand: force in the hand's frame = R^T (m x'' - m g), reversed.
    motion, dt = SlipMotion(), 1e-4
    rng = np.random.default_rng(0)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    arm, mass = rng.normal(size=3), 0.7
    angle = pendulum_angle(motion, dt, -1.0, 1.0)
    inertia = np.eye(3)[None] * 1e-3
    (wrench,) = pendulum_wrenches(angle[None], axis[None], arm[None], inertia, mass, 9.81)
    torque, force = wrench[:, :3], wrench[:, 3:]
    R = se3.exp_so3(angle[0][:, None] * axis)
    path = R @ arm
    acceleration = np.gradient(np.gradient(path, dt, axis=0), dt, axis=0)
    expected = mass * (np.array([0, 0, -9.81]) - acceleration)
    expected = (np.swapaxes(R, -1, -2) @ expected[..., None])[..., 0]
    middle = slice(10, len(path) // 8)
    assert np.allclose(force[middle], expected[middle], atol=2e-2)
    # A ball's spin: torque against the angular acceleration alone.
    assert np.allclose(torque, -1e-3 * angle[2][:, None] * axis, atol=1e-12)


def test_the_safety_factor_is_coulomb_s_and_what_it_makes_sure_is_what_the_engine_says():
    config, skipped = simulated(SlipPhysics(force_n=10.0, friction=0.3), MujocoSettings()), 0
    for mass in (0.02, 0.1, 0.125, 0.25, 0.5, 3.0):
        cubes = turned_trial(2, mass)
        sure = run_slip_test(cubes, replace(config, sure=3.0))
        every = run_slip_test(cubes, config)
        # Two fingers carry 2 mu F; a cone of eight edges is at most 5 % off.
        assert sure.safety[0, 0] == pytest.approx(2 * 0.3 * 10.0 / (9.81 * mass), rel=0.06)
        np.testing.assert_array_equal(sure.safety, every.safety)
        np.testing.assert_array_equal(sure.passed, every.passed)
        is_sure = sure.safety[:, 1:] >= 3.0
        assert np.all(sure.slip_m[:, 1:][is_sure] == 0)
        assert np.all(every.slip_m[:, 1:][is_sure] < 1e-3)
        skipped += int(is_sure.sum())
    assert skipped >= 18
    refused(r"0.5 makes nothing sure.*more than 1", SlipConfig, sure=0.5)


def test_a_sliver_between_parts_has_a_core_too():
    """A neighbour's part of 0.1 nm, whose planes leave no ball inside, stays as it is."""
    box = np.array(list(product((-0.01, 0.01), (-0.02, 0.02), (0.3, 0.3 + 1e-10))))
    box = box @ se3.exp_so3([0.3, 0.2, 0.1]).T
    try:
        cores, margin = drawn_in([box], 0.0005)
    except QhullError:
        return  # flatter than a hull can be: `Stand.around` leaves such parts out
    assert 0.0 < margin <= 0.0005
    np.testing.assert_allclose(np.ptp(cores[0], axis=0), np.ptp(box, axis=0), atol=2e-4)


# --- Margins: how little friction and force a grasp survives.

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
        return self.known(level)[rows]

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
        assert law.tries.max() <= (3 if search == "bisect" else len(LEVELS))
        assert np.array_equal(found[search].passed, found["descent"].passed)


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
            refused(name, SweepConfig, **{name: levels})


# --- the physics, on a box that Coulomb's law is solved for -------------------------------------


@pytest.mark.parametrize(("engine", "mass"), [("pybullet", 0.125), ("mujoco", 0.5)])
def test_the_least_friction_and_force_are_coulomb_s(engine, mass):
    # Two pads carry 2 mu F. Below the weight the box falls, above the peak load it stays; between
    # it slides for a moment, which may stay below 2 cm.
    force_n, friction = 20.0, 0.25
    weight, peak = mass * 9.81, mass * PEAK
    frictions = (peak * 4, peak * 1.05, weight * 0.9, weight * 0.5)
    sweep = SweepConfig(
        frictions=tuple(load / (2 * force_n) for load in frictions),
        forces_n=tuple(load / (2 * friction) for load in frictions),
        search="every",
    )
    physics = SlipPhysics(force_n=force_n, friction=friction)
    found = measured(trial(mass=mass), sweep, physics, engine)
    assert found.friction.least == pytest.approx([peak * 1.05 / (2 * force_n)])
    assert found.force.least == pytest.approx([peak * 1.05 / (2 * friction)])
    assert found.measures()["margin"] == pytest.approx([0.5])
    # A face that covers the pads is held by the same friction, however soft they are.
    assert found.stiffness.levels == pytest.approx([5e5, 3e5, 2e5, 1.2e5])
    assert found.measures()["stiffness_share"] == pytest.approx([1.0])
    assert not found.friction.exceptions.any() and not found.force.exceptions.any()


def test_pads_that_cannot_be_and_forces_that_press_them_through_are_left_out():
    own = SlipPhysics(force_n=20.0).with_pads(3e4)
    sweep = SweepConfig(frictions=(1.0,), forces_n=(70.0, 20.0), stiffness_factors=(50.0, 1.0, 0.3))
    found = measured(trial(mass=0.2), sweep, own, "mujoco")
    assert found.stiffness.levels.tolist() == [3e4] and found.force.levels.tolist() == [20.0]
    bare = measured(trial(mass=0.2), sweep, SlipPhysics(pads=None), "mujoco")
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
