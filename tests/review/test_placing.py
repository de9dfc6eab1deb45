"""Placing by hand: steps that undo each other, points that agree, objects that touch the table."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from realsim.arrays import Array, Array32
from realsim.geometry import se3
from realsim.geometry.distance_field import raycasting_scene
from realsim.geometry.parts import part
from realsim.interop import import_open3d
from realsim.records import ObjectPose, SupportPlane
from realsim.review.placing import placing
from realsim.review.placing.ellipsoid import ellipsoid_of, middle_of, pose_sigmas, unit_sphere
from realsim.review.placing.picking import ray_on_cloud, ray_on_mesh
from refusals import refused

MUG_MESH = part("mug").mesh
MIDDLE = placing.middle_of(MUG_MESH)
KINDS: tuple[placing.Kind, ...] = ("move", "turn")
FRAMES: tuple[placing.Frame, ...] = ("table", "object", "camera")


def random_poses(seed: int) -> tuple[Array, Array, Array]:
    T = se3.random_transform(np.random.default_rng(seed), 3)
    return T[0], T[1], T[2]


def step(
    T: Array, how: tuple[placing.Kind, placing.Frame, placing.Axis], amount: float,
    T_world_table: Array, T_world_cam: Array,
) -> Array:  # fmt: skip
    kind, frame, axis = how
    return placing.nudged(
        T, axis, amount, kind, frame, T_world_table=T_world_table, T_world_cam=T_world_cam,
        pivot_obj=MIDDLE,
    )  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("frame", FRAMES)
def test_a_step_goes_there_and_back_and_commutes_with_a_change_of_world(
    kind: placing.Kind, frame: placing.Frame
) -> None:
    how, (T, table, cam) = (kind, frame, "y"), random_poses(1)
    there = step(T, how, 0.3, table, cam)
    assert np.abs(there - T).max() > 0.01
    np.testing.assert_allclose(step(there, how, -0.3, table, cam), T, atol=1e-14)
    W = se3.random_transform(np.random.default_rng(3))
    np.testing.assert_allclose(step(W @ T, how, 0.3, W @ table, W @ cam), W @ there, atol=1e-14)


@pytest.mark.parametrize("frame", FRAMES)
def test_a_turn_leaves_the_middle_where_it_is(frame: placing.Frame) -> None:
    T, table, cam = random_poses(4)
    found = placing.moved(T, step(T, ("turn", frame, "y"), np.radians(5.0), table, cam), MUG_MESH)
    assert found.mm < 1e-10
    assert found.deg == pytest.approx(5.0)


def test_moves_go_along_the_named_axis() -> None:
    T, table, cam = random_poses(6)
    for frame, F in zip(FRAMES, (table, T, cam), strict=True):
        for k, axis in enumerate(placing.AXES):
            moved = step(T, ("move", frame, axis), 0.01, table, cam)
            np.testing.assert_allclose(moved[:3, 3] - T[:3, 3], 0.01 * F[:3, k], atol=1e-15)


def test_a_thousand_small_turns_leave_a_rigid_pose() -> None:
    T, table, cam = random_poses(7)
    for _ in range(1000):
        T = step(T, ("turn", "camera", "z"), 0.01, table, cam)
    np.testing.assert_allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-14)


def test_steps_that_are_none_are_refused() -> None:
    refused("camera", placing.nudged, np.eye(4), "x", 0.001, "move", "camera")
    refused("middle", placing.nudged, np.eye(4), "x", 0.001, "turn", "object")
    refused("finite", placing.nudged, np.eye(4), "x", float("nan"), "move", "object")
    for bad in (("w", "move", "table"), ("x", "stretch", "table"), ("x", "move", "moon")):
        axis, kind, frame = bad
        refused("accepted", placing.nudged, np.eye(4), axis, 0.1, kind, frame, pivot_obj=MIDDLE)


# --- points -----------------------------------------------------------------------------------

TRIANGLE = np.array([[0.04, 0.0, 0.0], [-0.03, 0.03, 0.01], [0.0, -0.03, 0.05]])


def test_exact_pairs_give_the_exact_pose() -> None:
    for n in (3, 4, 10):
        rng = np.random.default_rng(n)
        points = np.concatenate([TRIANGLE, rng.normal(scale=0.03, size=(n - 3, 3))])
        T = se3.random_transform(rng)
        found = placing.from_points(points, se3.transform(T, points))
        np.testing.assert_allclose(found.T_world_obj, T, atol=1e-12)
        assert found.rms_m < 1e-12


def test_points_are_equivariant_under_rigid_motions_of_either_side() -> None:
    rng = np.random.default_rng(8)
    T, A, B = se3.random_transform(rng, 3)
    world = se3.transform(T, TRIANGLE) + rng.normal(scale=5e-4, size=(3, 3))
    found = placing.from_points(TRIANGLE, world)
    moved = placing.from_points(se3.transform(A, TRIANGLE), se3.transform(B, world))
    np.testing.assert_allclose(moved.T_world_obj, B @ found.T_world_obj @ se3.invert(A), atol=1e-12)
    assert moved.rms_m == pytest.approx(found.rms_m)


def test_points_on_a_line_are_refused() -> None:
    line = np.outer([0.0, 0.02, 0.05], [1.0, 2.0, 0.5])
    refused(r"one line.*wide triangle", placing.from_points, line, line)
    refused("in the scene", placing.from_points, TRIANGLE, line)
    refused("one line", placing.from_points, np.zeros((3, 3)), np.zeros((3, 3)))


def test_the_pair_that_disagrees_is_named() -> None:
    world = TRIANGLE.copy()
    world[2] += 1.5 * (world[2] - world[0])
    refused(r"points 1 and 3 lie 70\.7 mm apart .* 176\.8 mm", placing.from_points, TRIANGLE, world)


def test_too_few_and_unequal_points_are_refused() -> None:
    refused("at least 3", placing.from_points, TRIANGLE[:2], TRIANGLE[:2])
    refused("no pairs", placing.from_points, TRIANGLE, TRIANGLE[:2])
    refused("finite", placing.from_points, TRIANGLE, TRIANGLE * np.nan)


# --- the table --------------------------------------------------------------------------------


def test_what_is_put_on_the_table_touches_it() -> None:
    T, table, _ = random_poses(10)
    plane = SupportPlane(T_world_table=table)
    down = placing.on_table(T, MUG_MESH, plane)
    assert abs(se3.transform(se3.invert(table) @ down, MUG_MESH.vertices)[:, 2].min()) < 1e-12
    np.testing.assert_array_equal(down[:3, :3], T[:3, :3])
    np.testing.assert_allclose(table[:3, :2].T @ (down[:3, 3] - T[:3, 3]), 0, atol=1e-12)
    np.testing.assert_allclose(placing.on_table(down, MUG_MESH, plane), down, atol=1e-14)


# --- What a click meets: invariant under motions of the world, the nearer thing before the farther.

MUG = part("mug")
WEDGE = part("wedge")


def rays_at(rng: np.random.Generator, n: int) -> tuple[Array, Array]:
    """Return rays from half a metre off towards about the origin."""
    away = rng.normal(size=(n, 3))
    origins = 0.5 * away / np.linalg.norm(away, axis=1, keepdims=True)
    return origins, rng.normal(scale=0.03, size=(n, 3)) - origins


def test_a_mesh_is_hit_where_open3d_hits_it() -> None:
    o3d = import_open3d()
    origins, directions = rays_at(np.random.default_rng(0), 120)
    rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
    t = raycasting_scene(MUG.mesh).cast_rays(o3d.core.Tensor(rays), 1)["t_hit"].numpy()
    hits = 0
    for o, d, u in zip(origins, directions, t, strict=True):
        found = ray_on_mesh(o, d, MUG.mesh, np.eye(4))
        assert (found is not None) == bool(np.isfinite(u))
        if found is not None:
            np.testing.assert_allclose(found, o + u * d, atol=2e-6)
            hits += 1
    assert 20 < hits < 120


def test_the_point_on_the_object_does_not_depend_on_where_the_world_is() -> None:
    rng = np.random.default_rng(1)
    T, W = se3.random_transform(rng, 2)
    for o, d in zip(*rays_at(rng, 40), strict=True):
        o_world, d_world = se3.transform(T, o[None])[0], T[:3, :3] @ d
        at = ray_on_mesh(o_world, d_world, MUG.mesh, T)
        o_moved, d_moved = se3.transform(W, o_world[None])[0], 7.0 * W[:3, :3] @ d_world
        moved = ray_on_mesh(o_moved, d_moved, MUG.mesh, W @ T)
        assert (at is None) == (moved is None)
        if at is not None and moved is not None:
            np.testing.assert_allclose(moved, at, atol=1e-12)


def test_what_lies_behind_the_eye_is_not_met() -> None:
    eye = np.array([0.0, 0.0, 1.0])
    assert ray_on_mesh(eye, [0, 0, 1], WEDGE.mesh, np.eye(4)) is None
    assert ray_on_mesh(eye, [0, 0, -1], WEDGE.mesh, np.eye(4)) is not None


# --- clouds -----------------------------------------------------------------------------------


def sheet(z: float, slope: float = 0.0, n: int = 120) -> Array32:
    """Return a sheet of points 1 mm apart that rises along x."""
    x, y = np.meshgrid(np.arange(n) * 1e-3 - 0.06, np.arange(n) * 1e-3 - 0.06)
    return np.stack([x.ravel(), y.ravel(), (z + slope * x).ravel()], -1).astype(np.float32)


def test_the_nearer_sheet_is_clicked() -> None:
    cloud = np.concatenate([sheet(0.0), sheet(0.02)])
    found = ray_on_cloud([0.0003, 0.0003, 0.5], [0, 0, -1], cloud)
    assert found is not None and found[2] == pytest.approx(0.02)
    found = ray_on_cloud([0.0003, 0.0003, -0.5], [0, 0, 1], cloud)
    assert found is not None and found[2] == pytest.approx(0.0)


def test_on_a_slanted_sheet_the_point_under_the_ray_is_clicked() -> None:
    cloud = sheet(0.0, slope=2.0)
    for x in (-0.03, 0.0004, 0.02):
        found = ray_on_cloud([x, 0.0, 0.5], [0, 0, -1], cloud)
        assert found is not None
        assert abs(found[0] - x) < 0.0011 and abs(found[1]) < 0.0011


def test_a_click_beside_the_cloud_meets_nothing() -> None:
    cloud, above, down = sheet(0.0), [0, 0, 0.5], [0, 0, -1]
    assert ray_on_cloud([0.2, 0, 0.5], down, cloud) is None
    assert ray_on_cloud(above, [0, 0, 1], cloud) is None
    for nothing in (np.zeros((0, 3), np.float32), np.full((9, 3), np.nan, np.float32)):
        assert ray_on_cloud(above, down, nothing) is None


def test_rays_that_are_none_are_refused() -> None:
    for o, d in (([0, 0, 0], [0, 0, 0]), ([0, 0, np.nan], [0, 0, 1]), ([0, 0], [0, 1])):
        refused("ray", ray_on_cloud, o, d, sheet(0.0))
        refused("ray", ray_on_mesh, o, d, WEDGE.mesh, np.eye(4))
    refused("shape", ray_on_cloud, [0, 0, 1], [0, 0, -1], np.zeros((4, 2), np.float32))


# --- The ellipsoid of a position and the sigmas of a turn: laws of covariances.

TUBE = replace(part("tube"), symmetry_axes=(((0.0, 0.0, 1.0), (0.0, 0.0, 0.0)),))


def covariance(seed: int) -> Array:
    A = np.random.default_rng(seed).normal(size=(6, 6))
    S = np.diag([0.02] * 3 + [0.001] * 3)
    return S @ A @ A.T @ S


def at(T: Array, C: Array | None) -> ObjectPose:
    return ObjectPose(obj_id=1, instance=0, T_world_obj=T, covariance=C)


def shape_of(placed: ObjectPose, **more: float) -> Array:
    """Return the ellipsoid's quadratic form (3, 3) in world: its axes' signs do not matter."""
    found = ellipsoid_of(placed, model=MUG, **more)
    assert found is not None
    A = found.T_world_ellipsoid[:3, :3] * found.radii_m
    return A @ A.T


def test_the_ellipsoid_is_the_spread_of_the_middle_of_sampled_poses() -> None:
    rng = np.random.default_rng(0)
    C = 1e-2 * covariance(1)  # small, so that the exponential is linear
    T = se3.random_transform(rng)
    Ts = T @ se3.exp(rng.multivariate_normal(np.zeros(6), C, size=60_000))
    spread = np.cov((Ts[:, :3, :3] @ middle_of(MUG) + Ts[:, :3, 3]).T)
    found = shape_of(at(T, C), sigmas=1.0)
    np.testing.assert_allclose(found, spread, atol=0.02 * np.abs(spread).max())


def test_it_does_not_depend_on_where_the_object_s_frame_lies() -> None:
    """T exp(xi) = T D D^-1 exp(xi): the same uncertainty, told in the frame of a moved mesh."""
    T, D = se3.random_transform(np.random.default_rng(4), 2)
    C, shift = covariance(4), se3.from_translation(D[:3, 3])
    Ad = se3.adjoint(se3.invert(shift))
    mesh = replace(MUG.mesh, vertices=se3.transform(se3.invert(shift), MUG.mesh.vertices))
    moved = ellipsoid_of(at(T @ shift, Ad @ C @ Ad.T), model=replace(MUG, mesh=mesh))
    found = ellipsoid_of(at(T, C), model=MUG)
    assert found is not None and moved is not None
    np.testing.assert_allclose(moved.radii_m, found.radii_m, rtol=1e-9)
    off = moved.T_world_ellipsoid[:3, 3] - found.T_world_ellipsoid[:3, 3]
    np.testing.assert_allclose(off, 0.0, atol=1e-12)


def test_a_turn_about_the_own_axis_does_not_blur_the_middle_nor_count_as_a_turn() -> None:
    C = np.diag([0.01, 0.02, 0.0, 1e-4, 1e-4, 1e-4]) ** 2
    blurred = C.copy()
    blurred[2, 2] = 1.0
    # Off the axis by a mark, as bounds of scanned meshes are.
    v = np.concatenate([TUBE.mesh.vertices, [[0.05, 0.0, 0.0]]])
    model = replace(TUBE, mesh=replace(TUBE.mesh, vertices=v, colors=None, uv=None, texture=None))
    assert np.linalg.norm(model.mesh.bounds.mean(0)[:2]) > 1e-3
    sharp, same = (ellipsoid_of(at(np.eye(4), c), model=model) for c in (C, blurred))
    assert sharp is not None and same is not None
    np.testing.assert_allclose(same.radii_m, sharp.radii_m)
    turn = pose_sigmas(at(np.eye(4), blurred), model)
    assert turn is not None
    np.testing.assert_allclose(turn.sigmas_deg, np.degrees([0.02, 0.01]))
    assert "own axis" in turn.words and "left out" in turn.words
    plain = pose_sigmas(at(np.eye(4), blurred), replace(model, symmetry_axes=()))
    assert plain is not None
    np.testing.assert_allclose(plain.sigmas_deg, np.degrees([1.0, 0.02, 0.01]))


def test_without_a_covariance_there_is_none() -> None:
    placed = at(np.eye(4), None)
    assert ellipsoid_of(placed) is None
    assert pose_sigmas(placed, MUG) is None
    refused("positive", ellipsoid_of, at(np.eye(4), covariance(8)), sigmas=0.0)


@pytest.mark.parametrize("divisions", [0, 2])
def test_the_sphere_is_closed_and_turned_outwards(divisions: int) -> None:
    sphere = unit_sphere(divisions)
    assert len(sphere.faces) == 20 * 4**divisions
    np.testing.assert_allclose(np.linalg.norm(sphere.vertices, axis=1), 1.0)
    assert trimesh.Trimesh(sphere.vertices, sphere.faces, process=False).is_volume
    refused("0 to 5", unit_sphere, 9)
