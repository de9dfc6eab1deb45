"""Antipodal pairs of closed, open, noisy and double surfaces; hands that are free of them."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from realsim.geometry import se3
from realsim.geometry.mesh import merged
from realsim.robots.hand import find_hand
from realsim_sim_bridge.grasping.antipodal import CandidateConfig, RaySurface, antipodal_pairs
from realsim_sim_bridge.grasping.candidates import IN_OBJECT, HandPoses, Stand
from realsim_sim_bridge.grasping.surroundings import hands_free, surface_tree
from trimesh_solids import box, cup, solid

CONFIG = CandidateConfig(surface_points=500)


def pairs_of(mesh, config=CONFIG, max_width=0.078, seed=0):
    counts = {}
    rng = np.random.default_rng(seed)
    return antipodal_pairs(RaySurface(mesh), config, max_width, rng, counts), counts


def sphere(radius=0.03):
    return solid(trimesh.creation.icosphere(subdivisions=5, radius=radius))


def test_both_ends_lie_on_the_surface_and_the_line_is_inside_both_cones():
    pairs, _ = pairs_of(sphere())
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
    mesh = solid(trimesh.creation.icosphere(subdivisions=4, radius=0.03))
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
    ball, rng = sphere(), np.random.default_rng(0)
    noise = rng.normal(scale=1e-4, size=ball.vertices.shape)
    scan = replace(ball, vertices=ball.vertices + noise)
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
    outline = np.array([[0.0, -0.002], [0.06, -0.002 - 0.06 * np.tan(a)]])
    outline = np.concatenate([outline, outline[::-1] * [1, -1]])
    prism = trimesh.creation.extrude_triangulation(
        outline, np.array([[0, 1, 2], [0, 2, 3]]), height=0.04
    )
    # Rays along the normals only: from one slope to the other they are 40 deg off there.
    config = replace(CONFIG, friction=friction, rays_per_point=4)
    pairs, _ = pairs_of(solid(prism), config)
    slope_pairs = np.sum((np.abs(pairs.normals[:, :, 1]) > 0.5).all(axis=1))
    assert slope_pairs == 0 if friction < np.tan(a) else slope_pairs > 50


# --- The hand's boxes against triangles: nothing that reaches into a box goes unnoticed.

HAND = find_hand()
DATA = Path(os.environ.get("REALSIM_DATA", Path(__file__).parents[2] / "../shared/data"))


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
def test_the_open_hand_is_free_in_all_grasps_of_acronym_s_mug():
    """Another simulator placed these hands so that they are free; their closing axis is x."""
    import h5py

    folder = DATA / "school" / "acronym_mug"
    files = sorted(folder.glob("Mug_*.h5"))
    if not files:
        pytest.skip(f"no real data at {folder} (set REALSIM_DATA)")
    with h5py.File(files[0]) as file:
        Ts = np.array(file["grasps/transforms"], dtype=float)
        scale = float(np.array(file["object/scale"]))
    shape = trimesh.load(next(folder.glob("*.obj")), force="mesh")
    tree = surface_tree(scale * np.array(shape.triangles))
    quarter = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
    T_hand_grasp = se3.from_rt(quarter, [0.0, 0.0, -HAND.mount_z_m])
    boxes = HAND.boxes(np.full(len(Ts), HAND.max_opening_m))
    assert len(Ts) == 2000
    assert hands_free(boxes, Ts @ T_hand_grasp, tree, 0.0).mean() > 0.99
    # With the fingers along the other axis hardly any is.
    wrong = Ts @ se3.from_translation([0.0, 0.0, -HAND.mount_z_m])
    assert hands_free(boxes, wrong, tree, 0.0).mean() < 0.5
