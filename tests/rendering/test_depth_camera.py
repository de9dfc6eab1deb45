"""The one depth camera: every source sees the same scene, and each fault comes from where it is."""

from dataclasses import replace

import numpy as np

from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.appearance import Material
from realsim.rendering.depth_camera import DepthCamera
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.depth_sensors.profiles import profile
from realsim.rendering.labels import LabelRenderer
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim.rendering.stereo import StereoConfig

CAMERA = CameraIntrinsics(width=160, height=120, fx=160, fy=160, cx=79.5, cy=59.5)
EXACT = DepthSensorModel.noiseless()
BLACK = Material(base_color=(0.001, 0.001, 0.001))


def square(instance: int, z: float, half: float, material: Material | None = None) -> PlacedMesh:
    corners = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) + [0, 0, z]
    mesh = Mesh(vertices=corners, faces=np.array([[0, 2, 1], [0, 3, 2]], np.int32))
    return PlacedMesh(instance, mesh, np.eye(4), material)


SCENE = [square(BACKGROUND, 0.6, 1.0, Material()), square(0, 0.4, 0.06, BLACK)]


def seen(camera: DepthCamera, seed: int = 0) -> np.ndarray:
    return camera.measure(CAMERA, np.eye(4), np.random.default_rng(seed))


def test_exact_depth_is_that_of_the_labels_and_a_given_view_is_taken_as_it_is() -> None:
    labels = LabelRenderer(SCENE).render(CAMERA, np.eye(4))
    assert np.allclose(seen(DepthCamera(SCENE)), labels.depth_m, rtol=1e-6)
    given = DepthCamera().measure(CAMERA, np.eye(4), np.random.default_rng(0), labels)
    assert np.array_equal(given, labels.depth_m)


def test_a_noise_model_reports_what_it_makes_of_the_exact_depth() -> None:
    model = DepthSensorModel.from_profile("d405")
    camera = DepthCamera(SCENE, model)
    exact = camera.exact(CAMERA, np.eye(4)).depth_m
    assert np.array_equal(seen(camera, 3), model.measure(exact, CAMERA, np.random.default_rng(3)))
    assert np.array_equal(seen(camera, 3), seen(camera, 3))


def test_counts_are_whole() -> None:
    counts = seen(DepthCamera(SCENE, EXACT, unit_m=0.003)) / 0.003
    assert np.allclose(counts, np.round(counts), atol=1e-3)


def test_shadows_by_rays_and_lossy_materials_are_switched_on_alone() -> None:
    shadows = replace(EXACT, occlusion=True, border=False, baseline_m=0.05)
    square_seen = DepthCamera(SCENE).exact(CAMERA, np.eye(4)).geometry == 1
    by_rays = seen(DepthCamera(SCENE, shadows, exact_shadows=True)) == 0
    left = np.flatnonzero(square_seen.any(0))[0]
    # f B (1 / 0.4 - 1 / 0.6) = 6.7 px of wall at the left of the square.
    assert 6 <= np.flatnonzero(by_rays[60]).size <= 7 and np.all(np.flatnonzero(by_rays[60]) < left)
    lost = seen(DepthCamera(SCENE, EXACT, material_loss=True)) == 0
    assert lost[square_seen].mean() > 0.9 and not lost[~square_seen].any()


def test_a_matched_pair_sees_the_same_scene() -> None:
    kind = replace(profile("d405"), min_z_m=0.1)
    scene = [square(BACKGROUND, 0.6, 1.0, Material()), square(0, 0.4, 0.06, Material())]
    found = seen(DepthCamera(scene, StereoConfig(), profile=kind))
    exact = DepthCamera(scene).exact(CAMERA, np.eye(4)).depth_m
    both = found > 0
    assert both.mean() > 0.3
    assert abs(float(np.median(found[both] / exact[both])) - 1) < 0.01
