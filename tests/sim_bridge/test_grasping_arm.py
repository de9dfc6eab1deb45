"""An arm with a hand: kinematics both ways, how far it reaches, and its URDF."""

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.robots.arm import find_arm
from realsim.robots.compiled_chain import follow_lines
from realsim.robots.hand import find_hand
from realsim_sim_bridge.arm.grasping_arm import GraspingArm
from realsim_sim_bridge.slip.bullet_shapes import hand_urdf
from realsim_sim_bridge.slip.world import PadModel
from realsim_sim_bridge.validation.arm_urdf import PANDA_LINKS, arm_urdf

HAND = find_hand()
PANDA = GraspingArm(find_arm("panda"), HAND)
READY = PANDA.arm.home
ARMS = ("panda", "ur5", "iiwa14", "xarm6")


def random_joints(n, seed=0, arm=PANDA):
    low, high = np.maximum(arm.limits.lower, -np.pi), np.minimum(arm.limits.upper, np.pi)
    return np.random.default_rng(seed).uniform(low, high, (n, arm.joints))


def test_the_ready_pose_is_franka_s():
    # Franka's documentation: O_T_EE without a hand is (0.3069, 0, 0.5903), pointing down.
    T = PANDA.forward(READY)
    assert np.allclose(T[:3, 3], [0.3069, 0.0, 0.5903 + HAND.mount_z_m], atol=1e-4)
    assert np.allclose(T[:3, :3], np.diag([1.0, -1.0, -1.0]), atol=1e-12)


@pytest.mark.parametrize("name", ARMS)
def test_inverse_solutions_reach_the_pose_within_the_limits(name):
    arm = GraspingArm(find_arm(name), HAND)
    Ts = arm.forward(random_joints(20, arm=arm))
    owner, q = arm.inverse(Ts, 16, 0.01, arm.arm.home)
    assert np.all(np.diff(owner) >= 0) and len(set(owner.tolist())) >= 17
    assert np.allclose(arm.forward(q), Ts[owner], atol=1e-9)
    assert arm.within_limits(q, 0.01).all()


@pytest.mark.parametrize("name", ARMS)
def test_the_swinging_joint_s_axis_in_the_grasp_frame_stays_when_it_turns(name):
    arm = GraspingArm(find_arm(name), HAND)
    q, j = random_joints(5, arm=arm), arm.swing_joint
    axis, point, left = arm.swing_in_grasp(q)
    T, turned = arm.forward(q), arm.forward(q + 0.3 * np.eye(arm.joints)[j])
    world_axis, world_point = T[:, :3, :3] @ axis[..., None], se3.transform(T, point[:, None])
    assert np.allclose(turned[:, :3, :3] @ axis[..., None], world_axis, atol=1e-12)
    assert np.allclose(se3.transform(turned, point[:, None]), world_point, atol=1e-12)
    assert np.allclose(q[:, j, None] + left, [arm.limits.lower[j], arm.limits.upper[j]])


@pytest.mark.parametrize("name", ARMS)
def test_the_wrist_s_distance_is_within_its_bounds_wherever_the_arm_is(name):
    arm = GraspingArm(find_arm(name), HAND)
    q = random_joints(3000, seed=1, arm=arm)
    least = arm.wrist_distance(arm.forward(q))
    assert np.all(least <= arm.wrist_reach_m + 1e-9) and least.max() > 0.95 * arm.wrist_reach_m
    if name == "panda":  # whose wrist is frame 6's origin, its shoulder frame 2's
        assert arm.wrist_reach_m == pytest.approx(np.hypot(0.316, 0.0825) + np.hypot(0.384, 0.0825))
        frames = arm.frames(q)
        true = np.linalg.norm(frames[:, 5, :3, 3] - frames[:, 1, :3, 3], axis=1)
        assert np.all(true >= least - 1e-12) and np.min(true - least) < 1e-3


def test_followed_lines_are_straight_and_their_slopes_are_derivatives():
    q = PANDA.inverse(PANDA.forward(READY)[None], 12, 0.1, READY)[1][:6]
    Ts = PANDA.forward(q)
    along = np.tile([0.6, 0.0, -0.8], (len(q), 1))
    distances = np.linspace(0.0, 0.1, 6)
    joints, slopes, error = follow_lines(PANDA.numbers, q, Ts, along, distances)
    assert np.all(error < 1e-9) and np.array_equal(joints[:, 0], q)
    wanted = Ts[:, None, :3, 3] + distances[:, None] * along[:, None]
    assert np.allclose(PANDA.forward(joints)[..., :3, 3], wanted, atol=1e-9)
    assert np.allclose(PANDA.forward(joints)[..., :3, :3], Ts[:, None, :3, :3], atol=1e-9)
    h = 1e-6
    moved = (PANDA.forward(joints + h * slopes) - PANDA.forward(joints))[..., :3, 3] / h
    assert np.allclose(moved, along[:, None], atol=1e-4)


@pytest.mark.parametrize("name", ARMS)
def test_pybullet_has_the_same_forward_kinematics(tmp_path, name):
    import pybullet

    arm = GraspingArm(find_arm(name), HAND)
    path, n = tmp_path / "arm.urdf", arm.joints
    links = (PANDA_LINKS[1],) * (n + 1)
    path.write_text(arm_urdf(arm.arm, HAND, hand_urdf(HAND, PadModel()), links), encoding="utf-8")
    client = pybullet.connect(pybullet.DIRECT)
    try:
        body = pybullet.loadURDF(str(path), useFixedBase=True, physicsClientId=client)
        names = [
            pybullet.getJointInfo(body, i, physicsClientId=client)[12].decode()
            for i in range(pybullet.getNumJoints(body, physicsClientId=client))
        ]
        last = names.index("palm")
        for q in random_joints(20, arm=arm):
            for i in range(n):
                pybullet.resetJointState(body, i, q[i], physicsClientId=client)
            state = pybullet.getLinkState(
                body, last, computeForwardKinematics=True, physicsClientId=client
            )
            R = np.array(pybullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)
            T = se3.from_rt(R, state[4])
            # It reads a URDF's vectors as float32.
            assert np.allclose(T, arm.forward(q), rtol=0, atol=1e-6)
        for i in range(n):
            info = pybullet.getJointInfo(body, i, physicsClientId=client)
            limits = (arm.limits.lower[i], arm.limits.upper[i], arm.limits.speed[i])
            assert np.allclose((*info[8:10], info[11]), limits)
    finally:
        pybullet.disconnect(client)
