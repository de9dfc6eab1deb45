"""Annotation of a small synthetic session: what its files hold, laws across them, and resuming."""

from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock, call

import cv2
import numpy as np
import pytest

from begun_sessions import begun
from file_trees import annotation_of
from plain_meshes import box
from realsim import CameraIntrinsics, GraspSet, Mesh, ObjectModel, Scene, View, images
from realsim.arrays import Mask, UInt16
from realsim.formats import label_maps
from realsim.formats.bop import scene as bop
from realsim.formats.bop.labels import mask_of, rle_area_and_bbox
from realsim.geometry import camera, se3
from realsim.records.grasps import joined_measure
from realsim.rendering.labels import LabelRenderer, PlacedMesh
from realsim.store import SessionStore
from realsim_sim_bridge.annotation.annotate import AnnotationConfig, annotate
from realsim_sim_bridge.annotation.config import maps_of
from realsim_sim_bridge.annotation.inputs import table_slab
from refusals import refused
from synthetic_scenes import MODELS as CENTRED
from synthetic_scenes import TABLE, rejected, two_boxes
from tried_grasps import plain_grasps

LENS = np.array([-0.12, 0.03, 0.001, -0.002, 0.0])
CAMERA = CameraIntrinsics(
    width=160, height=120, fx=150.0, fy=152.0, cx=79.0, cy=60.5, distortion=LENS
)
ALL = AnnotationConfig(plane_clearance_m=0.0, maps=("instance", "depth", "coordinates", "normals"))


def off_centre(mesh: Mesh) -> Mesh:
    """Return a mesh beside its own origin, so that its box is not the same about it."""
    return replace(mesh, vertices=mesh.vertices + 0.01)


MODELS = {i: replace(m, mesh=off_centre(m.mesh)) for i, m in CENTRED.items()}
TALL, FLAT = (
    replace(o, T_world_obj=o.T_world_obj @ se3.from_translation([-0.01] * 3))
    for o in two_boxes().objects
)
# The tall box stands between the first camera and the flat one.
SCENE = replace(
    two_boxes(), objects=(TALL, replace(FLAT, verdict="doubtful", reasons=("one view only",)))
)
CAMERAS = {
    0: se3.look_at([0.1, 0.0, 0.35], [0.5, 0.0, 0.12]),
    2: se3.look_at([0.5, 0.05, 0.6], [0.5, 0.0, 0.12]),
    5: se3.look_at([0.75, 0.3, 0.35], [0.5, 0.0, 0.12]),
    7: se3.look_at([0.6, 0.0, 0.35], [0.67, 0.03, 0.1]),  # objects leave the picture
    9: se3.look_at([0.8, 0.0, 0.4], [2.5, 0.0, 0.1]),  # no object at all
}
EXACT = (7, 9)
"""Views of a camera that is not blind anywhere."""


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
    store = begun(folder, CAMERA)
    placed = [PlacedMesh(o.instance, MODELS[o.obj_id].mesh, o.T_world_obj) for o in SCENE.objects]
    renderer = LabelRenderer([*placed, PlacedMesh(-1, table_slab(ALL), TABLE)])
    for index, T in CAMERAS.items():
        labels = renderer.render(CAMERA, T)
        grey = np.where(labels.ids >= 0, 90 + 30 * labels.ids, 200).astype(np.uint8)
        depth = labels.depth_m.copy()
        if index not in EXACT:
            depth[:, :4] = 0.0  # a stereo camera's blind border
        store.add_view(View(index=index, T_world_cam=T), np.stack([grey] * 3, -1), depth)
    return store


@pytest.fixture
def store(tmp_path: Path) -> SessionStore:
    """A session of its own, annotated as it is without a config."""
    store = make_session(tmp_path / "s")
    summary = annotate(store, SCENE, MODELS, GRASPS)
    assert all(a > 0.99 for a in summary.agreement.values())
    return store


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> SessionStore:
    store = make_session(tmp_path_factory.mktemp("s") / "boxes")
    summary = annotate(store, SCENE, MODELS, GRASPS, ALL)
    assert (summary.views, summary.skipped, summary.objects) == (5, 0, (0, 3))
    assert summary.doubtful == (3,) and summary.left_out == () and summary.grasps == 12
    assert all(a > 0.99 for a in summary.agreement.values())
    assert summary.empty_views == (9,) and summary.flagged_views == ()
    assert any("1 view shows no object: 9." in note for note in summary.notes)
    assert "5 views annotated" in str(summary) and "1 without any object" in str(summary)
    return store


def written(store: SessionStore) -> dict[str, bytes]:
    """Return what was written but for the file that carries the date of the session."""
    return {k: v for k, v in annotation_of(store.folder).items() if "coco" not in k}


def deep_rgb(store: SessionStore, name: str, view: int) -> UInt16:
    path = store.path(f"labels/{name}/{view:06d}.png")
    return np.ascontiguousarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1])


def part(store: SessionStore, view: int) -> dict[str, Any]:
    return store.read_json(f"annotations/{view:06d}.json")


def mask(store: SessionStore, folder: str, view: int, k: int) -> Mask:
    return images.read_grey(store.path(f"{folder}/{view:06d}_{k:06d}.png")) > 0


@pytest.mark.parametrize("view", [0, 7])
def test_the_instance_map_is_the_visible_masks(done: SessionStore, view: int) -> None:
    ids = label_maps.instances_of(done.read_image(f"labels/instance/{view:06d}.png"))
    for k, o in enumerate(SCENE.objects):
        np.testing.assert_array_equal(ids == o.instance, mask(done, "mask_visib", view, k))


@pytest.mark.parametrize("view", EXACT)
def test_the_clean_depth_is_what_an_exact_camera_stored(done: SessionStore, view: int) -> None:
    clean = done.read_image(f"labels/depth/{view:06d}.png")
    np.testing.assert_array_equal(clean, done.read_image(f"depth/{view:06d}.png"))


@pytest.mark.parametrize("view", [0, 7])
def test_object_coordinates_project_to_their_own_pixels(done: SessionStore, view: int) -> None:
    counts = deep_rgb(done, "coordinates", view)
    boxes = {
        e["instance"]: e["box_obj_m"] for e in done.read_json("annotations/objects.json")["objects"]
    }
    for k, e in enumerate(part(done, view)["objects"]):
        seen = mask(done, "mask_visib", view, k)
        low, high = (np.array(boxes[e["instance"]][end]) for end in ("low", "high"))
        points = low + counts[seen] * ((high - low) / 65535)
        uv = camera.project(CAMERA, se3.transform(np.array(e["T_cam_obj"]), points))
        rows, columns = np.nonzero(seen)
        np.testing.assert_allclose(uv, np.stack([columns, rows], -1), atol=0.02)
    nothing = done.read_image(f"labels/instance/{view:06d}.png") == 0
    assert not counts[nothing].any()


def test_bop_files_masks_and_annotations_say_the_same(done: SessionStore) -> None:
    info, coco = done.read_json("scene_gt_info.json"), done.read_json("scene_gt_coco.json")
    found = {(a["image_id"], a["category_id"]): a for a in coco["annotations"]}
    for view in CAMERAS:
        for k, e in enumerate(part(done, view)["objects"]):
            visible, whole = mask(done, "mask_visib", view, k), mask(done, "mask", view, k)
            assert not np.any(visible & ~whole)
            row = info[str(view)][k]
            assert all(row[name] == e[name] for name in row)
            assert row["px_count_visib"] == visible.sum() and row["px_count_all"] >= whole.sum()
            np.testing.assert_array_equal(mask_of(e["mask_visib_rle"]), visible)
            a = found.get((view, e["obj_id"]))
            assert (a is None) == (not visible.any())
            if a is not None:
                assert (a["area"], tuple(a["bbox"])) == rle_area_and_bbox(e["mask_visib_rle"])
                x, y, w, h = row["bbox_visib"]
                assert a["bbox"] == [x, y, w + 1, h + 1]


def test_camera_corners_and_surface_are_told(done: SessionStore) -> None:
    p = part(done, 0)
    assert p["camera"]["fx"] == CAMERA.fx and p["px_without_ray"] == 0 and p["camera_inside"] == []
    for e in p["objects"]:
        corners = np.array(e["corners_px"])
        vertices = se3.transform(np.array(e["T_cam_obj"]), MODELS[e["obj_id"]].mesh.vertices)
        np.testing.assert_allclose(corners, camera.project(CAMERA, vertices), atol=1e-3)
    for entry in done.read_json("annotations/objects.json")["objects"]:
        low, high = np.array(entry["box_obj_m"]["low"]), np.array(entry["box_obj_m"]["high"])
        with np.load(done.path(entry["surface"])) as cloud:
            points, normals = cloud["points"], cloud["normals"]
        assert points.shape == normals.shape == (4096, 3)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
        outwards = np.sum(normals * (points - (low + high) / 2), axis=1)
        assert np.all(outwards > 0)  # a box is seen from outside everywhere
        on_face = np.isclose(points, low, atol=1e-6) | np.isclose(points, high, atol=1e-6)
        assert on_face.any(axis=1).all()


@pytest.mark.slow
def test_two_processes_write_the_same_bytes_as_one(done: SessionStore, tmp_path: Path) -> None:
    store = make_session(tmp_path / "s")
    ticks: list[tuple[int, int]] = []
    how: dict[str, Any] = {"workers": 2, "progress": lambda *done: ticks.append(done)}
    annotate(store, SCENE, MODELS, GRASPS, ALL, **how)
    assert written(store) == written(done)
    assert ticks == [(k, 5) for k in range(6)]
    assert annotate(store, SCENE, MODELS, GRASPS, ALL, workers=2).skipped == 5
    assert store.verify() == []


def test_maps_that_are_no_longer_wanted_go(tmp_path: Path) -> None:
    store = make_session(tmp_path / "s")
    annotate(store, SCENE, MODELS, [], ALL)
    summary = annotate(store, SCENE, MODELS, [], replace(ALL, maps=maps_of("depth")))
    assert summary.skipped == 0
    assert {p.parent.name for p in store.folder.glob("labels/*/*.png")} == {"depth"}
    assert maps_of("all") == ALL.maps and maps_of("none") == ()
    assert maps_of("normals, instance") == ("instance", "normals")
    refused("no map 'colour'", maps_of, "instance,colour")


def test_an_image_of_another_size_is_named_with_both_sizes(tmp_path: Path) -> None:
    store = make_session(tmp_path / "s")
    store.set_cameras(replace(CAMERA, width=320, height=240), {})
    refused(r"rgb/000000\.png is 160x120.*320x240", annotate, store, SCENE, MODELS, [])
    assert not store.has("scene_gt.json")


def test_a_camera_inside_an_object_and_pixels_without_a_ray_are_told(tmp_path: Path) -> None:
    folded = replace(CAMERA, distortion=np.array([-0.9, 0.1, 0.0, 0.0, 0.0]))
    store = begun(tmp_path / "s", folded)
    big = ObjectModel(obj_id=1, name="crate", mesh=off_centre(box((0.4, 0.4, 0.4))))
    scene = replace(SCENE, objects=(TALL,), plane=None)
    T = TALL.T_world_obj @ se3.from_translation([0.05, 0.05, 0.05])
    store.add_view(View(index=7, T_world_cam=T), np.zeros((120, 160, 3), np.uint8))
    summary = annotate(store, scene, {1: big}, [])
    assert summary.flagged_views == (7,)
    assert "view 7: the camera stands inside crate" in summary.notes[0]
    said = part(store, 7)
    assert said["camera_inside"] == [0] and said["px_without_ray"] > 0
    assert any("cannot be inverted" in note for note in summary.notes)


# --- poses, grasps, resuming ----------------------------------------------------------------------


def test_the_bop_reader_gives_back_the_poses(done: SessionStore) -> None:
    scene = bop.read_scene(bop.find_scenes(done.folder)[0])
    for index, T_world_cam in CAMERAS.items():
        found = scene.ground_truth[index]
        assert [a.obj_id for a in found] == [1, 7]
        for a, placed in zip(found, SCENE.objects, strict=True):
            np.testing.assert_allclose(T_world_cam @ a.T_cam_obj, placed.T_world_obj, atol=1e-9)


def test_grasps_of_a_view_are_the_objects_grasps_in_its_camera(done: SessionStore) -> None:
    seen: list[int] = []
    for index, T_world_cam in CAMERAS.items():
        with np.load(done.path(f"grasps/views/{index:06d}.npz")) as data:
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


def test_again_is_skipped_and_changes_nothing(done: SessionStore) -> None:
    before = annotation_of(done.folder)
    progress = Mock()
    assert annotate(done, SCENE, MODELS, GRASPS, ALL, progress=progress).skipped == 5
    assert progress.mock_calls == [call(5, 5)]
    assert annotation_of(done.folder) == before


def moved(scene: Scene) -> Scene:
    first, *others = scene.objects
    T = first.T_world_obj @ se3.from_translation([0.0, 0.02, 0.0])
    return replace(scene, objects=(replace(first, T_world_obj=T), *others))


def test_changed_inputs_are_done_again(store: SessionStore) -> None:
    assert annotate(store, moved(SCENE), MODELS, GRASPS).skipped == 0
    assert annotate(store, moved(SCENE), MODELS, GRASPS[:1]).skipped == 0
    one_camera = CAMERAS[2] @ se3.from_translation([0.001, 0, 0])
    store.set_cameras(CAMERA, {2: one_camera})
    assert annotate(store, moved(SCENE), MODELS, GRASPS[:1]).skipped == 4


def test_going_back_after_a_kill_leaves_no_foreign_masks(
    store: SessionStore, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    assert annotate(store, SCENE, MODELS, GRASPS).skipped == 4
    assert annotation_of(store.folder) == before


def test_a_rejected_object_leaves_and_takes_its_masks_along(store: SessionStore) -> None:
    summary = annotate(store, rejected(SCENE, 3), MODELS, GRASPS)
    assert summary.left_out == (3,) and summary.grasps == 6
    assert "instance 3 is rejected, so nothing hides behind it" in summary.notes[0]
    names = sorted(p.name for p in (store.folder / "mask").iterdir())
    assert names == [f"{i:06d}_000000.png" for i in CAMERAS]
    assert all(len(rows) == 1 for rows in store.read_json("scene_gt.json").values())
    with np.load(store.path("grasps/views/000000.npz")) as data:
        assert set(data["instance"].tolist()) == {0}
    assert all(c["name"] != "flat" for c in store.read_json("scene_gt_coco.json")["categories"])


def test_without_cameras_it_says_calibrate_first(tmp_path: Path) -> None:
    store = begun(tmp_path / "s", CAMERA)
    store.add_view(View(index=4), np.zeros((120, 160, 3), np.uint8))
    refused(r"view 4.*calibrate first", annotate, store, SCENE, MODELS, GRASPS)
    assert not store.has("scene_gt.json")


def test_missing_models_and_foreign_grasps_are_named(done: SessionStore) -> None:
    refused(r"\[7\].*tall \(1\)", annotate, done, SCENE, {1: MODELS[1]}, GRASPS)
    refused("instance 0 are of object 7", annotate, done, SCENE, MODELS, [grasp_set(0, 7)])
    refused("instance 9", annotate, done, SCENE, MODELS, [grasp_set(9, 7)])
