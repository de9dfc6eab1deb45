import numpy as np
import pytest

from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim_calibration import CLOSED_FORMS, check_observable, park
from refusals import refused

ALL = sorted(CLOSED_FORMS)


def problem(seed, n=10, rot=0.0, trans=0.0):
    rng = np.random.default_rng(seed)
    X, Z = se3.random_transform(rng, spread=0.1), se3.random_transform(rng, spread=0.5)
    C = se3.from_rt(se3.exp_so3(rng.normal(scale=0.5, size=(n, 3))), rng.normal(size=(n, 3)))
    C[:, 2, 3] += 1.0
    A = Z @ se3.invert(C) @ se3.invert(X)
    noise = np.concatenate(
        [rng.normal(scale=rot, size=(n, 3)), rng.normal(scale=trans, size=(n, 3))], -1
    )
    return A @ se3.exp(noise), C, X, Z


def close(a, b, tol=1e-9):
    return np.abs(a - b).max() < tol


@pytest.mark.parametrize("name", ALL)
def test_exact_on_perfect_data(name):
    A, C, X, Z = problem(0)
    x, z = CLOSED_FORMS[name](A, C)
    assert close(x, X) and close(z, Z)


@pytest.mark.parametrize("name", ALL)
def test_frames_of_base_and_board_do_not_matter(name):
    A, C, _, _ = problem(1, rot=0.01, trans=0.01)
    rng = np.random.default_rng(9)
    G, H = se3.random_transform(rng), se3.random_transform(rng)
    x, z = CLOSED_FORMS[name](A, C)
    x2, z2 = CLOSED_FORMS[name](G @ A, C)
    assert close(x, x2, 1e-8) and close(G @ z, z2, 1e-8)
    x3, _ = CLOSED_FORMS[name](A, C @ H)
    # The board's origin is a lever arm for Shah's translation and the mean of the others' Z.
    assert close(x[:3, :3], x3[:3, :3], 1e-8)
    if name != "shah":
        assert close(x, x3, 1e-8)


@pytest.mark.parametrize("name", ALL)
def test_one_axis_is_refused_and_named(name):
    rng = np.random.default_rng(0)
    turns = np.outer(np.linspace(-1, 1, 8), [0, 0, 1.0])
    A = se3.from_rt(se3.exp_so3(turns), rng.normal(size=(8, 3)))
    with pytest.raises(DegenerateError, match=r"one axis only, \[-?0.00, -?0.00, 1.00\]"):
        CLOSED_FORMS[name](A, A)


def test_what_cannot_be_solved_is_refused():
    still = se3.from_translation(np.random.default_rng(0).normal(size=(8, 3)))
    refused("does not turn", park, still, still, error=DegenerateError)
    A, C, _, _ = problem(0)
    refused("2 usable views", check_observable, A[:2], error=DegenerateError)
    refused("10 hand poses and 9 board poses", park, A, C[1:])
