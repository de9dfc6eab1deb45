"""The validation suite: green at the settings that ship, red at every bad one that is known."""

import json
import math
from dataclasses import replace

import pytest

from realsim_sim_bridge.slip.engines import BulletSettings, MujocoSettings, make_engine, settings_of
from realsim_sim_bridge.slip.slip_test import SlipConfig
from realsim_sim_bridge.slip.world import SlipPhysics
from realsim_sim_bridge.validation.config import (
    CHECKS,
    LabelConfig,
    LimitConfig,
    StageConfig,
    ValidationConfig,
)
from realsim_sim_bridge.validation.report import CheckResult, LimitRatio, ValidationReport, picture
from realsim_sim_bridge.validation.suite import validate
from refusals import refused

SMALL = ValidationConfig(
    limits=LimitConfig(
        cases=((20.0, 0.25),),
        directions_deg=(0.0, 45.0, 90.0),
        coulomb_shares=(0.9, 0.97, 1.03, 1.1),
        torque_cases=((20.0, 0.25),),
        torque_shares=(0.9, 1.1),
        arms_m=(0.03,),
        creep_s=1.0,
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


@pytest.fixture
def told_otherwise(monkeypatch):
    """Make PyBullet take engine parameters besides those it is given."""
    from pybullet_utils.bullet_client import BulletClient

    def tell(**more):
        original = BulletClient.__getattr__

        def attribute(self, name):
            found = original(self, name)
            if name == "setPhysicsEngineParameter":
                return lambda **asked: found(**(asked | more))
            return found

        monkeypatch.setattr(BulletClient, "__getattr__", attribute)

    return tell


class StrongerEngine:
    """PyBullet whose fingers press half as hard again as they are told to."""

    def __init__(self, settings):
        self._engine = make_engine(settings)

    def __getattr__(self, name):
        return getattr(self._engine, name)

    def world(self, body, grips, physics, geometry, stand=None):
        stronger = replace(physics, force_n=1.5 * physics.force_n)
        return self._engine.world(body, grips, stronger, geometry, stand)


# --- what must be green --------------------------------------------------------------------------


def test_the_shipped_settings_pass_a_small_suite():
    report = run("settings", "coulomb", "torque", "creep", "box", "capacity")
    assert report.passed, report.to_rows()
    assert {r.group for r in report.ratios} == {"coulomb", "torque"}


@pytest.mark.slow
def test_the_quick_suite_passes():
    pytest.importorskip("mujoco")
    told = []
    report = validate(
        settings_of("mujoco"), ValidationConfig().quick(), lambda *progress: told.append(progress)
    )
    assert failed(report) == set(), report.to_rows()
    assert [t[0] for t in told] == list(CHECKS)
    groups = {c.group for c in report.checks}
    assert groups >= set(CHECKS) - {"replay"}
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


def test_a_friction_pyramid_fails_between_the_axes_alone(told_otherwise):
    told_otherwise(enableConeFriction=0)
    assert failed(run("coulomb")) == {"coulomb limit, 45 deg"}


def test_a_wrong_force_fails_everywhere():
    found = failed(run("settings", "torque", make=StrongerEngine))
    assert {"settings read back", "finger force", "torque limit, spin"} <= found


def test_a_light_object_without_a_mass_floor_fails():
    assert failed(run("box", settings=PLAIN)) == set()
    report = run("box", settings=PLAIN, physics=SlipPhysics(mass_floor_kg=0.0))
    assert {"box 13 g, slip", "box 13 g, turn"} <= failed(report)


def test_soft_friction_in_mujoco_creeps():
    pytest.importorskip("mujoco")
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
