"""Faults of views are named, and only those: every fault is done on purpose to simulated views."""

from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
import pytest
from numpy.typing import NDArray

from realsim.arrays import Array, Array32
from realsim.geometry import se3
from realsim.geometry.camera import project, ray_table
from realsim.records import CameraIntrinsics
from realsim.registration import view_checks
from realsim.registration.evidence import DepthFrame, DepthNoise
from realsim.registration.find_table import find_table
from realsim.registration.simulated import table_scene
from realsim.registration.view_checks import check_views
from realsim.registration.views import (
    SampleConfig,
    ViewPoints,
    sample_view,
    sample_views,
    world_cloud,
)
from refusals import refused
from table_scenes import SMALL_LAB, bodies_of, part_models, small_scene, true_poses, views_of

NOISE = DepthNoise(per_m=0.008, floor_m=2e-4)
VIEWS = 16
sampled = partial(views_of, noise=NOISE, stride=2, edge_reach_px=1)


@lru_cache(maxsize=4)
def views_at(seed: int):
    return sampled(small_scene(seed, 6, VIEWS))


def findings(views, noise=NOISE):
    return check_views(views, find_table(views, noise).plane, noise)


def with_pose(view, T):
    return replace(view, T_world_cam=T)


def off_by(view, mm: float, deg: float):
    T = se3.from_rt(se3.exp_so3(np.radians([deg, 0, 0])), [0, 0, mm / 1e3])
    return with_pose(view, view.T_world_cam @ T)


def kinds(found):
    return {f.index: f.kind for f in found}


@pytest.mark.parametrize(("seed", "views"), [(1, VIEWS), (1, 1), (1, 2)])
def test_sound_views_are_left_alone(seed, views):
    assert findings(views_at(seed)[:views]) == ()


def test_a_bad_hand_eye_is_no_fault_of_the_views():
    scene = small_scene(1, 6, VIEWS)
    config = replace(SMALL_LAB, views=VIEWS, hand_eye_mm=1.5, hand_eye_deg=0.4)
    bad = table_scene(part_models(), scene.truth, config, np.random.default_rng(4))
    assert findings(sampled(bad)) == ()


def test_views_without_depth_are_named():
    views = list(views_at(1))
    for k, left, share in ((2, 0, 0.0), (5, 300, 0.03), (7, 20, 0.01)):
        few = replace(views[k], points=views[k].points[:left], pixels=views[k].pixels[:left])
        views[k] = replace(few, measured_share=share)
    found = findings(views)
    assert kinds(found) == {2: "no_depth", 5: "little_depth", 7: "little_depth"}
    assert [f.exclude for f in found] == [True, False, True]
    assert "empty" in found[0].words and "3.0 %" in found[1].words


def test_a_view_with_a_displaced_camera_is_named():
    views = list(views_at(1))
    views[7] = off_by(views[7], 15, 3)
    found = findings(views)
    assert kinds(found) == {7: "table_off"} and found[0].exclude
    assert "3." in found[0].words  # the tilt is measured to the degree


def test_swapped_poses_are_named_with_their_partner():
    views = list(views_at(1))
    a, b = views[6], views[12]
    views[6], views[12] = with_pose(a, b.T_world_cam), with_pose(b, a.T_world_cam)
    found = findings(views)
    assert kinds(found) == {6: "pose_of_another", 12: "pose_of_another"}
    assert "that of view 12" in found[0].words and "that of view 6" in found[1].words


def test_views_of_another_session_are_named():
    # The other session stood on the same table, its cameras where they are said to be.
    wrong = range(10, 16)
    found = findings([views_at(2)[k] if k in wrong else v for k, v in enumerate(views_at(1))])
    assert kinds(found) == dict.fromkeys(wrong, "foreign")
    assert all(f.exclude for f in found)


def test_two_views_that_disagree_are_not_told_apart():
    found = findings([views_at(1)[0], views_at(2)[1]])
    assert kinds(found) == {None: "all_disagree"} and not found[0].exclude
    assert "depth's unit" in found[0].words and "aligned to the colour" in found[0].words


def test_a_slipped_mount_is_named_with_the_view_it_begins_at():
    found = findings([off_by(v, 10, 3) if k >= 11 else v for k, v in enumerate(views_at(1))])
    assert kinds(found) == dict.fromkeys(range(11, VIEWS), "slipped")
    assert "before view 11" in found[0].words


GL = np.diag([1.0, -1.0, -1.0, 1.0])


def in_mm(Ts):
    return se3.from_rt(Ts[:, :3, :3], 1e3 * Ts[:, :3, 3])


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        (se3.invert, "world-to-camera: invert"),
        (lambda Ts: se3.invert(Ts @ GL), "world-to-camera with OpenGL's"),
        (in_mm, "camera poses seem to be in millimetres"),
        (lambda Ts: np.random.default_rng(0).permutation(Ts), "Neither inverted"),
    ],
)
def test_a_mistake_of_all_poses_is_named(mistake, words):
    wrong = mistake(np.stack([v.T_world_cam for v in views_at(1)]))
    found = findings([with_pose(v, T) for v, T in zip(views_at(1), wrong, strict=True)])
    assert kinds(found) == {None: "all_disagree"}
    assert words in found[0].words


def test_a_wrong_depth_unit_is_named():
    noise = DepthNoise(per_m=NOISE.per_m / 10, floor_m=NOISE.floor_m * 10)
    found = findings([replace(v, points=v.points * np.float32(10)) for v in views_at(1)], noise)
    assert kinds(found) == {None: "all_disagree"} and "ten times too large" in found[0].words


def test_after_registration_views_that_fit_no_object_are_named(monkeypatch):
    scene = small_scene(1, 6, VIEWS)
    plane = find_table(views_at(1), NOISE).plane
    objects = {"bodies": bodies_of(scene, 48), "Ts_world_obj": true_poses(scene)}
    assert check_views(views_at(1), plane, NOISE, **objects) == ()
    # With the check against other views switched off, the objects alone tell.
    monkeypatch.setattr(view_checks, "PARTLY_SHARE", 2.0)
    monkeypatch.setattr(view_checks, "FOREIGN_SHARE", 2.0)
    views = [*views_at(1)[:3], replace(views_at(2)[6], index=9)]
    found = check_views(views, plane, NOISE, **objects)
    assert kinds(found) == {9: "objects_off"} and found[0].exclude


def test_senseless_calls_are_errors():
    refused("no views", check_views, [], None, NOISE)
    poses = [np.eye(4)]
    refused("0 objects have 1 poses", check_views, views_at(1), None, NOISE, Ts_world_obj=poses)


# --- The table is found without any object's pose, and moves with the world.


def sheet(plane_z: float, half: float, n: int, rng, middle=(0.0, 0.0)):
    xy = rng.uniform(-half, half, (n, 2)) + middle
    return np.concatenate([xy, np.full((n, 1), plane_z)], axis=1)


def view_of_points(index: int, eye, points_world) -> ViewPoints:
    """A view that holds just these points, wherever they are in its image."""
    T = se3.look_at(np.array(eye), [0.0, 0.0, 0.0])
    p = se3.transform(se3.invert(T), points_world)
    pixels = np.rint(p[:, :2] / p[:, 2:] * 400 + [320, 240]).astype(np.int32)
    return ViewPoints(
        index=index, T_world_cam=T, points=p.astype(np.float32), pixels=pixels, area_px=16.0,
        measured_share=0.9,
    )  # fmt: skip


def test_the_true_table_is_found():
    found = find_table(views_at(1), NOISE)
    assert found.plane is not None and found.reason == ""
    T = found.plane.T_world_table
    # The hand-eye is off by 0.5 mm and 0.1 deg, the arm by a little more.
    assert abs(T[2, 3]) < 0.0015
    assert np.degrees(np.arccos(T[2, 2])) < 0.3
    # x along world x; the origin under what the cameras look at.
    assert T[0, 0] > 0.999 and np.linalg.norm(T[:2, 3]) < 0.03
    assert [v.index for v in found.views if v.own_share > 0] == list(range(VIEWS))
    assert max(v.tilt_deg for v in found.views) < 1.0
    assert max(abs(v.height_m) for v in found.views) < 0.003


def test_the_table_moves_with_the_world():
    T = se3.from_rt(se3.exp_so3([0.3, -0.4, 1.1]), np.random.default_rng(3).normal(size=3))
    moved = [with_pose(v, T @ v.T_world_cam) for v in views_at(1)]
    a, b = (find_table(v, NOISE).plane for v in (views_at(1), moved))
    assert a is not None and b is not None
    normal = T[:3, :3] @ a.T_world_table[:3, 2]
    assert np.degrees(np.arccos(np.clip(normal @ b.T_world_table[:3, 2], -1, 1))) < 0.05
    assert np.allclose(se3.transform(T, a.T_world_table[:3, 3]), b.T_world_table[:3, 3], atol=2e-4)


def test_the_lid_of_a_large_box_is_not_the_table():
    # More points on the lid, 80 mm above, than on the table around it.
    rng = np.random.default_rng(0)
    lid = sheet(0.08, 0.12, 2500, rng)
    table = sheet(0.0, 0.3, 4000, rng)
    table = table[np.abs(table[:, :2]).max(1) > 0.17][:1800]
    points = np.concatenate([lid, table]) + rng.normal(0, 3e-4, (2500 + len(table), 3))
    eyes = [(0.3 * np.cos(a), 0.3 * np.sin(a), 0.6) for a in range(6)]
    views = [view_of_points(k, eye, points) for k, eye in enumerate(eyes)]
    plane = find_table(views, NOISE).plane
    assert plane is not None and abs(plane.T_world_table[2, 3]) < 0.002


def test_gravity_chooses_the_floor_of_a_shelf():
    rng = np.random.default_rng(1)
    floor, wall = sheet(0.0, 0.2, 1500, rng), sheet(0.0, 0.2, 4000, rng)
    wall = np.stack([np.full(len(wall), -0.2), wall[:, 0], wall[:, 1] + 0.2], axis=1)
    points = np.concatenate([floor, wall]) + rng.normal(0, 3e-4, (5500, 3))
    views = [view_of_points(k, (0.6, y, 0.25), points) for k, y in enumerate((-0.2, 0, 0.2))]
    blind = find_table(views, NOISE).plane
    told = find_table(views, NOISE, gravity_up_world=[0, 0, 1]).plane
    assert blind is not None and abs(blind.T_world_table[0, 2]) > 0.99  # the wall is larger
    assert told is not None and told.T_world_table[2, 2] > 0.999


def test_reasons_are_given_where_there_is_no_table():
    cloud = np.random.default_rng(0).uniform(-0.15, 0.15, (4000, 3))
    found = find_table([view_of_points(0, (0.0, 0.1, 0.6), cloud)], NOISE)
    assert found.plane is None and "largest plane" in found.reason
    view = views_at(1)[0]
    found = find_table([replace(view, points=view.points[:0], pixels=view.pixels[:0])], NOISE)
    assert found.plane is None and "0 trusted points" in found.reason


# --- Points of views: which pixels are trusted, and that they lie where the surface is.

CAMERA = CameraIntrinsics(width=160, height=90, fx=115.0, fy=112.0, cx=80.3, cy=44.1)


def frame(depth: NDArray, T: Array | None = None, index: int = 0) -> DepthFrame:
    T = np.eye(4) if T is None else T
    return DepthFrame(index=index, depth_m=np.asarray(depth, np.float32), T_world_cam=T)


def plane_depth(camera: CameraIntrinsics, T_world_cam: Array) -> Array32:
    """Exact depth of the plane z = 0 of the world (no lens distortion)."""
    down = ray_table(camera) @ T_world_cam[2, :3]
    return np.where(down < 0, -T_world_cam[2, 3] / down, 0).astype(np.float32)


def trusted_by_definition(depth: NDArray, config: SampleConfig) -> list[tuple[int, int]]:
    """(column, row) of the pixels that a reader of the config would keep."""
    known = np.isfinite(depth) & (depth > 0)
    pitch = config.edge_slope / min(CAMERA.fx, CAMERA.fy)
    kept: list[tuple[int, int]] = []
    reach = config.edge_reach_px
    for i in range(0, depth.shape[0], config.stride):
        for j in range(0, depth.shape[1], config.stride):
            if not known[i, j]:
                continue
            window = tuple(slice(max(0, k - reach), k + reach + 1) for k in (i, j))
            near = depth[window][known[window]]
            z = float(depth[i, j])
            allowed = config.edge_jump_m + pitch * z + config.edge_sigmas * NOISE.sigma(np.array(z))
            if float(near.max()) - float(near.min()) <= allowed:
                kept.append((j, i))
    return kept


@pytest.mark.parametrize("stride, reach", [(1, 3), (3, 2)])
def test_trusted_pixels_are_those_of_the_definition(stride: int, reach: int):
    rng = np.random.default_rng(stride)
    steps = np.kron(rng.uniform(0.3, 0.45, (6, 8)), np.ones((15, 20)))
    depth = (steps + rng.normal(0, 1e-3, steps.shape)).astype(np.float32)
    for wrong, share in ((0, 0.2), (np.nan, 0.01), (np.inf, 0.01), (-0.3, 0.01)):
        depth[rng.random(depth.shape) < share] = wrong
    config = SampleConfig(stride=stride, edge_reach_px=reach)
    view = sample_view(CAMERA, frame(depth), NOISE, config)
    expected = trusted_by_definition(depth, config)
    assert 50 < len(expected) < len(depth[::stride, ::stride].ravel())
    assert [(int(u), int(v)) for u, v in view.pixels] == expected
    sampled = depth[::stride, ::stride]
    measured = np.isfinite(sampled) & (sampled > 0)
    assert view.measured_share == pytest.approx(measured.mean())
    assert view.area_px == stride**2


def test_a_point_is_seen_where_its_pixel_is():
    camera = replace(CAMERA, distortion=np.array([-0.05, 0.02, 0.001, -0.002, 0.0]))
    depth = np.full((90, 160), 0.4, np.float32)
    view = sample_view(camera, frame(depth), NOISE, SampleConfig(stride=7))
    assert len(view.points) > 200 and view.points.dtype == np.float32
    np.testing.assert_allclose(view.points[:, 2], 0.4, rtol=1e-6)
    uv = project(camera, view.points.astype(np.float64))
    np.testing.assert_allclose(uv, view.pixels, atol=1e-3)


def test_cloud_looks_back_at_the_cameras_with_their_noise():
    Ts = [se3.look_at([0.2, 0, 0.4], [0, 0, 0]), se3.look_at([0, -0.3, 0.9], [0, 0, 0])]
    frames = [frame(plane_depth(CAMERA, T), T, k) for k, T in enumerate(Ts)]
    views = sample_views(CAMERA, frames, NOISE, SampleConfig(stride=5))
    cloud = world_cloud(views, NOISE)
    n = len(views[0].points)
    assert len(cloud.points) == n + len(views[1].points)
    np.testing.assert_allclose(np.linalg.norm(cloud.towards, axis=1), 1)
    for part, T, view in ((slice(0, n), Ts[0], views[0]), (slice(n, None), Ts[1], views[1])):
        far = np.linalg.norm(T[:3, 3] - cloud.points[part], axis=1, keepdims=True)
        back = cloud.points[part] + far * cloud.towards[part]
        np.testing.assert_allclose(back, np.tile(T[:3, 3], (len(far), 1)), atol=1e-9)
        z = view.points[:, 2].astype(np.float64)
        np.testing.assert_allclose(cloud.sigmas[part], np.maximum(2e-4, 0.008 * z**2), rtol=1e-6)
