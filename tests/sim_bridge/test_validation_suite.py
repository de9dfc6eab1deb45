"""The validation suite: green at the settings that ship, red at every bad one that is known."""

import json
import math
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pybullet_utils.bullet_client import BulletClient
from scipy.optimize import linprog

from realsim_sim_bridge.slip.engines import BulletSettings, MujocoSettings, make_engine, settings_of
from realsim_sim_bridge.slip.slip_test import SlipConfig
from realsim_sim_bridge.slip.world import PadModel, SlipPhysics
from realsim_sim_bridge.validation.config import (
    CHECKS,
    LabelConfig,
    LimitConfig,
    StageConfig,
    ValidationConfig,
)
from realsim_sim_bridge.validation.loads import FrictionPatch, hand_patch
from realsim_sim_bridge.validation.report import CheckResult, LimitRatio, ValidationReport, picture
from realsim_sim_bridge.validation.slip_limits import bracket, pulls, turns
from realsim_sim_bridge.validation.suite import validate
from refusals import refused

SMALL = ValidationConfig(
    limits=LimitConfig(
        cases=((20.0, 0.25),), directions_deg=(0.0, 45.0, 90.0),
        coulomb_shares=(0.9, 0.97, 1.03, 1.1), torque_cases=((20.0, 0.25),),
        torque_shares=(0.9, 1.1), arms_m=(0.03,), creep_s=1.0,
    ),
    stages=StageConfig(box_masses_kg=(0.013,)),
    labels=LabelConfig(
        masses_kg=(0.01, 0.5), grasps=1, shapes=("box", "wedge"), finer=((2, 1),),
        arm_cases=((0.125, 5.0, 0.05, 0.0),),
    ),
)  # fmt: skip


PLAIN = BulletSettings(iterations=100, friction_anchor=False)
"""Without the anchor, which covers up more than one bad setting."""


def run(*checks, settings=None, physics=None, make=make_engine):
    slip = SlipConfig(physics=physics or SlipPhysics())
    config = replace(SMALL, checks=checks, slip=slip)
    return validate(settings or BulletSettings(), config, make=make)


def failed(report):
    return {c.name for c in report.checks if not c.passed}


class StrongerEngine:
    """PyBullet whose fingers press half as hard again as they are told to."""

    def __init__(self, settings):
        self._engine = make_engine(settings)

    def __getattr__(self, name):
        return getattr(self._engine, name)

    def world(self, met, grips):
        stronger = replace(met.physics, force_n=1.5 * met.physics.force_n)
        return self._engine.world(replace(met, physics=stronger), grips)


# --- what must be green --------------------------------------------------------------------------


def test_the_shipped_settings_pass_a_small_suite():
    report = run("settings", "coulomb", "torque", "creep", "box", "capacity")
    assert report.passed, report.to_rows()
    assert {r.group for r in report.ratios} == {"coulomb", "torque"}


@pytest.mark.slow
def test_the_quick_suite_passes():
    told = Mock()
    report = validate(settings_of("mujoco"), ValidationConfig().quick(), told)
    assert failed(report) == set(), report.to_rows()
    assert [made.args[0] for made in told.mock_calls] == list(CHECKS)
    assert {c.group for c in report.checks} >= set(CHECKS) - {"replay"}
    assert picture(report)[:8] == b"\x89PNG\r\n\x1a\n"


# --- what must be red ----------------------------------------------------------------------------


def test_bare_fingers_fail_along_the_pad():
    report = run("coulomb", physics=SlipPhysics(pads=None))
    assert "coulomb limit, x" in failed(report)


def test_too_few_iterations_fail():
    assert failed(run("coulomb", settings=BulletSettings(iterations=10)))
    assert failed(run("box", settings=BulletSettings(iterations=10)))


def test_too_much_contact_damping_fails():
    assert failed(run("coulomb", settings=PLAIN)) == set()
    assert failed(run("coulomb", settings=replace(PLAIN, damping=1000.0)))


def test_a_friction_pyramid_fails_between_the_axes_alone(monkeypatch):
    original = BulletClient.__getattr__

    def pyramid(self, name):
        found = original(self, name)
        if name == "setPhysicsEngineParameter":
            return lambda **asked: found(**(asked | {"enableConeFriction": 0}))
        return found

    monkeypatch.setattr(BulletClient, "__getattr__", pyramid)
    assert failed(run("coulomb")) == {"coulomb limit, 45 deg"}


def test_a_wrong_force_fails_everywhere():
    found = failed(run("settings", "torque", make=StrongerEngine))
    assert {"settings read back", "finger force", "torque limit, spin"} <= found


def test_a_light_object_without_a_mass_floor_fails():
    assert failed(run("box", settings=PLAIN)) == set()
    report = run("box", settings=PLAIN, physics=SlipPhysics(mass_floor_kg=0.0))
    assert {"box 13 g, slip", "box 13 g, turn"} <= failed(report)


def test_soft_friction_in_mujoco_creeps():
    assert failed(run("creep", settings=MujocoSettings())) == set()
    report = run("creep", settings=MujocoSettings(creep_n_s_per_m=400.0))
    assert {"no creep", "no creeping turn", "no creep on a cylinder"} <= failed(report)


# --- the report ----------------------------------------------------------------------------------


def made(measured=1.0, limit=2.0, at_least=False, group="convergence"):
    return CheckResult(
        group=group, name="n", what="w", measured=measured, unit="mm", limit=limit,
        at_least=at_least,
    )  # fmt: skip


def report_of(*checks, ratios=()):
    return ValidationReport(
        engine="pybullet", version="3.2.7", settings={}, checks=checks, ratios=ratios, cpu_s=1.0
    )


def test_no_number_passes_no_limit():
    nan = float("nan")
    assert not made(nan).passed and not made(nan, at_least=True).passed
    assert made(2.0).passed and not made(2.1).passed and not made(math.inf).passed
    assert made(2.0, at_least=True).passed and not made(1.9, at_least=True).passed
    assert not report_of().passed
    assert not report_of(made(), made(3.0)).passed


def test_the_report_is_plain_json_and_a_table():
    ratio = LimitRatio(group="coulomb", load="x", case="c", held=0.9, slipped=math.inf)
    report = report_of(made(math.inf), made(0.5), ratios=(ratio,))
    plain = json.loads(json.dumps(report.to_json(), allow_nan=False))
    assert plain["passed"] is False and plain["checks"][0]["measured"] is None
    assert plain["ratios"][0]["slipped"] is None
    assert [row[0] for row in report.to_rows()] == ["FAIL", "pass"]
    assert report.to_rows()[1][2:4] == ("0.5 mm", "<= 2 mm")
    refused("no check 'x'", report.check, "x")


def test_parts_that_there_are_not_are_named():
    refused(r"no part 'friction'.*coulomb", run, "friction")
    refused("nothing to do", run)


# --- The limit surface that engines are judged by: its laws, and an independent lower bound.

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
