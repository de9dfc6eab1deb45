"""The arm's spheres, the obstacles, and the promise that a free move keeps its distance."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.robots.hand import find_hand
from realsim_sim_bridge.arm import panda
from realsim_sim_bridge.arm.arm_space import (
    FREE,
    IN_ITSELF,
    IN_TABLE,
    ArmSpace,
    ArmSpaceConfig,
)
from realsim_sim_bridge.arm.obstacles import (
    FINGER_SIDE,
    arm_spheres,
    hand_spheres,
    least_distance,
    obstacles_of,
)

READY = np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4])
HAND = find_hand()


def random_joints(n, seed=0):
    return np.random.default_rng(seed).uniform(panda.LOWER, panda.UPPER, (n, 7))


def cloud(n=3000, seed=0):
    points = np.random.default_rng(seed).uniform([-0.3, -0.3, 0.0], [0.3, 0.3, 0.2], (n, 3))
    return obstacles_of(points, np.arange(n) % 7, np.zeros(n, dtype=bool))


def upright(height=0.0):
    """The arm stands on the table, its base this high."""
    return se3.from_translation([-0.5, 0.0, height])


def space_of(obstacles=None, T_table_base=None, **clearances):
    if obstacles is None:
        obstacles = obstacles_of(np.zeros((0, 3)), np.zeros(0, dtype=np.int64), np.zeros(0, bool))
    T = upright() if T_table_base is None else T_table_base
    return ArmSpace(T, obstacles, ArmSpaceConfig(**clearances), HAND)


def franka_meshes(link):
    """The collision mesh of franka_description and, where PyBullet ships it, the visual one."""
    import pybullet_data

    cmeel = Path(np.__file__).parents[1] / "cmeel.prefix/share/example-robot-data/robots"
    mine = [cmeel / f"panda_description/meshes/collision/link{link}.stl"]
    looks = Path(pybullet_data.getDataPath()) / f"franka_panda/meshes/visual/link{link}.obj"
    return [trimesh.load(p, force="mesh") for p in (*mine, looks) if p.exists()]


def gaps(points, spheres):
    """How far each point is outside the spheres' union [m]."""
    distances = np.linalg.norm(points[:, None] - spheres[:, 1:4], axis=2) - spheres[:, 4]
    return distances.min(axis=1)


@pytest.mark.parametrize("link", range(8))
def test_every_vertex_and_surface_point_of_franka_s_meshes_is_inside_the_spheres(link):
    spheres = arm_spheres()
    mine = spheres[spheres[:, 0] == link]
    meshes = franka_meshes(link)
    assert meshes
    # The collision mesh is a convex hull with faces far from the real surface where that is
    # hollow: of it the vertices count, and of the visual mesh everything.
    for mesh in meshes:
        assert gaps(np.asarray(mesh.vertices), mine).max() < 0
    surface = trimesh.sample.sample_surface(meshes[-1], 20000, seed=7)[0]
    assert gaps(surface, mine).max() < 0


def test_the_hand_s_boxes_are_inside_its_spheres_at_any_opening():
    rng, spheres = np.random.default_rng(0), hand_spheres(HAND)
    for opening in (0.0, 0.05, 0.08):
        moved = spheres.copy()
        moved[spheres[:, 0] == FINGER_SIDE[0], 2] += opening / 2
        moved[spheres[:, 0] == FINGER_SIDE[1], 2] -= opening / 2
        for low, high in HAND.boxes(opening)[0]:
            assert gaps(rng.uniform(low, high, (4000, 3)), moved).max() < 1e-9
            corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), -1).reshape(-1, 3)
            assert gaps(corners, moved).max() < 1e-9


def test_the_grid_s_bound_is_below_the_distance_and_not_far_below():
    obstacles = cloud()
    tree = KDTree(obstacles.points)
    at = np.random.default_rng(1).uniform([-0.7, -0.7, -0.3], [0.7, 0.7, 0.6], (4000, 3))
    true = tree.query(at)[0]
    bound = np.array([least_distance(obstacles, *p) for p in at])
    assert np.all(bound <= true)
    assert np.mean((true - bound)[true < 0.15]) < 0.02


def test_a_free_move_keeps_half_its_clearance_along_its_whole_length():
    obstacles, config = cloud(400), ArmSpaceConfig()
    space = space_of(obstacles)
    tree, body = KDTree(obstacles.points), space.bodies[True]
    q = random_joints(3000, seed=5)
    q = q[space.blame(q, np.full(len(q), 0.05), with_hand=True) == FREE]
    moves = np.stack([q[:-1], q[:-1] + np.clip(np.diff(q, axis=0), -0.5, 0.5)], axis=1)
    free = space.blame_moves(moves, np.full(len(moves), 0.05), with_hand=True) == FREE
    assert 30 < free.sum() < len(free)
    shift = body.centers + np.outer(body.sides, [0.0, 0.025, 0.0])
    outside = body.links > 0
    for start, end in moves[free][:60]:
        frames = panda.link_frames(start + np.linspace(0, 1, 200)[:, None] * (end - start))
        T = (upright() @ frames)[:, body.links]
        centers = (T[..., :3, :3] @ shift[..., None])[..., 0] + T[..., :3, 3]
        near = tree.query(centers.reshape(-1, 3))[0].reshape(centers.shape[:2])
        least = config.clearance_m / 2 - 1e-9
        assert np.all((near - body.radii)[:, outside] >= least)
        assert np.all((centers[..., 2] - body.radii)[:, outside] >= least)


def test_what_stops_a_configuration_is_named():
    grid = np.linspace(-0.06, 0.06, 25)
    wall = np.stack([*np.meshgrid(grid, grid), np.zeros((25, 25))], -1).reshape(-1, 3)
    space = space_of()
    elbow_down = READY.copy()
    elbow_down[1] = 1.7
    folded = np.array([0.0, -1.7, 0.0, -3.05, 0.0, 0.3, 0.8])
    q = np.stack([READY, elbow_down, folded])
    codes = space.blame(q, np.full(3, 0.08), with_hand=True)
    assert codes[0] == FREE and codes[1] == IN_TABLE and codes[2] in (IN_ITSELF, IN_TABLE)
    wrist = (upright() @ panda.link_frames(READY))[6, :3, 3]
    obstacles = obstacles_of(wall + wrist, np.full(len(wall), 7), np.zeros(len(wall), bool))
    assert space_of(obstacles).blame(READY[None], np.array([0.08]), with_hand=True)[0] == 7


def test_clearances_that_cannot_be_checked_are_refused():
    with pytest.raises(InputError, match="clearances"):
        ArmSpaceConfig(clearance_m=0.0)
