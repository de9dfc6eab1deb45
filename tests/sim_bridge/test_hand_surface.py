"""The hand's boxes against triangles: nothing that reaches into a box goes unnoticed."""

import os
from pathlib import Path

import numpy as np
import pytest
import trimesh

from realsim.geometry import se3
from realsim.geometry.hand import HandGeometry
from realsim.records import Mesh
from realsim_sim_bridge.grasping.antipodal import CandidateConfig, RaySurface
from realsim_sim_bridge.grasping.candidates import (
    IN_OBJECT,
    HandPoses,
    Stand,
    Surroundings,
    sample_candidates,
    standing_object,
)
from realsim_sim_bridge.grasping.hand_free import boxes_free
from realsim_sim_bridge.grasping.surroundings import (
    first_triangle_inside,
    hands_free,
    surface_tree,
)

HAND = HandGeometry()
DATA = Path(os.environ.get("REALSIM_DATA", Path(__file__).parents[2] / "../shared/data"))


def cup():
    return trimesh.creation.annulus(0.028, 0.032, 0.08, sections=48)


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


@pytest.mark.parametrize("clearance", [0.0, 0.002])
def test_the_verdict_is_that_of_a_collision_library(clearance):
    boxes, Ts = hands(400, 0)
    triangles = np.array(cup().triangles)
    grown = boxes + np.array([[-clearance], [clearance]])
    expected = free_by_coal(grown, Ts, triangles)
    assert 100 < expected.sum() < 300
    assert np.array_equal(hands_free(boxes, Ts, surface_tree(triangles), clearance), expected)


def test_candidates_are_free_by_a_collision_library_where_sampled_points_are_not_enough():
    shape = cup()
    mesh = Mesh(vertices=np.array(shape.vertices), faces=np.array(shape.faces))
    T = se3.from_translation([0.0, 0.0, 0.04])
    config, rng = CandidateConfig(surface_points=200), np.random.default_rng(0)
    found = sample_candidates(mesh, T, Surroundings(), config, HAND, rng, 300)
    boxes = HAND.boxes(found.openings_m)
    # Less than the clearance by single precision's rounding.
    grown = boxes + np.array([[-1.0], [1.0]]) * (config.clearance_m - 1e-6)
    assert len(boxes) == 300
    assert free_by_coal(grown, found.Ts_obj_grasp, np.array(shape.triangles)).all()


def test_what_points_1_5_mm_apart_miss_the_triangles_show():
    boxes, Ts = hands(3000, 1, spread=0.06)
    triangles = np.array(cup().triangles)
    points = np.array(trimesh.sample.sample_surface(cup(), 4000, seed=0)[0])
    by_points, by_triangles = (
        boxes_free(boxes, Ts, points, 0.0),
        hands_free(boxes, Ts, surface_tree(triangles), 0.0),
    )
    assert not np.any(by_triangles & ~by_points)
    assert np.sum(by_points & ~by_triangles) > 5


def test_the_triangle_that_is_named_reaches_into_the_hand():
    boxes, Ts = hands(200, 2)
    triangles = np.array(cup().triangles)
    found = first_triangle_inside(boxes, Ts, surface_tree(triangles), 0.0)
    hit = np.nonzero(found >= 0)[0]
    assert len(hit) > 20
    for n in hit:
        alone = surface_tree(triangles[found[n]][None])
        assert not hands_free(boxes[n : n + 1], Ts[n : n + 1], alone, 0.0)[0]


def test_verdicts_move_with_hand_and_surface():
    boxes, Ts = hands(300, 3)
    T, triangles = se3.exp([0.3, 1.0, -0.2, 0.4, -0.1, 0.2]), np.array(cup().triangles)
    moved = se3.transform(T, triangles.reshape(-1, 3)).reshape(triangles.shape)
    here, there = (
        hands_free(boxes, Ts, surface_tree(triangles), 1e-3),
        hands_free(boxes, T @ Ts, surface_tree(moved), 1e-3),
    )
    assert np.array_equal(here, there)


def test_triangles_without_size_are_points():
    boxes, Ts = hands(300, 4)
    points = np.random.default_rng(5).normal(scale=0.06, size=(50, 3))
    tree = surface_tree(np.repeat(points[:, None], 3, axis=1))
    expected = boxes_free(boxes, Ts, points, 0.0)
    assert 20 < expected.sum() < 280
    assert np.array_equal(hands_free(boxes, Ts, tree, 0.0), expected)


def test_a_hand_wholly_inside_a_large_block_is_not_free():
    shape = trimesh.creation.box((0.6, 0.6, 0.6))
    mesh = Mesh(vertices=np.array(shape.vertices), faces=np.array(shape.faces))
    T = se3.from_translation([0.0, 0.0, 0.5])
    stand = Stand(RaySurface(mesh), T, None, CandidateConfig(), HAND)
    poses = HandPoses(
        Ts_obj_grasp=np.eye(4)[None],
        widths_m=np.array([0.05]),
        openings_m=np.array([0.06]),
        contact_depths_m=np.zeros(1),
    )
    assert stand.placed(poses)[1].tolist() == [IN_OBJECT]


def test_surroundings_near_a_place_give_the_same_verdicts_there():
    shape = cup()
    mesh = Mesh(vertices=np.array(shape.vertices), faces=np.array(shape.faces))
    objects = [
        standing_object(mesh, se3.from_translation([x, 0.0, 0.04]), i, 200)
        for i, x in enumerate((0.0, 0.5))
    ]
    boxes, Ts = hands(200, 6)
    near = objects[0].near(np.zeros(3), 0.4).tree()[0]
    assert np.array_equal(
        hands_free(boxes, Ts, objects[0].tree()[0], 0.0), hands_free(boxes, Ts, near, 0.0)
    )
    assert objects[1].near(np.zeros(3), 0.3).tree()[0] is None


def test_points_count_only_where_an_instance_has_no_triangles():
    known = standing_object(
        Mesh(vertices=np.array(cup().vertices), faces=np.array(cup().faces)), np.eye(4), 1, 10
    )
    bare = Surroundings(points=np.zeros((3, 3)), instances=np.full(3, 2))
    both = Surroundings(
        points=np.concatenate([known.points, bare.points]),
        instances=np.concatenate([known.instances, bare.instances]),
        triangles=known.triangles,
        triangle_instances=known.triangle_instances,
    )
    _, instances = both.tree()
    assert len(instances) == len(known.triangles) + 3 and np.sum(instances == 2) == 3


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
    T_hand_grasp = np.eye(4)
    T_hand_grasp[:3, :3] = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
    T_hand_grasp[2, 3] = -HAND.mount_z_m
    boxes = HAND.boxes(np.full(len(Ts), HAND.max_opening_m))
    assert len(Ts) == 2000
    assert hands_free(boxes, Ts @ T_hand_grasp, tree, 0.0).mean() > 0.99
    # With the fingers along the other axis hardly any is.
    wrong = Ts @ se3.from_translation([0.0, 0.0, -HAND.mount_z_m])
    assert hands_free(boxes, wrong, tree, 0.0).mean() < 0.5
