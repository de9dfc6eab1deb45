"""Known answers of the rigid transforms, and every way in which a matrix is not one."""

import numpy as np
import pytest

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
