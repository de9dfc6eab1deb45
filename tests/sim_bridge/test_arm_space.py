"""The arm's spheres, the obstacles, and the promise that a free move keeps its distance."""

from itertools import pairwise
from unittest.mock import Mock

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull, KDTree

from realsim.geometry import se3
from realsim.interop import pybullet_client
from realsim.robots.arm import find_arm
from realsim.robots.coal_geometry import Body, Geometry
from realsim.robots.compiled_chain import follow_lines, in_dh_frame
from realsim.robots.hand import find_hand
from realsim_sim_bridge.arm.arm_space import FREE, IN_ITSELF, IN_TABLE, ArmSpace, ArmSpaceConfig
from realsim_sim_bridge.arm.grasping_arm import (
    GraspingArm,
    Spheres,
    arm_spheres,
    hand_spheres,
    solid_points,
)
from realsim_sim_bridge.arm.joint_path import PlannerConfig, connect
from realsim_sim_bridge.arm.obstacles import least_distance, obstacles_of
from realsim_sim_bridge.arm.timing import TimingConfig, straight_times, timed_path
from realsim_sim_bridge.slip.bullet_shapes import hand_urdf
from realsim_sim_bridge.slip.world import PadModel
from realsim_sim_bridge.validation.full_arm import PANDA_LINKS, arm_urdf
from refusals import refused

HAND = find_hand()
PANDA = GraspingArm(find_arm("panda"), HAND)
READY = PANDA.arm.home
ARMS = ("panda", "ur5", "ur5e", "iiwa14", "xarm6")


@pytest.fixture
def arm(name):
    return GraspingArm(find_arm(name), HAND)


def random_turns(n, seed=0, arm=PANDA):
    low, high = np.maximum(arm.limits.lower, -np.pi), np.minimum(arm.limits.upper, np.pi)
    return np.random.default_rng(seed).uniform(low, high, (n, arm.joints))


def cloud(n=3000, seed=0):
    points = np.random.default_rng(seed).uniform([-0.3, -0.3, 0.0], [0.3, 0.3, 0.2], (n, 3))
    return obstacles_of(points, np.arange(n) % 7, np.zeros(n, dtype=bool))


def upright(height=0.0):
    """The arm stands on the table, its base this high."""
    return se3.from_translation([-0.5, 0.0, height])


def space_of(obstacles=None, T_table_base=None, arm=PANDA, **clearances):
    obstacles = cloud(0) if obstacles is None else obstacles
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
        shapes = [s for s in arm.shapes if s.frame == link]
        hulls = [ConvexHull(se3.transform(T_dh_link, solid_points(s))) for s in shapes]
        for shape, hull in zip(shapes, hulls, strict=True):
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
def test_levers_bound_how_far_a_sphere_is_from_each_axis(arm):
    body = space_of(arm=arm).bodies[True]
    q = random_turns(300, arm=arm)
    frames, centers = placed(arm, body, q, 0.05)
    for j in range(arm.joints):
        axes, at = frames[:, j, :3, 2], frames[:, j, :3, 3]
        apart = np.cross(centers - at[:, None], axes[:, None])
        moved = body.levers[:, j] > 0
        assert np.all(np.linalg.norm(apart, axis=2)[:, moved] <= body.levers[moved, j] + 1e-9)
        assert np.all(body.links[~moved] <= j)


@pytest.mark.parametrize("name", ARMS)
def test_what_is_called_free_of_itself_never_penetrates_by_coal(arm):
    q = random_turns(500, arm=arm)
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
            corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), -1).reshape(-1, 3)
            inside = rng.uniform(low, high, (4000, 3))
            assert gaps(np.concatenate([inside, corners]), moved).max() < 1e-9


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
    q = random_turns(3000, seed=5)
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


# --- An arm with a hand: kinematics both ways, how far it reaches, and its URDF.
FOUR_ARMS = ("panda", "ur5", "iiwa14", "xarm6")


def test_the_ready_pose_is_franka_s():
    # Franka's documentation: O_T_EE without a hand is (0.3069, 0, 0.5903), pointing down.
    T = PANDA.forward(READY)
    assert np.allclose(T[:3, 3], [0.3069, 0.0, 0.5903 + HAND.mount_z_m], atol=1e-4)
    assert np.allclose(T[:3, :3], np.diag([1.0, -1.0, -1.0]), atol=1e-12)


@pytest.mark.parametrize("name", FOUR_ARMS)
def test_inverse_solutions_reach_the_pose_within_the_limits(arm):
    Ts = arm.forward(random_turns(20, arm=arm))
    owner, q = arm.inverse(Ts, 16, 0.01, arm.arm.home)
    assert np.all(np.diff(owner) >= 0) and len(set(owner.tolist())) >= 17
    assert np.allclose(arm.forward(q), Ts[owner], atol=1e-9)
    assert arm.within_limits(q, 0.01).all()


@pytest.mark.parametrize("name", FOUR_ARMS)
def test_the_swinging_joint_s_axis_in_the_grasp_frame_stays_when_it_turns(arm):
    q, j = random_turns(5, arm=arm), arm.swing_joint
    axis, point, left = arm.swing_in_grasp(q)
    T, turned = arm.forward(q), arm.forward(q + 0.3 * np.eye(arm.joints)[j])
    world_axis, world_point = T[:, :3, :3] @ axis[..., None], se3.transform(T, point[:, None])
    assert np.allclose(turned[:, :3, :3] @ axis[..., None], world_axis, atol=1e-12)
    assert np.allclose(se3.transform(turned, point[:, None]), world_point, atol=1e-12)
    assert np.allclose(q[:, j, None] + left, [arm.limits.lower[j], arm.limits.upper[j]])


@pytest.mark.parametrize("name", FOUR_ARMS)
def test_the_wrist_s_distance_is_within_its_bounds_wherever_the_arm_is(arm, name):
    q = random_turns(3000, seed=1, arm=arm)
    least = arm.wrist_distance(arm.forward(q))
    assert np.all(least <= arm.wrist_reach_m + 1e-9) and least.max() > 0.95 * arm.wrist_reach_m
    if name == "panda":  # whose wrist is frame 6's origin, its shoulder frame 2's
        assert arm.wrist_reach_m == pytest.approx(np.hypot(0.316, 0.0825) + np.hypot(0.384, 0.0825))
        frames = arm.frames(q)
        true = np.linalg.norm(frames[:, 5, :3, 3] - frames[:, 1, :3, 3], axis=1)
        assert np.all(true >= least - 1e-12) and np.min(true - least) < 1e-3


def test_followed_lines_are_straight_and_their_slopes_are_derivatives():
    q = PANDA.inverse(PANDA.forward(READY)[None], 12, 0.1, READY)[1][:6]
    Ts = PANDA.forward(q)
    along = np.tile([0.6, 0.0, -0.8], (len(q), 1))
    distances = np.linspace(0.0, 0.1, 6)
    joints, slopes, error = follow_lines(PANDA.numbers, q, Ts, along, distances)
    assert np.all(error < 1e-9) and np.array_equal(joints[:, 0], q)
    wanted = Ts[:, None, :3, 3] + distances[:, None] * along[:, None]
    assert np.allclose(PANDA.forward(joints)[..., :3, 3], wanted, atol=1e-9)
    assert np.allclose(PANDA.forward(joints)[..., :3, :3], Ts[:, None, :3, :3], atol=1e-9)
    h = 1e-6
    moved = (PANDA.forward(joints + h * slopes) - PANDA.forward(joints))[..., :3, 3] / h
    assert np.allclose(moved, along[:, None], atol=1e-4)


@pytest.mark.parametrize("name", FOUR_ARMS)
def test_pybullet_has_the_same_forward_kinematics(tmp_path, arm):
    path, n = tmp_path / "arm.urdf", arm.joints
    links = (PANDA_LINKS[1],) * (n + 1)
    path.write_text(arm_urdf(arm.arm, HAND, hand_urdf(HAND, PadModel()), links), encoding="utf-8")
    engine = pybullet_client()
    body = engine.loadURDF(str(path), useFixedBase=True)
    infos = [engine.getJointInfo(body, i) for i in range(engine.getNumJoints(body))]
    last = [info[12] for info in infos].index(b"palm")
    for q in random_turns(20, arm=arm):
        for i in range(n):
            engine.resetJointState(body, i, q[i])
        state = engine.getLinkState(body, last, computeForwardKinematics=True)
        R = np.array(engine.getMatrixFromQuaternion(state[5])).reshape(3, 3)
        # It reads a URDF's vectors as float32.
        assert np.allclose(se3.from_rt(R, state[4]), arm.forward(q), rtol=0, atol=1e-6)
    for i, info in enumerate(infos[:n]):
        limits = (arm.limits.lower[i], arm.limits.upper[i], arm.limits.speed[i])
        assert np.allclose((*info[8:10], info[11]), limits)
    engine.disconnect()


# --- Paths round obstacles and the time along them.

SIDE, LOW = np.eye(7)[0], np.eye(7)[1]
LEFT, RIGHT = READY - 0.9 * SIDE + 0.5 * LOW, READY + 0.9 * SIDE + 0.5 * LOW
OPEN = 0.08


def walled(height):
    """A wall in front of the arm, between left and right."""
    x, z = np.meshgrid(np.linspace(0.25, 0.9, 66), np.linspace(0.0, height, 60))
    points = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)
    obstacles = obstacles_of(points, np.full(len(points), 3), np.zeros(len(points), bool))
    return space_of(obstacles, se3.from_translation([0.0, 0.0, 0.02]))


def is_free(space, path):
    return space.blame_moves(path[None], np.array([OPEN]), with_hand=True)[0] == FREE


def plan(space, seed=0, **config):
    rng = np.random.default_rng(seed)
    return connect(LEFT, RIGHT, space, OPEN, PlannerConfig(**config), rng)


def test_the_planner_goes_round_what_blocks_the_straight_move():
    space = walled(0.35)
    assert not is_free(space, np.stack([LEFT, RIGHT]))
    path = plan(space)
    assert path is not None and len(path) > 2
    assert np.array_equal(path[0], LEFT) and np.array_equal(path[-1], RIGHT)
    assert is_free(space, path) and PANDA.within_limits(path).all()


def test_a_plan_depends_on_its_seed_alone():
    space = walled(0.35)
    first = plan(space, seed=3)
    for other in (0, 1, 2):
        plan(space, seed=other)
    np.random.seed(5)  # noqa: NPY002 - the generator of the whole process is not used
    assert np.array_equal(first, plan(walled(0.35), seed=3))
    assert not np.array_equal(first, plan(space, seed=4))


def test_the_planner_gives_up_on_a_closed_wall():
    space = walled(1.6)
    assert is_free(space, LEFT[None]) and is_free(space, RIGHT[None])
    assert plan(space, iterations=15) is None


# --- time ---------------------------------------------------------------------------------------


def test_straight_moves_take_as_long_as_topp_ra_says():
    import toppra
    import toppra.algorithm
    import toppra.constraint

    toppra.setup_logging("ERROR")
    config = TimingConfig()
    velocity, acceleration = config.limits(PANDA.limits)
    limits = [
        toppra.constraint.JointVelocityConstraint(np.stack([-velocity, velocity], 1)),
        toppra.constraint.JointAccelerationConstraint(np.stack([-acceleration, acceleration], 1)),
    ]
    rng = np.random.default_rng(0)
    for scale in (0.05, 0.5, 2.0):
        start, end = READY, READY + scale * rng.uniform(-1, 1, 7)
        _, mine = straight_times((end - start)[None], PANDA.limits, config)
        solver = toppra.algorithm.TOPPRA(
            limits,
            toppra.SplineInterpolator(np.array([0.0, 1.0]), np.stack([start, end])),
            gridpoints=np.linspace(0, 1, 801),
            parametrizer="ParametrizeConstAccel",
        )
        assert mine[0] == pytest.approx(solver.compute_trajectory().duration, rel=5e-3)


@pytest.mark.parametrize("rounding", [True, False])
def test_limits_hold_along_a_path_with_corners(rounding):
    rng, config = np.random.default_rng(1), TimingConfig(sample_hz=200.0)
    velocity, acceleration = config.limits(PANDA.limits)
    for _ in range(2):
        corners = READY + rng.uniform(-0.5, 0.5, (4, 7))
        q, duration = timed_path(corners, lambda path: rounding, PANDA.limits, config)
        t = np.arange(len(q)) / 200.0
        assert t[-1] < duration <= t[-1] + 1 / 200.0 + 1e-9
        assert np.allclose(q[0], corners[0])
        q, t = np.concatenate([q, corners[-1:]]), np.append(t, duration)
        # Divided differences are means of the derivatives: they may not exceed a limit either.
        dt = np.diff(t)[:, None]
        speed = np.diff(q, axis=0) / dt
        assert np.all(np.abs(speed) <= velocity * (1 + 1e-6))
        change = np.diff(speed, axis=0) / ((dt[1:] + dt[:-1]) / 2)
        assert np.all(np.abs(change) <= acceleration * (1 + 1e-6))
        distance = np.linalg.norm(q[:, None] - corners, axis=2).min(axis=0)
        assert distance[-1] < 0.02 and (rounding or distance.max() < 0.02)


def test_a_rounded_path_is_used_only_where_it_is_free_and_is_quicker():
    corners = READY + np.array([[0, 0], [0.6, 0], [0.6, 0.6]]) @ np.eye(2, 7)
    ask, config = Mock(return_value=True), TimingConfig()
    rounded, quick = timed_path(corners, ask, PANDA.limits, config)
    stopping, slow = timed_path(corners, lambda path: False, PANDA.limits, config)
    ((asked,), _) = ask.call_args
    assert ask.call_count == 1 and quick < slow
    # What was checked is what is driven.
    dense = np.concatenate([np.linspace(a, b, 50) for a, b in pairwise(asked)])
    assert np.linalg.norm(rounded[:, None] - dense, axis=2).min(axis=1).max() < 0.01
    legs = np.concatenate([np.linspace(a, b, 400) for a, b in pairwise(corners)])
    assert np.linalg.norm(stopping[:, None] - legs, axis=2).min(axis=1).max() < 0.002


def test_timings_and_clearances_that_make_no_sense_are_refused():
    refused("clearances", ArmSpaceConfig, clearance_m=0.0)
    for wrong in ({"velocity_share": 0.0}, {"acceleration_share": 1.5}, {"sample_hz": 0.0}):
        refused(".", TimingConfig, **wrong)
