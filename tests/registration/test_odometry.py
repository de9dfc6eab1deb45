"""Camera motion from depth alone, and what it says about the robot's poses."""

import json
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.registration.odometry.cross_check import KinematicsCheck, check_kinematics
from realsim.registration.odometry.hand_held import hand_held_poses
from realsim.registration.odometry.pairs import FitConfig, LocalMap, thin_points
from realsim.registration.simulated import DEPTH_UNIT_M, render_depth
from realsim.registration.views import SampleConfig, ViewPoints
from refusals import refused
from table_scenes import TABLE, small_scene, things_of, views_of

VIEWS = 32


@lru_cache(maxsize=1)
def views() -> tuple[ViewPoints, ...]:
    return views_of(small_scene(1, objects=6, views=VIEWS))


def checked(order, Ts) -> KinematicsCheck:
    """Return the check of these views in a new order of capture, at these poses."""
    captured = [replace(views()[v], T_world_cam=Ts[k], index=k) for k, v in enumerate(order)]
    return check_kinematics(captured, TABLE)


def claimed() -> np.ndarray:
    return np.stack([v.T_world_cam for v in views()])


def off(mm: float, deg: float, seed: int = 0) -> np.ndarray:
    a = np.random.default_rng(seed).normal(size=(2, 3))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    return se3.from_rt(se3.exp_so3(np.radians(deg) * a[0]), 1e-3 * mm * a[1])


def test_known_motion_is_found():
    # A surface with relief in all directions, 35 cm before a camera.
    x, y = np.random.default_rng(1).uniform(-0.1, 0.1, (6000, 2)).T
    z = 0.35 + 0.02 * np.sin(60 * x) * np.cos(45 * y) + 0.3 * x * y
    points = np.column_stack([x, y, z])
    step = se3.exp([0.01, -0.02, 0.015, 0.003, -0.002, 0.001])
    kept = LocalMap(thin_points(points, 0.004), 0.004, 2)
    for k in range(3):
        true = np.linalg.matrix_power(step, k)
        cloud = se3.transform(se3.invert(true), points)
        found = kept.align(cloud, np.eye(4), FitConfig())
        error = se3.log(se3.invert(true) @ found)
        assert np.degrees(np.abs(error[:3])).max() < 0.15
        assert 1e3 * np.abs(error[3:]).max() < 1.0
        assert kept.align(cloud, np.eye(4), FitConfig()).tobytes() == found.tobytes()


def test_a_clean_capture_raises_no_alarm():
    check = check_kinematics(views(), TABLE)
    assert check.good, check.words()
    assert check.noise_mm < 1.6 and check.noise_deg < 0.25
    assert [v.index for v in check.views] == list(range(VIEWS))
    assert json.loads(json.dumps(check.as_json(), allow_nan=False))["good"] is True


def test_one_wrong_view_is_named():
    Ts = claimed()
    Ts[17] = Ts[17] @ off(6, 1.2)
    check = checked(range(VIEWS), Ts)
    assert [(f.kind, f.view) for f in check.faults] == [("view", 17)]
    assert check.faults[0].mm == pytest.approx(6, abs=2)
    assert check.faults[0].deg == pytest.approx(1.2, abs=0.4)
    assert "view 17: its depth disagrees with its robot pose" in check.words()[1]


def test_a_slipped_mount_is_named():
    Ts = claimed()
    Ts[18:] = Ts[18:] @ off(5, 1.0, 3)
    check = checked(range(VIEWS), Ts)
    assert [(f.kind, f.view) for f in check.faults] == [("mount", 18)]
    assert check.faults[0].mm == pytest.approx(5, abs=2)


@pytest.mark.slow
def test_swapped_images_are_named():
    order = np.arange(VIEWS)
    order[[9, 20]] = order[[20, 9]]
    check = checked(order, claimed())
    assert [(f.kind, f.view, f.other) for f in check.faults] == [("swapped", 9, 20)]


@pytest.mark.slow
def test_a_skipped_image_is_named():
    check = checked(np.delete(np.arange(VIEWS), 11), claimed())
    assert [(f.kind, f.view, f.other) for f in check.faults] == [("shifted", 11, 1)]
    assert "from view 11 on" in check.words()[1]


def test_an_empty_table_is_an_error():
    empty = [replace(v, points=v.points[:0], pixels=v.pixels[:0]) for v in views()[:3]]
    refused("0 of 3 views", check_kinematics, empty, TABLE)


# --- Camera poses of a capture without a robot.

SAMPLE = SampleConfig(stride=1)


@lru_cache(maxsize=1)
def led_by_hand():
    """Return intrinsics, depths and true poses of an arc in steps of about 5 degrees."""
    scene = small_scene(1, objects=6, views=32)
    rng = np.random.default_rng(7)
    poses = []
    for k in range(12):
        azimuth, height = np.radians(5.0 * k + rng.normal(scale=0.4)), 0.25 + 0.02 * np.sin(k / 3)
        eye = [0.22 * np.cos(azimuth), 0.22 * np.sin(azimuth), height]
        poses.append(se3.look_at(eye, [*rng.normal(scale=0.003, size=2), 0.03], 0.1 * np.sin(k)))
    images = render_depth(things_of(scene), scene.intrinsics, np.stack(poses), scene.sensor, 5)
    depths = [d.astype(np.float32) * np.float32(DEPTH_UNIT_M) for d in images]
    return scene.intrinsics, depths, np.stack(poses)


@lru_cache(maxsize=1)
def found():
    intrinsics, depths, _ = led_by_hand()
    return hand_held_poses(intrinsics, depths, SAMPLE)


def test_poses_are_good_enough_for_the_joint_refinement():
    _, _, true = led_by_hand()
    Ts = found().Ts_world_cam
    error = se3.log(se3.invert(se3.invert(true[0]) @ true) @ (se3.invert(Ts[0]) @ Ts))
    mm = 1e3 * np.linalg.norm(error[:, 3:], axis=1)
    # Against the first view, which all of the way turns about.
    assert np.median(mm) < 2.5 and mm.max() < 6.0
    assert np.degrees(np.linalg.norm(error[:, :3], axis=1)).max() < 1.0


def test_the_table_is_the_ground():
    _, _, true = led_by_hand()
    Ts = found().Ts_world_cam
    assert all(found().levelled)
    assert np.abs(Ts[:, 2, 3] - true[:, 2, 3]).max() < 2e-3
    tilt = np.arccos(np.clip(np.sum(Ts[:, 2, :3] * true[:, 2, :3], axis=1), -1, 1))
    assert np.degrees(tilt).max() < 0.4


def test_sigmas_grow_with_the_way():
    place, turn = slice(3, 6), slice(0, 3)  # of the twists
    sigma, sigma_deg = (
        unit * np.sqrt(np.trace(found().covariances[:, s, s], axis1=1, axis2=2))
        for unit, s in ((1e3, place), (180 / np.pi, turn))
    )
    assert sigma[0] < sigma[-1] < 10
    assert np.all(sigma_deg < 2)
    assert found().overlaps[0] == 1.0 and found().overlaps.min() > 0.6


def test_a_missing_piece_of_the_way_is_named():
    intrinsics, depths, _ = led_by_hand()
    turned = [*depths[:4], depths[4][::-1, ::-1].copy()]
    refused("view 4 cannot be placed", hand_held_poses, intrinsics, turned, SAMPLE)


def test_without_a_table_there_is_no_ground():
    intrinsics, depths, _ = led_by_hand()
    wild = np.random.default_rng(0).uniform(0.2, 0.6, depths[0].shape).astype(np.float32)
    with pytest.raises((DegenerateError, InputError), match="view 0"):
        hand_held_poses(intrinsics, [wild, depths[1]], SAMPLE)
