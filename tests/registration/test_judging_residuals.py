"""Residuals of surface patches: right poses leave none, near-symmetric ones leave much."""

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.records import SupportPlane
from realsim.registration.body import make_body
from realsim.registration.evidence import DepthNoise
from realsim.registration.judging.surface_residuals import (
    ResidualConfig,
    error_level_m,
    residual_checks,
    surface_residuals,
    wrong_bound_m,
)
from realsim.registration.views import SampleConfig, sample_views
from table_scenes import named_scene

CONFIG = ResidualConfig()
PLANE = SupportPlane(T_world_table=np.eye(4))
NOISE = DepthNoise(per_m=0.0069, floor_m=0.0002)
NAMES = ("gear", "box", "mug", "t_profile")


@pytest.fixture(scope="module")
def watched():
    """(scene, bodies, true poses, a function poses -> residuals) with true cameras."""
    scene = named_scene(3, NAMES, 16)
    bodies = [make_body(p, scene.models[p.obj_id], 64, 300) for p in scene.truth]
    views = sample_views(scene.intrinsics, scene.frames, NOISE, SampleConfig(stride=1))

    def residuals(poses, Ts=scene.Ts_world_cam, plane=PLANE):
        return surface_residuals(bodies, poses, scene.intrinsics, views, Ts, NOISE, plane, CONFIG)

    return scene, bodies, [p.T_world_obj for p in scene.truth], residuals


def turned(body, T, angle, axis=(0.0, 0.0, 1.0)):
    C = se3.from_translation(body.center_obj)
    R = se3.from_rt(se3.exp_so3(angle * np.asarray(axis)), np.zeros(3))
    return T @ C @ R @ se3.invert(C)


def checks_of(results):
    level = error_level_m(results, CONFIG)
    return [residual_checks(r, level, CONFIG) for r in results]


def test_true_poses_leave_no_wrong_surface(watched):
    _, _, poses, residuals = watched
    for c in checks_of(residuals(poses)):
        assert c["wrong_surface"] < 0.02
        assert c["looked_through"] < 0.02
        assert c["patch_rms"] < 0.3
        assert c["measured_surface"] > 0.3


def test_a_gear_turned_by_half_a_tooth_leaves_much(watched):
    _, bodies, poses, residuals = watched
    order = len(bodies[0].model.symmetries) // 2
    wrong = [turned(bodies[0], poses[0], np.pi / order), *poses[1:]]
    first, *others = checks_of(residuals(wrong))
    assert first["wrong_surface"] > 0.1
    assert first["wrong_patch_mm2"] > 100
    assert all(c["wrong_surface"] < 0.02 for c in others)


@pytest.mark.parametrize("millimetres", [-0.4, 0.3, 2.0])
def test_a_shift_up_is_measured_with_its_sign(watched, millimetres):
    _, _, poses, residuals = watched
    up = se3.from_translation([0, 0, 1e-3 * millimetres])
    r = residuals([poses[0], up @ poses[1], *poses[2:]])[1]
    # Patches that face up: the real surface lies below a model that was moved up.
    facing = (r.patches.normals @ poses[1][:3, :3].T)[:, 2] > 0.95
    before = residuals(poses)[1].mean_m[facing]
    assert np.nanmedian(r.mean_m[facing] - before) == pytest.approx(-1e-3 * millimetres, abs=1e-4)


def test_the_world_may_be_turned(watched):
    scene, _, poses, residuals = watched
    G = se3.exp([0.3, -0.5, 1.2, 0.4, -0.2, 0.7])
    plane = SupportPlane(T_world_table=G)
    moved = residuals([G @ T for T in poses], G @ scene.Ts_world_cam, plane)
    for a, b in zip(residuals(poses), moved, strict=True):
        both = a.measured & b.measured
        assert np.mean(a.measured == b.measured) > 0.99
        np.testing.assert_allclose(np.median(a.mean_m[both] - b.mean_m[both]), 0, atol=1e-7)


def test_free_space_is_looked_through_where_nothing_stands(watched):
    _, _, poses, residuals = watched
    lifted = se3.from_translation([0, 0, 0.06]) @ poses[1]
    c = checks_of(residuals([poses[0], lifted, *poses[2:]]))[1]
    assert c["looked_through"] > 0.5


def test_errors_that_all_objects_share_raise_the_bound_but_not_without_end(watched):
    scene, _, poses, residuals = watched
    exact = error_level_m(residuals(poses), CONFIG)
    # Cameras 1.2 mm too near along their axes: depth bias of a cheap camera.
    biased = scene.Ts_world_cam @ se3.from_translation([0, 0, 0.0012])
    results = residuals(poses, biased)
    level = error_level_m(results, CONFIG)
    assert exact < 0.0004 < level <= CONFIG.level_m[1]
    assert wrong_bound_m(exact, CONFIG) == CONFIG.wrong_m
    shares = [c["wrong_surface"] for c in checks_of(results)]
    without = [residual_checks(r, exact, CONFIG)["wrong_surface"] for r in results]
    assert max(shares) < 0.1 < min(without)
    # A single object cannot excuse itself.
    assert error_level_m(results[:1], CONFIG) < level
