"""Distances of measured points from the models: zero on them, signed, the same after a detour."""

import numpy as np
import pytest

from realsim.arrays import Array, Array32
from realsim.geometry import se3
from realsim.geometry.mesh_shape import sample_surface
from realsim.geometry.parts import part
from realsim.records import Mesh
from realsim.review.placing.depth_residuals import CloudResiduals, noise_of, residual_rgb
from refusals import refused

WEDGE = part("wedge").mesh
FLANGE = part("flange").mesh
T_WEDGE = se3.from_translation([0.5, 0.1, 0.0]) @ se3.exp(np.array([0.1, -0.3, 0.5, 0, 0, 0]))
T_FLANGE = se3.from_translation([0.65, 0.1, 0.0])


def residuals(points: Array, Ts: Array, meshes: list[Mesh]) -> Array32:
    return CloudResiduals(points).against(Ts, meshes)


def surface(offset_m: float = 0.0, seed: int = 0) -> Array:
    """Return points of the wedge in world, moved along their normals."""
    points, normals = sample_surface(WEDGE, 4000, np.random.default_rng(seed))
    return se3.transform(T_WEDGE, points + offset_m * normals)


def test_points_on_the_surface_have_no_residual() -> None:
    r = residuals(surface(), T_WEDGE[None], [WEDGE])
    assert np.all(np.isfinite(r))
    assert np.quantile(np.abs(r), 0.99) < 1e-4 and np.abs(r).max() < 4e-4


@pytest.mark.parametrize("offset_mm", [-2.0, 3.0])
def test_the_sign_tells_front_from_inside(offset_mm: float) -> None:
    r = residuals(surface(1e-3 * offset_mm), T_WEDGE[None], [WEDGE])
    assert np.median(r) == pytest.approx(1e-3 * offset_mm, abs=5e-5)
    assert np.mean(np.sign(r) == np.sign(offset_mm)) > 0.97


def test_residuals_do_not_depend_on_where_the_world_is() -> None:
    W = se3.random_transform(np.random.default_rng(1))
    points = surface(0.001)
    a = residuals(points, np.stack([T_WEDGE, T_FLANGE]), [WEDGE, FLANGE])
    b = residuals(se3.transform(W, points), np.stack([W @ T_WEDGE, W @ T_FLANGE]), [WEDGE, FLANGE])
    np.testing.assert_allclose(a, b, atol=2e-6)


def test_points_far_from_all_have_none() -> None:
    points = np.concatenate([surface()[:10], [[0.5, 0.1, 0.5], [0.0, 0.0, 0.0]]])
    assert list(np.isnan(residuals(points, T_WEDGE[None], [WEDGE]))) == [False] * 10 + [True] * 2
    assert np.all(np.isnan(residuals(points, np.zeros((0, 4, 4)), [])))


def test_of_several_models_the_nearest_counts_whatever_their_order() -> None:
    points = np.concatenate([surface(0.002), surface(-0.001, 1)])
    T_near = T_WEDGE @ se3.from_translation([0.0, 0.0, 0.004])
    pair = residuals(points, np.stack([T_WEDGE, T_near]), [WEDGE, WEDGE])
    swapped = residuals(points, np.stack([T_near, T_WEDGE]), [WEDGE, WEDGE])
    np.testing.assert_array_equal(np.abs(pair), np.abs(swapped))
    alone = [residuals(points, T[None], [WEDGE]) for T in (T_WEDGE, T_near)]
    np.testing.assert_array_equal(np.abs(pair), np.nanmin(np.abs(alone), axis=0))


def test_after_one_object_has_moved_the_residuals_are_those_of_a_fresh_cloud() -> None:
    points = np.concatenate([surface(0.001), surface(-0.002, 1)])
    Ts = np.stack([T_WEDGE, T_FLANGE])
    cloud = CloudResiduals(points)
    first = cloud.against(Ts, [WEDGE, FLANGE])
    Ts[0, 0, 3] += 0.002
    second = cloud.against(Ts, [WEDGE, FLANGE])
    np.testing.assert_array_equal(second, residuals(points, Ts, [WEDGE, FLANGE]))
    assert not np.array_equal(first, second, equal_nan=True)


def test_colours_tell_inside_from_outside_also_without_red_green_vision() -> None:
    rgb = residual_rgb(np.array([-0.02, -0.005, 0.0, 0.005, 0.02, np.nan])).astype(int)
    np.testing.assert_array_equal(rgb[0], rgb[1])
    np.testing.assert_array_equal(rgb[3], rgb[4])
    # Who sees no red-green still sees blue against yellow: the blue channel and the sum differ.
    inside, on, outside, none = rgb[1], rgb[2], rgb[3], rgb[5]
    assert inside[2] > outside[2] + 80 and outside[0] > inside[0] + 80
    assert on.sum() > inside.sum() + 200 and on.sum() > outside.sum() + 200
    assert none[0] == none[1] == none[2]


def test_what_is_no_cloud_is_refused() -> None:
    refused(r"\(N, 3\)", CloudResiduals, np.zeros((4, 2)))
    refused("positive", CloudResiduals, np.zeros((4, 3)), within_m=0.0)
    refused("one of each", residuals, np.zeros((4, 3)), np.eye(4)[None], [])
    refused("times the noise", residual_rgb, [0.0], 0.0)


def test_noise_looks_like_noise_and_an_error_does_not() -> None:
    noise = np.random.default_rng(0).normal(scale=0.0007, size=4000)
    sigma = noise_of(np.append(noise, np.nan))
    assert sigma == pytest.approx(0.0007, rel=0.05)
    on = residual_rgb([0.0])[0]
    assert np.mean((residual_rgb(noise, noise_m=sigma) == on).all(1)) > 0.93
    assert np.mean((residual_rgb(noise + 0.003, noise_m=sigma) == on).all(1)) < 0.02
    # A scene in which most stands wrong must not pass for a noisy one.
    assert noise_of(noise + 0.006) <= 0.001


def test_points_of_the_table_are_no_residual_of_what_stands_on_it() -> None:
    mesh = part("box").mesh
    half = -float(mesh.bounds[0, 2])
    reach = float(mesh.bounds[1, 0])
    T = se3.from_translation([0.0, 0.0, half])
    beside, side = [reach + 0.006, 0.0, 0.0005], [reach + 0.006, 0.0, 0.02]
    points = np.array([beside, side], np.float32)
    alone = CloudResiduals(points).against(T[None], [mesh])
    assert np.all(np.isfinite(alone))
    with_table = CloudResiduals(points, T_world_table=np.eye(4)).against(T[None], [mesh])
    assert np.isnan(with_table[0]) and with_table[1] == alone[1]
    # The law holds wherever world is.
    M = se3.random_transform(np.random.default_rng(1))
    moved = se3.transform(M, points).astype(np.float32)
    again = CloudResiduals(moved, T_world_table=M).against((M @ T)[None], [mesh])
    assert np.isnan(again[0]) and np.isclose(again[1], alone[1], atol=1e-5)
