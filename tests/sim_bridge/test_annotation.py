"""Annotation of a small synthetic session: files, laws across them, and resuming."""

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock, call

import numpy as np
import pytest

from begun_sessions import begun
from file_trees import annotation_of
from realsim import CameraIntrinsics, GraspSet, Scene, View
from realsim.formats.bop import scene as bop
from realsim.geometry import se3
from realsim.records.grasps import joined_measure
from realsim.rendering.labels import LabelRenderer, PlacedMesh
from realsim.store import SessionStore
from realsim_sim_bridge.annotation.annotate import AnnotationConfig, annotate
from realsim_sim_bridge.annotation.inputs import table_slab
from refusals import refused
from synthetic_scenes import MODELS, TABLE, rejected, two_boxes
from tried_grasps import plain_grasps

INTRINSICS = CameraIntrinsics(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5)
TALL, FLAT = two_boxes().objects
# The tall box stands between the first camera and the flat one.
SCENE = replace(
    two_boxes(), objects=(TALL, replace(FLAT, verdict="doubtful", reasons=("one view only",)))
)
CAMERAS = {
    0: se3.look_at([0.1, 0.0, 0.35], [0.5, 0.0, 0.12]),
    2: se3.look_at([0.5, 0.05, 0.6], [0.5, 0.0, 0.12]),
    5: se3.look_at([0.75, 0.3, 0.35], [0.5, 0.0, 0.12]),
}


def grasp_set(instance: int, obj_id: int, n: int = 6) -> GraspSet:
    rng = np.random.default_rng(instance)
    Ts = se3.from_rt(np.diag([1.0, -1.0, -1.0]), rng.normal(scale=0.01, size=(n, 3)))
    return plain_grasps(
        Ts, obj_id=obj_id, instance=instance, scores=np.append(rng.uniform(size=n - 1), np.nan),
        base_scores=np.zeros(n), reachable=rng.uniform(size=n) < 0.5,
    )  # fmt: skip


GRASPS = [
    grasp_set(0, 1),
    replace(grasp_set(3, 7), measures={"p_hold": np.linspace(0, 1, 6), "safety": np.ones((6, 4))}),
]


def make_session(folder: Path) -> SessionStore:
    """Return a session of three views."""
    store = begun(folder, INTRINSICS)
    placed = [PlacedMesh(o.instance, MODELS[o.obj_id].mesh, o.T_world_obj) for o in SCENE.objects]
    placed.append(PlacedMesh(-1, table_slab(AnnotationConfig(plane_clearance_m=0.0)), TABLE))
    renderer = LabelRenderer(placed)
    for index, T in CAMERAS.items():
        labels = renderer.render(INTRINSICS, T)
        grey = np.where(labels.ids >= 0, 90 + 30 * labels.ids, 200).astype(np.uint8)
        depth = labels.depth_m.copy()
        depth[:, :4] = 0.0  # a stereo camera's blind border
        store.add_view(View(index=index, T_world_cam=T), np.stack([grey] * 3, -1), depth)
    return store


@pytest.fixture(scope="module")
def annotated(tmp_path_factory: pytest.TempPathFactory) -> SessionStore:
    store = make_session(tmp_path_factory.mktemp("s") / "boxes")
    summary = annotate(store, SCENE, MODELS, GRASPS)
    assert (summary.views, summary.skipped, summary.objects) == (3, 0, (0, 3))
    assert summary.doubtful == (3,) and summary.left_out == () and summary.grasps == 12
    assert all(a > 0.99 for a in summary.agreement.values())
    assert "3 views annotated" in str(summary)
    return store


def test_the_bop_reader_gives_back_the_poses(annotated: SessionStore) -> None:
    scene = bop.read_scene(bop.find_scenes(annotated.folder)[0])
    for index, T_world_cam in CAMERAS.items():
        found = scene.ground_truth[index]
        assert [a.obj_id for a in found] == [1, 7]
        for a, placed in zip(found, SCENE.objects, strict=True):
            np.testing.assert_allclose(T_world_cam @ a.T_cam_obj, placed.T_world_obj, atol=1e-9)


def test_grasps_of_a_view_are_the_objects_grasps_in_its_camera(annotated: SessionStore) -> None:
    seen: list[int] = []
    for index, T_world_cam in CAMERAS.items():
        with np.load(annotated.path(f"grasps/views/{index:06d}.npz")) as data:
            got = dict(data)
        expected = [
            se3.invert(T_world_cam) @ SCENE.object(g.instance).T_world_obj @ g.Ts_obj_grasp
            for g in GRASPS
        ]
        np.testing.assert_allclose(got["Ts_cam_grasp"], np.concatenate(expected), atol=1e-12)
        np.testing.assert_array_equal(got["instance"], [0] * 6 + [3] * 6)
        np.testing.assert_array_equal(got["scores"], np.concatenate([g.scores for g in GRASPS]))
        for name in ("p_hold", "safety"):
            np.testing.assert_array_equal(got[name], joined_measure(GRASPS, name))
        np.testing.assert_array_equal(got["reachable"], [r for g in GRASPS for r in g.reachable])
        np.testing.assert_array_equal(got["visibility"], got["contact_seen"].sum(1))
        seen += got["visibility"].tolist()
    assert {0, 2} <= set(seen)


def test_again_is_skipped_and_changes_nothing(annotated: SessionStore) -> None:
    before = annotation_of(annotated.folder)
    progress = Mock()
    assert annotate(annotated, SCENE, MODELS, GRASPS, progress=progress).skipped == 3
    assert progress.mock_calls == [call(3, 3)]
    assert annotation_of(annotated.folder) == before


def moved(scene: Scene) -> Scene:
    first, *others = scene.objects
    T = first.T_world_obj @ se3.from_translation([0.0, 0.02, 0.0])
    return replace(scene, objects=(replace(first, T_world_obj=T), *others))


def test_changed_inputs_are_done_again(tmp_path: Path) -> None:
    store = make_session(tmp_path / "s")
    annotate(store, SCENE, MODELS, GRASPS)
    assert annotate(store, moved(SCENE), MODELS, GRASPS).skipped == 0
    assert annotate(store, moved(SCENE), MODELS, GRASPS[:1]).skipped == 0
    one_camera = CAMERAS[2] @ se3.from_translation([0.001, 0, 0])
    store.set_cameras(INTRINSICS, {2: one_camera})
    assert annotate(store, moved(SCENE), MODELS, GRASPS[:1]).skipped == 2


def test_going_back_after_a_kill_leaves_no_foreign_masks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = make_session(tmp_path / "s")
    annotate(store, SCENE, MODELS, GRASPS)
    before = annotation_of(store.folder)

    write_bytes = SessionStore.write_bytes

    def killed(self: SessionStore, path: str, data: bytes) -> None:
        if path == "annotations/000000.json":
            raise KeyboardInterrupt
        write_bytes(self, path, data)

    with monkeypatch.context() as patch:
        patch.setattr(SessionStore, "write_bytes", killed)
        with pytest.raises(KeyboardInterrupt):
            annotate(store, moved(SCENE), MODELS, GRASPS)
    assert annotation_of(store.folder) != before
    assert annotate(store, SCENE, MODELS, GRASPS).skipped == 2
    assert annotation_of(store.folder) == before


def test_a_rejected_object_leaves_and_takes_its_masks_along(tmp_path: Path) -> None:
    store = make_session(tmp_path / "s")
    annotate(store, SCENE, MODELS, GRASPS)
    only = rejected(SCENE, 3)
    summary = annotate(store, only, MODELS, GRASPS)
    assert summary.left_out == (3,) and summary.grasps == 6
    assert "instance 3 is rejected, so nothing hides behind it" in summary.notes[0]
    names = sorted(p.name for p in (store.folder / "mask").iterdir())
    assert names == [f"{i:06d}_000000.png" for i in CAMERAS]
    assert all(len(rows) == 1 for rows in store.read_json("scene_gt.json").values())
    with np.load(store.path("grasps/views/000000.npz")) as data:
        assert set(data["instance"].tolist()) == {0}
    assert all(c["name"] != "flat" for c in store.read_json("scene_gt_coco.json")["categories"])


def test_without_cameras_it_says_calibrate_first(tmp_path: Path) -> None:
    store = begun(tmp_path / "s", INTRINSICS)
    store.add_view(View(index=4), np.zeros((120, 160, 3), np.uint8))
    refused(r"view 4.*calibrate first", annotate, store, SCENE, MODELS, GRASPS)
    assert not store.has("scene_gt.json")


def test_missing_models_and_foreign_grasps_are_named(annotated: SessionStore) -> None:
    refused(r"\[7\].*tall \(1\)", annotate, annotated, SCENE, {1: MODELS[1]}, GRASPS)
    refused("instance 0 are of object 7", annotate, annotated, SCENE, MODELS, [grasp_set(0, 7)])
    refused("instance 9", annotate, annotated, SCENE, MODELS, [grasp_set(9, 7)])
