"""The hand-eye of pose pairs: the truth, its sigma, wrong pairs, and frames that do not matter."""

from functools import cache

import numpy as np
import pytest

from realsim.arrays import Array
from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim_calibration import solve_pose_pairs
from realsim_calibration.results import Mode
from refusals import refused

X_TRUE = se3.exp([0.1, -0.2, 0.7, 0.03, -0.05, 0.08])
Z_TRUE = se3.exp([3.0, 0.1, 0.2, 0.5, 0.1, 0.05])


def pairs(
    seed: int, n: int = 25, camera: tuple[float, float] = (2e-3, 1e-3), robot: float = 3e-4
) -> tuple[Array, Array]:
    """Return T_base_ee and T_cam_board of a camera in the hand that circles a board."""
    rng = np.random.default_rng(seed)
    A, C = np.zeros((n, 4, 4)), np.zeros((n, 4, 4))
    for k in range(n):
        side, roll = rng.uniform(-0.6, 0.6, 2), rng.uniform(-np.pi, np.pi)
        eye = np.array([*side * 0.5, -rng.uniform(0.35, 0.6)])
        T_cam_board = se3.invert(se3.look_at(eye, rng.normal(scale=0.03, size=3), roll))
        A[k] = Z_TRUE @ se3.invert(T_cam_board) @ se3.invert(X_TRUE)
        A[k] = A[k] @ se3.exp(rng.normal(scale=robot, size=6))
        C[k] = T_cam_board @ se3.exp([*rng.normal(scale=camera[0], size=3), 0, 0, 0])
        C[k, :3, 3] += rng.normal(scale=camera[1], size=3) * [1, 1, 3]
    return A, C


def off(T: Array, truth: Array) -> Array:
    """Return the right twist from an estimate to the truth (6,)."""
    return se3.log(se3.invert(T) @ truth)


def test_exact_pairs_give_the_truth() -> None:
    """Without errors X and Z come back to the micrometre."""
    A, C = pairs(0, camera=(0.0, 0.0), robot=0.0)
    found = solve_pose_pairs(A, C)
    assert np.abs(off(found.X, X_TRUE)).max() < 1e-6
    assert np.abs(off(found.Z, Z_TRUE)).max() < 1e-6
    assert found.used.all()


@cache
def trials() -> tuple[tuple[Array, Array, Array], ...]:
    """Return (off, covariance, off of the unweighted closed form) of 14 sets."""
    from realsim_calibration import shah

    rows: list[tuple[Array, Array, Array]] = []
    for seed in range(14):
        A, C = pairs(100 + seed, camera=(8e-3, 5e-4))
        found = solve_pose_pairs(A, C)
        rows.append((off(found.X, X_TRUE), found.covariance[:6, :6], off(shah(A, C)[0], X_TRUE)))
    return tuple(rows)


def test_sigma_is_that_of_the_errors() -> None:
    """The squared distance of the truth in the stated covariance is 6 on the average."""
    nees = [float(d @ np.linalg.solve(S, d)) for d, S, _ in trials()]
    assert 3.5 < np.mean(nees) < 9.5
    assert np.mean(np.array(nees) < 12.6) > 0.8


def test_weighing_what_is_sure_beats_a_closed_form() -> None:
    """The error of X is well below that of Shah's closed form."""
    ours = np.median([np.linalg.norm(d[3:]) for d, _, _ in trials()])
    closed = np.median([np.linalg.norm(d[3:]) for _, _, d in trials()])
    assert ours < 0.6 * closed


def test_half_of_the_pairs_may_be_wrong() -> None:
    """Every invented pose is named and X stays."""
    A, C = pairs(3, n=30)
    rng = np.random.default_rng(4)
    bad = rng.permutation(30)[:14]
    C = C.copy()
    for k in bad:
        t = rng.normal(size=3)
        C[k] = se3.from_rt(se3.random_rotation(rng), 0.5 * t / np.linalg.norm(t))
    found = solve_pose_pairs(A, C)
    assert not found.used[bad].any()
    assert found.used.sum() >= 15
    assert np.linalg.norm(off(found.X, X_TRUE)[3:]) < 3e-3


@pytest.mark.parametrize("mode", ["eye_in_hand", "eye_to_hand"])
def test_a_fixed_camera_is_the_inverse_problem(mode: Mode) -> None:
    """The same cameras and boards with the hand inverted give the same frames."""
    A, C = pairs(5)
    given = A if mode == "eye_in_hand" else se3.invert(A)
    found = solve_pose_pairs(given, C, mode=mode)
    assert np.linalg.norm(off(found.X, X_TRUE)[3:]) < 3e-3
    assert np.linalg.norm(off(found.Z, Z_TRUE)[3:]) < 3e-3


def test_another_base_frame_moves_z_alone() -> None:
    """X and its covariance do not depend on where the base is."""
    A, C = pairs(6)
    G = se3.exp([0.3, 0.2, -0.5, 1.0, 2.0, -0.5])
    one, other = solve_pose_pairs(A, C), solve_pose_pairs(G @ A, C)
    np.testing.assert_allclose(one.X, other.X, atol=2e-6)
    np.testing.assert_allclose(G @ one.Z, other.Z, atol=1e-5)
    np.testing.assert_allclose(one.covariance[:6, :6], other.covariance[:6, :6], rtol=0.03)


def test_pairs_that_do_not_belong_together_are_named() -> None:
    """Shuffled poses agree with no place of the camera."""
    A, C = pairs(7)
    refused("belong together", solve_pose_pairs, A, np.roll(C, 7, axis=0))


def test_bad_stacks_are_named() -> None:
    """Lengths, values and motion are checked."""
    A, C = pairs(8)
    refused("25 hand poses and 24 camera poses", solve_pose_pairs, A, C[:-1])
    C[3, 0, 0] = np.nan
    refused("the first is pair 3", solve_pose_pairs, A, C)
    with pytest.raises(DegenerateError, match="does not turn"):
        solve_pose_pairs(np.repeat(A[:1], 10, 0), np.repeat(pairs(8)[1][:1], 10, 0))
