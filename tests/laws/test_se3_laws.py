"""SE(3) is a group, exp and log are inverses, the adjoint and the Jacobian are derivatives."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from realsim.geometry import se3

few = settings(max_examples=15, deadline=None)
seeds = st.integers(0, 2**32 - 1)
# Near nothing, small, ordinary, and near half a turn, where formulas divide by zero.
angles = st.sampled_from([0.0, 1e-12, 1e-8, 1e-5, 1e-3, 0.5, 2.0, 3.1, np.pi - 1e-6, np.pi - 1e-9])


def twist(seed, angle):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    return np.concatenate([angle * axis / np.linalg.norm(axis), rng.normal(size=3)])


@few
@given(seeds)
def test_transforms_form_a_group(seed):
    A, B, C = se3.random_transform(np.random.default_rng(seed), 3)
    np.testing.assert_allclose((A @ B) @ C, A @ (B @ C), atol=1e-13)
    np.testing.assert_allclose(A @ se3.invert(A), np.eye(4), atol=1e-14)
    np.testing.assert_allclose(se3.invert(A @ B), se3.invert(B) @ se3.invert(A), atol=1e-13)
    np.testing.assert_allclose(se3.check_rigid(A @ B, "A B"), A @ B, atol=1e-13)


@few
@given(seeds)
def test_transform_is_the_matrix_product(seed):
    rng = np.random.default_rng(seed)
    T, p = se3.random_transform(rng), rng.normal(size=(7, 3))
    homogeneous = np.concatenate([p, np.ones((7, 1))], -1)
    np.testing.assert_allclose(se3.transform(T, p), (homogeneous @ T.T)[:, :3], atol=1e-13)
    np.testing.assert_allclose(se3.transform(se3.invert(T), se3.transform(T, p)), p, atol=1e-13)


@few
@given(seeds, angles)
def test_log_undoes_exp_near_zero_and_near_half_a_turn(seed, angle):
    xi = twist(seed, angle)
    # Near pi the logarithm divides by what is left of 1 + cos: digits are lost there, no more.
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-12 if angle < 3.0 else 1e-8)


@few
@given(seeds)
def test_exp_undoes_log(seed):
    T = se3.random_transform(np.random.default_rng(seed))
    np.testing.assert_allclose(se3.exp(se3.log(T)), T, atol=1e-9)


@few
@given(seeds, angles)
def test_exp_is_a_one_parameter_group(seed, angle):
    xi = twist(seed, angle)
    np.testing.assert_allclose(se3.exp(0.3 * xi) @ se3.exp(0.7 * xi), se3.exp(xi), atol=1e-12)
    np.testing.assert_allclose(se3.exp(-xi), se3.invert(se3.exp(xi)), atol=1e-12)


@few
@given(seeds, angles)
def test_adjoint_moves_a_twist_to_the_other_side(seed, angle):
    T = se3.random_transform(np.random.default_rng(seed + 1))
    xi = twist(seed, angle)
    np.testing.assert_allclose(T @ se3.exp(xi), se3.exp(se3.adjoint(T) @ xi) @ T, atol=1e-11)


@few
@given(seeds)
def test_adjoint_is_a_homomorphism(seed):
    A, B = se3.random_transform(np.random.default_rng(seed), 2)
    np.testing.assert_allclose(se3.adjoint(A @ B), se3.adjoint(A) @ se3.adjoint(B), atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-4, 0.7, 2.5, 3.14])
def test_left_jacobian_is_the_derivative_of_exp(angle):
    # exp(w + d) = exp(J(w) d) exp(w) to first order.
    w = twist(5, angle)[:3]
    J, h = se3.left_jacobian_so3(w), 1e-6
    columns = [
        se3.log_so3(se3.exp_so3(w + h * e) @ se3.exp_so3(w - h * e).T) / (2 * h) for e in np.eye(3)
    ]
    np.testing.assert_allclose(J, np.stack(columns, -1), atol=1e-8)


@few
@given(seeds, angles)
def test_quaternions_and_rotations_are_the_same_thing(seed, angle):
    R = se3.exp_so3(twist(seed, angle)[:3])
    q = se3.quaternion_wxyz(R)
    assert q[0] >= 0 and abs(np.linalg.norm(q) - 1) < 1e-12
    np.testing.assert_allclose(se3.from_quaternion_wxyz(q), R, atol=1e-12)
    np.testing.assert_allclose(se3.from_quaternion_wxyz(-3.0 * q), R, atol=1e-12)


def test_stacks_are_the_same_as_one_by_one():
    rng = np.random.default_rng(2)
    Ts = se3.random_transform(rng, 6)
    xis = rng.normal(size=(6, 6))
    np.testing.assert_array_equal(se3.invert(Ts), np.stack([se3.invert(T) for T in Ts]))
    np.testing.assert_allclose(se3.log(Ts), np.stack([se3.log(T) for T in Ts]), atol=1e-14)
    np.testing.assert_allclose(se3.exp(xis), np.stack([se3.exp(x) for x in xis]), atol=1e-14)
    np.testing.assert_allclose(se3.adjoint(Ts), np.stack([se3.adjoint(T) for T in Ts]), atol=1e-14)


def test_the_mean_rotation_commutes_with_turning_everything():
    rng = np.random.default_rng(3)
    center, turn = se3.random_rotation(rng), se3.random_rotation(rng)
    Rs = center @ se3.exp_so3(rng.normal(scale=0.1, size=(20, 3)))
    mean = se3.mean_rotation(Rs)
    np.testing.assert_allclose(se3.mean_rotation(turn @ Rs), turn @ mean, atol=1e-12)
    assert np.degrees(se3.angle(center.T @ mean)) < 5


def test_random_rotations_are_uniform():
    # For rotations uniform over SO(3) the mean matrix is 0, and E angle = pi/2 + 2/pi.
    Rs = se3.random_rotation(np.random.default_rng(4), 20_000)
    assert np.abs(Rs.mean(axis=0)).max() < 0.02
    assert abs(se3.angle(Rs).mean() - (np.pi / 2 + 2 / np.pi)) < 0.02
