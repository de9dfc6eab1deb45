"""Camera poses of a capture without a robot."""

from functools import lru_cache

import numpy as np
import pytest

from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.registration.odometry.hand_held import hand_held_poses
from realsim.registration.simulated import DEPTH_UNIT_M, render_depth
from realsim.registration.views import SampleConfig
from refusals import refused
from table_scenes import small_scene, things_of

SAMPLE = SampleConfig(stride=1)
VIEWS = 12


@lru_cache(maxsize=1)
def led_by_hand():
    """Return intrinsics, depths and true poses of an arc in steps of about 5 degrees."""
    scene = small_scene(1, objects=6, views=32)
    rng = np.random.default_rng(7)
    poses = []
    for k in range(VIEWS):
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
    rng = np.random.default_rng(0)
    wild = rng.uniform(0.2, 0.6, depths[0].shape).astype(np.float32)
    with pytest.raises((DegenerateError, InputError), match="view 0"):
        hand_held_poses(intrinsics, [wild, depths[1]], SAMPLE)
