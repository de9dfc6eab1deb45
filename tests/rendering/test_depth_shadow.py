"""Shadows of a second eye: by rays, by brute force, and by the scan of a depth image."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from fault_sessions import losses
from plain_meshes import card
from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from realsim.records import CameraIntrinsics
from realsim.rendering.appearance import Material
from realsim.rendering.depth_camera import DepthCamera
from realsim.rendering.depth_sensors.loss import (
    half_occluded,
    material_loss,
    shadow_mask,
    signal_loss,
)
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.depth_sensors.profiles import profile
from realsim.rendering.labels import LabelRenderer
from realsim.rendering.rays import BACKGROUND, PlacedMesh, RayScene
from realsim.rendering.stereo import StereoConfig
from refusals import refused
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
    measured = partial(model.measure, depth, CAMERA, np.random.default_rng(0))
    assert np.array_equal(measured(shadow=shadow) == 0, shadow)
    refused("give T_world_cam", measured, scene=RayScene(placed()))
    refused("the camera 96x72", measured, shadow=shadow[:10])


# --- The one depth camera: every source sees the same scene, and each fault comes from where it is.

WIDE = CameraIntrinsics(width=160, height=120, fx=160, fy=160, cx=79.5, cy=59.5)
EXACT = DepthSensorModel.noiseless()
BLACK = Material(base_color=(0.001, 0.001, 0.001))


SCENE = [card(BACKGROUND, 0.6, 1.0, Material()), card(0, 0.4, 0.06, BLACK)]


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
    scene = [card(BACKGROUND, 0.6, 1.0, Material()), card(0, 0.4, 0.06, Material())]
    found = seen(DepthCamera(scene, StereoConfig(), profile=replace(profile("d405"), min_z_m=0.1)))
    exact = DepthCamera(scene).exact(WIDE, np.eye(4)).depth_m
    both = found > 0
    assert both.mean() > 0.3
    assert abs(float(np.median(found[both] / exact[both])) - 1) < 0.01


# --- What a depth sensor loses: laws of the causes, and a known loss found again from known views.

FULL = CameraIntrinsics(width=320, height=240, fx=320, fy=320, cx=159.5, cy=119.5)


def grey(value: float, metallic: float = 0.0, roughness: float = 0.8) -> float:
    return material_loss(Material(base_color=(value,) * 3, metallic=metallic, roughness=roughness))


def test_darker_and_shinier_materials_lose_more_and_white_paint_next_to_nothing() -> None:
    lost = [grey(v) for v in (0.9, 0.3, 0.1, 0.03, 0.003)]
    assert lost == sorted(lost) and lost[0] < 1e-3 < 0.9 < lost[-1]
    # The threshold itself: half of a surface of that reflectance is lost.
    assert grey(0.03) == pytest.approx(0.5, abs=0.01)
    mirrors = [grey(0.9, 1.0, r) for r in (1.0, 0.6, 0.2, 0.05)]
    assert mirrors == sorted(mirrors) and mirrors[-1] > 0.5 and mirrors[0] < 1e-3
    image = np.full((8, 8, 3), 255, np.uint8)
    image[:, :4] = 0
    half = Material(base_color=(1, 1, 1), base_color_image=image)
    assert material_loss(half) == pytest.approx(grey(0.5), abs=1e-6)


def test_loss_depends_only_on_range_over_distance_and_on_reflectance_times_its_square() -> None:
    z = np.array([[0.5, 1.0, 2.0, 4.0]], np.float32)
    facing = np.ones_like(z)
    lost = signal_loss(z, facing, 2.0, 0.4)
    assert np.all(np.diff(lost) > 0) and lost[0, 2] == pytest.approx(0.5)
    assert np.allclose(signal_loss(2 * z, facing, 4.0, 0.4), lost, atol=1e-6)
    quarter = np.full_like(z, 0.25)
    assert np.allclose(signal_loss(z, facing, 4.0, 0.4, quarter), lost, atol=1e-6)
    assert np.allclose(signal_loss(z, quarter, 4.0, 0.4), lost, atol=1e-6)


def view(model: DepthSensorModel, reflectance: dict[int, float], seed: int) -> Any:
    """Return what a sensor sees of two squares before a wall, with the truth."""
    cards = [card(0, 0.6, 0.09, x=-0.13), card(1, 0.6, 0.09, x=0.15)]
    placed = [card(BACKGROUND, 0.9, 1.2), *cards]
    labels = LabelRenderer(placed).render(FULL, np.eye(4))
    rho = np.ones(labels.ids.shape, np.float32)
    for instance, value in reflectance.items():
        rho[labels.ids == instance] = value
    scene = RayScene(placed)
    measured = model.measure(
        labels.depth_m, FULL, np.random.default_rng(seed), scene=scene, T_world_cam=np.eye(4),
        reflectance=rho,
    )  # fmt: skip
    return losses.KnownView(
        measured_m=measured, exact_m=labels.depth_m, ids=labels.ids,
        kinds={0: "rubber", 1: "paper"}, intrinsics=FULL, scene=scene, T_world_cam=np.eye(4),
    )  # fmt: skip


PLAIN = replace(
    DepthSensorModel.from_profile("structured_light"), min_z_m=0.1, border=False,
    edge_width_px=2, edge_dropout=0.5, blobs_per_megapixel=0.0, signal_range_m=1.5,
    loss_patch_px=1.0,
)  # fmt: skip


def test_the_reflectance_of_each_kind_and_what_edges_lose_are_found_again() -> None:
    true = {0: 0.12, 1: 0.8}
    views = [view(PLAIN, true, seed) for seed in (0, 1)]
    tried = losses.LossFitConfig(edge_width_px=(1, 2, 3), edge_dropout=(0.2, 0.5, 0.8))
    fit = losses.fit_losses(replace(PLAIN, edge_width_px=1, edge_dropout=0.2), views, tried)
    assert fit.reflectance["rubber"] == pytest.approx(0.12, rel=0.15)
    assert fit.share_by_kind["rubber"] > 0.5 and fit.share_by_kind["paper"] < 0.05
    # Narrow edges that lose nearly all and wider ones that lose half leave as many holes.
    assert fit.model.edge_width_px * fit.model.edge_dropout == pytest.approx(1.0, abs=0.25)
    assert fit.zone_error < 0.03
    # What was not fitted: another draw of the same scene has as many holes on each object.
    new = view(PLAIN, true, 7)
    again = fit.model.measure(
        new.exact_m, FULL, np.random.default_rng(8), scene=new.scene, T_world_cam=np.eye(4),
        reflectance=fit.reflectance_of(new),
    )  # fmt: skip
    for instance in (0, 1):
        on = new.ids == instance
        assert np.mean(again[on] == 0) == pytest.approx(np.mean(new.measured_m[on] == 0), abs=0.05)


def test_a_kind_that_was_not_seen_gets_the_mean_of_all() -> None:
    tried = losses.LossFitConfig(edge_width_px=(2,), edge_dropout=(0.5,))
    fit = losses.fit_losses(PLAIN, [view(PLAIN, {0: 0.12, 1: 0.8}, 0)], tried)
    low, high = sorted(fit.reflectance.values())
    assert low < fit.mean_reflectance < high
    unknown = replace(view(PLAIN, {}, 1), kinds={0: "cup"})
    rho = fit.reflectance_of(unknown)
    assert np.allclose(rho[unknown.ids == 0], fit.mean_reflectance)
    assert np.all(rho[unknown.ids != 0] == 1)


def test_mistakes_are_named() -> None:
    refused("found none", losses.fit_losses, PLAIN, [])
    empty = view(PLAIN, {}, 0)
    nothing = replace(empty, ids=np.full_like(empty.ids, -1))
    refused("found none", losses.fit_losses, PLAIN, [nothing])
    refused("320x240", replace, empty, measured_m=empty.measured_m[:100])
