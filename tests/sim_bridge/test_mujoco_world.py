"""MuJoCo holds what Coulomb's law holds, drops what it drops, and repeats itself to the bit."""

from dataclasses import replace

import numpy as np
import pytest

from held_boxes import DOWN, SIDE, held_box
from realsim.geometry import se3
from realsim.robots.hand import find_hand
from realsim_sim_bridge.slip.engines import MujocoSettings
from realsim_sim_bridge.slip.motion import SlipMotion, lift_acceleration, oscillation_acceleration
from realsim_sim_bridge.slip.mujoco_world import MujocoEngine
from realsim_sim_bridge.slip.world import Closing, Grips, Meeting, SlipPhysics
from refusals import refused

CENTRED = np.eye(4)[None]
CUBE = held_box(0.125)
GRAVITY = np.array([0.0, 0.0, -9.81])
ENGINE = MujocoEngine(MujocoSettings())


def grips(Ts_obj_grasp=CENTRED, R=DOWN, opening=SIDE + 0.008):
    """Grips by hands of rotation R; the cube is seen turned so that its faces meet the fingers."""
    n = len(Ts_obj_grasp)
    Ts = se3.from_rt(np.broadcast_to(R, (n, 3, 3)), np.zeros((n, 3)))
    return Grips(Ts_table_grasp=Ts, Ts_obj_grasp=Ts_obj_grasp, openings_m=np.full(n, opening))


def scattered(n, seed=0):
    """Return n grasps of the cube beside its middle and a little turned about x and z."""
    rng = np.random.default_rng(seed)
    turns = rng.uniform(-0.1, 0.1, (n, 3)) * [1, 0, 1]
    return se3.from_rt(se3.exp_so3(turns), rng.uniform(-0.01, 0.01, (n, 3)) * [1, 0.2, 1])


def world(body=CUBE, given=None, physics=None, engine=ENGINE):
    return engine.world(Meeting(body, physics or SlipPhysics(), find_hand()), given or grips())


def constant(force, steps, n=1):
    """Return wrenches (n, steps, 6) of a force that grows within 100 steps."""
    wrenches = np.zeros((n, steps, 6))
    rise = np.minimum(1.0, np.arange(steps) / 100)
    wrenches[:, :, 3:] = rise[:, None] * np.asarray(force)
    return wrenches


def slip_mm(hands, wrenches, sample=25, lost_m=0.05):
    """Return how far each object of the closed hands went (K, S) [mm]."""
    start = hands.states().Ts_world_body[:, None, :3, 3]
    seen = hands.play(wrenches, sample, lost_m).Ts_world_body[:, :, :3, 3]
    return 1e3 * np.linalg.norm(seen - start, axis=-1)


def same(a, b):
    """Return whether two states or motions are equal to the bit."""
    return all(
        np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True) for name in a.__slots__
    )


# --- laws -----------------------------------------------------------------------------------------


def test_results_repeat_to_the_bit_and_do_not_depend_on_the_company():
    given = grips(scattered(48))
    loads = constant([0.0, 0.0, -90.0], 150, n=48)  # some slide, some are lost
    together = []
    for _ in range(2):
        with world(given=given) as hands:
            together.append((hands.close(Closing()), hands.play(loads, 10, 0.01), hands.states()))
    assert all(same(a, b) for a, b in zip(*together, strict=True))
    closed, played, states = together[0]
    for row in (0, 17, 47):
        with world(given=given.rows(np.array([row]))) as hands:
            alone = hands.close(Closing())
            ended = closed.Ts_world_body[row, -1]
            assert np.array_equal(alone.Ts_world_body[0, -1], ended)
            assert np.array_equal(alone.finger_n[0, -1], closed.finger_n[row, -1])
            seen = hands.play(loads[:1], 10, 0.01)
            assert np.array_equal(seen.finger_n[0], played.finger_n[row], equal_nan=True)
            assert same(hands.states(), states.rows(np.array([row])))


def test_states_carry_over_into_another_world():
    given, loads = grips(scattered(3)), constant([0.0, 0.0, -60.0], 100, n=3)
    with world(given=given) as hands, world(given=given) as other, world(given=given) as third:
        hands.close(Closing())
        states = hands.states()
        other.put(states)
        third.put(states)
        back = other.states()
        for name in states.__slots__:
            assert np.allclose(getattr(back, name), getattr(states, name), rtol=0, atol=1e-12)
        a, b, c = (w.play(loads, 20, 0.05) for w in (hands, other, third))
        assert same(b, c)
        assert np.allclose(a.Ts_world_body, b.Ts_world_body, rtol=0, atol=1e-4)
        # What the solver starts from is not part of the state: 22 to 94 mN of 68 N, by processor.
        assert np.allclose(a.finger_n, b.finger_n, rtol=3e-3, atol=0)


def test_a_free_object_moves_as_its_twist_and_its_wrench_say():
    mass, steps = 0.3, 10
    R = se3.exp_so3([0.3, -1.1, 0.7])
    aside = se3.from_translation([0.0, 0.0, 0.3])[None]  # no finger touches the object
    twist = np.array([1.0, -2.0, 3.0, 0.2, 0.5, -0.4])
    wrench = np.array([2e-4, 1e-4, -3e-4, 0.3, -0.6, 0.9])
    with world(held_box(mass), grips(aside, R)) as hands:
        start = hands.states()
        moving = replace(start, twists=twist[None])
        hands.put(moving)
        assert np.allclose(hands.states().twists, twist, rtol=0, atol=1e-12)
        hands.play(np.broadcast_to(wrench, (1, steps, 6)), steps, 1.0)
        end = hands.states()
    t = steps * hands.dt
    inertia = mass * SIDE**2 / 6  # a cube's is the same about all axes
    speeds = twist + wrench / np.repeat([inertia, mass], 3) * t
    assert np.allclose(end.twists[0], speeds, rtol=0, atol=1e-9)
    way = end.Ts_world_body[0, :3, 3] - start.Ts_world_body[0, :3, 3]
    assert np.allclose(way, 0.5 * (twist[3:] + speeds[3:]) * t, rtol=0, atol=1e-4)
    turn = end.Ts_world_body[0, :3, :3] @ start.Ts_world_body[0, :3, :3].T
    assert np.allclose(se3.log_so3(turn), 0.5 * (twist[:3] + speeds[:3]) * t, rtol=0, atol=2e-3)


def test_turning_hand_and_load_together_changes_nothing_in_the_hand():
    force = np.array([4.0, 5.0, -13.0])
    found = []
    for R in (np.eye(3), DOWN, se3.exp_so3([0.3, -1.1, 0.7])):
        with world(given=grips(R=R), physics=SlipPhysics(force_n=20.0, friction=0.25)) as hands:
            hands.close(Closing())
            seen = hands.play(constant(R @ force, 100), 20, 0.05)
        in_hand = R.T @ seen.Ts_world_body[0, :, :3, :]
        found.append(np.concatenate([in_hand.ravel(), 1e-3 * seen.finger_n.ravel()]))
    assert np.allclose(found[0], found[1], atol=1e-6) and np.allclose(found[0], found[2], atol=1e-6)
    assert np.ptp(found[0].reshape(-1)) > 0


@pytest.mark.parametrize("force_n", [2.0, 70.0])
def test_each_finger_presses_with_the_hand_s_force_and_carries_the_load_across(force_n):
    across = 0.5 * force_n
    with world(given=grips(R=np.eye(3)), physics=SlipPhysics(force_n=force_n)) as hands:
        closed = hands.close(Closing())
        assert np.allclose(closed.finger_n[0, -1], force_n, rtol=0.01)
        held = hands.play(np.zeros((1, 200, 6)), 50, 0.05)
        assert np.allclose(held.finger_n, force_n, rtol=0.01)
        assert np.allclose(held.times_s, [0.1, 0.2, 0.3, 0.4])
        pushed = hands.play(constant([0.0, across, 0.0], 300), 300, 0.05).finger_n[0, -1]
    # The coupled fingers press with 2 F together; their difference carries the load (Newton).
    assert pushed[0] - pushed[1] == pytest.approx(across, rel=0.01)
    assert pushed.sum() == pytest.approx(2 * force_n, rel=0.01)


# --- Coulomb --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("mass", "settings"), [
    (0.013, MujocoSettings()), (0.125, MujocoSettings.reference()),
])  # fmt: skip
def test_a_box_sticks_through_lift_and_oscillation(mass, settings):
    motion, engine = SlipMotion(), MujocoEngine(settings)
    with world(held_box(mass), engine=engine) as hands:
        hands.close(Closing())
        for a in (lift_acceleration(motion, hands.dt), oscillation_acceleration(motion, hands.dt)):
            wrenches = np.zeros((1, len(a), 6))
            wrenches[:, :, 3:] = mass * (GRAVITY - a)
            before = hands.states().Ts_world_body
            assert slip_mm(hands, wrenches).max() < 0.02
            turn = np.swapaxes(before[0, :3, :3], 0, 1) @ hands.states().Ts_world_body[0, :3, :3]
            assert np.degrees(se3.angle(turn)) < 0.05


def test_a_load_beyond_the_capacity_is_lost_although_light_objects_are_simulated_heavier():
    mass, force_n = 0.013, 1.0
    weight = constant(mass * GRAVITY, 600)
    with world(held_box(mass), physics=SlipPhysics(force_n=force_n, friction=0.05)) as hands:
        assert hands.settings()["object_mass_kg"] == pytest.approx(0.2)
        hands.close(Closing())
        assert not slip_mm(hands, weight)[0, -1] < 10.0
    with world(held_box(mass), physics=SlipPhysics(force_n=4 * force_n, friction=0.05)) as hands:
        hands.close(Closing())
        assert slip_mm(hands, weight).max() < 0.05


# --- closing, losing, removing --------------------------------------------------------------------


def test_a_lost_pair_stops_and_a_removed_one_is_nan_and_neither_disturbs_the_others():
    n = 3
    with world(given=grips(np.repeat(CENTRED, n, axis=0))) as hands:
        hands.close(Closing())
        hands.remove(np.array([False, True, False]))
        loads = constant([0.0, 0.0, -1.0], 600, n=n)
        loads[2] *= 500.0
        loads[1] = np.nan  # nobody looks
        seen = hands.play(loads, 20, 0.05)
        assert np.isfinite(seen.Ts_world_body[0]).all() and np.isnan(seen.finger_n[1]).all()
        assert np.isfinite(seen.Ts_world_body[2, 0]).all()
        assert np.isnan(seen.Ts_world_body[2, -1, :3]).all()
        states = hands.states()
        assert np.isnan(states.Ts_world_body[1, :3]).all() and hands.alive.tolist() == [1, 0, 1]
        hands.put(states)  # NaN rows stay as they are
        assert hands.alive.tolist() == [1, 0, 1]


# --- settings, models, bad input ------------------------------------------------------------------


def test_bad_input_is_refused_in_words():
    flat = replace(CUBE, parts=(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]]),))
    refused("plane", world, flat)
    with world() as hands:
        refused(r"0\.001 m/s", hands.close, Closing(speed=0.001))
        refused(r"\(1, 5, 3\)", hands.play, np.zeros((1, 5, 3)), 1, 0.05)
        refused("pair 0", hands.play, np.full((1, 5, 6), np.nan), 1, 0.05)
