"""Cameras of synthetic views: where they stand, where they look, how evenly they are spread."""

from dataclasses import replace

import numpy as np
import pytest

from realsim import Mesh
from realsim.geometry import se3
from realsim.geometry.camera import project, ray_table
from realsim.rendering.appearance import Material
from realsim.rendering.depth_camera import DepthCamera
from realsim.rendering.depth_sensors.loss import look_of
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.labels import LabelRenderer
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim_sim_bridge.synthetic.cameras import hemisphere_cameras
from realsim_sim_bridge.synthetic.config import SyntheticConfig
from refusals import refused
from synthetic_scenes import INTRINSICS, cameras, synthetic_scene, table

CENTER = np.array([0.4, -0.2, 0.1])


def spread(count=200, seed=0, elevation_deg=(15.0, 85.0)):
    rng = np.random.default_rng(seed)
    return hemisphere_cameras(CENTER, (0.5, 0.8), count, rng, elevation_deg)


def directions(Ts):
    away = Ts[:, :3, 3] - CENTER
    return away / np.linalg.norm(away, axis=1, keepdims=True)


def test_cameras_stand_within_the_asked_distances_and_elevations():
    Ts = spread()
    away = np.linalg.norm(Ts[:, :3, 3] - CENTER, axis=1)
    assert away.min() >= 0.5 and away.max() <= 0.8
    assert away.min() < 0.53 and away.max() > 0.77
    elevation = np.degrees(np.arcsin(directions(Ts)[:, 2]))
    assert elevation.min() >= 15 - 1e-9 and elevation.max() <= 85 + 1e-9


def test_the_picture_stands_upright_and_the_center_is_ahead():
    Ts = spread()
    assert np.abs(Ts[:, 2, 0]).max() < 1e-12  # x axis level
    assert (Ts[:, 2, 1] < 0).all()  # y axis down
    to_center = -directions(Ts)
    angle = np.degrees(np.arccos(np.sum(Ts[:, :3, 2] * to_center, axis=1)))
    assert angle.max() < 10 and angle.mean() > 1


def test_equal_areas_of_the_band_get_equal_numbers():
    found = directions(spread(2000))
    height = found[:, 2]
    low, high = np.sin(np.radians([15, 85]))
    counts, _ = np.histogram(height, np.linspace(low, high, 11))
    assert counts.min() >= 190 and counts.max() <= 210
    azimuth = np.arctan2(*found[:, 1::-1].T)
    counts, _ = np.histogram(azimuth, np.linspace(-np.pi, np.pi, 9))
    assert counts.min() > 225 and counts.max() < 275


def test_the_same_seed_gives_the_same_cameras_and_another_one_others():
    assert np.array_equal(spread(20, 3), spread(20, 3))
    assert not np.allclose(spread(20, 3), spread(20, 4))


def test_what_cannot_be_is_refused():
    for radius, count, elevation in (
        ((0.5, 0.4), 5, (15, 85)), ((0, 1), 5, (15, 85)), ((0.4, 0.5), 0, (15, 85)),
        ((0.4, 0.5), 5, (50, 20)),
    ):  # fmt: skip
        rng = np.random.default_rng(0)
        refused("accepted", hemisphere_cameras, CENTER, radius, count, rng, elevation)


# --- The simulated depth camera of synthetic views: exact shadows, lossy materials, fitted figures.

FAULTLESS = DepthSensorModel.noiseless()
WITH_SHADOWS = replace(FAULTLESS, occlusion=True, border=False, baseline_m=0.05)
BLACK = Material(base_color=(0.002, 0.002, 0.002), name="black")
WHITE = Material(base_color=(0.9, 0.9, 0.9), name="white")
MIRROR = Material(base_color=(0.9, 0.9, 0.9), metallic=1.0, roughness=0.05, name="mirror")
T = cameras(1)[0]


def exact(scene):
    return LabelRenderer(scene.placed()).render(INTRINSICS, T)


def measured(scene, model, seed=0, material_loss=True):
    camera = DepthCamera(scene.placed(), model, exact_shadows=True, material_loss=material_loss)
    return camera.measure(INTRINSICS, T, np.random.default_rng(seed), exact(scene))


def test_the_shadows_are_what_the_second_eye_cannot_see():
    scene = synthetic_scene()
    labels = exact(scene)
    lost = (
        (measured(scene, WITH_SHADOWS, material_loss=False) == 0)
        & (labels.depth_m > 0)
        & (labels.depth_m < WITH_SHADOWS.max_z_m)
    )
    T_world_right = T @ se3.from_translation([WITH_SHADOWS.baseline_m, 0, 0])
    right = LabelRenderer(scene.placed()).render(INTRINSICS, T_world_right)
    rows, columns = np.nonzero(labels.depth_m > 0)
    # By the second eye's own picture: a point is hidden where that picture shows something nearer.
    points = ray_table(INTRINSICS)[rows, columns] * labels.depth_m[rows, columns, None]
    uv = project(INTRINSICS, points - [WITH_SHADOWS.baseline_m, 0, 0])
    at = np.round(uv).astype(int)
    inside = np.all((at >= 1) & (at < [INTRINSICS.width - 1, INTRINSICS.height - 1]), axis=1)
    around = [right.depth_m[at[inside, 1] + j, at[inside, 0] + i] for i in (-1, 0, 1)
              for j in (-1, 0, 1)]  # fmt: skip
    z, hidden = points[inside, 2], lost[rows[inside], columns[inside]]
    assert not np.any(hidden & (z < np.min(around, axis=0) + 1e-4))
    clearly = np.max(around, axis=0) < z - 0.01
    assert clearly.sum() > 20 and np.all(hidden[clearly])


@pytest.mark.parametrize(("material", "least", "most"), [
    (WHITE, 0.0, 0.0), (BLACK, 0.9, 1.0), (MIRROR, 0.4, 0.65),
])  # fmt: skip
def test_dark_and_mirroring_surfaces_lose_pixels(material, least, most):
    looks, white_table = {0: material, 3: WHITE}, replace(table(), material=WHITE)
    scene = synthetic_scene(materials=looks, surroundings=(white_table,))
    labels = exact(scene)
    found = np.mean([
        measured(scene, FAULTLESS, seed)[labels.ids == 0] == 0 for seed in range(4)
    ])  # fmt: skip
    assert least <= found <= most
    assert np.all(measured(scene, FAULTLESS)[labels.ids == 3] > 0)
    assert np.all(measured(scene, FAULTLESS, material_loss=False)[labels.ids == 0] > 0)


def test_the_mean_look_of_a_mesh_is_its_own():
    v, f = np.eye(4)[:, :3], np.array([[0, 1, 2]], np.int32)
    grey = np.full((4, 3), 188, np.uint8)  # sRGB 188 is half of the light
    colored = PlacedMesh(0, Mesh(vertices=v, faces=f, colors=grey), np.eye(4))
    assert look_of(colored).base_color == pytest.approx((0.5, 0.5, 0.5), abs=0.01)
    image = np.stack([np.zeros((8, 3), np.uint8), np.full((8, 3), 255, np.uint8)])
    own = Material(base_color=(0.5, 1.0, 1.0), base_color_image=image, metallic=1.0, roughness=0.2)
    seen = look_of(PlacedMesh(BACKGROUND, Mesh(vertices=v, faces=f), np.eye(4), own))
    assert seen.base_color == pytest.approx((0.25, 0.5, 0.5), abs=0.01)
    assert (seen.metallic, seen.roughness, seen.base_color_image) == (1.0, 0.2, None)
    plain = look_of(PlacedMesh(0, Mesh(vertices=v, faces=f), np.eye(4)))
    assert plain.base_color == Material().base_color


def test_a_fitted_model_with_another_kind_of_depth_is_refused():
    refused("'disparity'", SyntheticConfig, depth="stereo", depth_model=FAULTLESS)
