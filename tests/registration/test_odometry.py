"""Camera motion from depth alone, and what it says about the robot's poses."""

import json
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import SupportPlane
from realsim.registration.evidence import DepthNoise
from realsim.registration.odometry.cross_check import check_kinematics
from realsim.registration.odometry.kiss import FitConfig, LocalMap, thin_points
from realsim.registration.views import SampleConfig, ViewPoints, sample_views
from table_scenes import small_scene

PLANE = SupportPlane(T_world_table=np.eye(4))
NOISE = DepthNoise(per_m=0.0069, floor_m=2e-4)
VIEWS = 32


@lru_cache(maxsize=4)
def views_of(seed: int) -> tuple[ViewPoints, ...]:
    scene = small_scene(seed, objects=6, views=VIEWS)
    return sample_views(scene.intrinsics, scene.frames, NOISE, SampleConfig(stride=1))


def posed(views, Ts) -> list[ViewPoints]:
    """Return the views in a new order of capture, at these poses."""
    return [
        replace(v, T_world_cam=T, index=k) for k, (v, T) in enumerate(zip(views, Ts, strict=False))
    ]


def poses_of(views) -> np.ndarray:
    return np.stack([v.T_world_cam for v in views])


def off(mm: float, deg: float, seed: int = 0) -> np.ndarray:
    a = np.random.default_rng(seed).normal(size=(2, 3))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    return se3.from_rt(se3.exp_so3(np.radians(deg) * a[0]), 1e-3 * mm * a[1])


def bumpy(rng: np.random.Generator) -> np.ndarray:
    """Points (N, 3) on a surface with relief in all directions, 35 cm before a camera."""
    xy = rng.uniform(-0.1, 0.1, (6000, 2))
    z = 0.35 + 0.02 * np.sin(60 * xy[:, 0]) * np.cos(45 * xy[:, 1]) + 0.3 * xy[:, 0] * xy[:, 1]
    return np.column_stack([xy, z])


def test_known_motion_is_found():
    rng = np.random.default_rng(1)
    points = bumpy(rng)
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
    check = check_kinematics(views_of(1), PLANE)
    assert check.good, check.words()
    assert check.noise_mm < 1.6 and check.noise_deg < 0.25
    assert [v.index for v in check.views] == list(range(VIEWS))
    assert json.loads(json.dumps(check.as_json(), allow_nan=False))["good"] is True


def test_one_wrong_view_is_named():
    views = views_of(1)
    Ts = poses_of(views)
    Ts[17] = Ts[17] @ off(6, 1.2)
    check = check_kinematics(posed(views, Ts), PLANE)
    assert [(f.kind, f.view) for f in check.faults] == [("view", 17)]
    assert check.faults[0].mm == pytest.approx(6, abs=2)
    assert check.faults[0].deg == pytest.approx(1.2, abs=0.4)
    assert "view 17: its depth disagrees with its robot pose" in check.words()[1]


def test_a_slipped_mount_is_named():
    views = views_of(1)
    Ts = poses_of(views)
    Ts[18:] = Ts[18:] @ off(5, 1.0, 3)
    check = check_kinematics(posed(views, Ts), PLANE)
    assert [(f.kind, f.view) for f in check.faults] == [("mount", 18)]
    assert check.faults[0].mm == pytest.approx(5, abs=2)


@pytest.mark.slow
def test_swapped_images_are_named():
    views = views_of(1)
    order = np.arange(VIEWS)
    order[[9, 20]] = order[[20, 9]]
    check = check_kinematics(posed([views[k] for k in order], poses_of(views)), PLANE)
    assert [(f.kind, f.view, f.other) for f in check.faults] == [("swapped", 9, 20)]


@pytest.mark.slow
def test_a_skipped_image_is_named():
    views = views_of(1)
    kept = np.delete(np.arange(VIEWS), 11)
    check = check_kinematics(posed([views[k] for k in kept], poses_of(views)), PLANE)
    assert [(f.kind, f.view, f.other) for f in check.faults] == [("shifted", 11, 1)]
    assert "from view 11 on" in check.words()[1]


def test_an_empty_table_is_an_error():
    views = [replace(v, points=v.points[:0], pixels=v.pixels[:0]) for v in views_of(1)[:3]]
    with pytest.raises(InputError, match="0 of 3 views"):
        check_kinematics(views, PLANE)
