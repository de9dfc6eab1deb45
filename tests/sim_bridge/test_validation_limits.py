"""The limit surface that engines are judged by: its laws, and an independent lower bound."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from realsim_sim_bridge.slip.world import PadModel
from realsim_sim_bridge.validation.loads import FrictionPatch, hand_patch
from realsim_sim_bridge.validation.slip_limits import bracket, pulls, turns

PADS = PadModel().centers_xz()
SEEDS = st.integers(0, 2**32 - 1)


def patch_of(seed, points=None):
    rng = np.random.default_rng(seed)
    count = points or rng.integers(2, 8)
    return FrictionPatch(
        points_m=0.01 * rng.normal(size=(count, 2)), friction_n=rng.uniform(0.1, 2.0, count)
    )


def load_of(seed):
    return np.random.default_rng(seed + 1).normal(size=3) * [0.01, 1.0, 1.0]


def carried(patch, load, corners=180):
    """The largest factor for which friction forces within inscribed polygons carry the load."""
    count = len(patch.points_m)
    angles = 2 * np.pi * np.arange(corners) / corners
    inside = np.kron(np.eye(count), np.stack([np.cos(angles), np.sin(angles)], axis=-1))
    radii = np.repeat(patch.friction_n * np.cos(np.pi / corners), corners)
    x, z = patch.points_m.T
    sums = np.zeros((3, 2 * count + 1))
    sums[0, :-1] = np.stack([-z, x], axis=-1).ravel()
    sums[1, 0:-1:2] = sums[2, 1:-1:2] = 1.0
    sums[:, -1] = -np.asarray(load)
    found = linprog(
        np.eye(2 * count + 1)[-1] * -1.0,
        A_ub=np.column_stack([inside, np.zeros(len(inside))]),
        b_ub=radii,
        A_eq=sums,
        b_eq=np.zeros(3),
        bounds=[(None, None)] * (2 * count) + [(0, None)],
    )
    return found.x[-1]


@pytest.mark.parametrize("angle", [0.0, 0.4])
def test_a_pull_through_the_centre_is_carried_by_all_friction(angle):
    patch = hand_patch(PADS, 20.0, 0.25)
    pull = [0.0, np.cos(angle), np.sin(angle)]
    assert patch.slip_load(pull) == pytest.approx(2 * 0.25 * 20.0, rel=1e-9)


def test_a_torque_is_carried_by_friction_at_its_mean_arm():
    patch = hand_patch(PADS, 20.0, 0.25)
    expected = 10.0 * np.linalg.norm(PADS, axis=1).mean()
    assert patch.slip_load([1.0, 0.0, 0.0]) == pytest.approx(expected, rel=1e-9)
    assert np.linalg.norm(PADS, axis=1).mean() == pytest.approx(7.66e-3, abs=1e-5)


@settings(max_examples=10, deadline=None)
@given(SEEDS)
def test_the_upper_bound_meets_the_largest_load_that_friction_forces_carry(seed):
    patch, load = patch_of(seed), load_of(seed)
    lower, found = carried(patch, load), patch.slip_load(load)
    assert lower <= found * (1 + 1e-7)
    assert found <= lower / np.cos(np.pi / 180) ** 2 * (1 + 1e-4)


@settings(max_examples=10, deadline=None)
@given(SEEDS)
def test_limits_are_convex_symmetric_and_scale_with_the_friction(seed):
    patch, a, b = patch_of(seed), load_of(seed), load_of(seed + 7)
    on_a, on_b = a * patch.slip_load(a), b * patch.slip_load(b)
    assert patch.slip_load(-a) == pytest.approx(patch.slip_load(a), rel=1e-9)
    assert patch.slip_load(3.0 * a) == pytest.approx(patch.slip_load(a) / 3.0, rel=1e-7)
    # Between two loads on the limit, every load is carried.
    for share in (0.25, 0.5, 0.75):
        assert patch.slip_load(share * on_a + (1 - share) * on_b) >= 1 - 1e-5
    twice = FrictionPatch(points_m=patch.points_m, friction_n=2 * patch.friction_n)
    assert twice.slip_load(a) == pytest.approx(2 * patch.slip_load(a), rel=1e-7)


def test_a_point_turns_freely_and_no_load_never_slips():
    point = FrictionPatch(points_m=np.zeros((1, 2)), friction_n=np.array([3.0]))
    assert point.slip_load([0.01, 0.0, 0.0]) == pytest.approx(0.0, abs=1e-9)
    assert point.slip_load([0.0, 0.0, -2.0]) == pytest.approx(1.5)
    assert point.slip_load([0.0, 0.0, 0.0]) == np.inf


def test_loads_are_the_wrenches_of_forces_at_their_points():
    for load in [*pulls((0.0, 45.0, 180.0)), *turns((0.03,))]:
        wrench = load.wrench()
        assert np.allclose(wrench[3:], [load.force[0], 0.0, load.force[1]])
        if "off" in load.name:
            at = [0.03, 0, 0] if load.name.startswith("-z") else [0, 0, 0.03]
            assert np.allclose(wrench[:3], np.cross(at, wrench[3:]))
        # The planar load is the same wrench: x to z is a negative turn about y.
        assert load.planar()[0] == -wrench[1]


def test_a_bracket_ends_at_the_first_slip_and_begins_after_the_last_hold():
    shares = np.array([0.9, 0.97, 1.03, 1.1])
    assert bracket(shares, np.array([False, False, True, True])) == (0.97, 1.03)
    assert bracket(shares, np.array([False, True, False, True])) == (0.9, 1.1)
    assert bracket(shares, np.array([True, True, True, True])) == (0.0, 0.9)
    assert bracket(shares, np.array([False, False, False, False])) == (1.1, np.inf)
