"""The suite's specimens, its loads, and the arm that carries a cube."""

from dataclasses import replace

import numpy as np
import pytest

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.robots.hand import find_hand
from realsim_sim_bridge.slip.engines import MujocoSettings
from realsim_sim_bridge.slip.motion import SlipMotion
from realsim_sim_bridge.slip.slip_test import SlipConfig
from realsim_sim_bridge.validation.config import LabelConfig, ValidationConfig
from realsim_sim_bridge.validation.full_arm import carry_cube, stage_joints
from realsim_sim_bridge.validation.known_outcomes import peak_load
from realsim_sim_bridge.validation.loads import with_hand
from realsim_sim_bridge.validation.specimens import READY, edge_trial, fits, panda, specimen
from realsim_sim_bridge.validation.suite import validate
from refusals import refused

SHAPES = LabelConfig().shapes


def test_two_parts_have_the_moments_of_the_whole():
    body = specimen("l_shape", 1.0)
    rng = np.random.default_rng(0)
    low = np.stack([p.min(axis=0) for p in body.parts])
    high = np.stack([p.max(axis=0) for p in body.parts])
    volumes = np.prod(high - low, axis=1)
    which = rng.choice(2, size=400_000, p=volumes / volumes.sum())
    points = rng.uniform(low[which], high[which]) - body.center_of_mass
    assert np.allclose(points.mean(axis=0), 0.0, atol=2e-4)
    second = points.T @ points / len(points)
    assert np.allclose(body.inertia, np.trace(second) * np.eye(3) - second, atol=6e-6)


@pytest.mark.parametrize("shape", SHAPES)
def test_grasps_on_the_edge_fit_the_hand_and_do_not_hang_on_the_mass(shape):
    hand = find_hand()
    light, heavy = edge_trial(shape, 0.01, 5, 7, hand), edge_trial(shape, 2.0, 5, 7, hand)
    assert np.array_equal(light.Ts_obj_grasp, heavy.Ts_obj_grasp)
    assert heavy.body.mass_kg == pytest.approx(2.0)
    corners = np.concatenate(light.body.parts)
    for T in light.Ts_obj_grasp:
        seen = se3.transform(se3.invert(T), corners)
        assert np.abs(seen[:, 1]).max() < hand.max_opening_m / 2
        assert seen[:, 2].min() > hand.palm_face_z_m
    beside = edge_trial(shape, 0.01, 5, 7, hand, shift_m=5e-5)
    moved = np.linalg.norm((beside.Ts_obj_grasp - light.Ts_obj_grasp)[:, :3, 3], axis=1)
    assert np.allclose(moved, 5e-5)


def test_a_shape_too_large_for_the_hand_is_named_and_not_looked_for_without_end():
    narrow = replace(find_hand("parallel"), max_opening_m=0.06)
    assert not fits("cone", narrow) and fits("ball", narrow)
    refused(r"(?s)cone.*64 mm wide.*opens 60 mm", edge_trial, "cone", 1.0, 1, 7, narrow)
    refused(r"cone.*opens 80 mm", edge_trial, "cone", 1.0, 1, 7, find_hand(), lean_deg=1.0)


def test_the_suite_names_a_hand_that_does_not_open_wide_enough_for_its_cube():
    narrow = replace(find_hand("parallel"), max_opening_m=0.05)
    with pytest.raises(InputError, match=r"cube of 50 mm.*opens 50 mm only.*58 mm or more"):
        validate(MujocoSettings(), ValidationConfig.of(narrow))


def test_a_shape_that_there_is_not_is_named():
    refused(r"no specimen 'torus'.*wedge", specimen, "torus", 1.0)


def test_the_peak_load_is_what_lift_and_oscillation_ask_for():
    motion = SlipMotion()
    shake = motion.oscillation_m * (2 * np.pi * motion.oscillation_hz) ** 2
    lift = 9.81 + 5.7735 * motion.lift_height_m / motion.lift_s**2
    assert peak_load(2.0, motion) == pytest.approx(2.0 * max(np.hypot(9.81, shake), lift), rel=1e-4)


def test_joint_paths_carry_the_hand_as_the_stages_do():
    motion, dt = SlipMotion(), 0.01
    start = panda().forward(READY)
    lift = panda().forward(stage_joints(1, READY, motion, dt))
    assert np.allclose(lift[-1, :3, 3] - start[:3, 3], [0, 0, motion.lift_height_m], atol=1e-4)
    assert np.allclose(lift[:, :3, :3], start[:3, :3], atol=1e-3)
    shake = panda().forward(stage_joints(2, READY, motion, dt))[:, :3, 3] - start[:3, 3]
    ends = [2 * motion.oscillation_m, 2 * motion.oscillation_m, 0.0]
    assert np.allclose(np.ptp(shake, axis=0), ends, atol=1e-3)
    swing = stage_joints(3, READY, motion, dt)
    assert np.array_equal(
        np.delete(swing, 4, axis=1), np.tile(np.delete(READY, 4), (len(swing), 1))
    )
    assert np.degrees(np.ptp(swing[:, 4])) == pytest.approx(2 * motion.pendulum_deg, abs=0.1)


@pytest.mark.slow
def test_the_arm_carries_what_the_hand_holds():
    held = carry_cube(0.125, np.eye(4), with_hand(SlipConfig(), 10.0, 0.3), find_hand())
    assert held.passed and held.tracking_rad < np.radians(0.5)
    assert held.slip_m.max() < 2e-3 and np.degrees(held.slip_rad.max()) < 1.0
