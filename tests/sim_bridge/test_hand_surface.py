"""The hand's boxes against triangles: nothing that reaches into a box goes unnoticed."""

import os
from pathlib import Path

import numpy as np
import pytest
import trimesh

from realsim.geometry import se3
from realsim.robots.hand import find_hand
from realsim_sim_bridge.grasping.antipodal import CandidateConfig, RaySurface
from realsim_sim_bridge.grasping.candidates import IN_OBJECT, HandPoses, Stand
from realsim_sim_bridge.grasping.surroundings import hands_free, surface_tree
from trimesh_solids import box, cup

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
    clearance = 0.002
    boxes, Ts = hands(400, 0)
    mesh = cup(48)
    triangles = mesh.vertices[mesh.faces]
    grown = boxes + np.array([[-clearance], [clearance]])
    expected = free_by_coal(grown, Ts, triangles)
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
    T_hand_grasp = np.eye(4)
    T_hand_grasp[:3, :3] = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
    T_hand_grasp[2, 3] = -HAND.mount_z_m
    boxes = HAND.boxes(np.full(len(Ts), HAND.max_opening_m))
    assert len(Ts) == 2000
    assert hands_free(boxes, Ts @ T_hand_grasp, tree, 0.0).mean() > 0.99
    # With the fingers along the other axis hardly any is.
    wrong = Ts @ se3.from_translation([0.0, 0.0, -HAND.mount_z_m])
    assert hands_free(boxes, wrong, tree, 0.0).mean() < 0.5
