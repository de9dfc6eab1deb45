"""Whether grasps are reached, why not, and what the arm does over time."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.records.grasps import PHASES
from realsim.robots.arm import find_arm
from realsim.robots.hand import find_hand
from realsim_sim_bridge.arm.grasping_arm import GraspingArm
from realsim_sim_bridge.arm.obstacles import obstacles_of
from realsim_sim_bridge.arm.reach import (
    ReachConfig,
    ReachTask,
    base_on_table,
    check_reach,
    home_joints,
)
from realsim_sim_bridge.arm.reach_config import ChosenArm, chosen_arm
from realsim_sim_bridge.arm.straight_moves import first_touched, touched_when_lifted
from realsim_sim_bridge.arm.timing import TimingConfig
from realsim_sim_bridge.grasping.candidates import Surroundings
from realsim_sim_bridge.grasping.hand_free import first_point_inside
from realsim_sim_bridge.slip.motion import SlipMotion, min_jerk, pendulum_angle
from refusals import refused

DOWN = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
OPENING, WIDTH = 0.06, 0.05
PANDA = GraspingArm(find_arm("panda"), find_hand())


def from_above(x, y, z, yaw=0.0):
    return se3.from_rt(se3.exp_so3([0, 0, yaw]) @ DOWN, [x, y, z])


def some_grasps():
    places = product((-0.1, 0.05), (-0.1, 0.1), [0.05], (0.0, 1.9))
    return np.stack([from_above(*place) for place in places])


@pytest.fixture(scope="module")
def some_reached():
    return reach_of(some_grasps())


def attempts(reach):
    """Yield the row, phases, times and joints of every attempt."""
    paths = reach.trajectories
    for row in paths.rows.tolist():
        at = paths.attempt(row)
        yield row, paths.phase[at], paths.time_s[at], paths.joints_rad[at]


def box_points(low, high, instance, step=0.004):
    """Points on the six faces of a box."""
    axes = [np.arange(a, b + 1e-9, step) for a, b in zip(low, high, strict=True)]
    faces = []
    for k, side in product(range(3), (low, high)):
        rest = [*axes[:k], side[k : k + 1], *axes[k + 1 :]]
        faces.append(np.stack(np.meshgrid(*rest, indexing="ij"), -1).reshape(-1, 3))
    points = np.concatenate(faces)
    return Surroundings(points=points, instances=np.full(len(points), instance))


def reach_of(Ts, neighbours=None, config=None, obj=None, arm=PANDA, motion=None, seed=0):
    n = len(Ts)
    task = ReachTask(
        Ts_table_grasp=np.asarray(Ts), widths_m=np.full(n, WIDTH), openings_m=np.full(n, OPENING),
        obj=obj or Surroundings(), neighbours=neighbours or Surroundings(), middle_xy=(0.0, 0.0),
    )  # fmt: skip
    rng = np.random.default_rng(seed)
    return check_reach(task, config or ReachConfig(), arm, rng, motion)


# --- laws ---------------------------------------------------------------------------------------


def test_a_grasp_from_above_is_reached_at_its_pose():
    T = from_above(0.05, 0.02, 0.03)
    reach = reach_of([T])
    assert reach.reachable[0] and reach.reasons[0] == ""
    T_table_base = base_on_table((0.0, 0.0), ReachConfig(), PANDA)
    assert np.allclose(T_table_base @ PANDA.forward(reach.joints[0]), T, atol=1e-6)
    lifted = T_table_base @ PANDA.forward(reach.joints_lifted[0])
    assert np.allclose(lifted[:3, 3] - T[:3, 3], [0, 0, 0.2], atol=1e-6)


def test_grasps_do_not_depend_on_the_others():
    Ts = some_grasps()
    lid = box_points([-0.02, -0.02, 0.0], [0.02, 0.02, 0.18], 4)
    together, alone = reach_of(Ts, lid), [reach_of([T], lid) for T in Ts]
    assert np.array_equal(together.reachable, [r.reachable[0] for r in alone])
    assert together.reasons == tuple(r.reasons[0] for r in alone)


def test_a_lab_s_arm_beside_the_table_reaches_too():
    beside = ReachConfig(T_table_base=se3.from_translation([-0.5, 0.0, 0.0]))
    reach = reach_of(some_grasps(), config=beside)
    assert reach.reachable.mean() > 0.7
    T = se3.from_translation([-0.5, 0.0, 0.0]) @ PANDA.forward(reach.joints[reach.reachable])
    assert np.allclose(T, some_grasps()[reach.reachable], atol=1e-6)


@pytest.mark.parametrize(
    ("name", "hand"), [("ur5", "franka_hand"), ("iiwa14", "parallel"), ("xarm6", "franka_hand")]
)
def test_every_arm_reaches_from_where_it_hangs_and_does_the_stages(name, hand):
    arm, config = GraspingArm(find_arm(name), find_hand(hand)), ReachConfig(arm=chosen_arm(name))
    reach = reach_of(some_grasps(), config=config, arm=arm)
    assert reach.reachable.mean() >= 0.7
    T = base_on_table((0.0, 0.0), config, arm) @ arm.forward(reach.joints[reach.reachable])
    assert np.allclose(T, some_grasps()[reach.reachable], atol=1e-6)
    paths = reach.trajectories
    assert paths.joints_rad.shape[1] == arm.joints and arm.within_limits(paths.joints_rad).all()
    for row, phase, _, q in attempts(reach):
        if reach.stage_possible[row, 2]:
            moved = np.ptp(q[phase == PHASES.index("pendulum")], axis=0)
            assert moved[arm.swing_joint] > 0.5 and np.delete(moved, arm.swing_joint).max() == 0.0
    assert all(f"joint {arm.swing_joint + 1}" in n for n in reach.notes if n.startswith("pendulum"))


def test_an_arm_that_has_become_another_is_refused():
    other = ChosenArm(name="panda", digest="0" * 64)
    refused(r"'panda' .* is another than the one that was chosen", other.found)
    refused("no arm 'puma'", chosen_arm, "puma")


# --- reasons ------------------------------------------------------------------------------------


def test_reasons_are_given_in_words():
    far, into_table = from_above(2.0, 0.0, 0.03), from_above(0.0, 0.0, -0.01)
    reach = reach_of([far, into_table])
    assert not reach.reachable.any() and np.isnan(reach.joints).all()
    assert reach.reasons[0].startswith("no inverse kinematics at the grasp: the wrist would be")
    assert "its reach is 0.72 m" in reach.reasons[0]
    assert reach.reasons[1] == "the approach collides with the table"


def test_an_object_in_the_way_of_the_hand_is_named():
    lid = box_points([-0.05, -0.05, 0.16], [0.05, 0.05, 0.17], 7)
    reach = reach_of([from_above(0.0, 0.0, 0.03)], lid)
    assert reach.reasons[0] == "the approach collides with the object of instance 7"


def test_a_swept_hand_meets_what_a_thousand_poses_meet():
    rng, hand = np.random.default_rng(0), find_hand()
    n, k = 60, 1000
    Ts = np.stack([from_above(*rng.uniform(-0.1, 0.1, 3), rng.uniform(0, 3)) for _ in range(n)])
    Ts[:, :3, :3] = se3.exp_so3(rng.uniform(-1, 1, (n, 3))) @ Ts[:, :3, :3]
    moves = rng.uniform(-0.15, 0.15, (n, 3))
    boxes = hand.boxes(rng.uniform(0.01, 0.08, n))
    points = rng.uniform(-0.3, 0.3, (24, 3))
    obstacles = obstacles_of(points, np.arange(24), np.arange(24) < 10)
    for own_too in (True, False):
        found = first_touched(boxes, Ts, moves, obstacles, 0.001, own_too=own_too)
        left = points if own_too else points[10:]
        dense = np.zeros(n, dtype=bool)
        for s in np.linspace(0, 1, k):
            moved = Ts.copy()
            moved[:, :3, 3] += s * moves
            dense |= first_point_inside(boxes, moved, left, 0.001) >= 0
        assert 5 < dense.sum() < n - 5
        assert np.array_equal(found >= 0, dense)


def test_a_home_that_is_blocked_is_said():
    block = box_points([-0.05, -0.05, 0.2], [0.05, 0.05, 0.4], 9, step=0.01)
    reach = reach_of([from_above(0.12, 0.16, 0.03)], block)
    assert reach.reasons[0].startswith("no path from home: the arm at home collides with")
    assert reach.reasons[0].endswith("instance 9")


def test_a_base_from_which_home_cannot_be_reached_is_refused():
    high = ReachConfig(base_height_m=3.0)
    refused(r"wrist would be .* from the shoulder", home_joints, high, PANDA)
    refused(r"rigid|transform", ReachConfig, T_table_base=np.eye(3))
    far = ReachConfig(T_table_base=se3.from_translation([-3.0, 0.0, 0.0]))
    refused("another base", reach_of, [from_above(0.0, 0.0, 0.05)], config=far)


def test_contradictions_are_refused():
    refused("lift", reach_of, [from_above(0.0, 0.0, 0.05)], motion=SlipMotion(lift_height_m=0.1))


# --- the lifted object --------------------------------------------------------------------------


SMALL_BOX = box_points([-0.03, -0.03, 0.0], [0.03, 0.03, 0.05], 1)


def lifted(neighbour, obj=SMALL_BOX):
    return touched_when_lifted(obj, neighbour, 0.2, 0.004)


def test_what_hangs_over_the_object_stops_its_lift():
    assert lifted(box_points([0.02, -0.1, 0.1], [0.2, 0.1, 0.12], 6)) == 6
    assert lifted(box_points([0.02, -0.1, 0.3], [0.2, 0.1, 0.32], 6)) is None
    assert lifted(box_points([0.05, -0.1, 0.1], [0.2, 0.1, 0.12], 6)) is None
    reach = reach_of(
        [from_above(0.0, 0.0, 0.03)],
        box_points([0.027, -0.01, 0.13], [0.032, 0.01, 0.135], 6, step=0.002),
        obj=box_points([-0.03, -0.02, 0.0], [0.03, 0.02, 0.035], 1),
    )
    assert not reach.reachable[0] and reach.reasons[0].endswith("instance 6")


def test_an_object_slides_up_along_a_neighbour_that_it_touches():
    for gap in (0.0, 0.001, 0.003, 0.006):
        beside = box_points([0.03 + gap, -0.05, 0.0], [0.09, 0.05, 0.12], 3)
        assert lifted(beside) is None
    turned = se3.from_rt(se3.exp_so3([0, 0, 0.6]), np.zeros(3))
    beside = box_points([0.031, -0.05, 0.0], [0.09, 0.05, 0.12], 3)
    obj, beside = (replace(b, points=se3.transform(turned, b.points)) for b in (SMALL_BOX, beside))
    assert lifted(beside, obj) is None


# --- over time ----------------------------------------------------------------------------------


def test_an_attempt_has_its_phases_in_order_and_ends_where_it_was_lifted(some_reached):
    reach, paths = some_reached, some_reached.trajectories
    assert np.array_equal(paths.rows, np.nonzero(reach.reachable)[0])
    home = home_joints(ReachConfig(), PANDA)
    for row, phase, t, q in attempts(reach):
        assert np.all(np.diff(phase) >= 0) and np.all(np.diff(t) > 0)
        missing = {"oscillate"} if "oscillate: the motion" in reach.notes[row] else set()
        assert {PHASES[p] for p in phase} == set(PHASES) - missing
        assert reach.stage_possible[row].shape == (3,)
        assert np.allclose(q[0], home) and np.array_equal(q[-1], reach.joints_lifted[row])
        closed = q[phase == PHASES.index("close")]
        assert np.allclose(closed, reach.joints[row], atol=1e-12)
        openings = paths.opening_m[paths.attempt(row)]
        assert openings[0] == OPENING and openings[-1] == WIDTH
        assert np.diff(openings).min() >= -2 * 0.1 / 50 - 1e-12 and np.diff(openings).max() <= 0


def test_limits_hold_at_all_samples():
    timing = TimingConfig(sample_hz=100.0)
    reach = reach_of(some_grasps(), config=ReachConfig(timing=timing))
    velocity, acceleration = timing.limits(PANDA.limits)
    checked = 0
    for row, phase, t, q in attempts(reach):
        assert PANDA.within_limits(q).all()
        dt = np.diff(t)[:, None]
        speed = np.diff(q, axis=0) / dt
        going = phase[1:] <= PHASES.index("approach")
        assert np.all(np.abs(speed[going]) <= velocity * (1 + 1e-6))
        change = np.diff(speed, axis=0) / ((dt[1:] + dt[:-1]) / 2)
        assert np.all(np.abs(change[going[1:]]) <= acceleration * (1 + 1e-6))
        for stage, name in enumerate(("lift", "oscillate", "pendulum")):
            if reach.stage_possible[row, stage]:
                during = phase[:-1] == PHASES.index(name)
                assert np.all(np.abs(speed[during]) <= PANDA.limits.speed * (1 + 2e-3))
                checked += 1
    assert checked > 20


def test_the_stages_are_the_slip_test_s_motions(some_reached):
    reach, motion, rate, seen = some_reached, SlipMotion(), 50.0, 0
    T_table_base = base_on_table((0.0, 0.0), ReachConfig(), PANDA)
    for row, phase, t, q in attempts(reach):
        T = T_table_base @ PANDA.forward(q)

        def during(name, phase=phase, t=t):
            mine = np.nonzero(phase == PHASES.index(name))[0]
            return mine, t[mine] - t[mine[0]]

        mine, clock = during("approach")
        start, end = T[mine[0], :3, 3], T[phase == PHASES.index("close")][0]
        assert np.allclose(end[:3, 3] - start, 0.08 * end[:3, 2], atol=1e-6)
        off = np.cross(T[mine, :3, 3] - start, end[:3, 2])
        assert np.abs(off).max() < 1e-4
        mine, clock = during("lift")
        wanted = min_jerk(motion.lift_height_m, motion.lift_s, clock)[0]
        assert np.allclose(T[mine, :3, 3] - end[:3, 3], np.outer(wanted, [0, 0, 1]), atol=1e-4)
        top = end[:3, 3] + [0.0, 0.0, motion.lift_height_m]
        if reach.stage_possible[row, 1]:
            mine, clock = during("oscillate")
            half = motion.oscillation_cycles / motion.oscillation_hz
            wave = motion.oscillation_m * (1 - np.cos(2 * np.pi * motion.oscillation_hz * clock))
            wanted = np.where((clock < half)[:, None], [1, 0, 0], [0, 1, 0]) * wave[:, None]
            assert np.allclose(T[mine, :3, 3] - top, wanted, atol=1e-4)
            seen += 1
        mine, clock = during("pendulum")
        mine = mine[: round(motion.pendulum_s * rate)]
        lift = reach.joints_lifted[row]
        low = max(PANDA.limits.lower[4] - lift[4], -np.radians(60))
        high = min(PANDA.limits.upper[4] - lift[4], np.radians(60))
        swing = pendulum_angle(motion, 1 / rate, low, high)[0]
        assert np.allclose(q[mine, 4] - lift[4], swing, atol=1e-12)
        assert np.array_equal(np.delete(q[mine], 4, axis=1), np.tile(np.delete(lift, 4), (160, 1)))
    assert seen > 3
