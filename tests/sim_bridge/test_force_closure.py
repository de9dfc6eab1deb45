"""Analytic grasp quality: contacts, friction levels, and the largest ball of wrenches.

Antipodal pairs of closed, open, noisy and double surfaces; hands that are free of them.
"""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from real_data import DATA, needs
from realsim.geometry import se3
from realsim.geometry.mesh import merged
from realsim.records import Mesh
from realsim.robots.hand import find_hand
from realsim.robots.robot_files import names_of
from realsim_sim_bridge.grasping.antipodal import RaySurface, antipodal_pairs
from realsim_sim_bridge.grasping.candidates import (
    IN_OBJECT,
    CandidateConfig,
    HandPoses,
    Stand,
    Surroundings,
    sample_candidates,
    standing_object,
)
from realsim_sim_bridge.grasping.force_closure import (
    ClosureConfig,
    finger_wrenches,
    force_closure,
    largest_balls,
)
from realsim_sim_bridge.grasping.hand_free import boxes_free, lowest_corner
from realsim_sim_bridge.grasping.pad_contacts import pad_contacts, pad_heights
from realsim_sim_bridge.grasping.surroundings import hands_free, surface_tree
from refusals import refused
from trimesh_solids import ball, box, cup, wedge

HAND = find_hand()
CUBE = (0.05, 0.05, 0.05)


def candidates(mesh, height=0.025, surroundings=None, hand=HAND, count=60, **config):
    """Return grasps of an object whose origin is at a height over the table [m]."""
    T, config = se3.from_translation([0.0, 0.0, height]), {"surface_points": 400} | config
    around, rng = surroundings or Surroundings(), np.random.default_rng(0)
    return sample_candidates(mesh, T, around, CandidateConfig(**config), hand, rng, count)


def random_contacts(n, seed):
    """Return grasps of which some have force closure and others none, as `largest_balls` takes."""
    rng = np.random.default_rng(seed)
    points = 0.5 * rng.normal(size=(n, 2, 3))
    points[:, 1] = -points[:, 0] + 0.2 * rng.normal(size=(n, 3))
    normals = -points / np.linalg.norm(points, axis=-1, keepdims=True)
    normals = normals + 0.4 * rng.normal(size=(n, 2, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return points, normals, rng.normal(size=(n, 3)), rng.uniform(0.05, 0.3, (n, 2))


def test_nothing_changes_when_object_and_grasps_move_together():
    mesh = cup()
    found = candidates(mesh, -mesh.vertices[:, 2].min(), count=80, surface_points=200)
    Ts, openings = found.Ts_obj_grasp, found.openings_m
    T = se3.exp([0.8, -0.3, 1.1, 0.2, -0.1, 0.3])
    here = force_closure(mesh, Ts, openings)
    turned = replace(mesh, vertices=se3.transform(T, mesh.vertices))
    there = force_closure(turned, T @ Ts, openings)
    # Rays have single precision: at the rim of a pad one may fall off an edge.
    same = np.isclose(here.ferrari_canny, there.ferrari_canny, atol=1e-5)
    assert len(same) == 80 and np.mean(same) >= 0.9
    # The needed friction turns with the mean of what touches, so it moves a little more.
    assert np.mean(np.isclose(here.needed_friction, there.needed_friction, atol=1e-4)) >= 0.85
    assert np.mean(here.dexnet_closure == there.dexnet_closure) >= 0.98


def test_quality_grows_with_friction_and_with_torsion():
    points, normals, tangents, torsions = random_contacts(200, 1)
    grasps = (points, normals, tangents)
    by_friction = [largest_balls(*grasps, mu, torsions, 8) for mu in (0.3, 0.6, 1)]
    assert np.all(np.diff(by_friction, axis=0) >= -1e-12)
    assert np.sum(by_friction[-1] > by_friction[0] + 1e-6) > 50
    less = largest_balls(*grasps, 1.0, 0.5 * torsions, 8)
    assert np.all(less <= by_friction[-1] + 1e-12) and np.any(less < by_friction[-1] - 1e-3)


def test_the_quality_is_the_hull_s_by_qhull():
    from scipy.spatial import ConvexHull

    contacts = random_contacts(120, 0)
    for friction, edges in ((0.7, 8), (0.6, 4), (1.0, 12)):
        args = (*contacts[:3], friction, contacts[3], edges)
        corners = finger_wrenches(*args).reshape(120, -1, 6)
        expected = [max(0.0, -ConvexHull(c).equations[:, -1].max()) for c in corners]
        assert np.allclose(largest_balls(*args), expected, atol=1e-10)
        assert 10 < np.count_nonzero(expected) < 110


@pytest.mark.parametrize("friction", [1.0, 0.5])
def test_a_centred_grasp_of_a_cube_has_the_quality_of_the_formula(friction):
    """Torsion (gamma) and the friction of both fingers at their arm (r) share the normal force."""
    config = ClosureConfig(friction=friction)
    closure = force_closure(box(CUBE), np.eye(4)[None], np.array([0.06]), config)
    length = np.sqrt(3) * 0.025
    gamma = friction * closure.contacts.levers_m[0, 0] / length
    r = friction * np.cos(np.pi / 8) * 0.025 / length
    assert closure.ferrari_canny[0] == pytest.approx(1 / np.hypot(1 / gamma, 1 / r), rel=1e-4)


def test_the_lever_of_a_pad_on_a_flat_face_is_that_of_an_evenly_loaded_patch():
    contacts = pad_contacts(
        RaySurface(box(CUBE)), np.eye(4)[None], np.array([0.06]), HAND, rays=7, softness_m=5e-4
    )
    xz = np.random.default_rng(0).uniform(-0.5, 0.5, (200000, 2)) * [0.02, 0.0176]
    assert contacts.levers_m == pytest.approx(np.linalg.norm(xz, axis=1).mean(), rel=0.02)
    assert np.allclose(contacts.points[0], [[0, -0.025, 0], [0, 0.025, 0]], atol=1e-7)
    assert np.allclose(contacts.normals[0], [[0, -1, 0], [0, 1, 0]])


@pytest.mark.parametrize("angle_deg", [15, 40])
def test_a_wedge_closes_from_the_tangent_of_its_half_angle_on(angle_deg):
    mesh, tangent = wedge(np.radians(angle_deg), 0.06, 0.01, 0.02), np.tan(np.radians(angle_deg))
    T, opening = np.eye(4)[None], np.array([0.08])
    for friction, closes in ((tangent - 0.001, False), (tangent + 0.001, True)):
        closure = force_closure(mesh, T, opening, ClosureConfig(friction=friction))
        assert closure.dexnet_closure[0] == closes
        # A corner of the polygon in the cone points along the slope, so it is not narrower there.
        assert (closure.ferrari_canny[0] > 0) == closes
    assert closure.needed_friction[0] == pytest.approx(tangent, abs=1e-4)
    levels = np.array([0.2, 0.4, 0.6, 0.8, 1.0, 1.2])
    assert closure.closure_friction[0] == levels[levels >= tangent - 1e-6].min()


def test_a_finger_that_touches_nothing_closes_nothing():
    Ts = np.stack([np.eye(4), se3.from_translation([0.0, 0.0, 0.2])])
    closure = force_closure(box(CUBE), Ts, np.array([0.06, 0.06]))
    assert closure.contacts.both.tolist() == [True, False]
    assert closure.axis_contacts.both.tolist() == [True, False]
    assert np.isnan(closure.contacts.points[1]).all()
    assert closure.ferrari_canny[1] == 0 and closure.dexnet_closure[1] == 0
    assert np.isinf(closure.closure_friction[1]) and np.isinf(closure.needed_friction[1])


def test_impossible_input_is_named():
    refused("2 openings for 1 grasps", force_closure, box(CUBE), np.eye(4)[None], np.zeros(2))
    for change in ({"friction": 0.0}, {"cone_edges": 6}, {"levels": (0.2, -1.0)}, {"pad_rays": 0}):
        refused("force closure", replace, ClosureConfig(), **change)
    flat = Mesh(vertices=np.eye(3), faces=np.array([[0, 1, 2]]))
    refused("flat", force_closure, flat, np.eye(4)[None], np.array([0.06]))


# --- Antipodal candidates: their geometry, what is filtered, and that chance is the seed's alone.


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
    bars = hand.bar_boxes(found.widths_m)
    assert boxes_free(bars, found.Ts_obj_grasp, mesh.vertices, 0.0).all()


def test_each_filter_s_counts_add_up_to_what_came_in():
    near = standing_object(box(CUBE), se3.from_translation([0.09, 0.0, 0.025]), 1, 500)
    c = candidates(box((0.05, 0.05, 0.09)), height=0.045, surroundings=near).counts
    assert c["surface_points"] == c["points_without_pair"] + c["antipodal_points"] == 400
    exits = ("too_near", "too_wide", "outside_cone", "antipodal_pairs")
    assert c["exits"] == sum(c[k] for k in exits)
    assert c["turned"] == CandidateConfig().rotations * c["antipodal_pairs"]
    stopped = [c[f"hand_in_{what}"] for what in ("table", "object", "neighbour")]
    assert c["turned"] == sum(stopped) + c["free"] and min(stopped) > 0
    assert c["free"] == c["not_chosen"] + c["kept"] and c["kept"] == 60


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
    low, high = boxes[:, None, :, 0] - 1e-3, boxes[:, None, :, 1] + 1e-3
    inside = (local[:, :, None] > low) & (local[:, :, None] < high)
    expected = ~inside.all(axis=-1).any(axis=(1, 2))
    assert np.array_equal(boxes_free(boxes, Ts, points, 1e-3), expected)
    assert 0 < expected.sum() < 40


def test_contacts_nearer_to_the_tips_let_the_fingers_clear_a_table():
    plate, few = box((0.04, 0.04, 0.02)), {"surface_points": 300, "count": 10**6}
    centred, shifted = (
        candidates(plate, 0.01, contact_depths_m=depths, **few)
        for depths in ((0.0,), (0.0, 0.003, 0.006))
    )
    assert shifted.counts["free"] > 1.5 * centred.counts["free"]
    assert set(shifted.contact_depths_m.tolist()) == {0.0, 0.003, 0.006}
    # Who can stand centred does.
    assert np.sum(shifted.contact_depths_m == 0.0) == centred.counts["free"]


def test_a_thin_neighbour_that_points_miss_stops_the_hand_by_its_triangles():
    sheet = box((0.0004, 0.2, 0.2))
    T = se3.from_translation([0.04, 0.0, 0.1])
    exact = standing_object(sheet, T, 1, 4)
    points = Surroundings(points=exact.points[:4], instances=exact.instances[:4])
    by_triangles, by_points = (
        candidates(box(CUBE), surroundings=s).counts["hand_in_neighbour"] for s in (exact, points)
    )
    assert by_triangles > 1.3 * by_points > 0


def test_impossible_settings_are_named():
    for wrong in (
        {"surface_points": 0}, {"rotations": 0}, {"friction": float("nan")}, {"spread_m": 0.0},
        {"contact_depths_m": ()}, {"opening_margins_m": (0.001,)},
    ):  # fmt: skip
        refused("candidates", CandidateConfig, **wrong)


# --- pairs of closed, open, noisy and double surfaces ---------------------------------------------


CONFIG = CandidateConfig(surface_points=500)
MUG = DATA / "school/acronym_mug"


def pairs_of(mesh, config=CONFIG, max_width=0.078, seed=0):
    counts = {}
    rng = np.random.default_rng(seed)
    return antipodal_pairs(RaySurface(mesh), config, max_width, rng, counts), counts


def test_both_ends_lie_on_the_surface_and_the_line_is_inside_both_cones():
    pairs, _ = pairs_of(ball(0.03, 5))
    assert np.allclose(np.linalg.norm(pairs.points, axis=-1), 0.03, atol=1e-4)
    line = pairs.points[:, 1] - pairs.points[:, 0]
    line = line / pairs.widths_m[:, None]
    for end, sign in ((0, -1.0), (1, 1.0)):
        assert np.all(np.sum(pairs.normals[:, end] * line, axis=1) * sign > np.sqrt(0.5) - 1e-2)


def test_pairs_turn_with_the_mesh():
    mesh, T = cup(), se3.exp([0.4, -1.0, 0.7, 0.1, 0.2, -0.3])
    # Only the rays along the normal: the random ones start from axes of the frame.
    first = replace(CONFIG, rays_per_point=1)
    turned = replace(mesh, vertices=se3.transform(T, mesh.vertices))
    a, b = (pairs_of(m, first)[0] for m in (mesh, turned))
    # Rays have single precision: of pairs at the edge of a triangle a few may differ.
    assert abs(len(a) - len(b)) <= 0.02 * len(a)
    moved = se3.transform(T, a.points.reshape(-1, 3)).reshape(-1, 6)
    gap = np.linalg.norm(moved[:, None] - b.points.reshape(1, -1, 6), axis=2).min(axis=1)
    assert np.mean(gap < 1e-5) > 0.97


def test_a_mesh_whose_triangles_all_face_inwards_has_the_same_pairs():
    mesh = cup()
    inside_out = replace(mesh, faces=mesh.faces[:, ::-1])
    (a, _), (b, counts) = pairs_of(mesh), pairs_of(inside_out)
    assert abs(len(b) - len(a)) < 0.05 * len(a)
    assert counts["antipodal_points"] > 400


def test_an_open_mesh_with_triangles_of_either_orientation_keeps_its_pairs():
    rng = np.random.default_rng(3)
    mesh = ball(0.03)
    whole, _ = pairs_of(mesh)
    faces = mesh.faces[rng.random(len(mesh.faces)) > 0.03].copy()
    turned = rng.random(len(faces)) < 0.4
    faces[turned] = faces[turned][:, ::-1]
    scan = replace(mesh, faces=faces)
    assert not RaySurface(scan).is_closed
    found, _ = pairs_of(scan)
    assert len(found) > 0.9 * len(whole)
    assert np.mean(np.sum(found.normals * found.points, axis=-1) > 0) > 0.97


def test_averaged_normals_are_nearer_to_the_truth_on_a_noisy_scan():
    smooth = ball(0.03, 5)
    noise = np.random.default_rng(0).normal(scale=1e-4, size=smooth.vertices.shape)
    scan = replace(smooth, vertices=smooth.vertices + noise)
    errors = {}
    for radius in (0.0, CONFIG.normal_radius_m):
        pairs, _ = pairs_of(scan, replace(CONFIG, normal_radius_m=radius))
        true = pairs.points / np.linalg.norm(pairs.points, axis=-1, keepdims=True)
        cos = np.clip(np.sum(pairs.normals * true, axis=-1), -1, 1)
        errors[radius] = np.degrees(np.median(np.arccos(cos)))
    assert errors[CONFIG.normal_radius_m] < 0.6 * errors[0.0]


def test_a_double_surface_gives_no_pair_across_its_layers_and_one_exit_per_wall():
    scan = merged([box((side, side, side)) for side in (0.05, 0.0494)])
    pairs, counts = pairs_of(scan, replace(CONFIG, rays_per_point=1))
    assert np.all(pairs.widths_m > 0.049)
    assert counts["exits"] == CONFIG.surface_points


@pytest.mark.parametrize("friction", [0.2, 1.0])
def test_a_wedge_closes_only_where_friction_exceeds_the_tangent_of_its_half_angle(friction):
    a = np.radians(20)
    # Rays along the normals only: from one slope to the other they are 40 deg off there.
    config = replace(CONFIG, friction=friction, rays_per_point=4)
    pairs, _ = pairs_of(wedge(a, 0.06, 0.002, 0.02), config)
    slope_pairs = np.sum((np.abs(pairs.normals[:, :, 1]) > 0.5).all(axis=1))
    assert slope_pairs == 0 if friction < np.tan(a) else slope_pairs > 50


# --- The hand's boxes against triangles: nothing that reaches into a box goes unnoticed.


def hands(count, seed, spread=0.07):
    rng = np.random.default_rng(seed)
    boxes = HAND.boxes(rng.uniform(0.001, 0.08, count))
    return boxes, se3.random_transform(rng, count, spread=spread)


def free_by_coal(boxes, Ts, triangles):
    """Return the verdicts of a collision library on the same boxes and triangles."""
    import coal

    model = coal.BVHModelOBBRSS()
    model.beginModel(0, 0)
    for a, b, c in triangles:
        model.addTriangle(a, b, c)
    model.endModel()
    here, request = coal.Transform3s(np.eye(3), np.zeros(3)), coal.CollisionRequest()
    free = np.ones(len(boxes), dtype=bool)
    for n, hand in enumerate(boxes):
        for low, high in hand:
            T = Ts[n] @ se3.from_translation((low + high) / 2)
            there = coal.Transform3s(T[:3, :3], T[:3, 3])
            solid, result = coal.Box(*(high - low)), coal.CollisionResult()
            free[n] &= not coal.collide(model, here, solid, there, request, result)
    return free


def test_the_verdict_is_that_of_a_collision_library():
    clearance, mesh = 0.002, cup(48)
    boxes, Ts = hands(400, 0)
    triangles = mesh.vertices[mesh.faces]
    expected = free_by_coal(boxes + np.array([[-clearance], [clearance]]), Ts, triangles)
    assert 100 < expected.sum() < 300
    assert np.array_equal(hands_free(boxes, Ts, surface_tree(triangles), clearance), expected)


def test_a_hand_wholly_inside_a_large_block_is_not_free():
    T = se3.from_translation([0.0, 0.0, 0.5])
    stand = Stand(RaySurface(box((0.6, 0.6, 0.6))), T, None, CandidateConfig(), HAND)
    poses = HandPoses(
        Ts_obj_grasp=np.eye(4)[None],
        widths_m=np.array([0.05]),
        openings_m=np.array([0.06]),
        contact_depths_m=np.zeros(1),
    )
    assert stand.placed(poses)[1].tolist() == [IN_OBJECT]


@pytest.mark.real
@needs(MUG)
def test_the_open_hand_is_free_in_all_grasps_of_acronym_s_mug():
    """Another simulator placed these hands so that they are free; their closing axis is x."""
    import h5py

    with h5py.File(next(MUG.glob("Mug_*.h5"))) as file:
        Ts = np.array(file["grasps/transforms"], dtype=float)
        scale = float(np.array(file["object/scale"]))
    shape = trimesh.load(next(MUG.glob("*.obj")), force="mesh")
    tree = surface_tree(scale * np.array(shape.triangles))
    quarter = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
    T_hand_grasp = se3.from_rt(quarter, [0.0, 0.0, -HAND.mount_z_m])
    boxes = HAND.boxes(np.full(len(Ts), HAND.max_opening_m))
    assert len(Ts) == 2000
    assert hands_free(boxes, Ts @ T_hand_grasp, tree, 0.0).mean() > 0.99
    # With the fingers along the other axis hardly any is.
    wrong = Ts @ se3.from_translation([0.0, 0.0, -HAND.mount_z_m])
    assert hands_free(boxes, wrong, tree, 0.0).mean() < 0.5
