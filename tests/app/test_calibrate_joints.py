"""Joints beside poses prove the arm, with images and without."""

import numpy as np

from realsim.app.calibrate.board_views import arm_of_poses
from realsim.robots.arm import find_arm


def test_joints_prove_the_arm_whose_poses_they_give():
    chain = find_arm("ur5").chain.bare()
    joints = np.random.default_rng(0).uniform(-2, 2, (12, 6))
    Ts = np.stack([chain.forward(q) for q in joints])
    found = arm_of_poses(Ts, joints)
    assert found is not None and found.name == chain.name
    assert arm_of_poses(Ts, joints[::-1]) is None
