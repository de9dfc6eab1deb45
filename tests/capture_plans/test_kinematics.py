"""Laws of the arm: forward and inverse undo each other, the Jacobian is the derivative."""

from dataclasses import replace

import numpy as np
import pytest

from given_plans import calibrated
from realsim.geometry import se3
from realsim.robots.arm import UR5, UR5E, find_arm
from realsim.robots.kinematics import DhChain
from realsim.robots.robot_files import names_of

CHAINS = [UR5E, calibrated(UR5, 1)]
IDS = ["UR5e", "UR5 calibrated"]


def regular_joints(chain: DhChain, n: int, seed: int = 0) -> np.ndarray:
    q = np.random.default_rng(seed).uniform(-np.pi, np.pi, (3 * n, 6))
    return q[chain.sigma_min(q) > 0.05][:n]


@pytest.mark.parametrize("chain", CHAINS, ids=IDS)
def test_inverse_finds_the_joints_that_made_the_pose(chain: DhChain) -> None:
    for q in regular_joints(chain, 20, seed=3):
        found = chain.inverse(chain.forward(q))
        inside = chain.limits.contains(q)
        assert inside  # the draw stays within half a turn, which all limits allow
        assert np.abs(found - q).max(-1).min() < 1e-6
        assert np.all(chain.limits.contains(found))


def test_whole_turns_are_all_distinct_and_all_reach_the_pose() -> None:
    q = np.array([0.3, -1.2, 1.4, -0.8, 1.5, 0.2])
    found = UR5.inverse(UR5.forward(q))
    assert np.abs(UR5.forward(found) - UR5.forward(q)).max() < 1e-9
    assert len(np.unique(np.round(found, 6), axis=0)) == len(found)
    # Each joint but the elbow has exactly one other whole turn inside +-2 pi.
    assert len(found) % 32 == 0


@pytest.mark.parametrize("chain", CHAINS, ids=IDS)
def test_jacobian_is_the_derivative_of_forward(chain: DhChain) -> None:
    q = regular_joints(chain, 40, seed=5)
    J = chain.jacobian(q)
    h = 1e-6
    for i in range(6):
        step = np.eye(6)[i] * h
        twist = se3.log(se3.invert(chain.forward(q - step)) @ chain.forward(q + step)) / (2 * h)
        assert np.abs(J[..., i] - twist).max() < 1e-8


def test_known_poses_of_the_nominal_ur5() -> None:
    # At zero the arm lies along -x: x = a2 + a3, y = -(d4 + d6), z = d1 - d5.
    T = UR5.forward(np.zeros(6))
    assert T[:3, 3] == pytest.approx([-0.81725, -0.19145, -0.005491], abs=1e-12)
    # Turning the base turns the whole pose.
    turned = UR5.forward([0.7, 0, 0, 0, 0, 0])
    assert turned[:3, :3] == pytest.approx(se3.exp_so3([0, 0, 0.7]) @ T[:3, :3])
    # A UR5e is not a UR5.
    q = np.array([0.1, -1.5, 1.6, -1.6, -1.6, 0.0])
    gap_mm = 1e3 * np.linalg.norm(UR5E.forward(q)[:3, 3] - UR5.forward(q)[:3, 3])
    assert 40 < gap_mm < 100


def test_an_arm_without_a_closed_form_is_solved_all_the_same() -> None:
    general = replace(UR5, alpha=UR5.alpha + np.array([0.01, 0.02, -0.015, 0.02, 0.01, 0.0]))
    T = general.forward([0.1, -1.2, 1.3, -0.5, -1.4, 0.2])
    found = general.inverse(T)
    assert len(found)
    np.testing.assert_allclose(general.forward(found), np.tile(T, (len(found), 1, 1)), atol=1e-8)


def test_poses_of_every_arm_that_ships_are_reached_inside_its_limits() -> None:
    """What a dense search finds is found: poses of random joints, of six joints and of seven."""
    for name in names_of("arm"):
        chain = find_arm(name).chain
        limits = chain.limits
        low, high = np.maximum(limits.lower, -np.pi), np.minimum(limits.upper, np.pi)
        Ts = chain.forward(np.random.default_rng(8).uniform(low, high, (200, chain.joints)))
        q, of = chain.inverse_branches(Ts)
        assert len(np.unique(of)) >= 199, name
        assert np.all(limits.contains(q)), name
        np.testing.assert_allclose(chain.forward(q), Ts[of], atol=1e-8)
