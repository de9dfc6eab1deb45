"""Analytic labels: what closes, what the gripper hits, and how few of many are chosen."""

from dataclasses import replace

import numpy as np
import pytest

from realsim.formats.graspnet import gripper_frame as frame
from realsim.geometry import se3
from realsim.robots.hand import find_hand
from realsim_sim_bridge.grasping.analytic import (
    AnalyticConfig,
    analytic_labels,
    gripper_boxes,
    select_rows,
)
from realsim_sim_bridge.grasping.analytic_given import given_candidates, standing_labels
from realsim_sim_bridge.grasping.candidates import CandidateConfig, Surroundings
from realsim_sim_bridge.grasping.force_closure import ClosureConfig, force_closure
from tried_grasps import assert_same
from trimesh_solids import ball, box, wedge

HAND = find_hand()
FEW = AnalyticConfig(points=12)
BOX = box((0.04, 0.06, 0.1))


def labels_of(mesh, config=FEW, seed=0):
    return analytic_labels(mesh, np.random.default_rng(seed), config)


@pytest.fixture(scope="module")
def of_box():
    return BOX, labels_of(BOX)


# --- laws -------------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_labels(of_box):
    mesh, labels = of_box
    assert_same(labels_of(mesh), labels)


@pytest.mark.parametrize("mesh", [replace(BOX, faces=BOX.faces[:, ::-1]), ball(0.03, 3)])
def test_the_friction_is_that_of_the_measure_closure_friction(mesh):
    """Two ways to the same number: rays of 14,400 lines a point, and the hand's closing axis."""
    labels = labels_of(mesh)
    some = labels.rows(np.arange(0, len(labels), max(1, len(labels) // 300)))
    config, openings = ClosureConfig(levels=AnalyticConfig().levels), some.openings_m.astype(float)
    closure = force_closure(mesh, some.Ts_obj_grasp(), openings, config, HAND)
    same = np.abs(closure.closure_friction - some.friction) < 1e-6
    # Lines along an edge meet the one or the other face.
    assert len(some) > 50 and same.mean() > 0.97


# --- known answers ----------------------------------------------------------------------------


def test_what_closes_on_a_wedge_needs_the_friction_of_its_slopes():
    """A line across slopes at +-a, itself tilted by any angle, written out by hand."""
    half_angle = 0.25
    labels = labels_of(wedge(half_angle), AnalyticConfig(points=30))
    Ts = labels.Ts_obj_grasp()
    middle, y = Ts[:, :3, 3], Ts[:, :3, 1]
    y = y * np.sign(y[:, 1:2])
    needed, on_slopes = [], np.ones(len(y), dtype=bool)
    for side in (1, -1):
        n = np.array([-np.sin(half_angle), side * np.cos(half_angle), 0.0])
        edge = np.array([-0.02, side * 0.008, 0.0])
        with np.errstate(divide="ignore"):
            contact = middle + ((edge - middle) @ n / (y @ n))[:, None] * y
        on_slopes &= (np.abs(contact[:, 0]) < 0.0199) & (np.abs(contact[:, 2]) < 0.0299)
        needed.append(np.tan(np.arccos(np.clip(side * (y @ n), -1, 1))))
    needed = np.max(needed, axis=0)[on_slopes]
    level = np.ceil(needed * 10 - 1e-4) / 10
    assert on_slopes.sum() > 200 and needed.min() >= np.tan(half_angle) - 1e-6
    np.testing.assert_allclose(labels.friction[on_slopes], level, atol=1e-6)


def test_a_box_that_nothing_can_hold_has_no_label():
    labels = labels_of(box((0.3, 0.3, 0.3)))
    assert len(labels) == 0 and len(labels.points) == 12
    assert len(select_rows(labels, 10, np.random.default_rng(0))) == 0


def test_graspnets_gripper_has_the_boxes_of_its_collision_check():
    boxes = gripper_boxes(np.array([0.03]), np.array([0.05]))[0]
    np.testing.assert_allclose(boxes[0], [[-0.03, -0.035, -0.01], [-0.02, 0.035, 0.01]])
    np.testing.assert_allclose(boxes[1], [[-0.02, -0.035, -0.01], [0.03, -0.025, 0.01]])
    np.testing.assert_allclose(boxes[2], [[-0.02, 0.025, -0.01], [0.03, 0.035, 0.01]])


def test_a_palm_in_the_object_collides_with_it():
    """Wherever one of a dozen points of the gripper is in the box, the label says so."""
    half = np.array([0.03, 0.1, 0.1])
    labels = labels_of(box(2 * half))
    Ts = frame.graspnet_poses(labels.Ts_obj_grasp(), labels.depths_m)
    boxes = gripper_boxes(labels.depths_m.astype(float), labels.openings_m.astype(float))
    at = np.array([[a, b, c] for a in (0.1, 0.5, 0.9) for b in (0.1, 0.9) for c in (0.2, 0.8)])
    p = boxes[:, :, :1] + at * (boxes[:, :, 1:] - boxes[:, :, :1])
    inside = np.all(np.abs(se3.transform(Ts, p.reshape(len(Ts), -1, 3))) < half, axis=-1).any(1)
    assert inside.sum() > 100 and labels.collision[inside].all()
    assert (~labels.collision).sum() > 20


# --- the choice -------------------------------------------------------------------------------


def test_the_choice_is_free_spread_and_of_every_level(of_box):
    labels = of_box[1]
    rows = select_rows(labels, 60, np.random.default_rng(1))
    few = labels.rows(select_rows(labels, 60, np.random.default_rng(1)))
    assert len(few) == 60
    np.testing.assert_array_equal(few.index, labels.index[rows])
    np.testing.assert_array_equal(few.friction, labels.friction[rows])
    assert not labels.collision[rows].any()
    there = np.unique(labels.friction[~labels.collision])
    shares = [np.sum(labels.friction[rows] == f) for f in there]
    assert min(shares) >= min(4, 60 // len(there))
    chance = np.random.default_rng(2).choice(np.flatnonzero(~labels.collision), 60)

    def nearest(Ts):
        d = np.linalg.norm(Ts[:, None, :3, 3] - Ts[None, :, :3, 3], axis=-1)
        return np.median((d + np.eye(len(d))).min(axis=1))

    Ts = labels.Ts_obj_grasp()
    assert nearest(Ts[rows]) > 1.3 * nearest(Ts[chance])


# --- given grasps -----------------------------------------------------------------------------


def standing(mesh):
    return se3.from_translation([0.3, 0.1, -mesh.vertices[:, 2].min()])


def test_given_grasps_keep_their_contacts_and_their_friction(of_box):
    mesh, labels = of_box
    given = labels.rows(select_rows(labels, 80, np.random.default_rng(0)))
    Ts = given.Ts_obj_grasp()
    alone, config = Surroundings(), CandidateConfig()
    found, rows = given_candidates(mesh, standing(mesh), alone, Ts, config, HAND)
    counts = found.counts
    taken = ("without_contacts", "too_near", "too_wide", "hand_in_table", "hand_in_object",
             "hand_in_neighbour", "free")  # fmt: skip
    assert counts["given"] == 80 == sum(counts[name] for name in taken)
    assert len(rows) == counts["kept"] > 5
    closure = force_closure(
        mesh, found.Ts_obj_grasp, found.openings_m, ClosureConfig(levels=FEW.levels), HAND,
        contact_depths_m=found.contact_depths_m,
    )  # fmt: skip
    same = np.abs(closure.closure_friction - given.friction[rows]) < 1e-6
    assert same.mean() > 0.95
    middle = closure.axis_contacts.points.mean(axis=1)
    off = np.sum((middle - found.Ts_obj_grasp[:, :3, 3]) * found.Ts_obj_grasp[:, :3, 1], axis=1)
    assert np.abs(off).max() < 1e-6  # both fingers touch at once
    np.testing.assert_allclose(found.Ts_obj_grasp[:, :3, :3], Ts[rows, :3, :3], atol=1e-12)


def test_labels_that_stand_are_those_the_hand_can_take(of_box):
    mesh, labels = of_box
    T = standing(mesh)
    config, rng = CandidateConfig(), np.random.default_rng(0)
    found = standing_labels(labels, mesh, T, Surroundings(), config, HAND, rng)
    assert 20 < len(found) < (~labels.collision).sum() and not found.collision.any()
    Ts = found.rows(select_rows(found, 40, rng)).Ts_obj_grasp()
    again, rows = given_candidates(mesh, T, Surroundings(), Ts, config, HAND)
    assert len(rows) == len(Ts) == 40
    lowest = np.min((T @ again.Ts_obj_grasp)[:, 2, 3])
    assert lowest > 0 and again.counts["hand_in_table"] == 0
