"""How sure refined poses are: covariances that hold what they promise."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.registration.body import Body, make_body
from realsim.registration.config import RegistrationConfig
from realsim.registration.intake import take_in
from realsim.registration.refinement.equations import HAND_EYE, OBJECTS, moves_of_all
from realsim.registration.refinement.refine import Refined, refine
from realsim.registration.refinement.uncertainty import (
    SeenPose,
    common_and_own,
    object_covariance,
    seen_poses,
)
from realsim.registration.simulated import TableScene
from table_scenes import named_scene

NAMES = ("wedge", "l_bracket", "elbow", "t_profile")
"""Parts without a symmetry about an axis: every turn is seen."""
SEEDS = range(3)


@lru_cache(maxsize=8)
def refined_scene(seed: int) -> tuple[TableScene, list[Body], Refined]:
    scene = named_scene(seed, NAMES)
    intake = take_in(scene.intrinsics, scene.frames, RegistrationConfig())
    bodies = [make_body(p, scene.models[p.obj_id], 96, 400) for p in scene.truth]
    poses = [b.T_start for b in bodies]
    result = refine(scene.intrinsics, intake.views, bodies, poses, intake.plane, intake.noise)
    return scene, bodies, result


@lru_cache(maxsize=8)
def seen(seed: int) -> list[list[SeenPose]]:
    scene, bodies, refined = refined_scene(seed)
    return seen_poses(refined, bodies, scene.intrinsics)


def normalised(xi: Array, C: Array) -> float:
    return float(xi @ np.linalg.solve(C, xi)) / len(xi)


# --- laws ----------------------------------------------------------------------------------------


def test_covariances_are_symmetric_and_positive():
    _, bodies, refined = refined_scene(0)
    matrices = [object_covariance(refined, b, k) for k, b in enumerate(bodies)]
    matrices += [s.covariance for of in seen(0) for s in of] + list(refined.covariance.views)
    matrices.append(refined.covariance.shared)
    for C in matrices:
        np.testing.assert_allclose(C, C.T, atol=1e-9 * np.abs(C).max())
        assert np.linalg.eigvalsh(C).min() > 0


def test_covariance_in_a_view_is_that_of_samples_of_everything():
    """Drawn together with their correlations: object, hand-eye and view."""
    scene, bodies, refined = refined_scene(0)
    rng = np.random.default_rng(1)
    k, v, body = 2, 5, bodies[2]
    C = refined.covariance
    at = np.r_[
        np.arange(OBJECTS + 6 * k, OBJECTS + 6 * k + 6), np.arange(HAND_EYE.start, HAND_EYE.stop)
    ]
    joint = np.block([
        [C.shared[np.ix_(at, at)], C.cross[v][at, :6]],
        [C.cross[v][at, :6].T, C.views[v][:6, :6]],
    ])  # fmt: skip
    x = rng.multivariate_normal(np.zeros(18), joint, 20_000)
    c = se3.from_translation(body.center_obj)
    object_ = refined.poses[k] @ c @ se3.exp(x[:, :6]) @ se3.invert(c)
    camera = refined.cameras[v] @ se3.exp(x[:, 6:12] + x[:, 12:])
    T = seen(0)[k][v].T_cam_obj
    xi = se3.log(se3.invert(T) @ se3.invert(camera) @ object_)
    expected = seen(0)[k][v].covariance
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        np.cov(xi.T) / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.04
    )
    # And in pixels.
    every = max(1, len(body.samples) // 40)
    points = body.samples[::every]
    uv = np.stack([
        project(scene.intrinsics, se3.transform(se3.invert(cam) @ obj, points))
        for cam, obj in zip(camera[:1500], object_[:1500], strict=True)
    ])  # fmt: skip
    spread = np.sqrt(uv.var(0).sum(-1).mean())
    assert seen(0)[k][v].sigma_px == pytest.approx(spread, rel=0.05)


def test_a_move_of_everything_is_common_and_what_is_left_is_own():
    _, bodies, refined = refined_scene(0)
    moves = moves_of_all(bodies, refined.state)
    S = np.diag(np.square([1e-3, 2e-3, 1e-3, 1e-4, 2e-4, 3e-4]))

    def told(C: Array) -> tuple[Array, Array]:
        return common_and_own(
            replace(refined, covariance=replace(refined.covariance, shared=C)), bodies
        )

    common, own = told(moves @ S @ moves.T)
    np.testing.assert_allclose(common, S, rtol=1e-3, atol=1e-13)
    np.testing.assert_allclose(own, 0.0, atol=1e-13)
    # What one object alone may be off by is its own.
    C = np.zeros_like(refined.covariance.shared)
    C[-3:, -3:] = 1e-8 * np.eye(3)
    common, own = told(C)
    assert np.trace(own[-1][3:, 3:]) == pytest.approx(3e-8, rel=0.01)
    assert np.trace(own[0][3:, 3:]) < 1e-12 and np.trace(common[3:, 3:]) < 1e-12


# --- statistics ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_errors_are_as_large_as_the_covariance_says():
    """The normalised square of six errors is 1 on average."""
    in_world: list[float] = []
    in_views: list[float] = []
    hands: list[float] = []
    for seed in SEEDS:
        scene, bodies, refined = refined_scene(seed)
        off = refined.state.hand_eye - se3.log(se3.invert(scene.T_ee_cam) @ scene.T_ee_cam_true)
        hands.append(normalised(off, refined.covariance.shared[HAND_EYE, HAND_EYE]))
        Ts_cam_world = se3.invert(scene.Ts_world_cam)
        for k, (p, body) in enumerate(zip(scene.truth, bodies, strict=True)):
            xi = se3.log(se3.invert(refined.poses[k]) @ p.T_world_obj)
            in_world.append(normalised(xi, object_covariance(refined, body, k)))
            for s, T in zip(seen(seed)[k], Ts_cam_world, strict=True):
                xi = se3.log(se3.invert(s.T_cam_obj) @ T @ p.T_world_obj)
                in_views.append(normalised(xi, s.covariance))
    assert 0.3 < np.mean(in_world) < 3 and 0.3 < np.median(in_world) < 3
    assert 0.3 < np.mean(in_views) < 3
    assert 0.2 < np.mean(hands) < 3
