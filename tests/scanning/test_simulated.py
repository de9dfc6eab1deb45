"""The simulated scan: what it calls true is true, and its errors are exactly those asked for."""

from dataclasses import replace

import numpy as np
import pytest

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from realsim.geometry.mesh import box_mesh
from realsim.records import Mesh
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.scanning.simulated import T_EE_CAM, ScanLabConfig, ScanViews, scan_views, standing

HALF_M = np.array([0.03, 0.02, 0.05])
SMALL = ScanLabConfig(width=64, height=36, focal_px=32.4, sensor=DepthSensorModel.noiseless())
"""A lab whose images cost nothing: poses do not depend on them."""


def block() -> Mesh:
    """Return a block of 60 x 40 x 100 mm about the origin, 12 triangles."""
    return box_mesh(-HALF_M, HALF_M)


def scanned(config: ScanLabConfig, seed: int) -> ScanViews:
    rng = np.random.default_rng(seed)
    mesh = block()
    return scan_views(mesh, standing(mesh, np.eye(3), rng), config, rng)


def pose_errors(views: ScanViews) -> Array:
    """Return inv(true) @ reported (F, 4, 4)."""
    return se3.invert(views.Ts_world_cam) @ np.stack([f.T_world_cam for f in views.frames])


def test_the_hand_eye_error_is_one_constant_motion_of_the_size_asked_for():
    directions = []
    for seed in range(24):
        E = pose_errors(scanned(replace(SMALL, views=3, arm_mm=0.0, arm_deg=0.0), seed))
        np.testing.assert_allclose(E, np.broadcast_to(E[0], E.shape), atol=1e-12)
        assert np.linalg.norm(E[0, :3, 3]) == pytest.approx(0.5e-3, rel=1e-9)
        assert np.degrees(se3.angle(E[0, :3, :3])) == pytest.approx(0.1, rel=1e-6)
        directions.append(E[0, :3, 3] / 0.5e-3)
    # Evenly over the sphere: the mean of 24 unit vectors has 1/sqrt(72) per axis.
    assert np.all(np.abs(np.mean(directions, axis=0)) < 4 / np.sqrt(72))


def test_the_arm_error_is_white_at_the_flange_with_the_sigmas_asked_for():
    views = scanned(replace(SMALL, views=600, hand_eye_mm=0.0, hand_eye_deg=0.0), seed=3)
    # reported = true @ inv(X) @ exp(xi) @ X with the camera X on the hand.
    xi = se3.log(T_EE_CAM @ pose_errors(views) @ se3.invert(T_EE_CAM))
    spread = 4 / np.sqrt(2 * xi[:, :3].size)  # of a standard deviation, four sigma
    assert np.degrees(xi[:, :3].std()) == pytest.approx(0.03, rel=spread)
    assert 1e3 * xi[:, 3:].std() == pytest.approx(0.2, rel=spread)
    unit = xi / xi.std(0)
    assert np.all(np.abs(unit.mean(0)) < 4 / np.sqrt(len(xi)))
    correlation = np.corrcoef(np.concatenate([unit[1:], unit[:-1]], 1).T)
    assert np.all(np.abs(correlation - np.eye(12)) < 5 / np.sqrt(len(xi)))


def slab_depth(views: ScanViews, T_world_cam: Array) -> tuple[Array, Array]:
    """Return, by hand, the depth image (H, W) of the block on its table, and where the block is.

    The table ends 0.6 m from the block: there is nothing beyond, nor above the horizon.
    """
    directions = ray_table(views.intrinsics).astype(np.float64) @ T_world_cam[:3, :3].T
    origin = T_world_cam[:3, 3]
    table = -origin[2] / directions[..., 2]
    place = (origin + table[..., None] * directions - views.T_world_obj[:3, 3])[..., :2]
    table = np.where((table > 0) & np.all(np.abs(place) < 0.6, axis=-1), table, 0.0)
    T_obj_world = se3.invert(views.T_world_obj)
    o = se3.transform(T_obj_world, origin[None])[0]
    d = directions @ T_obj_world[:3, :3].T
    first, second = (-HALF_M - o) / d, (HALF_M - o) / d
    enter, leave = np.minimum(first, second).max(-1), np.maximum(first, second).min(-1)
    seen = (enter < leave) & (enter > 0)
    return np.where(seen, enter, table), seen


def test_without_noise_depth_is_that_of_the_true_geometry_at_the_true_poses():
    views = scanned(replace(SMALL, width=320, height=180, focal_px=162.0, views=6), seed=5)
    for frame, T in zip(views.frames, views.Ts_world_cam, strict=True):
        expected, block_seen = slab_depth(views, T)
        off = np.abs(frame.depth_m - expected)
        assert frame.depth_m.dtype == np.float32
        # A ray through an edge may go either way in float32.
        assert np.mean(off < 2e-6) > 0.9995
        assert np.mean(off[block_seen] < 2e-6) > 0.98
        assert block_seen.sum() > 300
