"""Cameras that stand still beside the one in the hand, in the joint fit."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.records import CameraIntrinsics, ObjectPose
from realsim.records.depth_bias import DepthBias
from realsim.registration.evidence import DepthFrame
from realsim.registration.fixed_cameras import FixedCamera, FixedFrames, noise_of, still_depth
from realsim.rendering.labels import LabelRenderer
from refusals import refused
from table_scenes import named_scene, register, starts_off_by, things_of

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
    camera = FixedCamera(
        name=f"fixed{seed}", intrinsics=CAMERA, T_world_cam=T @ error, sigma_mm=SIGMA_MM,
        sigma_deg=SIGMA_DEG,
    )  # fmt: skip
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
