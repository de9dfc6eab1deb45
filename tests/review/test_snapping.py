"""Snapping one object to the depth: it comes back from a push, and says when it cannot."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from begun_sessions import add_drawn, begun
from plain_meshes import box
from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.metrics import mssd
from realsim.geometry.parts import part
from realsim.records import ObjectPose, Scene, SupportPlane
from realsim.records.depth_bias import DepthBias
from realsim.rendering.labels import LabelRenderer, PlacedMesh
from realsim.review.placing.measured_views import depth_bias_of, usable_views
from realsim.review.placing.placing import middle_of
from realsim.review.placing.snapping import Snapped, Snapper
from realsim.store import SessionStore
from registered_sessions import CAMERA, models_of, table_session, true_cameras, true_poses

MODELS = models_of()
TUBE = part("tube")
TRUTH = {o.instance: o for o in true_poses()}
SCENE = Scene(
    name="two objects",
    objects=tuple(replace(o, verdict="accepted") for o in TRUTH.values()),
    plane=SupportPlane(T_world_table=np.eye(4)),
)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> SessionStore:
    return table_session(tmp_path_factory.mktemp("snap") / "s", views=8, sigma=(0.0, 0.0))


@pytest.fixture(scope="module")
def snapper(store: SessionStore) -> Iterator[Snapper]:
    yield Snapper(store, SCENE, MODELS)


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
    stored, placed = tube_session(tmp_path / "tube")
    scene = Scene(name="tube", objects=(placed,), plane=SCENE.plane)
    spun = pushed(placed, 5.0, 0.0) @ se3.exp(np.array([0, 0, 0.7, 0, 0, 0]))
    found = Snapper(stored, scene, {TUBE.obj_id: TUBE}).snap(0, TUBE.obj_id, spun)
    axis = found.T_world_obj[:3, 2]
    assert np.degrees(np.arccos(min(1.0, axis @ placed.T_world_obj[:3, 2]))) < 0.3
    turned = placed.T_world_obj[:3, :3].T @ found.T_world_obj[:3, :3]
    assert np.arctan2(turned[1, 0], turned[0, 0]) == pytest.approx(0.7, abs=0.02)
    assert found.moved_mm == pytest.approx(5.0, abs=0.3)


def tube_session(folder: Path) -> tuple[SessionStore, ObjectPose]:
    """Return a session of one tube on a table, and where it stands."""
    T = se3.from_translation([0.0, 0.0, -TUBE.mesh.bounds[0, 2]])
    table = PlacedMesh(-1, box((1.0, 1.0, 0.02)), se3.from_translation([0.0, 0.0, -0.01]))
    renderer = LabelRenderer([PlacedMesh(0, TUBE.mesh, T), table])
    store = add_drawn(begun(folder, CAMERA), renderer, true_cameras(3))
    return store, ObjectPose(obj_id=TUBE.obj_id, instance=0, T_world_obj=T)


def test_two_views_are_enough_for_a_snap(store: SessionStore) -> None:
    few = Snapper(store, SCENE, MODELS, excluded_views=[0, 2, 3, 4, 6, 7])
    found = few.snap(1, TRUTH[1].obj_id, pushed(TRUTH[1], 8.0, 6.0))
    assert found.is_better
    assert off_mm(found, TRUTH[1]) < 1.0


def test_excluded_views_are_not_looked_at(store: SessionStore) -> None:
    assert usable_views(store) == list(range(8))
    assert usable_views(store, [1, 5]) == [0, 2, 3, 4, 6, 7]
    with pytest.raises(InputError, match="but for excluded ones"):
        Snapper(store, SCENE, MODELS, excluded_views=range(8)).snap(0, TRUTH[0].obj_id, np.eye(4))


def test_the_bias_is_the_calibration_s_followed_by_the_registration_s(tmp_path: Path) -> None:
    store = table_session(tmp_path / "s", views=1)
    assert depth_bias_of(store).is_none
    first, then = (
        DepthBias(scale=1.01, offset_per_m=-0.01),
        DepthBias(scale=0.99, offset_per_m=0.02),
    )
    report = {
        "asked": {
            "depth_bias_taken_out": {"scale": first.scale, "offset_per_m": first.offset_per_m}
        },
        "refinement": {"depth_scale": then.scale, "depth_offset_per_m": then.offset_per_m},
    }
    store.write_json("registration/report.json", report)
    z = np.linspace(0.2, 1.5, 9)
    np.testing.assert_allclose(
        depth_bias_of(store).corrected(z), then.corrected(first.corrected(z))
    )
    store.write_json(
        "registration/report.json", {"asked": {"depth_bias_taken_out": {"scale": "x"}}}
    )
    with pytest.raises(InputError, match="bias"):
        depth_bias_of(store)
