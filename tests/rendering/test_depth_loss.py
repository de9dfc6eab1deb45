"""What a depth sensor loses: laws of the causes, and a known loss found again from known views."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fault_sessions import losses
from plain_meshes import square
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.appearance import Material
from realsim.rendering.depth_sensors.loss import material_loss, signal_loss
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.labels import LabelRenderer
from realsim.rendering.rays import BACKGROUND, PlacedMesh, RayScene
from refusals import refused

KnownView, LossFitConfig = losses.KnownView, losses.LossFitConfig
fit_losses = losses.fit_losses
CAMERA = CameraIntrinsics(width=320, height=240, fx=320, fy=320, cx=159.5, cy=119.5)


def facing(instance: int, z: float, half: float, x: float = 0.0) -> PlacedMesh:
    mesh = Mesh(vertices=square(half).vertices + np.array([x, 0, z]), faces=square().faces[:, ::-1])
    return PlacedMesh(instance, mesh, np.eye(4))


def grey(value: float, metallic: float = 0.0, roughness: float = 0.8) -> float:
    return material_loss(Material(base_color=(value,) * 3, metallic=metallic, roughness=roughness))


def test_darker_and_shinier_materials_lose_more_and_white_paint_next_to_nothing() -> None:
    losses = [grey(v) for v in (0.9, 0.3, 0.1, 0.03, 0.003)]
    assert losses == sorted(losses) and losses[0] < 1e-3 < 0.9 < losses[-1]
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
    placed = [facing(BACKGROUND, 0.9, 1.2), facing(0, 0.6, 0.09, -0.13), facing(1, 0.6, 0.09, 0.15)]
    labels = LabelRenderer(placed).render(CAMERA, np.eye(4))
    rho = np.ones(labels.ids.shape, np.float32)
    for instance, value in reflectance.items():
        rho[labels.ids == instance] = value
    scene = RayScene(placed)
    measured = model.measure(
        labels.depth_m, CAMERA, np.random.default_rng(seed), scene=scene, T_world_cam=np.eye(4),
        reflectance=rho,
    )  # fmt: skip
    return KnownView(
        measured_m=measured, exact_m=labels.depth_m, ids=labels.ids,
        kinds={0: "rubber", 1: "paper"}, intrinsics=CAMERA, scene=scene, T_world_cam=np.eye(4),
    )  # fmt: skip


PLAIN = replace(
    DepthSensorModel.from_profile("structured_light"), min_z_m=0.1, border=False,
    edge_width_px=2, edge_dropout=0.5, blobs_per_megapixel=0.0, signal_range_m=1.5,
    loss_patch_px=1.0,
)  # fmt: skip


def test_the_reflectance_of_each_kind_and_what_edges_lose_are_found_again() -> None:
    true = {0: 0.12, 1: 0.8}
    views = [view(PLAIN, true, seed) for seed in (0, 1)]
    tried = LossFitConfig(edge_width_px=(1, 2, 3), edge_dropout=(0.2, 0.5, 0.8))
    fit = fit_losses(replace(PLAIN, edge_width_px=1, edge_dropout=0.2), views, tried)
    assert fit.reflectance["rubber"] == pytest.approx(0.12, rel=0.15)
    assert fit.share_by_kind["rubber"] > 0.5 and fit.share_by_kind["paper"] < 0.05
    # Narrow edges that lose nearly all and wider ones that lose half leave as many holes.
    assert fit.model.edge_width_px * fit.model.edge_dropout == pytest.approx(1.0, abs=0.25)
    assert fit.zone_error < 0.03
    # What was not fitted: another draw of the same scene has as many holes on each object.
    new = view(PLAIN, true, 7)
    again = fit.model.measure(
        new.exact_m, CAMERA, np.random.default_rng(8), scene=new.scene, T_world_cam=np.eye(4),
        reflectance=fit.reflectance_of(new),
    )  # fmt: skip
    for instance in (0, 1):
        on = new.ids == instance
        assert np.mean(again[on] == 0) == pytest.approx(np.mean(new.measured_m[on] == 0), abs=0.05)


def test_a_kind_that_was_not_seen_gets_the_mean_of_all() -> None:
    fit = fit_losses(PLAIN, [view(PLAIN, {0: 0.12, 1: 0.8}, 0)],
                     LossFitConfig(edge_width_px=(2,), edge_dropout=(0.5,)))  # fmt: skip
    low, high = sorted(fit.reflectance.values())
    assert low < fit.mean_reflectance < high
    unknown = replace(view(PLAIN, {}, 1), kinds={0: "cup"})
    rho = fit.reflectance_of(unknown)
    assert np.allclose(rho[unknown.ids == 0], fit.mean_reflectance)
    assert np.all(rho[unknown.ids != 0] == 1)


def test_mistakes_are_named() -> None:
    refused("found none", fit_losses, PLAIN, [])
    empty = view(PLAIN, {}, 0)
    refused("found none", fit_losses, PLAIN, [replace(empty, ids=np.full_like(empty.ids, -1))])
    refused("320x240", replace, empty, measured_m=empty.measured_m[:100])
