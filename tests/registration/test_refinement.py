"""Laws and known answers of the joint refinement of objects, cameras, table and depth bias."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.geometry.metrics import mssd_symmetric
from realsim.geometry.parts import part
from realsim.records.depth_bias import DepthBias
from realsim.registration.body import Body, make_body
from realsim.registration.config import RegistrationConfig
from realsim.registration.intake import Intake, take_in
from realsim.registration.refinement.config import CameraPrior, PointConfig, RefineConfig
from realsim.registration.refinement.equations import BIAS, HAND_EYE
from realsim.registration.refinement.refine import Refined, refine
from realsim.registration.refinement.uncertainty import object_covariance
from realsim.registration.simulated import (
    TableLabConfig,
    TableScene,
    scatter_objects,
    table_scene,
)
from realsim.rendering.depth_sensors.model import DepthSensorModel
from table_scenes import SMALL_LAB, part_models, small_scene

Array = NDArray[np.float64]
NAMES = ("box", "wedge", "l_bracket", "elbow", "flange")
DISPARITY_PER_M = 648 * 0.018
"""Focal length [px] times baseline [m]: pixels of disparity per inverse depth."""
ALL_POINTS = RefineConfig(
    early_share=1.0,
    points=PointConfig(points_per_object=10_000_000, table_points_per_view=1_000_000),
)
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
        return np.array([
            1e3 * mssd_symmetric(p.T_world_obj, T, self.scene.models[p.obj_id])
            for p, T in zip(self.scene.truth, refined.poses, strict=True)
        ])  # fmt: skip

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
    bodies = [make_body(p, scene.models[p.obj_id], 96, 400) for p in scene.truth]
    return Case(scene, intake, bodies)


def made(seed: int, config: TableLabConfig, names: tuple[str, ...] = NAMES) -> Case:
    rng = np.random.default_rng(seed)
    models = {part(n).obj_id: part_models()[part(n).obj_id] for n in names}
    meshes = {i: m.mesh for i, m in models.items()}
    placed = scatter_objects(meshes, list(models), config, rng)
    return case_of(table_scene(models, placed.objects, config, rng))


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
    return made(0, NO_NOISE)


def seen_alike(a: Refined, b: Refined, mm: float, deg: float) -> None:
    """Assert that objects and cameras of two results are the same to `mm` and `deg`."""
    for one, other in ((a.poses, b.poses), (a.cameras, b.cameras)):
        e = se3.log(se3.invert(one) @ other)
        assert 1e3 * np.abs(e[:, 3:]).max() < mm
        assert np.degrees(np.abs(e[:, :3])).max() < deg


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
    back = replace(there, poses=se3.invert(T) @ there.poses, cameras=se3.invert(T) @ there.cameras)
    # Single precision of points in world decides whose some of them are.
    seen_alike(here, back, 0.003, 0.002)
    np.testing.assert_allclose(there.state.hand_eye, here.state.hand_eye, atol=3e-6)
    np.testing.assert_allclose(there.state.bias, here.state.bias, atol=1e-5)
    assert there.plane is not None and here.plane is not None
    e = se3.log(se3.invert(T @ here.plane.T_world_table) @ there.plane.T_world_table)
    assert np.abs(e).max() < 5e-6


@pytest.mark.slow
def test_order_of_views_and_of_objects_does_not_matter():
    case, _ = noisy()
    here = case.refined(ALL_POINTS)
    rng = np.random.default_rng(1)
    v, k = rng.permutation(len(case.intake.views)), rng.permutation(len(case.bodies))
    bodies = [case.bodies[i] for i in k]
    there = case.refined(
        ALL_POINTS, views=[case.intake.views[i] for i in v], bodies=bodies,
        poses=[b.T_start for b in bodies],
    )  # fmt: skip
    sorted_back = replace(
        there, poses=there.poses[np.argsort(k)], cameras=there.cameras[np.argsort(v)]
    )
    seen_alike(here, sorted_back, 1e-4, 1e-4)
    np.testing.assert_allclose(there.used[:-1], here.used[:-1][k], atol=2)


@pytest.mark.slow
def test_the_start_does_not_matter():
    case = exact()
    off = case.refined(ALL_POINTS, poses=starts_off(case))
    seen_alike(case.refined(ALL_POINTS), off, 0.005, 0.005)


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


@pytest.mark.slow
def test_an_object_without_points_stays_where_it_is():
    case, _ = noisy()
    T = case.bodies[0].T_start.copy()
    T[:3, 3] += [0.0, 0.0, 0.4]
    lost = replace(case.bodies[0], start=replace(case.bodies[0].start, T_world_obj=T))
    bodies = [*case.bodies, lost]
    with_lost = case.refined(bodies=bodies, poses=[b.T_start for b in bodies])
    np.testing.assert_allclose(with_lost.poses[-1], T, atol=1e-9)
    without = case.refined()
    assert with_lost.used[len(case.bodies)] == 0
    kept = replace(with_lost, poses=with_lost.poses[:-1])
    seen_alike(without, kept, 0.002, 0.001)
    # Nothing says where it is, and its covariance says so: metres and tens of degrees.
    sigma = np.sqrt(np.diag(object_covariance(with_lost, lost, len(case.bodies))))
    assert sigma[3:].min() > 0.3 and np.degrees(sigma[:3].min()) > 15


def test_a_body_of_revolution_keeps_its_turn():
    case = made(3, replace(SMALL_LAB, views=6), ("cylinder_can", "box"))
    refined = case.refined()
    can = case.bodies[0]
    (axis, _), *_ = can.model.symmetry_axes
    turn = se3.log_so3(can.T_start[:3, :3].T @ refined.poses[0][:3, :3]) @ np.asarray(axis)
    assert abs(np.degrees(turn)) < 5.0


@pytest.mark.slow
def test_what_is_not_unknown_is_held():
    case, _ = noisy()
    held = case.refined(RefineConfig(fit_bias=False))
    np.testing.assert_allclose(held.state.bias, [1, 0], atol=1e-9)
    known = DepthBias(scale=1.002, offset_per_m=-0.003, covariance=np.diag([1e-12, 1e-12]))
    told = case.refined(RefineConfig(bias=known))
    np.testing.assert_allclose(told.state.bias, [1.002, -0.003], atol=2e-5)
    rigid = case.refined(RefineConfig(prior=CameraPrior(hand_eye_mm=1e-6, hand_eye_deg=1e-6)))
    assert np.abs(rigid.state.hand_eye).max() < 1e-7
    alike = RefineConfig(prior=CameraPrior(view_mm=1e-5, view_deg=1e-5, learn_views=False))
    same, free = case.refined(alike), case.refined()
    assert np.all(same.state.views.std(0) < 0.35 * free.state.views.std(0))


def test_objects_elsewhere_are_refused():
    case, _ = noisy()
    far = [b.T_start @ se3.from_translation([0, 0, 5.0]) for b in case.bodies]
    with pytest.raises(DegenerateError, match="nothing to refine cameras with"):
        case.refined(poses=far, plane=None)
    # The table is used around objects only, so without any there is nothing at all.
    with pytest.raises(DegenerateError, match="0 of the table"):
        case.refined(bodies=[], poses=[])


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
    # The sigma says something: far less than the prior.
    assert 1e3 * np.sqrt(np.diag(C)[3:]).max() < 0.3


def test_sigma_of_the_views_is_the_arms():
    _, refined = noisy()
    assert refined.view_sigma[0] == pytest.approx(SMALL_LAB.arm_deg, rel=0.5)
    assert refined.view_sigma[1] == pytest.approx(SMALL_LAB.arm_mm, rel=0.5)


def test_a_disparity_bias_is_found():
    case = made(0, replace(SMALL_LAB, bias_px=0.1))
    refined = case.refined()
    true = -0.1 / DISPARITY_PER_M
    sigma = np.sqrt(np.diag(refined.covariance.shared[BIAS, BIAS]))
    assert abs(refined.state.bias[1] - true) < 3 * sigma[1]
    assert abs(refined.state.bias[0] - 1) < 3 * sigma[0]
    assert sigma[1] < 0.25 * abs(true)
    held = case.refined(RefineConfig(fit_bias=False))
    assert case.camera_errors(refined.cameras)[0] < 0.5 * case.camera_errors(held.cameras)[0]


# --- statistics ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_strong_noise_does_not_pull_the_depth():
    """Errors in variables: noise in derivatives or weights would pull the depth by millimetres."""
    full = SMALL_LAB.sensor
    loud = replace(full, disparity_noise_px=3 * full.disparity_noise_px)
    config = replace(SMALL_LAB, sensor=loud, views=48)
    rows: list[Array] = []
    for seed in range(8):
        case = made(seed, config)
        refined = case.refined(RefineConfig(thin_share=-1.0))
        z = refined.state.hand_eye[5] - case.hand_eye_true[5]
        rows.append(np.array([refined.state.bias[0] - 1, refined.state.bias[1], z]))
    errors = np.stack(rows)
    scale, offset, z = errors.mean(0)
    # What is left at three times a D405's noise, of a depth of 0.35 m: dz = -(z ds + z^2 do).
    assert abs(0.35 * scale + 0.35**2 * offset) < 4e-4
    assert abs(z) < 1.5e-4
    assert np.abs(errors[:, 2]).max() < 5e-4
