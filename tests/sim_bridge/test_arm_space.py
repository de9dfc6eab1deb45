"""The arm's spheres, the obstacles, and the promise that a free move keeps its distance."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull, KDTree

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.robots.arm import find_arm
from realsim.robots.coal_geometry import Body, Geometry
from realsim.robots.compiled_chain import in_dh_frame
from realsim.robots.hand import find_hand
from realsim_sim_bridge.arm.arm_space import FREE, IN_ITSELF, IN_TABLE, ArmSpace, ArmSpaceConfig
from realsim_sim_bridge.arm.grasping_arm import GraspingArm
from realsim_sim_bridge.arm.link_spheres import Spheres, arm_spheres, hand_spheres, solid_points
from realsim_sim_bridge.arm.obstacles import least_distance, obstacles_of

HAND = find_hand()
PANDA = GraspingArm(find_arm("panda"), HAND)
READY = PANDA.arm.home
ARMS = ("panda", "ur5", "ur5e", "iiwa14", "xarm6")


def random_joints(n, seed=0, arm=PANDA):
    return np.random.default_rng(seed).uniform(arm.limits.lower, arm.limits.upper, (n, arm.joints))


def cloud(n=3000, seed=0):
    points = np.random.default_rng(seed).uniform([-0.3, -0.3, 0.0], [0.3, 0.3, 0.2], (n, 3))
    return obstacles_of(points, np.arange(n) % 7, np.zeros(n, dtype=bool))


def upright(height=0.0):
    """The arm stands on the table, its base this high."""
    return se3.from_translation([-0.5, 0.0, height])


def space_of(obstacles=None, T_table_base=None, arm=PANDA, **clearances):
    if obstacles is None:
        obstacles = obstacles_of(np.zeros((0, 3)), np.zeros(0, dtype=np.int64), np.zeros(0, bool))
    T = upright() if T_table_base is None else T_table_base
    return ArmSpace(T, obstacles, ArmSpaceConfig(**clearances), arm)


def placed(arm, body, q, opening):
    """DH frames and the grasp (N, n + 2, 4, 4), and the spheres' centres (N, S, 3), in the base."""
    frames = arm.frames(q)
    for link in range(arm.joints + 1):
        frames[:, link] = frames[:, link] @ se3.invert(in_dh_frame(arm.arm.chain, link))
    T = frames[:, body.links]
    centers = body.centers + np.outer(body.sides, [0.0, opening / 2, 0.0])
    return frames, (T[..., :3, :3] @ centers[..., None])[..., 0] + T[..., :3, 3]


def gaps(points, spheres):
    """How far each point is outside the spheres' union [m]."""
    distances = np.linalg.norm(points[:, None] - spheres.centers, axis=2) - spheres.radii
    return distances.min(axis=1)


def part(spheres, rows):
    return Spheres(*(x[rows] for x in spheres))


@pytest.mark.parametrize("name", ARMS)
def test_the_surface_of_every_link_is_inside_its_spheres_which_are_few_and_close(name):
    arm = find_arm(name)
    spheres = arm_spheres(arm)
    assert len(spheres.radii) <= 8 * (arm.joints + 1)
    for link in {s.frame for s in arm.shapes}:
        mine = part(spheres, spheres.links == link)
        T_dh_link = in_dh_frame(arm.chain, link)
        hulls = [ConvexHull(se3.transform(T_dh_link, solid_points(s)))
                 for s in arm.shapes if s.frame == link]  # fmt: skip
        for shape, hull in zip([s for s in arm.shapes if s.frame == link], hulls, strict=True):
            mesh = trimesh.Trimesh(hull.points, hull.simplices, process=False)
            inner = trimesh.sample.sample_surface(mesh, 3000, seed=7)[0]
            surface = np.concatenate([hull.points, inner])
            deep = [(surface @ h.equations[:, :3].T + h.equations[:, 3]).max(axis=1) < -1e-6
                    for h in hulls]  # fmt: skip
            assert gaps(surface[~np.any(deep, axis=0)], mine).max(initial=-1.0) < 1e-9, shape.part
        # On average the spheres' free surface is not far outside of the bodies.
        around = np.random.default_rng(0).normal(size=(200, 3))
        around /= np.linalg.norm(around, axis=1)[:, None]
        shells = (mine.centers[:, None] + mine.radii[:, None, None] * around).reshape(-1, 3)
        shells = shells[gaps(shells, mine) > -1e-9]
        out = np.min([(shells @ h.equations[:, :3].T + h.equations[:, 3]).max(axis=1)
                      for h in hulls], axis=0)  # fmt: skip
        assert np.maximum(out, 0.0).mean() < 0.035


@pytest.mark.parametrize("name", ARMS)
def test_levers_bound_how_far_a_sphere_is_from_each_axis(name):
    arm = GraspingArm(find_arm(name), HAND)
    body = space_of(arm=arm).bodies[True]
    q = random_joints(300, arm=arm)
    frames, centers = placed(arm, body, q, 0.05)
    for j in range(arm.joints):
        axes, at = frames[:, j, :3, 2], frames[:, j, :3, 3]
        apart = np.cross(centers - at[:, None], axes[:, None])
        moved = body.levers[:, j] > 0
        assert np.all(np.linalg.norm(apart, axis=2)[:, moved] <= body.levers[moved, j] + 1e-9)
        assert np.all(body.links[~moved] <= j)


@pytest.mark.parametrize("name", ARMS)
def test_what_is_called_free_of_itself_never_penetrates_by_coal(name):
    arm = GraspingArm(find_arm(name), HAND)
    q = random_joints(500, arm=arm)
    space = space_of(T_table_base=upright(5.0), arm=arm)
    free = space.blame(q, np.full(len(q), 0.05), with_hand=False) == FREE
    shapes = arm.arm.shapes
    kept = {tuple(sorted(p)) for p in arm.arm.kept_apart}
    pairs = [
        (a, b) for a, x in enumerate(shapes) for b, y in enumerate(shapes)
        if x.frame < y.frame - 2 and (x.frame, y.frame) not in kept
    ]  # fmt: skip
    bodies = tuple(Body(shape, "link") for shape in shapes)
    placements = np.tile(np.eye(4), (arm.joints + 1, 1, 1))
    apart = Geometry(arm.arm.chain, placements, bodies).with_pairs(pairs)(q).min(axis=1)
    assert 0.1 < free.mean() < 1.0 and apart[free].min() > 0.0
    assert np.mean(apart[~free] < 0.08) > 0.9


def test_the_hand_s_boxes_are_inside_its_spheres_at_any_opening():
    rng, spheres = np.random.default_rng(0), hand_spheres(HAND, 8)
    for opening in (0.0, 0.05, 0.08):
        shift = np.outer(spheres.sides, [0.0, opening / 2, 0.0])
        moved = spheres._replace(centers=spheres.centers + shift)
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
    outside = body.links > 0
    for start, end in moves[free][:60]:
        along = start + np.linspace(0, 1, 200)[:, None] * (end - start)
        centers = se3.transform(upright(), placed(PANDA, body, along, 0.05)[1])
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
    wrist = (upright() @ PANDA.frames(READY))[6, :3, 3]
    obstacles = obstacles_of(wall + wrist, np.full(len(wall), 7), np.zeros(len(wall), bool))
    assert space_of(obstacles).blame(READY[None], np.array([0.08]), with_hand=True)[0] == 7


def test_clearances_that_cannot_be_checked_are_refused():
    with pytest.raises(InputError, match="clearances"):
        ArmSpaceConfig(clearance_m=0.0)
