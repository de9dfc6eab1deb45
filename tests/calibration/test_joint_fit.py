from dataclasses import replace

import numpy as np
import pytest

from realsim.geometry import camera, se3
from realsim.records import ArmErrorMap, CameraIntrinsics, RobotErrorMap
from realsim.robots.arm import find_arm
from realsim_calibration.fit.joint_solve import FLAT, JointConfig, JointProblem, Setup, ViewCorners
from realsim_calibration.fit.linear_model import LinearModel
from realsim_calibration.fit.noise_scale import largest_ratio, whiteness
from realsim_calibration.fit.robot_error import arm_basis, map_basis, map_record
from realsim_calibration.fit.view_system import (
    camera_from_board,
    camera_vector,
    refined_pose,
    view_equations,
    view_rows,
)

RATIO = np.full(2, 0.3)


def norm(view):
    return np.linalg.norm(view_rows(*view)[:, -1])


@pytest.fixture(params=[False, True], ids=["in hand", "to hand"])
def view(request):
    rng = np.random.default_rng(1)
    X, A = se3.random_transform(rng, spread=0.1), se3.random_transform(rng)
    D = se3.exp(rng.normal(scale=1e-2, size=6))
    T = se3.from_rt(se3.exp_so3([0.3, 0.2, 0.5]), [-0.05, 0.02, 0.5])
    Z = se3.invert(A @ D) @ X @ T if request.param else A @ D @ X @ T
    lens = np.array([640, 641, 640, 360, -0.05, 0.04, 1e-3, -5e-4, 0.01, 0.01, 0.02, 0.005])
    board = np.array([1.01, 0.002, 0.01, -0.004, 0.02])
    xy, uv = rng.uniform(-0.1, 0.1, (30, 2)), rng.uniform(0, 900, (30, 2))
    middle, root = np.array([0.1, 0.1, 0.0]), rng.uniform(0.5, 1, 30)
    return [X, Z, A, D, request.param, lens, board, 0.1, middle, xy, uv, root]


def moved(view, step):
    X, Z, A, D, to_hand, lens, board, *rest = view
    return [
        X @ se3.exp(step[:6]), Z @ se3.exp(step[6:12]), A, D @ se3.exp(step[29:35]), to_hand,
        lens + step[12:24], board + step[24:29], *rest,
    ]  # fmt: skip


def test_compressed_equations_have_the_cost_and_the_gradient_of_the_points(view):
    J = view_equations(*view)
    assert np.isclose(np.linalg.norm(J[:, -1]), norm(view), rtol=1e-12)
    gradient = J[:, :-1].T @ J[:, -1]

    def cost(step):
        return norm(moved(view, step)) ** 2 / 2

    numeric = [(cost(h) - cost(-h)) / 2e-6 for h in np.eye(35) * 1e-6]
    assert np.allclose(gradient, numeric, rtol=1e-5, atol=1e-5 * np.abs(gradient).max())


def test_compressed_equations_have_the_normal_matrix_of_the_points(view):
    rows = view_rows(*view)
    J = view_equations(*view)
    # Camera and board columns come without the chain rule: their Gram matrix is that of the points.
    direct = rows[:, 6:23].T @ rows[:, 6:23]
    assert np.allclose(J[:, 12:29].T @ J[:, 12:29], direct, rtol=1e-9, atol=1e-9)


def test_the_compiled_lens_is_the_geometry_module_s(view):
    X, Z, A, D, to_hand, lens, _, half, middle, xy, _, _ = view
    K = CameraIntrinsics(width=1280, height=720, fx=lens[0], fy=lens[1], cx=lens[2], cy=lens[3],
                         distortion=lens[4:])  # fmt: skip
    T = camera_from_board(X, Z, A, D, to_hand)
    points = se3.transform(T, middle + np.concatenate([xy, np.zeros((30, 1))], -1))
    uv, d_point, d_camera = camera.projection_jacobian(K, points)
    rows = view_rows(X, Z, A, D, to_hand, lens, FLAT, half, middle, xy, np.zeros((30, 2)),
                     np.ones(30))  # fmt: skip
    assert np.allclose(rows[:, -1].reshape(-1, 2), uv, atol=1e-9)
    assert np.allclose(rows[:, 6:18].reshape(-1, 2, 12), d_camera, atol=1e-8)
    assert np.allclose(rows[:, 3:6].reshape(-1, 2, 3), d_point, rtol=1e-9)
    found, cost = refined_pose(T @ se3.exp(np.full(6, 0.01)), lens, points, uv, 20, 1e-4, 1e-12)
    assert cost < 1e-12 or not np.allclose(found, T)


def test_a_point_behind_the_camera_makes_a_step_dear(view):
    view[0] = view[0] @ se3.from_rt(np.eye(3), [0.0, 0.0, 2.0])
    assert norm(view) > 1e4


def problem_of(sim, views=None, config=None):
    points = sim.board.points_board
    middle = (points.max(0) + points.min(0)) / 2
    corners = tuple(
        ViewCorners(
            index=v.index, T_base_ee=np.ascontiguousarray(v.T_base_ee),
            xy=np.ascontiguousarray((v.detection.points(sim.board) - middle)[:, :2]),
            uv=v.detection.uv,
        )
        for v in views or sim.views
    )  # fmt: skip
    setup = Setup(views=corners, to_hand=False, middle=middle,
                  half_extent=float(np.ptp(points, axis=0).max() / 2),
                  intrinsics0=sim.intrinsics0)  # fmt: skip
    return JointProblem(setup, config or JointConfig())


def fitted(sim, basis_of=None, sigma=0.3):
    problem = problem_of(sim)
    start = problem.start(sim.T_ee_cam, sim.T_base_board)
    start = replace(start, camera=camera_vector(sim.intrinsics))
    basis = None if basis_of is None else basis_of(np.stack([v.T_base_ee for v in sim.views]))
    for _ in range(3):
        start = problem.optimize(start, sigma, RATIO, problem.ones(), basis)
    return problem, start, basis


BASES = {
    "none": None,
    "map in tool axes": lambda Ts: map_basis(Ts, "ee", 0.3, 5e-4),
    "map in base axes": lambda Ts: map_basis(Ts, "base", 0.3, 5e-4),
}


def whole_problem(problem, state, basis, sigma):
    """Return Jacobian and residuals of all unknowns: shared ones, weights, every robot error."""
    n, p = len(state.errors), len(state.weights)
    rows = problem.equations(state, problem.ones()) / sigma
    center, covariance = problem.prior()
    robot = 1 / (np.repeat(RATIO, 3) * sigma * problem.unit_robot_sd(state))
    J, r = np.zeros((30 * n + 17 + p, 29 + p + 6 * n)), np.zeros(30 * n + 17 + p)
    for k in range(n):
        view, tie = slice(24 * k, 24 * k + 24), slice(24 * n + 6 * k, 24 * n + 6 * k + 6)
        own = slice(29 + p + 6 * k, 35 + p + 6 * k)
        J[view, :29], J[view, own], r[view] = rows[k, :, :29], rows[k, :, 29:35], rows[k, :, -1]
        J[tie, own], r[tie] = np.diag(robot), robot * state.errors[k]
        if basis is not None:
            J[tie, 29 : 29 + p] = -robot[:, None] * basis.columns[k]
            r[tie] -= robot * (basis.columns[k] @ state.weights)
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    J[30 * n : 30 * n + 17, 12:29] = root
    r[30 * n : 30 * n + 17] = root @ (np.concatenate([state.camera, state.board]) - center)
    J[30 * n + 17 :, 29 : 29 + p], r[30 * n + 17 :] = np.eye(p), state.weights
    return J, r


@pytest.mark.parametrize("name", BASES)
def test_the_linear_model_has_the_marginals_and_the_optimum_of_all_unknowns(simulate, name):
    problem, state, basis = fitted(simulate(5, views=10), BASES[name])
    fit = LinearModel(problem, state, problem.ones()).fit(basis, RATIO, 0.3, rounds=0)
    J, r = whole_problem(problem, state, basis, 0.3)
    shared = 29 + len(state.weights)
    ours, theirs = np.linalg.inv(fit.information), np.linalg.inv(J.T @ J)[:shared, :shared]
    scale = np.sqrt(np.outer(np.diag(theirs), np.diag(theirs)))
    assert np.abs((ours - theirs) / scale).max() < 1e-3
    sd = np.sqrt(np.diag(ours))[:29]
    assert np.all(np.abs(np.linalg.solve(J.T @ J, J.T @ r))[:29] < 1e-3 * sd)
    # The fit is at its optimum, so the linear step from there is nothing but the map's weights.
    assert np.all(np.abs(fit.step[:29]) < 0.02 * sd)
    if basis is not None:
        assert np.allclose(fit.step[29:], state.weights, atol=0.02)


def test_the_likelihood_finds_the_robots_share(simulate):
    from realsim_calibration.fit.noise_scale import estimate_ratio

    # Truth: robot sd over the angle that a corner's 0.1 px subtends at f = 643 and 0.4 m.
    px = 0.1 / 643
    for robot in (0.1e-3, 1e-3):
        problem, state, _ = fitted(simulate(3, views=30, robot=(robot, robot)))
        model = LinearModel(problem, state, problem.ones())
        ratio = estimate_ratio(model, None, 0.1, 50.0)
        assert 0.6 < ratio[0] / (robot / px) < 1.7
        assert 0.6 < ratio[1] / (robot / 0.4 / px) < 1.7


def test_a_warped_print_shows_as_correlated_corners(simulate):
    sim = simulate(4, views=12)
    problem, state, _ = fitted(sim)
    white = whiteness(problem, state)
    assert white.excess < 0.1 and largest_ratio(white) > 3
    views = []
    for v in sim.views:
        x = v.detection.uv[:, 0]
        bent = v.detection.uv + np.stack([0 * x, 0.8 * np.sin(x / 90.0)], -1)
        views.append(replace(v, detection=replace(v.detection, uv=bent)))
    bent_white = whiteness(problem_of(sim, views), state)
    assert bent_white.excess > 1 and largest_ratio(bent_white) == 0.3


def test_records_of_maps_give_the_basis_errors():
    rng = np.random.default_rng(2)
    Ts = se3.random_transform(rng, 15, 0.3)
    for kind in ("ee", "base"):
        basis = map_basis(Ts, kind, 0.3, 5e-4)
        w = rng.normal(size=72)
        record = map_record(basis, w, Ts, None)
        assert isinstance(record, RobotErrorMap)
        assert np.allclose(record.twist(Ts), basis.columns @ w, atol=1e-15)
        assert np.allclose(se3.log(se3.invert(Ts) @ record.corrected(Ts)), basis.columns @ w)
        assert record.beyond(Ts).max() == 0
        assert record.beyond(Ts @ se3.exp([2, 0, 0, 3, 0, 0])).min() > 1


@pytest.mark.parametrize("name", ["ur5e", "panda"])
def test_an_arms_basis_is_the_derivative_of_the_corrected_arm(name):
    rng, arm = np.random.default_rng(2), find_arm(name).chain.bare()
    joints = rng.uniform(-2, 2, (15, arm.joints))
    tool = se3.from_rt(se3.exp_so3([0.1, 0.2, 0.3]), [0.0, 0.01, 0.2])
    held = arm.forward(joints) @ tool
    basis = arm_basis(arm, joints, held)
    assert np.allclose(basis.T_flange_tool, tool, atol=1e-12)
    w = rng.normal(size=4 * arm.joints)
    record = map_record(basis, w, held, arm)
    assert isinstance(record, ArmErrorMap)
    exact = se3.log(se3.invert(held) @ record.corrected(held, joints))
    assert np.allclose(exact, basis.columns @ w, atol=3e-6)  # the basis is linear, the arm is not
