"""Shadows of a second eye: by rays, by brute force, and by the scan of a depth image."""

from dataclasses import replace

import numpy as np
import pytest

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.appearance import Material
from realsim.rendering.depth_camera import DepthCamera
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.depth_sensors.profiles import profile
from realsim.rendering.depth_sensors.shadow import half_occluded, shadow_mask
from realsim.rendering.labels import LabelRenderer
from realsim.rendering.rays import BACKGROUND, PlacedMesh, RayScene
from realsim.rendering.stereo import StereoConfig
from trimesh_solids import ball, box

CAMERA = CameraIntrinsics(width=96, height=72, fx=90, fy=90, cx=47.5, cy=35.5)
SMALL = CameraIntrinsics(width=48, height=36, fx=45, fy=45, cx=23.5, cy=17.5)
LENS = replace(SMALL, distortion=np.array([-0.12, 0.05, 0.001, -0.002, 0.0]))


def placed(behind: bool = False) -> list[PlacedMesh]:
    """Return a ball and a turned box before a wall; a second wall behind the camera."""
    turned, wall = se3.exp_so3([0.5, 0.4, 0.3]), box((3.0, 3.0, 0.01))
    things = [
        PlacedMesh(0, ball(0.07, 2), se3.from_translation([-0.06, 0.02, 0.5])),
        PlacedMesh(1, box((0.1, 0.06, 0.08)), se3.from_rt(turned, [0.12, -0.03, 0.42])),
        PlacedMesh(-1, wall, se3.from_translation([0, 0, 0.8])),
    ]
    return [*things, PlacedMesh(-1, wall, se3.from_translation([0, 0, -0.3]))] if behind else things


def brute_force_hidden(points: np.ndarray, eye: np.ndarray, things: list[PlacedMesh]) -> np.ndarray:
    """Return which points have a triangle between themselves and the eye (Moeller-Trumbore)."""
    corners = np.concatenate(
        [se3.transform(p.T_world_obj, p.mesh.vertices)[p.mesh.faces] for p in things]
    )
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    hidden = np.zeros(len(points), bool)
    for k, x in enumerate(points):
        d = x - eye
        h = np.cross(d, e2)
        det = np.einsum("ij,ij->i", e1, h)
        f = 1 / np.where(np.abs(det) < 1e-14, np.inf, det)
        s = eye - a
        q = np.cross(s, e1)
        u, v = f * np.einsum("ij,ij->i", s, h), f * (q @ d)
        t = f * np.einsum("ij,ij->i", e2, q)
        hidden[k] = np.any((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-9) & (t < 1 - 5e-4))
    return hidden


@pytest.mark.parametrize("offset", [0.0, -0.03])
def test_the_shadow_is_what_a_search_through_all_triangles_finds(offset: float) -> None:
    camera = LENS
    things = placed()
    depth = LabelRenderer(things).render(camera, np.eye(4)).depth_m
    mask = shadow_mask(
        RayScene(things), depth, camera, np.eye(4),
        baseline_m=0.05, eye_offset_m=offset, border=False,
    )  # fmt: skip
    points = (ray_table(camera) * depth[..., None]).reshape(-1, 3).astype(np.float64)
    expected = np.zeros(len(points), bool)
    for x in {offset, offset + 0.05} - {0.0}:
        expected |= brute_force_hidden(points, np.array([x, 0, 0]), things)
    assert 0.02 < mask.mean() < 0.5
    # Where the line of sight grazes a surface (the rim of the ball) float32 decides.
    assert np.sum(mask.ravel() != expected) <= 3


def test_a_wall_behind_the_camera_hides_nothing() -> None:
    depth = LabelRenderer(placed()).render(CAMERA, np.eye(4)).depth_m
    masks = [
        shadow_mask(RayScene(placed(b)), depth, CAMERA, np.eye(4), baseline_m=0.05)
        for b in (False, True)
    ]
    assert np.array_equal(masks[0], masks[1])


def test_the_scan_of_the_picture_finds_nearly_the_same() -> None:
    depth = LabelRenderer(placed()).render(CAMERA, np.eye(4)).depth_m
    model = replace(DepthSensorModel.noiseless(), occlusion=True, baseline_m=0.05)
    rng = np.random.default_rng
    scanned = model.measure(depth, CAMERA, rng(0)) == 0
    exact = model.measure(
        depth, CAMERA, rng(0), scene=RayScene(placed()), T_world_cam=np.eye(4)
    ) == 0  # fmt: skip
    assert np.mean(scanned != exact) < 0.02
    assert exact.mean() == pytest.approx(scanned.mean(), rel=0.1)


def test_an_eye_on_the_left_casts_the_mirrored_shadow() -> None:
    disparity = np.full((4, 60), 5.0, np.float32)
    disparity[:, 20:30] = 15.0
    right = half_occluded(disparity, border=False)
    left = half_occluded(disparity[:, ::-1], second_eye=-1.0, border=False)[:, ::-1]
    assert np.array_equal(right, left)
    assert np.flatnonzero(right[0]).tolist() == list(range(11, 20))


def test_a_given_shadow_is_lost_and_mistakes_are_named() -> None:
    depth = np.full((72, 96), 0.5, np.float32)
    shadow = np.zeros((72, 96), bool)
    shadow[10:20, 30:40] = True
    model = replace(DepthSensorModel.noiseless(), occlusion=True)
    out = model.measure(depth, CAMERA, np.random.default_rng(0), shadow=shadow)
    assert np.array_equal(out == 0, shadow)
    with pytest.raises(InputError, match="give T_world_cam"):
        model.measure(depth, CAMERA, np.random.default_rng(0), scene=RayScene(placed()))
    with pytest.raises(InputError, match="the camera 96x72"):
        model.measure(depth, CAMERA, np.random.default_rng(0), shadow=shadow[:10])


# --- The one depth camera: every source sees the same scene, and each fault comes from where it is.

WIDE = CameraIntrinsics(width=160, height=120, fx=160, fy=160, cx=79.5, cy=59.5)
EXACT = DepthSensorModel.noiseless()
BLACK = Material(base_color=(0.001, 0.001, 0.001))


def square(instance: int, z: float, half: float, material: Material | None = None) -> PlacedMesh:
    corners = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) + [0, 0, z]
    mesh = Mesh(vertices=corners, faces=np.array([[0, 2, 1], [0, 3, 2]], np.int32))
    return PlacedMesh(instance, mesh, np.eye(4), material)


SCENE = [square(BACKGROUND, 0.6, 1.0, Material()), square(0, 0.4, 0.06, BLACK)]


def seen(camera: DepthCamera, seed: int = 0) -> np.ndarray:
    return camera.measure(WIDE, np.eye(4), np.random.default_rng(seed))


def test_exact_depth_is_that_of_the_labels_and_a_given_view_is_taken_as_it_is() -> None:
    labels = LabelRenderer(SCENE).render(WIDE, np.eye(4))
    assert np.allclose(seen(DepthCamera(SCENE)), labels.depth_m, rtol=1e-6)
    given = DepthCamera().measure(WIDE, np.eye(4), np.random.default_rng(0), labels)
    assert np.array_equal(given, labels.depth_m)


def test_a_noise_model_reports_what_it_makes_of_the_exact_depth() -> None:
    model = DepthSensorModel.from_profile("d405")
    camera = DepthCamera(SCENE, model)
    exact = camera.exact(WIDE, np.eye(4)).depth_m
    assert np.array_equal(seen(camera, 3), model.measure(exact, WIDE, np.random.default_rng(3)))
    assert np.array_equal(seen(camera, 3), seen(camera, 3))


def test_counts_are_whole() -> None:
    counts = seen(DepthCamera(SCENE, EXACT, unit_m=0.003)) / 0.003
    assert np.allclose(counts, np.round(counts), atol=1e-3)


def test_shadows_by_rays_and_lossy_materials_are_switched_on_alone() -> None:
    shadows = replace(EXACT, occlusion=True, border=False, baseline_m=0.05)
    square_seen = DepthCamera(SCENE).exact(WIDE, np.eye(4)).geometry == 1
    by_rays = seen(DepthCamera(SCENE, shadows, exact_shadows=True)) == 0
    left = np.flatnonzero(square_seen.any(0))[0]
    # f B (1 / 0.4 - 1 / 0.6) = 6.7 px of wall at the left of the square.
    assert 6 <= np.flatnonzero(by_rays[60]).size <= 7 and np.all(np.flatnonzero(by_rays[60]) < left)
    lost = seen(DepthCamera(SCENE, EXACT, material_loss=True)) == 0
    assert lost[square_seen].mean() > 0.9 and not lost[~square_seen].any()


def test_a_matched_pair_sees_the_same_scene() -> None:
    scene = [square(BACKGROUND, 0.6, 1.0, Material()), square(0, 0.4, 0.06, Material())]
    found = seen(DepthCamera(scene, StereoConfig(), profile=replace(profile("d405"), min_z_m=0.1)))
    exact = DepthCamera(scene).exact(WIDE, np.eye(4)).depth_m
    both = found > 0
    assert both.mean() > 0.3
    assert abs(float(np.median(found[both] / exact[both])) - 1) < 0.01
