"""Antipodal candidates: their geometry, what is filtered, and that chance is the seed's alone."""

import numpy as np
import pytest

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.robots.hand import find_hand
from realsim.robots.robot_files import names_of
from realsim_sim_bridge.grasping.antipodal import RaySurface
from realsim_sim_bridge.grasping.candidates import (
    CandidateConfig,
    Surroundings,
    sample_candidates,
    standing_object,
)
from realsim_sim_bridge.grasping.force_closure import force_closure
from realsim_sim_bridge.grasping.hand_free import boxes_free, lowest_corner
from realsim_sim_bridge.grasping.pad_contacts import pad_heights
from trimesh_solids import box

HAND = find_hand()
CUBE = (0.05, 0.05, 0.05)


def candidates(mesh, height=0.025, seed=0, surroundings=None, limit=60, hand=HAND):
    return sample_candidates(
        mesh,
        se3.from_translation([0.0, 0.0, height]),
        surroundings or Surroundings(),
        CandidateConfig(surface_points=400),
        hand,
        np.random.default_rng(seed),
        limit,
    )


def test_contacts_lie_on_the_surface_and_inside_both_friction_cones():
    found = candidates(box(CUBE))
    assert 0 < len(found.widths_m) <= 60
    y, z = found.Ts_obj_grasp[:, :3, 1], found.Ts_obj_grasp[:, :3, 2]
    middle = found.Ts_obj_grasp[:, :3, 3] + found.contact_depths_m[:, None] * z
    for side in (-0.5, 0.5):
        contact = middle + side * found.widths_m[:, None] * y
        # On a box the outermost coordinate is the face's.
        assert np.allclose(np.abs(contact).max(axis=1), 0.025, atol=1e-6)
        face = np.argmax(np.abs(contact), axis=1)
        assert np.all(np.abs(np.take_along_axis(y, face[:, None], 1)) >= np.sqrt(0.5) - 1e-6)


@pytest.mark.parametrize("name", sorted(names_of("hand")))
def test_every_hand_s_pads_close_on_the_contacts(name):
    """The pads, where the law has them at that width, touch the faces; the linkage is free."""
    hand, mesh = find_hand(name), box(CUBE)
    found = candidates(mesh, hand=hand)
    assert len(found) > 20
    depths = found.contact_depths_m - hand.z_pad(found.widths_m)
    for depth in np.unique(depths.round(9)):
        assert np.abs(np.array([0.0, 0.003, 0.006]) - depth).min() < 1e-9
    closure = force_closure(
        mesh, found.Ts_obj_grasp, found.openings_m, None, hand,
        contact_depths_m=found.contact_depths_m,
    )  # fmt: skip
    width = np.linalg.norm(np.diff(closure.axis_contacts.points, axis=1)[:, 0], axis=-1)
    np.testing.assert_allclose(width, found.widths_m, atol=1e-6)
    surface = RaySurface(mesh)
    heights = pad_heights(surface, found.Ts_obj_grasp, found.openings_m, hand)
    facing = np.abs(found.Ts_obj_grasp[:, :3, 1]).max(axis=1) > 1 - 1e-9  # flat on both faces
    np.testing.assert_allclose(heights[facing], hand.z_pad(found.widths_m[facing]), atol=1e-4)
    corners = mesh.vertices
    bars = hand.bar_boxes(found.widths_m)
    assert boxes_free(bars, found.Ts_obj_grasp, corners, 0.0).all()


def test_each_filter_s_counts_add_up_to_what_came_in():
    near = standing_object(box(CUBE), se3.from_translation([0.09, 0.0, 0.025]), 1, 500)
    c = candidates(box((0.05, 0.05, 0.09)), height=0.045, surroundings=near).counts
    assert c["surface_points"] == c["points_without_pair"] + c["antipodal_points"] == 400
    assert c["exits"] == sum(
        c[k] for k in ("too_near", "too_wide", "outside_cone", "antipodal_pairs")
    )
    assert c["turned"] == CandidateConfig().rotations * c["antipodal_pairs"]
    assert c["turned"] == sum(
        c[k] for k in ("hand_in_table", "hand_in_object", "hand_in_neighbour", "free")
    )
    assert c["free"] == c["not_chosen"] + c["kept"] and c["kept"] == 60
    assert min(c[f"hand_in_{what}"] for what in ("table", "object", "neighbour")) > 0


def test_hands_are_free_of_table_object_and_neighbours():
    near = np.random.default_rng(0).uniform([0.05, -0.05, 0.0], [0.07, 0.05, 0.08], (2000, 3))
    neighbours = Surroundings(points=near, instances=np.ones(2000, dtype=np.int64))
    found = candidates(box(CUBE), surroundings=neighbours)
    assert found.counts["hand_in_neighbour"] > 0
    Ts = se3.from_translation([0.0, 0.0, 0.025]) @ found.Ts_obj_grasp
    boxes = HAND.boxes(found.openings_m)
    assert lowest_corner(boxes, Ts).min() > 0
    assert boxes_free(boxes, Ts, near, 0.0).all()


def test_boxes_free_agrees_with_looking_at_each_point():
    rng = np.random.default_rng(1)
    Ts, points = se3.random_transform(rng, 40, spread=0.05), rng.normal(scale=0.08, size=(60, 3))
    boxes = HAND.boxes(rng.uniform(0.0, 0.08, 40))
    local = np.stack([se3.transform(T, points) for T in se3.invert(Ts)])
    inside = (local[:, :, None] > boxes[:, None, :, 0] - 1e-3) & (
        local[:, :, None] < boxes[:, None, :, 1] + 1e-3
    )
    expected = ~inside.all(axis=-1).any(axis=(1, 2))
    assert np.array_equal(boxes_free(boxes, Ts, points, 1e-3), expected)
    assert 0 < expected.sum() < 40


def test_contacts_nearer_to_the_tips_let_the_fingers_clear_a_table():
    plate = box((0.04, 0.04, 0.02))
    T = se3.from_translation([0.0, 0.0, 0.01])
    found = {}
    for depths in ((0.0,), (0.0, 0.003, 0.006)):
        config = CandidateConfig(surface_points=300, contact_depths_m=depths)
        rng = np.random.default_rng(0)
        found[depths] = sample_candidates(plate, T, Surroundings(), config, HAND, rng, 10**6)
    centred, shifted = found.values()
    assert shifted.counts["free"] > 1.5 * centred.counts["free"]
    assert set(shifted.contact_depths_m.tolist()) == {0.0, 0.003, 0.006}
    # Who can stand centred does.
    assert np.sum(shifted.contact_depths_m == 0.0) == centred.counts["free"]


def test_a_thin_neighbour_that_points_miss_stops_the_hand_by_its_triangles():
    sheet = box((0.0004, 0.2, 0.2))
    T = se3.from_translation([0.04, 0.0, 0.1])
    exact = standing_object(sheet, T, 1, 4)
    points = Surroundings(points=exact.points[:4], instances=exact.instances[:4])
    with_triangles, with_points = (
        candidates(box(CUBE), surroundings=s).counts for s in (exact, points)
    )
    assert with_triangles["hand_in_neighbour"] > 1.3 * with_points["hand_in_neighbour"] > 0


def test_impossible_settings_are_named():
    for wrong in (
        {"surface_points": 0}, {"rotations": 0}, {"friction": float("nan")}, {"spread_m": 0.0},
        {"contact_depths_m": ()}, {"opening_margins_m": (0.001,)},
    ):  # fmt: skip
        with pytest.raises(InputError, match="candidates"):
            CandidateConfig(**wrong)
