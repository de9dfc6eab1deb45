"""Camera motion from depth alone, and what it says about the robot's poses."""

import json
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.registration.odometry.cross_check import KinematicsCheck, check_kinematics
from realsim.registration.odometry.kiss import FitConfig, LocalMap, thin_points
from realsim.registration.views import ViewPoints
from refusals import refused
from table_scenes import TABLE, small_scene, views_of

VIEWS = 32


@lru_cache(maxsize=1)
def views() -> tuple[ViewPoints, ...]:
    return views_of(small_scene(1, objects=6, views=VIEWS))


def checked(order, Ts) -> KinematicsCheck:
    """Return the check of these views in a new order of capture, at these poses."""
    return check_kinematics(
        [replace(views()[v], T_world_cam=Ts[k], index=k) for k, v in enumerate(order)], TABLE
    )


def claimed() -> np.ndarray:
    return np.stack([v.T_world_cam for v in views()])


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
