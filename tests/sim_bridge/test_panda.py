"""The Panda: kinematics, limits, and its URDF."""

import numpy as np

from realsim.geometry import se3
from realsim.robots.hand import find_hand
from realsim_sim_bridge.arm import panda
from realsim_sim_bridge.arm.chain import follow_lines, frames_into
from realsim_sim_bridge.arm.panda import panda_urdf
from realsim_sim_bridge.slip.bullet_shapes import hand_urdf
from realsim_sim_bridge.slip.world import PadModel

READY = np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4])


def random_joints(n, seed=0):
    return np.random.default_rng(seed).uniform(panda.LOWER, panda.UPPER, (n, 7))


def test_the_ready_pose_is_franka_s():
    # Franka's documentation: O_T_EE without a hand is (0.3069, 0, 0.5903), pointing down.
    T = panda.forward(READY)
    assert np.allclose(T[:3, 3], [0.3069, 0.0, 0.5903 - panda.TCP_M], atol=1e-4)
    assert np.allclose(T[:3, :3], np.diag([1.0, -1.0, -1.0]), atol=1e-12)


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


def test_the_compiled_chain_is_the_same_one():
    frames = np.empty((9, 3, 4))
    T_a_base = se3.from_rt(se3.exp_so3([0.3, -0.8, 0.2]), [0.1, 0.2, -0.3])
    for q in random_joints(20):
        frames_into(q, T_a_base, frames)
        assert np.allclose(frames, (T_a_base @ panda.link_frames(q))[:, :3], atol=1e-12)


def test_the_wrist_s_distance_is_a_lower_bound_that_configurations_attain():
    q = random_joints(300, seed=1)
    frames = panda.link_frames(q)
    true = np.linalg.norm(frames[:, 6, :3, 3] - frames[:, 2, :3, 3], axis=1)
    least = panda.wrist_distance(frames[:, -1])
    assert np.all(true >= least - 1e-12) and np.all(true <= panda.WRIST_REACH_M + 1e-12)
    assert np.min(true - least) < 1e-3


def test_followed_lines_are_straight_and_their_slopes_are_derivatives():
    q = panda.inverse(panda.forward(READY), 12, 0.1)[:6]
    Ts = panda.forward(q)
    along = np.tile([0.6, 0.0, -0.8], (len(q), 1))
    distances = np.linspace(0.0, 0.1, 6)
    joints, slopes, error = follow_lines(q, Ts, along, distances)
    assert np.all(error < 1e-9) and np.array_equal(joints[:, 0], q)
    wanted = Ts[:, None, :3, 3] + distances[:, None] * along[:, None]
    assert np.allclose(panda.forward(joints)[..., :3, 3], wanted, atol=1e-9)
    assert np.allclose(panda.forward(joints)[..., :3, :3], Ts[:, None, :3, :3], atol=1e-9)
    h = 1e-6
    moved = (panda.forward(joints + h * slopes) - panda.forward(joints))[..., :3, 3] / h
    assert np.allclose(moved, along[:, None], atol=1e-4)


def test_pybullet_has_the_same_forward_kinematics(tmp_path):
    import pybullet

    geometry = find_hand()
    path = tmp_path / "panda.urdf"
    path.write_text(panda_urdf(geometry, hand_urdf(geometry, PadModel())), encoding="utf-8")
    client = pybullet.connect(pybullet.DIRECT)
    try:
        arm = pybullet.loadURDF(str(path), useFixedBase=True, physicsClientId=client)
        names = [
            pybullet.getJointInfo(arm, i, physicsClientId=client)[12].decode()
            for i in range(pybullet.getNumJoints(arm, physicsClientId=client))
        ]
        last = names.index("palm")
        for q in random_joints(20):
            for i in range(7):
                pybullet.resetJointState(arm, i, q[i], physicsClientId=client)
            state = pybullet.getLinkState(
                arm, last, computeForwardKinematics=True, physicsClientId=client
            )
            R = np.array(pybullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)
            T = se3.from_rt(R, state[4])
            # It reads a URDF's vectors as float32.
            assert np.allclose(T, panda.forward(q), rtol=0, atol=5e-7)
        for i in range(7):
            info = pybullet.getJointInfo(arm, i, physicsClientId=client)
            limits = (panda.LOWER[i], panda.UPPER[i], panda.TORQUE[i], panda.VELOCITY[i])
            assert np.allclose(info[8:12], limits)
    finally:
        pybullet.disconnect(client)
