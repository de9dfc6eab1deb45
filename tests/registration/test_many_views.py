"""Registration from many views: what goes into the refinement, and what is made of its result."""

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from unittest.mock import Mock

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.records import CameraIntrinsics, ObjectPose
from realsim.records.calibration import DepthBias
from realsim.registration.body import Body, moved_body
from realsim.registration.config import RegistrationConfig
from realsim.registration.evidence import DepthFrame, LazyFrame, correct_frame
from realsim.registration.intake import Intake, take_in
from realsim.registration.many_views import (
    LEAST_SIGMA_DEG,
    LEAST_SIGMA_MM,
    ManyViews,
    refine_config,
    register_many,
)
from realsim.registration.simulated import TableScene
from realsim.registration.views import FixedCamera, FixedFrames, noise_of, still_depth
from realsim.rendering.labels import LabelRenderer
from refusals import refused
from table_faults import without_any_depth
from table_scenes import (
    SMALL_LAB,
    bodies_of,
    errors_mm,
    named_scene,
    register,
    small_scene,
    starts_off_by,
    things_of,
)

CONFIG = RegistrationConfig(field_cells=64)
NAMES = ("cylinder_can", "wedge", "elbow")
"""The first is round: nothing shows how it is turned about its axis."""


@dataclass(frozen=True, eq=False)
class Case:
    scene: TableScene
    intake: Intake
    bodies: list[Body]
    claimed: list[Body | None]
    many: ManyViews


@lru_cache(maxsize=1)
def case() -> Case:
    """Somebody claimed the can turned by 40 deg and the wedge a little off; not the elbow."""
    scene = named_scene(6, NAMES, 8)
    intake = take_in(scene.intrinsics, scene.frames, CONFIG)
    bodies = bodies_of(scene, 64, 400)
    (axis, point), *_ = bodies[0].model.symmetry_axes
    P, turn = se3.from_translation(point), np.radians(40.0) * np.asarray(axis)
    turned = bodies[0].T_start @ P @ se3.exp(np.r_[turn, np.zeros(3)]) @ se3.invert(P)
    claimed: list[Body | None] = [
        moved_body(bodies[0], turned),
        moved_body(bodies[1], bodies[1].T_start @ se3.exp(np.array([0.05, 0, 0, 0, 0.004, 0]))),
        None,
    ]
    many = register_many(intake, bodies, claimed, intake.plane, CONFIG)
    return Case(scene, intake, bodies, claimed, many)


def errors(many: ManyViews) -> list[float]:
    """Return the objects' errors [mm]."""
    truth = case().scene.truth
    placed = [replace(p, T_world_obj=T) for p, T in zip(truth, many.poses, strict=True)]
    return [*errors_mm(case().scene, placed).values()]


def test_objects_and_cameras_are_right():
    c = case()
    assert max(errors(c.many)) < 0.8
    before, after = (
        np.median(np.linalg.norm(se3.log(se3.invert(c.scene.Ts_world_cam) @ T)[:, 3:], axis=1))
        for T in (c.intake.cameras, c.many.refined.cameras)
    )
    assert after < 0.6 * before


def test_a_turn_that_nothing_shows_stays_as_it_was_claimed():
    c = case()
    assert c.claimed[0] is not None
    (axis, _), *_ = c.bodies[0].model.symmetry_axes
    off = se3.log_so3(c.claimed[0].T_start[:3, :3].T @ c.many.poses[0][:3, :3])
    assert abs(np.degrees(off @ np.asarray(axis))) < 0.5
    assert c.many.kept[0].report["start_kept"]
    # What is shown is not kept: the wedge was claimed 4 mm off.
    assert 1e3 * np.linalg.norm(c.many.poses[1][:3, 3] - c.bodies[1].T_start[:3, 3]) < 1.0
    assert c.many.kept[1].report == {} and c.many.kept[2].report == {}


def test_covariances_hold_and_turn_with_the_pose():
    c = case()
    for k, (p, C) in enumerate(zip(c.scene.truth, c.many.covariances, strict=True)):
        np.testing.assert_allclose(C, C.T, atol=1e-9 * np.abs(C).max())
        assert np.linalg.eigvalsh(C).min() > 0
        if k > 0:
            xi = se3.log(se3.invert(c.many.poses[k]) @ p.T_world_obj)
            assert xi @ np.linalg.solve(C, xi) < 6 * 4
    # The can's turn about its axis is the only one that is unsure.
    (axis, _), *_ = c.bodies[0].model.symmetry_axes
    values, vectors = np.linalg.eigh(c.many.covariances[0][:3, :3])
    assert abs(vectors[:, 2] @ np.asarray(axis)) > 0.99
    assert values[2] > 100 * values[1] and np.degrees(np.sqrt(values[2])) > 20
    for s in c.many.seen[0]:
        assert np.degrees(np.sqrt(np.linalg.eigvalsh(s.covariance[:3, :3])[2])) > 20
    assert np.degrees(np.sqrt(np.linalg.eigvalsh(c.many.covariances[1][:3, :3])[2])) < 0.5


def test_what_calibrations_say_becomes_the_prior():
    said = RegistrationConfig(
        hand_eye_sigma_mm=0.3, hand_eye_sigma_deg=1e-5, arm_sigma_mm=1e-6,
        bias=DepthBias(scale=1.01, offset_per_m=0.002, covariance=np.diag([1e-6, 1e-6])),
    )  # fmt: skip
    found = refine_config(said)
    assert found.prior.hand_eye_mm == 0.3
    assert found.prior.hand_eye_deg == LEAST_SIGMA_DEG
    assert found.prior.view_mm == LEAST_SIGMA_MM
    assert found.prior.view_deg == said.refine.prior.view_deg
    # The images have the bias taken out already; how sure it was remains.
    assert (found.bias.scale, found.bias.offset_per_m) == (1.0, 0.0)
    np.testing.assert_array_equal(found.bias.covariance, said.bias.covariance)
    assert refine_config(RegistrationConfig()).prior == RegistrationConfig().refine.prior


@pytest.mark.slow
def test_without_a_table_and_with_a_lost_object():
    c = case()
    lost = moved_body(c.bodies[2], se3.from_translation([0, 0, 0.4]) @ c.bodies[2].T_start)
    many = register_many(c.intake, [*c.bodies[:2], lost], [None] * 3, None, CONFIG)
    np.testing.assert_allclose(many.poses[2], lost.T_start, atol=1e-9)
    assert len(many.clouds[2].points) == 0
    assert np.sqrt(many.covariances[2][3, 3]) > 0.3
    assert max(errors(many)[:2]) < 1.0


# --- From depth images to points, noise, table and sound views; frames that are read when asked.

TAKEN = RegistrationConfig()


def scene() -> TableScene:
    return small_scene(0)


def taken(frames, config: RegistrationConfig = TAKEN):
    return take_in(scene().intrinsics, frames, config)


def test_a_corrected_frame_has_its_bias_taken_out_and_its_camera_moved():
    bias = DepthBias(scale=1.01, offset_per_m=-0.02)
    z = np.array([[0.0, 0.2, 0.4]], np.float32)
    reader = Mock(return_value=bias.measured(z).astype(np.float32))
    T = se3.from_translation([1, 2, 3])
    frame = correct_frame(LazyFrame(3, np.eye(4), reader), T, bias)
    assert not reader.called
    np.testing.assert_allclose(frame.depth_m, z, atol=1e-7)
    assert frame.depth_m.dtype == np.float32 and frame.index == 3
    np.testing.assert_array_equal(frame.T_world_cam, T)
    twice = correct_frame(frame, np.eye(4), DepthBias(scale=2.0 / 1.5))
    np.testing.assert_allclose(twice.depth_m, 0.75 * z, atol=1e-7)


# --- what is taken in ----------------------------------------------------------------------------


def test_table_noise_and_points_are_those_of_the_scene():
    intake = taken(scene().frames)
    assert intake.findings == () and len(intake.views) == SMALL_LAB.views
    assert intake.plane is not None and intake.no_plane == ""
    T = intake.plane.T_world_table
    assert np.degrees(np.arccos(T[2, 2])) < 0.1 and abs(T[2, 3]) < 7e-4
    k = scene().sensor.disparity_noise_px / (scene().intrinsics.fx * 0.018)
    assert intake.noise.per_m == pytest.approx(k, rel=0.35)
    np.testing.assert_array_equal(intake.cameras, scene().Ts_base_ee @ scene().T_ee_cam)


def test_a_known_bias_is_taken_out():
    bias = DepthBias(scale=1.003, offset_per_m=-0.01)
    spoilt = [
        replace(f, depth_m=np.where(f.depth_m > 0, bias.measured(f.depth_m), 0).astype(np.float32))
        for f in scene().frames
    ]
    here, there = taken(scene().frames), taken(spoilt, RegistrationConfig(bias=bias))
    for a, b in zip(here.views, there.views, strict=True):
        assert abs(len(a.points) - len(b.points)) < 0.001 * len(a.points)
        assert b.points[:, 2].mean() == pytest.approx(a.points[:, 2].mean(), abs=5e-6)
    np.testing.assert_allclose(there.frames[0].depth_m, scene().frames[0].depth_m, atol=1e-6)
    # What is only unsure leaves the images as they are.
    unsure = taken(scene().frames, RegistrationConfig(bias=DepthBias.unmeasured()))
    assert unsure.frames[0].depth_m is scene().frames[0].depth_m


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_an_empty_view_is_left_out_and_named(value: float):
    frames = list(scene().frames)
    frames[0] = replace(frames[0], depth_m=np.full_like(frames[0].depth_m, value))
    frames[5] = without_any_depth(frames[5])
    intake = taken(frames)
    assert [f.index for f in intake.frames] == [k for k in range(12) if k not in (0, 5)]
    assert [v.index for v in intake.views] == [f.index for f in intake.frames]
    found = {f.index: f for f in intake.findings}
    assert set(found) == {0, 5} and all(f.exclude for f in found.values())
    assert "view 5" in found[5].words and "empty" in found[5].words


def test_nothing_to_use_is_refused_by_name():
    refused("at least one", taken, [])
    refused("unique", taken, [scene().frames[0], replace(scene().frames[1], index=0)])
    empty = [without_any_depth(f) for f in scene().frames[:3]]
    refused(r"3 depth images.*all zero", taken, empty)
    given = RegistrationConfig(evidence=replace(TAKEN.evidence, noise_per_m=0.007))
    refused(r"none of the 3 views can be used.*view 0.*view 2", taken, empty, given)
    small = replace(scene().frames[1], depth_m=np.ones((9, 16), np.float32))
    refused("shape", taken, [scene().frames[0], small])


def test_one_view_is_enough():
    intake = taken(scene().frames[:1])
    assert len(intake.views) == 1 and intake.plane is not None


# --- Cameras that stand still beside the one in the hand, in the joint fit.

CAMERA = CameraIntrinsics(width=400, height=300, fx=310.0, fy=312.0, cx=203.0, cy=147.0)
"""Another camera than the one in the hand."""
NOISE_PER_M = 0.004
IMAGES = 9
SIGMA_MM, SIGMA_DEG = 1.0, 0.15
BIAS = DepthBias(scale=1.002, offset_per_m=-0.002)
"""What the fixed cameras' depth is off by, and nobody knows."""
EYES = ([0.28, -0.36, 0.42], [-0.35, -0.30, 0.45], [0.02, -0.5, 0.4])


@pytest.fixture(scope="module")
def one_sided():
    """Objects of which the camera in the hand sees the far side (+y) only."""
    scene = named_scene(3, ("wedge", "box"), 1)
    renderer = LabelRenderer(things_of(scene))
    rng = np.random.default_rng(8)
    frames = []
    for k, a in enumerate(np.radians(np.linspace(60, 120, 8))):
        flat, up = 0.36 * np.cos(np.radians(28)), 0.36 * np.sin(np.radians(28))
        T = se3.look_at([flat * np.cos(a), flat * np.sin(a), up], [0.0, 0.0, 0.02])
        z = renderer.render(scene.intrinsics, T).depth_m.astype(np.float64)
        z = np.where(z > 0, z + rng.normal(size=z.shape) * NOISE_PER_M * z**2, 0)
        error = se3.exp(rng.normal(size=6) * np.repeat([np.radians(0.03), 2e-4], 3))
        frames.append(DepthFrame(index=k, depth_m=z.astype(np.float32), T_world_cam=T @ error))
    return replace(scene, frames=tuple(frames))


def fixed_camera(scene, eye, seed: int) -> tuple[FixedFrames, np.ndarray]:
    """A fixed camera with errors of its own, an arm before it in some images; where it stands."""
    rng = np.random.default_rng(seed)
    T = se3.look_at(eye, [0.0, 0.0, 0.02])
    exact = LabelRenderer(things_of(scene)).render(CAMERA, T).depth_m.astype(np.float64)
    images = []
    for k in range(IMAGES):
        z = exact.copy()
        if k % 3 == 0:
            z[:, 40 * k : 40 * k + 120] = 0.25
        z = z + rng.normal(size=z.shape) * NOISE_PER_M * z**2
        z[rng.random(z.shape) < 0.03] = 0.0
        images.append(BIAS.measured(np.where(exact > 0, z, 0)).astype(np.float32))
    error = se3.exp(rng.normal(size=6) * np.repeat([np.radians(SIGMA_DEG), SIGMA_MM / 1e3], 3))
    sure = {"sigma_mm": SIGMA_MM, "sigma_deg": SIGMA_DEG}
    camera = FixedCamera(name=f"fixed{seed}", intrinsics=CAMERA, T_world_cam=T @ error, **sure)
    return FixedFrames(camera=camera, read=lambda: images), T


@pytest.fixture(scope="module")
def registered(one_sided):
    """Registrations with none to three fixed cameras."""
    starts = starts_off_by(one_sided, 4, 4, seed=2)
    cameras = [fixed_camera(one_sided, eye, seed) for seed, eye in enumerate(EYES)]
    found = [register(one_sided, starts, fixed=[c for c, _ in cameras[:n]]) for n in (0, 1, 3)]
    return found, cameras


def sigma_mm(pose: ObjectPose) -> float:
    assert pose.covariance is not None
    return 1e3 * float(np.sqrt(np.trace(pose.covariance[3:, 3:])))


def centre_error_mm(scene, pose: ObjectPose) -> float:
    truth = next(t for t in scene.truth if t.instance == pose.instance)
    middle = scene.models[pose.obj_id].mesh.bounds.mean(0)[None]
    apart = se3.transform(pose.T_world_obj, middle) - se3.transform(truth.T_world_obj, middle)
    return 1e3 * float(np.linalg.norm(apart))


def seen_error_mm(T: np.ndarray, T_true: np.ndarray) -> float:
    """By how much a camera sees a point in the middle of the table beside where it is."""
    middle = np.array([[0.0, 0.0, 0.02]])
    return 1e3 * float(np.linalg.norm(se3.transform(T @ se3.invert(T_true), middle) - middle))


def test_what_the_hand_sees_from_one_side_becomes_surer_with_each_fixed_camera(
    registered, one_sided
):
    results, _ = registered
    for fewer, more in pairwise(results):
        for before, after in zip(fewer.scene.objects, more.scene.objects, strict=True):
            assert sigma_mm(after) < 0.9 * sigma_mm(before)
            assert after.verdict == "accepted"
            # What all cameras have in common nobody sees: no worse means within its sigma.
            error = centre_error_mm(one_sided, after)
            assert error < centre_error_mm(one_sided, before) + 0.1 * sigma_mm(before)
            assert error < 2.0 * sigma_mm(after)


def test_a_fixed_camera_is_one_unknown_and_moves_to_where_it_stands(registered):
    results, cameras = registered
    three = results[-1]
    assert sorted(three.fixed_cameras) == [c.camera.name for c, _ in cameras]
    assert sorted(three.cameras) == list(range(8))
    before = [seen_error_mm(c.camera.T_world_cam, T) for c, T in cameras]
    after = [seen_error_mm(three.fixed_cameras[c.camera.name], T) for c, T in cameras]
    assert np.mean(after) < 0.6 * np.mean(before)
    told = three.report["refinement"]["fixed_cameras"]["fixed0"]
    assert told["noise_per_m"] < 0.7 * NOISE_PER_M
    assert 0 < told["sigma_mm"] < np.sqrt(3) * SIGMA_MM


def test_too_few_views_for_a_joint_fit_leave_fixed_cameras_out_and_say_so(one_sided):
    frames, _ = fixed_camera(one_sided, EYES[0], 0)
    starts = starts_off_by(one_sided, 2, 2, seed=2)
    found = register(one_sided, starts, frames=one_sided.frames[:2], fixed=[frames])
    assert found.fixed_cameras == {}
    (said,) = [f.words for f in found.findings if f.kind == "fixed_cameras"]
    assert "fixed0" in said


def test_images_of_another_size_than_the_camera_are_named(one_sided):
    frames, _ = fixed_camera(one_sided, EYES[0], 0)
    wrong = replace(frames, read=lambda: [np.ones((10, 20), np.float32)])
    starts = starts_off_by(one_sided, 2, 2, seed=2)
    refused(r"camera 'fixed0': .*\(10, 20\)", register, one_sided, starts, fixed=[wrong])


def test_the_still_depth_is_that_of_the_scene_behind_a_passing_arm():
    rng = np.random.default_rng(0)
    exact = np.full((60, 80), 0.8)
    images = []
    for k in range(10):
        z = exact + rng.normal(size=exact.shape) * NOISE_PER_M * exact**2
        z[:, 8 * k : 8 * k + 20] = 0.3 + 0.02 * k
        z[:5] = 0.0 if k != 3 else 0.8
        images.append(z.astype(np.float32))
    still = still_depth(images)
    assert not np.any(still[:5])
    assert np.abs(still[5:] - 0.8).max() < 0.01
    assert noise_of(still).per_m < 0.6 * NOISE_PER_M


def test_a_pixel_on_which_images_do_not_agree_has_no_depth():
    images = [np.full((2, 3), z, np.float32) for z in (0.5, 0.6, 0.7, 0.8)]
    assert not np.any(still_depth(images))
    refused("sizes", still_depth, [*images, np.ones((3, 3), np.float32)])
