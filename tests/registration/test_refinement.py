"""Laws and known answers of the joint refinement of objects, cameras, table and depth bias."""

from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Any

import numpy as np
import pytest

from realsim.arrays import Array
from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.geometry.parts import part
from realsim.registration.body import Body
from realsim.registration.config import RegistrationConfig
from realsim.registration.intake import Intake, take_in
from realsim.registration.refinement.config import CameraPrior, PointConfig, RefineConfig
from realsim.registration.refinement.equations import BIAS, HAND_EYE, OBJECTS, moves_of_all
from realsim.registration.refinement.refine import Refined, refine
from realsim.registration.refinement.uncertainty import (
    SeenPose,
    common_and_own,
    object_covariance,
    seen_poses,
)
from realsim.registration.simulated import TableLabConfig, TableScene
from realsim.rendering.depth_sensors.model import DepthSensorModel
from refusals import refused
from table_scenes import SMALL_LAB, bodies_of, errors_mm, named_scene, scene_of, small_scene

DISPARITY_PER_M = 648 * 0.018
"""Focal length [px] times baseline [m]: pixels of disparity per inverse depth."""
EVERY = PointConfig(points_per_object=10_000_000, table_points_per_view=1_000_000)
ALL_POINTS = RefineConfig(early_share=1.0, points=EVERY)
"""Nothing is thinned out: which points are left out depends on their order."""
NO_NOISE = replace(SMALL_LAB, sensor=DepthSensorModel.noiseless(), arm_mm=0.0, arm_deg=0.0)


@dataclass(frozen=True, eq=False)
class Case:
    """A scene, ready to be refined."""

    scene: TableScene
    intake: Intake
    bodies: list[Body]

    def refined(self, config: RefineConfig | None = None, **other: Any) -> Refined:
        given: dict[str, Any] = {
            "views": self.intake.views, "bodies": self.bodies,
            "poses": [b.T_start for b in self.bodies], "plane": self.intake.plane,
        } | other  # fmt: skip
        return refine(
            self.scene.intrinsics, given["views"], given["bodies"], given["poses"],
            given["plane"], self.intake.noise, config, given.get("progress"),
        )  # fmt: skip

    def object_errors_mm(self, refined: Refined) -> Array:
        found = zip(self.scene.truth, refined.poses, strict=True)
        placed = [replace(p, T_world_obj=T) for p, T in found]
        return np.array([*errors_mm(self.scene, placed).values()])

    def camera_errors(self, cameras: Array) -> tuple[float, float]:
        """Median error of the cameras [mm, deg]."""
        e = se3.log(se3.invert(self.scene.Ts_world_cam) @ cameras)
        mm, rad = np.linalg.norm(e[:, 3:], axis=1), np.linalg.norm(e[:, :3], axis=1)
        return 1e3 * float(np.median(mm)), float(np.degrees(np.median(rad)))

    @property
    def hand_eye_true(self) -> Array:
        return se3.log(se3.invert(self.scene.T_ee_cam) @ self.scene.T_ee_cam_true)


def case_of(scene: TableScene) -> Case:
    intake = take_in(scene.intrinsics, scene.frames, RegistrationConfig())
    return Case(scene, intake, bodies_of(scene, 96, 400))


def made(config: TableLabConfig) -> Case:
    ids = [part(name).obj_id for name in ("box", "wedge", "l_bracket", "elbow", "flange")]
    return case_of(scene_of(ids, config, np.random.default_rng(0)))


def starts_off(case: Case) -> list[Array]:
    """Return the true poses, off by about 1 mm and a degree."""
    rng = np.random.default_rng(0)
    return [b.T_start @ se3.exp(rng.normal(0, [0.02] * 3 + [1e-3] * 3)) for b in case.bodies]


@lru_cache(maxsize=1)
def noisy() -> tuple[Case, Refined]:
    """A scene with a real lab's errors, refined from starts that are a little off."""
    case = case_of(small_scene(0))
    return case, case.refined(poses=starts_off(case))


@lru_cache(maxsize=1)
def exact() -> Case:
    """No noise, no error of the arm; the hand-eye is off by 0.5 mm and 0.1 deg."""
    return made(NO_NOISE)


# --- laws ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_results_move_with_the_world():
    case, _ = noisy()
    here = case.refined(ALL_POINTS)
    T = se3.random_transform(np.random.default_rng(7))
    plane = case.intake.plane
    assert plane is not None
    there = case.refined(
        ALL_POINTS, poses=[T @ b.T_start for b in case.bodies],
        views=[replace(v, T_world_cam=T @ v.T_world_cam) for v in case.intake.views],
        plane=replace(plane, T_world_table=T @ plane.T_world_table),
    )  # fmt: skip
    # Single precision of points in world decides whose some of them are.
    for one, other in ((here.poses, there.poses), (here.cameras, there.cameras)):
        e = se3.log(se3.invert(T @ one) @ other)
        assert 1e3 * np.abs(e[:, 3:]).max() < 0.003
        assert np.degrees(np.abs(e[:, :3])).max() < 0.002
    np.testing.assert_allclose(there.state.hand_eye, here.state.hand_eye, atol=3e-6)
    np.testing.assert_allclose(there.state.bias, here.state.bias, atol=1e-5)
    assert there.plane is not None and here.plane is not None
    e = se3.log(se3.invert(T @ here.plane.T_world_table) @ there.plane.T_world_table)
    assert np.abs(e).max() < 5e-6


def test_same_input_gives_the_same_bytes():
    case, a = noisy()
    b = case.refined(poses=starts_off(case))
    assert a.poses.tobytes() == b.poses.tobytes() and a.cameras.tobytes() == b.cameras.tobytes()


@pytest.mark.slow
def test_without_noise_the_hand_eye_is_found():
    case = exact()
    assert case.camera_errors(case.intake.cameras)[0] == pytest.approx(0.5, abs=0.01)
    # Triangles instead of the field, which swells convex edges by a few hundredths of a mm.
    refined = case.refined(RefineConfig(thin_share=-1.0))
    assert case.object_errors_mm(refined).max() < 0.02
    mm, deg = case.camera_errors(refined.cameras)
    assert mm < 0.02 and deg < 0.003
    off = refined.state.hand_eye - case.hand_eye_true
    assert 1e3 * np.linalg.norm(off[3:]) < 0.03
    assert np.degrees(np.linalg.norm(off[:3])) < 0.003
    assert abs(refined.state.bias[0] - 1) < 5e-5
    assert abs(refined.state.bias[1]) * DISPARITY_PER_M < 0.002
    # A robot without errors is found to be one, as far as that is believed.
    said = CameraPrior()
    assert refined.view_sigma[1] == pytest.approx(said.learn_factor[0] * said.view_mm)


def test_objects_elsewhere_are_refused():
    case, _ = noisy()
    far = [b.T_start @ se3.from_translation([0, 0, 5.0]) for b in case.bodies]
    no_cameras = "nothing to refine cameras with"
    refused(no_cameras, case.refined, poses=far, plane=None, error=DegenerateError)
    # The table is used around objects only, so without any there is nothing at all.
    refused("0 of the table", case.refined, bodies=[], poses=[], error=DegenerateError)


# --- known answers -------------------------------------------------------------------------------


def test_cameras_are_right_and_better_than_claimed():
    case, refined = noisy()
    before, after = case.camera_errors(case.intake.cameras), case.camera_errors(refined.cameras)
    assert after[0] < before[0] / 3 and after[1] < before[1] / 3
    assert case.object_errors_mm(refined).max() < 0.35


def test_hand_eye_is_found_within_its_sigma():
    case, refined = noisy()
    off = refined.state.hand_eye - case.hand_eye_true
    C = refined.covariance.shared[HAND_EYE, HAND_EYE]
    assert np.all(np.abs(off) < 3 * np.sqrt(np.diag(C)))
    assert off @ np.linalg.solve(C, off) < 6 * 3
    # The sigma says something: less than the prior of 1 mm. A view's own offset of the depth is
    # hard to tell from a shift of the camera.
    assert 1e3 * np.sqrt(np.diag(C)[3:]).max() < 0.6


def test_sigma_of_the_views_is_the_arms():
    _, refined = noisy()
    assert refined.view_sigma[0] == pytest.approx(SMALL_LAB.arm_deg, rel=0.5)
    assert refined.view_sigma[1] == pytest.approx(SMALL_LAB.arm_mm, rel=0.5)


@pytest.mark.slow
def test_a_disparity_bias_is_found():
    case = made(replace(SMALL_LAB, bias_px=0.1))
    refined = case.refined()
    true = -0.1 / DISPARITY_PER_M
    sigma = np.sqrt(np.diag(refined.covariance.shared[BIAS, BIAS]))
    assert abs(refined.state.bias[1] - true) < 3 * sigma[1]
    assert abs(refined.state.bias[0] - 1) < 3 * sigma[0]
    assert sigma[1] < 0.25 * abs(true)
    # Neither of all views nor, as drift, of each.
    held = case.refined(RefineConfig(fit_bias=False, prior=CameraPrior(view_offset_per_m=1e-7)))
    assert case.camera_errors(refined.cameras)[0] < 0.5 * case.camera_errors(held.cameras)[0]


# --- How sure refined poses are: covariances that hold what they promise.

ALL_SEEN = ("wedge", "l_bracket", "elbow", "t_profile")
"""Parts without a symmetry about an axis: every turn is seen."""


@cache
def refined_case(seed: int) -> tuple[Case, Refined, list[list[SeenPose]]]:
    """Return a case, what it is refined to, and its objects as the views see them."""
    case = case_of(named_scene(seed, ALL_SEEN))
    refined = case.refined()
    return case, refined, seen_poses(refined, case.bodies, case.scene.intrinsics)


def normalised(xi: Array, C: Array) -> float:
    return float(xi @ np.linalg.solve(C, xi)) / len(xi)


def test_covariances_are_symmetric_and_positive():
    case, refined, seen = refined_case(0)
    matrices = [object_covariance(refined, b, k) for k, b in enumerate(case.bodies)]
    matrices += [s.covariance for of in seen for s in of] + list(refined.covariance.views)
    matrices.append(refined.covariance.shared)
    for C in matrices:
        np.testing.assert_allclose(C, C.T, atol=1e-9 * np.abs(C).max())
        assert np.linalg.eigvalsh(C).min() > 0


def test_covariance_in_a_view_is_that_of_samples_of_everything():
    """Drawn together with their correlations: object, hand-eye and view."""
    case, refined, seen = refined_case(0)
    rng = np.random.default_rng(1)
    k, v, body = 2, 5, case.bodies[2]
    told, C = seen[k][v], refined.covariance
    at = np.r_[OBJECTS + 6 * k : OBJECTS + 6 * k + 6, HAND_EYE]
    joint = np.block([
        [C.shared[np.ix_(at, at)], C.cross[v][at, :6]],
        [C.cross[v][at, :6].T, C.views[v][:6, :6]],
    ])  # fmt: skip
    x = rng.multivariate_normal(np.zeros(18), joint, 20_000)
    c = se3.from_translation(body.center_obj)
    object_ = refined.poses[k] @ c @ se3.exp(x[:, :6]) @ se3.invert(c)
    camera = refined.cameras[v] @ se3.exp(x[:, 6:12] + x[:, 12:])
    xi = se3.log(se3.invert(told.T_cam_obj) @ se3.invert(camera) @ object_)
    scale = np.sqrt(np.outer(*2 * [np.diag(told.covariance)]))
    np.testing.assert_allclose(np.cov(xi.T) / scale, told.covariance / scale, atol=0.04)
    # And in pixels.
    points = body.samples[:: max(1, len(body.samples) // 40)]
    uv = np.stack([
        project(case.scene.intrinsics, se3.transform(se3.invert(cam) @ obj, points))
        for cam, obj in zip(camera[:1500], object_[:1500], strict=True)
    ])  # fmt: skip
    assert told.sigma_px == pytest.approx(np.sqrt(uv.var(0).sum(-1).mean()), rel=0.05)


def test_a_move_of_everything_is_common_and_what_is_left_is_own():
    case, refined, _ = refined_case(0)
    moves = moves_of_all(case.bodies, refined.state)
    S = np.diag(np.square([1e-3, 2e-3, 1e-3, 1e-4, 2e-4, 3e-4]))

    def told(C: Array) -> tuple[Array, Array]:
        of_everything = replace(refined.covariance, shared=C)
        return common_and_own(replace(refined, covariance=of_everything), case.bodies)

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
    in_world, in_views, hands = [], [], []
    for seed in range(3):
        case, refined, seen = refined_case(seed)
        off = refined.state.hand_eye - case.hand_eye_true
        hands.append(normalised(off, refined.covariance.shared[HAND_EYE, HAND_EYE]))
        Ts_cam_world = se3.invert(case.scene.Ts_world_cam)
        for k, body in enumerate(case.bodies):
            xi = se3.log(se3.invert(refined.poses[k]) @ body.T_start)
            in_world.append(normalised(xi, object_covariance(refined, body, k)))
            for s, T in zip(seen[k], Ts_cam_world, strict=True):
                xi = se3.log(se3.invert(s.T_cam_obj) @ T @ body.T_start)
                in_views.append(normalised(xi, s.covariance))
    assert 0.3 < np.mean(in_world) < 3 and 0.3 < np.median(in_world) < 3
    assert 0.3 < np.mean(in_views) < 3
    assert 0.2 < np.mean(hands) < 3
