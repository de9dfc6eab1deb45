"""The independent contact model: its laws, and what it must say where the answer is known."""

from dataclasses import replace

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.robots.hand import find_hand
from realsim_sim_bridge.slip.engines import MujocoSettings
from realsim_sim_bridge.slip.motion import SlipMotion
from realsim_sim_bridge.slip.slip_test import SlipConfig, run_slip_test
from realsim_sim_bridge.slip.stand import Stand
from realsim_sim_bridge.slip.world import Closing, Grips, Meeting, PadModel, SlipPhysics
from realsim_sim_bridge.validation.config import LabelConfig, ValidationConfig
from realsim_sim_bridge.validation.full_arm import carry_cube, stage_joints
from realsim_sim_bridge.validation.loads import hand_patch, hold, with_hand
from realsim_sim_bridge.validation.reference_contact import ReferenceEngine, ReferenceSettings
from realsim_sim_bridge.validation.reference_loops import closest
from realsim_sim_bridge.validation.slip_limits import press_checks
from realsim_sim_bridge.validation.specimens import (
    READY,
    cube,
    edge_trial,
    fits,
    frustum,
    panda,
    specimen,
)
from realsim_sim_bridge.validation.suite import peak_load, validate
from refusals import refused

HAND = find_hand()
MIRROR = np.diag([1.0, -1.0, 1.0])
EDGE = with_hand(SlipConfig.of(HAND), 20.0, 0.5)
GRIPS = Grips(
    Ts_table_grasp=np.eye(4)[None], Ts_obj_grasp=np.eye(4)[None], openings_m=np.array([0.06])
)


def closed(body, physics=EDGE.physics, settings=None):
    """Return a world of one hand that has closed on a body, with its origin between the pads."""
    world = ReferenceEngine(settings).world(Meeting(body, physics, HAND), GRIPS)
    world.close(Closing())
    return world


def slips_of(trial, settings=None):
    """Return the slips in stages of half the usual length."""
    motion = SlipMotion(lift_height_m=0.05, lift_s=0.5, oscillation_cycles=1, pendulum_s=1.8)
    engine = ReferenceEngine(settings)
    return run_slip_test(trial, replace(EDGE, motion=motion), None, HAND, engine)


def held_at(shares, load, limit, body, config):
    """Return whether each share of the limit (K,) moves the body by less than a millimetre."""
    loads = np.outer(np.array(shares) * limit, load)
    moved = hold(ReferenceEngine(), config, HAND, body, loads, ramp_s=0.1, hold_s=0.2)
    return moved.shift_m < 1e-3


# --- laws ----------------------------------------------------------------------------------------


def test_the_nearest_point_of_a_triangle_is_no_farther_than_any_other():
    rng = np.random.default_rng(0)
    shares = rng.dirichlet([0.5, 0.5, 0.5], 4000)
    for _ in range(200):
        triangle, p = rng.normal(size=(3, 3)), 2.0 * rng.normal(size=3)
        squared, found = closest(tuple(p), triangle)
        assert squared == pytest.approx(np.sum((p - found) ** 2))
        inside = np.linalg.solve(triangle.T, found)
        assert inside.min() > -1e-9 and inside.sum() == pytest.approx(1.0)
        sampled = np.linalg.norm(shares @ triangle - p, axis=1).min()
        assert np.sqrt(squared) - 1e-12 <= sampled < np.sqrt(squared) + 0.1


def test_no_sphere_takes_the_far_side_of_a_sharp_edge_for_its_own():
    # Beyond the wide rim of a cone, whose flank and end meet at 80 degrees, most faces see the
    # sphere's centre from below.
    trial = edge_trial("cone", 1.1, 12, 7, HAND, lean_deg=20.0).part(slice(6, 7))
    grips = trial.grips(EDGE.headroom_m)
    with ReferenceEngine().world(trial.met(EDGE.physics, HAND), grips) as world:
        world.close(Closing())
        assert world.deepest_m.max() < 1e-3


def test_energy_does_not_grow():
    world = closed(frustum(0.3, 8.0), settings=ReferenceSettings(damping=0.2))
    pushed = np.array([[3.0, 2.0, -4.0, 0.15, 0.1, -0.2]])
    world.put(replace(world.states(), twists=pushed))
    energies = []
    for _ in range(150):
        world.play(np.zeros((1, 1, 6)), 1, 1.0)
        energies.append(world.energy_j[0])
    lost = -np.diff(energies)
    assert lost.min() > -1e-4 * (energies[0] - energies[-1]) and lost.sum() > 5e-3


def test_what_the_fingers_give_is_what_the_object_takes():
    world = closed(cube(0.5))
    seen = world.play(np.tile([0.0, 0.0, 0.0, 2.0, 0.0, -3.0], (1, 400, 1)), 100, 1.0)
    # It rests: the friction of both fingers is the load, and they press as hard as they are driven.
    assert np.linalg.norm(world.states().twists) < 1e-5
    assert np.allclose(seen.finger_n[0, -1], 20.0, rtol=1e-4)
    sideways = np.tile([0.0, 0.0, 0.0, 0.0, 3.0, 0.0], (1, 400, 1))
    first, second = world.play(sideways, 400, 1.0).finger_n[0, -1]
    # The fingers are coupled: a load along y is carried by their difference, whatever they press.
    assert first - second == pytest.approx(3.0, rel=1e-3) and first + second == pytest.approx(40.0)


def test_a_mirrored_load_does_the_mirrored_thing():
    rng = np.random.default_rng(1)
    cone = frustum(0.5, 8.0)
    parts = tuple(p @ MIRROR for p in cone.parts)
    mirrored = replace(cone, parts=parts, inertia=MIRROR @ cone.inertia @ MIRROR)
    force, torque = 2.8 * rng.normal(size=3), 0.056 * rng.normal(size=3)
    ends, there = [], [*(-MIRROR @ torque), *(MIRROR @ force)]
    for body, load in ((cone, [*torque, *force]), (mirrored, there)):
        world = closed(body)
        world.play(np.tile(load, (1, 300, 1)), 300, 1.0)
        ends.append(world.states().Ts_world_body[0] @ se3.invert(body.principal_frame()[0]))
    flip = se3.from_rt(MIRROR, np.zeros(3))
    assert np.abs(ends[0] - np.eye(4)).max() > 1e-3
    assert np.allclose(flip @ ends[0] @ flip, ends[1], atol=1e-12)


def test_half_the_step_changes_nothing_that_counts():
    trial = edge_trial("cylinder", 0.8, 1, 7, HAND, lean_deg=20.0)
    coarse, fine = slips_of(trial), slips_of(trial, ReferenceSettings(step_s=12.5e-6))
    assert np.array_equal(coarse.passed, fine.passed)
    both = np.isfinite(coarse.slip_m)
    assert np.array_equal(both, np.isfinite(fine.slip_m))
    assert np.allclose(coarse.slip_m[both], fine.slip_m[both], rtol=0.02, atol=2e-5)


# --- known answers -------------------------------------------------------------------------------


@pytest.mark.parametrize(("force_n", "friction"), [(20.0, 0.25), (70.0, 1.0)])
def test_pulls_and_spins_slip_at_the_computed_limits(force_n, friction):
    config = with_hand(SlipConfig.of(HAND), force_n, friction)
    patch = hand_patch(PadModel().centers_xz(), force_n, friction)
    body = cube(np.clip(2.0 * friction * force_n / 20.0, 0.05, 2.0))
    for angle in (0.0, 0.7, np.pi / 2):
        load = np.array([0.0, 0.0, 0.0, np.cos(angle), 0.0, np.sin(angle)])
        limit = patch.slip_load([0.0, np.cos(angle), np.sin(angle)])
        assert held_at([0.98, 1.02], load, limit, body, config).tolist() == [True, False]
    aside = np.array([0.0, 0.03, 0.0, 0.0, 0.0, -1.0])
    limit = patch.slip_load([-0.03, 0.0, -1.0])
    assert held_at([0.97, 1.05], aside, limit, body, config).tolist() == [True, False]


def test_the_pads_are_as_stiff_as_they_are_said_to_be():
    (check,) = press_checks(ReferenceEngine(), ValidationConfig.of(HAND))
    assert check.measured < 0.01, check.detail


@pytest.mark.parametrize(("half_angle_deg", "stays"), [(13.0, True), (15.0, False)])
def test_a_cone_is_squeezed_out_where_its_flank_leans_beyond_friction(half_angle_deg, stays):
    # atan(0.25) is 14.04 degrees; the narrow end is at the palm, the cone leaves along z.
    cone = frustum(0.3, half_angle_deg)
    world = closed(cone, replace(EDGE.physics, friction=0.25))
    world.play(np.zeros((1, 300, 6)), 300, 1.0)
    moved = world.states().Ts_world_body[0, 2, 3] - cone.center_of_mass[2]
    assert moved < 2e-4 if stays else moved > 4e-3


def test_a_ball_rolls_between_flat_pads_and_does_not_slip_along_them():
    along = np.array([0.0, 0.0, 0.0, 0.0, 0.0, -1.0])
    # The spheres' normals lean by 12 degrees: they carry 2 mu F and a little more.
    held = held_at([0.8, 1.5], along, 20.0, specimen("ball", 0.2), EDGE)
    assert held.tolist() == [True, False]


def test_no_pads_a_flat_part_and_a_table_are_named():
    world, bare = ReferenceEngine().world, SlipPhysics(pads=None)
    refused(r"sphere pads.*PadModel\.of", world, Meeting(cube(0.1), bare, HAND), GRIPS)
    stand = Stand(height_m=0.0, friction=0.4, gravity=9.81)
    refused("free objects", world, Meeting(cube(0.1), EDGE.physics, HAND, stand), GRIPS)
    flat = replace(cube(0.1), parts=(np.eye(4)[:, :3] * [1.0, 1.0, 0.0],))
    refused("has no volume", world, Meeting(flat, EDGE.physics, HAND), GRIPS)


# --- The suite's specimens, its loads, and the arm that carries a cube.


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


@pytest.mark.parametrize("shape", LabelConfig().shapes)
def test_grasps_on_the_edge_fit_the_hand_and_do_not_hang_on_the_mass(shape):
    light, heavy = (edge_trial(shape, mass, 5, 7, HAND) for mass in (0.01, 2.0))
    assert np.array_equal(light.Ts_obj_grasp, heavy.Ts_obj_grasp)
    assert heavy.body.mass_kg == pytest.approx(2.0)
    corners = np.concatenate(light.body.parts)
    for T in light.Ts_obj_grasp:
        seen = se3.transform(se3.invert(T), corners)
        assert np.abs(seen[:, 1]).max() < HAND.max_opening_m / 2
        assert seen[:, 2].min() > HAND.palm_face_z_m
    beside = edge_trial(shape, 0.01, 5, 7, HAND, shift_m=5e-5)
    moved = np.linalg.norm((beside.Ts_obj_grasp - light.Ts_obj_grasp)[:, :3, 3], axis=1)
    assert np.allclose(moved, 5e-5)


def test_a_shape_too_large_for_the_hand_is_named_and_not_looked_for_without_end():
    narrow = replace(find_hand("parallel"), max_opening_m=0.06)
    assert not fits("cone", narrow) and fits("ball", narrow)
    refused(r"(?s)cone.*64 mm wide.*opens 60 mm", edge_trial, "cone", 1.0, 1, 7, narrow)
    refused(r"cone.*opens 80 mm", edge_trial, "cone", 1.0, 1, 7, find_hand(), lean_deg=1.0)


def test_the_suite_names_a_hand_that_does_not_open_wide_enough_for_its_cube():
    narrow = replace(find_hand("parallel"), max_opening_m=0.05)
    said = r"cube of 50 mm.*opens 50 mm only.*58 mm or more"
    refused(said, validate, MujocoSettings(), ValidationConfig.of(narrow))


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
    assert np.all(np.delete(swing - READY, 4, axis=1) == 0.0)
    assert np.degrees(np.ptp(swing[:, 4])) == pytest.approx(2 * motion.pendulum_deg, abs=0.1)


@pytest.mark.slow
def test_the_arm_carries_what_the_hand_holds():
    held = carry_cube(0.125, np.eye(4), with_hand(SlipConfig(), 10.0, 0.3), find_hand())
    assert held.passed and held.tracking_rad < np.radians(0.5)
    assert held.slip_m.max() < 2e-3 and np.degrees(held.slip_rad.max()) < 1.0
