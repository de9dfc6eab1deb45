"""Snapping one object to the depth: it comes back from a push, and says when it cannot."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from begun_sessions import add_drawn, begun
from plain_meshes import square
from realsim.arrays import Array, Array32
from realsim.geometry import se3
from realsim.geometry.mesh_shape import sample_surface
from realsim.geometry.metrics import mssd
from realsim.geometry.parts import part
from realsim.records import Mesh, ObjectPose, Scene, SupportPlane
from realsim.records.calibration import DepthBias
from realsim.rendering.labels import LabelRenderer, PlacedMesh
from realsim.review.placing.depth_residuals import CloudResiduals, noise_of, residual_rgb
from realsim.review.placing.measured_views import depth_bias_of, usable_views
from realsim.review.placing.placing import middle_of
from realsim.review.placing.snapping import Snapped, Snapper
from realsim.store import SessionStore
from refusals import refused
from registered_sessions import CAMERA, models_of, table_session, true_cameras, true_poses

MODELS = models_of()
TUBE = part("tube")
TRUTH = {o.instance: o for o in true_poses()}
ACCEPTED = tuple(replace(o, verdict="accepted") for o in TRUTH.values())
SCENE = Scene(name="two objects", objects=ACCEPTED, plane=SupportPlane(T_world_table=np.eye(4)))


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> SessionStore:
    return table_session(tmp_path_factory.mktemp("snap") / "s", views=8, sigma=(0.0, 0.0))


@pytest.fixture(scope="module")
def snapper(store: SessionStore) -> Snapper:
    return Snapper(store, SCENE, MODELS)


def pushed(placed: ObjectPose, mm: float, deg: float, seed: int = 0) -> Array:
    """Return a pose that is off by so much, turned about the object's middle."""
    turn, shift = np.random.default_rng(seed).normal(size=(2, 3))
    turn, shift = turn / np.linalg.norm(turn), shift / np.linalg.norm(shift)
    C = se3.from_translation(middle_of((MODELS | {TUBE.obj_id: TUBE})[placed.obj_id].mesh))
    xi = np.concatenate([np.radians(deg) * turn, 1e-3 * mm * shift])
    return placed.T_world_obj @ C @ se3.exp(xi) @ se3.invert(C)


def off_mm(found: Snapped, placed: ObjectPose) -> float:
    """Return how far the vertex that is most off is from where it belongs [mm]."""
    vertices = MODELS[placed.obj_id].mesh.vertices
    return 1e3 * mssd(placed.T_world_obj, found.T_world_obj, vertices, np.eye(4)[None])


@pytest.mark.parametrize(("instance", "seed"), [(0, 0), (1, 1)])
def test_an_object_comes_back_from_10_mm_and_8_deg(
    snapper: Snapper, instance: int, seed: int
) -> None:
    placed = TRUTH[instance]
    found = snapper.snap(instance, placed.obj_id, pushed(placed, 10.0, 8.0, seed))
    assert off_mm(found, placed) < 0.2
    assert found.is_better
    assert found.moved_mm == pytest.approx(10.0, abs=0.3)
    assert found.turned_deg == pytest.approx(8.0, abs=0.3)
    assert found.checks["agree"] > 0.95 > found.checks_before["agree"]
    assert "moved 10" in found.words and "% before" in found.words
    assert found.covariance is not None
    assert np.all(np.linalg.eigvalsh(found.covariance) > 0)


def test_what_is_in_its_place_stays_there(snapper: Snapper) -> None:
    placed = TRUTH[0]
    found = snapper.snap(0, placed.obj_id, placed.T_world_obj)
    assert off_mm(found, placed) < 0.2
    assert found.is_better and "in its place" in found.words


def test_where_nothing_was_measured_the_object_is_left_where_it_is(snapper: Snapper) -> None:
    T = se3.from_translation([0.0, 0.0, 0.6])
    found = snapper.snap(0, TRUTH[0].obj_id, T)
    np.testing.assert_array_equal(found.T_world_obj, T)
    assert not found.is_better
    assert found.covariance is None
    assert "says nothing" in found.words


def test_what_belongs_to_a_neighbour_does_not_draw_an_object_to_it(snapper: Snapper) -> None:
    """The wedge claimed where the mug stands: the mug's points are the mug's."""
    found = snapper.snap(1, TRUTH[1].obj_id, TRUTH[0].T_world_obj)
    assert not found.is_better
    assert "other objects" in found.words or "worse" in found.words or "ran off" in found.words


def test_a_symmetric_object_keeps_the_turn_it_was_given(tmp_path: Path) -> None:
    """Nothing tells how a tube is turned about its axis."""
    T = se3.from_translation([0.0, 0.0, -TUBE.mesh.bounds[0, 2]])
    placed = ObjectPose(obj_id=TUBE.obj_id, instance=0, T_world_obj=T)
    table = PlacedMesh(-1, square(0.5), np.eye(4))
    renderer = LabelRenderer([PlacedMesh(0, TUBE.mesh, T), table])
    stored = add_drawn(begun(tmp_path / "tube", CAMERA), renderer, true_cameras(3))
    scene = Scene(name="tube", objects=(placed,), plane=SCENE.plane)
    spun = pushed(placed, 5.0, 0.0) @ se3.exp(np.array([0, 0, 0.7, 0, 0, 0]))
    found = Snapper(stored, scene, {TUBE.obj_id: TUBE}).snap(0, TUBE.obj_id, spun)
    axis = found.T_world_obj[:3, 2]
    assert np.degrees(np.arccos(min(1.0, axis @ placed.T_world_obj[:3, 2]))) < 0.3
    turned = placed.T_world_obj[:3, :3].T @ found.T_world_obj[:3, :3]
    assert np.arctan2(turned[1, 0], turned[0, 0]) == pytest.approx(0.7, abs=0.02)
    assert found.moved_mm == pytest.approx(5.0, abs=0.3)


def test_two_views_are_enough_for_a_snap(store: SessionStore) -> None:
    few = Snapper(store, SCENE, MODELS, excluded_views=[0, 2, 3, 4, 6, 7])
    found = few.snap(1, TRUTH[1].obj_id, pushed(TRUTH[1], 8.0, 6.0))
    assert found.is_better
    assert off_mm(found, TRUTH[1]) < 1.0


def test_excluded_views_are_not_looked_at(store: SessionStore) -> None:
    assert usable_views(store) == list(range(8))
    assert usable_views(store, [1, 5]) == [0, 2, 3, 4, 6, 7]
    blind = Snapper(store, SCENE, MODELS, excluded_views=range(8))
    refused("but for excluded ones", blind.snap, 0, TRUTH[0].obj_id, np.eye(4))


def test_the_bias_is_the_calibration_s_followed_by_the_registration_s(tmp_path: Path) -> None:
    store = table_session(tmp_path / "s", views=1)
    assert depth_bias_of(store).is_none
    first = DepthBias(scale=1.01, offset_per_m=-0.01)
    then = DepthBias(scale=0.99, offset_per_m=0.02)
    asked = {"depth_bias_taken_out": {"scale": first.scale, "offset_per_m": first.offset_per_m}}
    found = {"depth_scale": then.scale, "depth_offset_per_m": then.offset_per_m}
    store.write_json("registration/report.json", {"asked": asked, "refinement": found})
    z = np.linspace(0.2, 1.5, 9)
    wanted = then.corrected(first.corrected(z))
    np.testing.assert_allclose(depth_bias_of(store).corrected(z), wanted)
    asked = {"depth_bias_taken_out": {"scale": "x"}}
    store.write_json("registration/report.json", {"asked": asked})
    refused("bias", depth_bias_of, store)


# --- Distances of measured points from the models: zero on them, signed, the same after a detour.

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
