"""Known answers of the rigid transforms, and every way in which a matrix is not one."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from realsim.errors import NotRigidError
from realsim.geometry import se3
from refusals import refused

QUARTER_Z = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


def test_a_quarter_turn_about_z():
    T = se3.from_rt(QUARTER_Z, [1, 2, 3])
    np.testing.assert_allclose(se3.exp_so3([0, 0, np.pi / 2]), QUARTER_Z, atol=1e-15)
    np.testing.assert_allclose(se3.log_so3(QUARTER_Z), [0, 0, np.pi / 2], atol=1e-15)
    np.testing.assert_allclose(se3.quaternion_wxyz(QUARTER_Z), [np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    np.testing.assert_allclose(se3.transform(T, [[1, 0, 0]]), [[1, 3, 3]])
    np.testing.assert_allclose(se3.invert(T)[:3, 3], [-2, 1, -3])


def test_a_screw_moves_along_its_axis():
    # Half a turn about z with pitch: translation along the axis only adds up.
    T = se3.exp([0, 0, np.pi, 0, 0, 5])
    np.testing.assert_allclose(T, se3.from_rt(np.diag([-1, -1, 1]), [0, 0, 5]), atol=1e-15)


def test_half_turns_have_a_logarithm_of_length_pi():
    for axis in np.eye(3):
        w = se3.log_so3(2 * np.outer(axis, axis) - np.eye(3))
        np.testing.assert_allclose(np.abs(w), np.pi * axis, atol=1e-12)


def test_twists_are_rotation_first():
    np.testing.assert_allclose(se3.log(se3.from_translation([1, 2, 3])), [0, 0, 0, 1, 2, 3])


def test_looking_straight_down_x_is_the_worlds_x():
    T = se3.look_at([0.2, 0.1, 0.5], [0.2, 0.1, 0.0])
    np.testing.assert_allclose(T[:3, :3], np.diag([1.0, -1, -1]), atol=1e-12)


def test_look_at_puts_the_target_on_the_optical_axis_and_y_down():
    eye, target = np.array([0.5, -0.3, 0.4]), np.array([0.1, 0.2, 0.0])
    T = se3.look_at(eye, target, roll=0.0)
    in_cam = se3.transform(se3.invert(T), target[None])[0]
    np.testing.assert_allclose(in_cam, [0, 0, np.linalg.norm(target - eye)], atol=1e-12)
    assert abs(T[2, 0]) < 1e-12 and T[2, 1] < 0
    rolled = se3.look_at(eye, target, roll=0.4)
    np.testing.assert_allclose(rolled, T @ se3.exp([0, 0, 0.4, 0, 0, 0]), atol=1e-12)


def test_look_at_needs_a_direction():
    refused("target", se3.look_at, [0, 0, 1], [0, 0, 1], error=NotRigidError)


@pytest.mark.parametrize(
    ("matrix", "says"),
    [
        (se3.from_rt(1.02 * QUARTER_Z, [0, 0, 0]), "mean scale 1.02"),
        (se3.from_rt(np.diag([1.0, 1, -1]), [0, 0, 0]), "mirrored"),
        (se3.from_rt(QUARTER_Z, [1, 2, 3]).T, "transposed"),
        (se3.from_rt(QUARTER_Z, [np.nan, 0, 0]), "not measured"),
        (np.eye(3), r"shape \(3, 3\)"),
    ],
)
def test_what_is_not_rigid_is_named(matrix, says):
    said = refused(says, se3.check_rigid, matrix, "T_world_mug", error=NotRigidError)
    assert "T_world_mug" in said


def test_float32_rotations_become_exactly_orthonormal():
    T = se3.random_transform(np.random.default_rng(0)).astype(np.float32)
    checked = se3.check_rigid(T, "T")
    assert np.abs(checked[:3, :3].T @ checked[:3, :3] - np.eye(3)).max() < 1e-15 * 4
    np.testing.assert_allclose(checked, T, atol=1e-6)


def test_angle_is_the_length_of_the_logarithm():
    axes = np.random.default_rng(0).normal(size=(200, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.concatenate([np.geomspace(1e-9, 0.1, 100), np.pi - np.geomspace(1e-9, 0.1, 100)])
    R = se3.exp_so3(axes * angles[:, None])
    assert np.allclose(se3.angle(R), angles, rtol=0, atol=1e-12)
    assert np.allclose(se3.angle(R), np.linalg.norm(se3.log_so3(R), axis=-1), atol=1e-7)


# --- Laws: a group, exp and log are inverses, the adjoint and the Jacobian are derivatives.

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
