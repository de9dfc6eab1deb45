"""The Panda: kinematics, limits, and whether grasps are reached."""

from itertools import pairwise

import numpy as np
import pytest

from realsim.geometry import se3
from realsim_sim_bridge.arm import panda
from realsim_sim_bridge.grasping.candidates import Surroundings
from realsim_sim_bridge.grasping.hand import HandGeometry
from realsim_sim_bridge.arm.joint_path import PlannerConfig, connect, straight
from realsim_sim_bridge.arm.reach import ReachConfig, ReachTask, base_on_table, check_reach

DOWN = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
READY = np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4])


def random_joints(n, seed=0):
    return np.random.default_rng(seed).uniform(panda.LOWER, panda.UPPER, (n, 7))


def test_the_ready_pose_is_franka_s():
    # Franka's documentation: O_T_EE without a hand is (0.3069, 0, 0.5903), pointing down.
    T = panda.forward(READY)
    assert np.allclose(T[:3, 3], [0.3069, 0.0, 0.5903 - panda.TCP_M], atol=1e-4)
    assert np.allclose(T[:3, :3], np.diag([1.0, -1.0, -1.0]), atol=1e-12)


def test_the_limits_are_the_robot_s_and_not_pybullet_s():
    assert panda.UPPER[0] == 2.8973 and panda.LOWER[3] == -3.0718 and panda.UPPER[5] == 3.7525


def test_inverse_solutions_reach_the_pose_within_the_limits():
    found = 0
    for T in panda.forward(random_joints(20)):
        q = panda.inverse(T, samples=16, margin=0.01)
        found += len(q) > 0
        if len(q):
            assert np.allclose(panda.forward(q), T, atol=1e-9)
            assert panda.within_limits(q, 0.01).all()
    assert found >= 18


def test_the_jacobian_is_the_derivative():
    q, h = random_joints(1)[0], 1e-6
    frames = panda.link_frames(q)
    J = panda.jacobian(frames)
    for i in range(7):
        T = panda.forward(q + h * np.eye(7)[i])
        turn = se3.log_so3(T[:3, :3] @ frames[-1, :3, :3].T) / h
        assert np.allclose(J[:, i], [*turn, *((T[:3, 3] - frames[-1, :3, 3]) / h)], atol=1e-5)


def test_joint_5_s_axis_in_the_grasp_frame_stays_when_joint_5_turns():
    q = random_joints(5)
    axis, point = panda.joint5_in_grasp(q)
    T = panda.forward(q)
    turned = panda.forward(q + 0.3 * np.eye(7)[4])
    world_axis, world_point = T[:, :3, :3] @ axis[..., None], se3.transform(T, point[:, None])
    assert np.allclose(turned[:, :3, :3] @ axis[..., None], world_axis, atol=1e-12)
    assert np.allclose(se3.transform(turned, point[:, None]), world_point, atol=1e-12)


def test_spheres_contain_their_capsules():
    spheres = panda.spheres_of(panda.ARM_CAPSULES)
    rng = np.random.default_rng(0)
    for c in panda.ARM_CAPSULES:
        axis = rng.random((300, 1)) * (np.array(c.end) - c.start) + c.start
        on = rng.normal(size=(300, 3))
        points = axis + c.radius_m * on / np.linalg.norm(on, axis=1, keepdims=True)
        mine = spheres.links == c.link
        gap = np.linalg.norm(points[:, None] - spheres.centers[mine], axis=2) - spheres.radii[mine]
        assert gap.min(axis=1).max() < 1e-9


def reach_of(Ts, neighbours=None, config=None):
    n = len(Ts)
    task = ReachTask(
        Ts_table_grasp=np.asarray(Ts),
        widths_m=np.full(n, 0.05),
        openings_m=np.full(n, 0.06),
        obj=Surroundings(),
        neighbours=neighbours or Surroundings(),
        middle_xy=(0.0, 0.0),
    )
    return check_reach(task, config or ReachConfig(), HandGeometry(), np.random.default_rng(0))


def test_a_grasp_from_above_is_reached_at_its_pose():
    T = se3.from_rt(DOWN, [0.05, 0.02, 0.03])
    reach = reach_of([T])
    assert reach.reachable[0] and reach.reasons[0] == ""
    T_table_base = base_on_table((0.0, 0.0), ReachConfig())
    assert np.allclose(T_table_base @ panda.forward(reach.joints[0]), T, atol=1e-6)
    lifted = T_table_base @ panda.forward(reach.joints_lifted[0])
    assert np.allclose(lifted[:3, 3] - T[:3, 3], [0, 0, 0.2], atol=1e-6)


def test_reasons_are_given_in_words():
    far = se3.from_rt(DOWN, [2.0, 0.0, 0.03])
    into_table = se3.from_rt(DOWN, [0.0, 0.0, -0.01])
    reach = reach_of([far, into_table])
    assert not reach.reachable.any()
    assert reach.reasons[0] == "no inverse kinematics at the grasp"
    assert "collides with the table" in reach.reasons[1]


def test_an_object_in_the_way_of_the_hand_is_named():
    T = se3.from_rt(DOWN, [0.0, 0.0, 0.03])
    grid = np.linspace(-0.05, 0.05, 30)
    lid = np.stack([*np.meshgrid(grid, grid), np.full((30, 30), 0.16)], -1).reshape(-1, 3)
    neighbours = Surroundings(points=lid, instances=np.full(len(lid), 7))
    reach = reach_of([T], neighbours)
    assert not reach.reachable[0]
    assert reach.reasons[0].endswith("collides with the object of instance 7")


def test_the_planner_goes_round_what_blocks_the_straight_move():
    start, goal = READY.copy(), READY.copy()
    start[0], goal[0] = -1.0, 1.0

    def is_free(q):
        return ~((np.abs(q[:, 0]) < 0.2) & (q[:, 1] < 0.3))

    config = PlannerConfig(iterations=300)
    path = connect(start, goal, is_free, config, np.random.default_rng(3))
    again = connect(start, goal, is_free, config, np.random.default_rng(3))
    assert path is not None and again is not None and np.array_equal(path, again)
    assert np.array_equal(path[0], start) and np.array_equal(path[-1], goal)
    for a, b in pairwise(path):
        assert is_free(straight(a, b, config.resolution_rad)).all()
    assert not is_free(straight(start, goal, config.resolution_rad)).all()


def test_the_planner_gives_up_on_a_closed_wall():
    goal = READY + np.array([2.0, 0, 0, 0, 0, 0, 0])

    def is_free(q):
        return np.abs(q[:, 0] - 1.0) > 0.2

    config = PlannerConfig(iterations=20)
    assert connect(READY, goal, is_free, config, np.random.default_rng(0)) is None


@pytest.mark.parametrize("x", [-0.15, 0.0, 0.15])
def test_the_perfect_reach_covers_the_table(x):
    Ts = [
        se3.from_rt(se3.exp_so3([0, 0, yaw]) @ DOWN, [x, y, 0.05])
        for y in (-0.15, 0.0, 0.15)
        for yaw in np.linspace(0, np.pi, 4, endpoint=False)
    ]
    assert reach_of(Ts).reachable.mean() > 0.9
