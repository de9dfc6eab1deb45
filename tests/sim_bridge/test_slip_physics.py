"""The slip test's physics: a box that must be held, Coulomb's limit, and the engine's traps."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from realsim.geometry import se3
from realsim_sim_bridge.grasping.hand import HandGeometry
from realsim_sim_bridge.slip.motion import (
    SlipMotion,
    inertial_wrench,
    lift_acceleration,
    oscillation_acceleration,
    pendulum_angle,
    pendulum_load,
)
from realsim_sim_bridge.slip.score import ScoreLimits, score_stages
from realsim_sim_bridge.slip.slip_test import SlipConfig, SlipTrial, batches, run_slip_test
from realsim_sim_bridge.slip.slip_world import SlipBody, SlipPhysics, SlipWorld

DOWN = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
SIDE = 0.05


def cube(mass=0.125):
    corners = np.array(list(product((-SIDE / 2, SIDE / 2), repeat=3)))
    inertia = np.eye(3) * mass * SIDE**2 / 6
    return SlipBody(parts=(corners,), mass_kg=mass, center_of_mass=np.zeros(3), inertia=inertia)


def trial(n=1, mass=0.125, R=DOWN):
    Ts = np.repeat(se3.from_rt(R, np.zeros(3))[None], n, axis=0)
    return SlipTrial(
        body=cube(mass),
        Ts_obj_grasp=Ts,
        Ts_table_grasp=Ts,
        openings_m=np.full(n, SIDE + 0.008),
        joint5_axes=np.tile([0.0, 1.0, 0.0], (n, 1)),
        joint5_points=np.tile([-0.088, 0.0, -0.21], (n, 1)),
        joint5_ranges=np.tile([-2.0, 2.0], (n, 1)),
    )


def run(physics=None, **kwargs):
    return run_slip_test(trial(**kwargs), SlipConfig(physics=physics or SlipPhysics()))


def score(slips):
    tried = np.ones(len(slips.failures), dtype=bool)
    return score_stages(slips.slip_m, slips.slip_rad, tried, ScoreLimits())[1]


def test_the_box_is_held_through_all_stages_without_slip():
    slips = run()
    assert slips.failures == ("",) and score(slips)[0] == 1.0
    assert slips.slip_m.max() < 1e-3 and np.degrees(slips.slip_rad.max()) < 1.0


def test_a_bare_default_world_drops_the_same_box():
    default = SlipPhysics(pads=None, iterations=50, mass_floor_kg=0.0)
    patient = ScoreLimits(slip_m=0.04, slip_deg=360.0)
    config = SlipConfig(physics=default)
    assert score(run_slip_test(trial(), config))[0] < 0.5
    # Even if turning and slipping are let pass, the box falls out before the end.
    slips = run_slip_test(trial(), config, patient)
    assert np.isinf(slips.slip_m).any() and "lost" in slips.failures[0]


def test_too_weak_a_squeeze_fails_in_the_lift_and_70_newton_hold():
    weak = run(SlipPhysics(friction=0.05, force_n=5.0))  # carries 0.5 N of 1.23 N
    assert weak.failures[0].startswith("lift") and score(weak)[0] < 0.25
    strong = run(SlipPhysics(friction=0.05))  # carries 7 N
    assert score(strong)[0] == 1.0 and strong.slip_m.max() < 1e-3


def hold(load_share, force_n, friction, direction):
    """Return how far a cube moves in 0.5 s under a share of Coulomb's limit 2 mu F."""
    physics = SlipPhysics(force_n=force_n, friction=friction)
    mass = 0.3
    t = trial(mass=mass)
    with SlipWorld(
        t.body, t.Ts_table_grasp, t.Ts_obj_grasp, t.openings_m, physics, HandGeometry()
    ) as world:
        world.set_acceleration(np.zeros(3))
        world.close_fingers(0.1)
        for _ in range(120):
            world.step()
        assert np.allclose(world.finger_forces(), force_n, rtol=0.02)
        start = world.Ts_world_body()
        load = load_share * 2 * friction * force_n / mass * np.asarray(direction)
        for i in range(150):
            world.set_acceleration(load * min(1.0, i / 30))  # a ramp: a step would overshoot
            world.step()
        now = world.Ts_world_body()
    return float(np.linalg.norm(now[0, :3, 3] - start[0, :3, 3]))


@pytest.mark.parametrize(("force_n", "friction"), [(2.0, 0.25), (20.0, 0.25), (70.0, 1.0)])
@pytest.mark.parametrize("direction", [(0, 0, -1), (1, 0, 0), (0.7071, 0, -0.7071)])
def test_coulomb_s_limit_along_the_pad(force_n, friction, direction):
    assert hold(0.9, force_n, friction, direction) < 1e-3
    assert hold(1.1, force_n, friction, direction) > 2e-3


def test_the_limit_is_met_within_three_percent():
    assert hold(0.97, 20.0, 0.25, (0, 0, -1)) < 1e-3
    assert hold(1.03, 20.0, 0.25, (0, 0, -1)) > 1e-3


def test_light_objects_are_held_and_carry_their_true_weight():
    assert run(mass=0.013).slip_m.max() < 1e-3
    # 2 * 0.05 * 1 N = 0.1 N carries 13 g x 9.81 = 0.128 N no more, although the engine's mass is
    # raised 15 times.
    assert run(SlipPhysics(friction=0.05, force_n=1.0), mass=0.013).failures[0] != ""
    assert run(SlipPhysics(friction=0.05, force_n=4.0), mass=0.013).failures[0] == ""


def test_results_are_repeatable_to_the_bit_and_alike_among_pairs():
    a, b = run(n=3), run(n=3)
    assert np.array_equal(a.slip_m, b.slip_m) and np.array_equal(a.slip_rad, b.slip_rad)
    assert np.ptp(a.slip_m, axis=0).max() < 5e-5


def test_a_hand_that_closes_on_nothing_fails_in_the_first_stage():
    beside = trial()
    beside = replace(beside, Ts_obj_grasp=se3.from_rt(DOWN, [0.0, 0.0, 0.2])[None])
    slips = run_slip_test(beside)
    assert slips.failures[0] == "close: the fingers did not both touch the object"
    assert np.isinf(slips.slip_m[0, 0]) and np.isnan(slips.slip_m[0, 1:]).all()


def test_no_grasps_give_no_slips():
    assert run_slip_test(trial(0)).slip_m.shape == (0, 4)
    assert batches(5, 2) == [slice(0, 2), slice(2, 4), slice(4, 5)]


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
    force, _ = inertial_wrench(pendulum_load(angle, axis, 9.81), arm, mass, np.eye(3))
    R = se3.exp_so3(angle[0][:, None] * axis)
    path = R @ arm
    acceleration = np.gradient(np.gradient(path, dt, axis=0), dt, axis=0)
    expected = mass * (np.array([0, 0, -9.81]) - acceleration)
    expected = (np.swapaxes(R, -1, -2) @ expected[..., None])[..., 0]
    middle = slice(10, len(path) // 8)
    assert np.allclose(force[middle], expected[middle], atol=2e-2)
