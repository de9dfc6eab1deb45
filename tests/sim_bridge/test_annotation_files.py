"""What an annotated session holds: maps, clouds, boxes, BOP files; the same from any process."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from begun_sessions import add_drawn, begun
from file_trees import annotation_of
from realsim import (
    CameraIntrinsics,
    Mesh,
    ObjectModel,
    ObjectPose,
    Scene,
    SupportPlane,
    View,
    images,
)
from realsim.arrays import Mask, UInt16
from realsim.formats import label_maps
from realsim.formats.bop.labels import mask_of, rle_area_and_bbox
from realsim.geometry import camera, se3
from realsim.geometry.mesh import box_mesh
from realsim.rendering.labels import LabelRenderer, PlacedMesh
from realsim.store import SessionStore
from realsim_sim_bridge.annotation.annotate import AnnotationConfig, annotate
from realsim_sim_bridge.annotation.config import maps_of
from realsim_sim_bridge.annotation.inputs import table_slab
from refusals import refused

LENS = np.array([-0.12, 0.03, 0.001, -0.002, 0.0])
CAMERA = CameraIntrinsics(
    width=160, height=120, fx=150.0, fy=152.0, cx=79.0, cy=60.5, distortion=LENS
)
ALL = AnnotationConfig(plane_clearance_m=0.0, maps=("instance", "depth", "coordinates", "normals"))


def box(size: tuple[float, float, float]) -> Mesh:
    half = np.array(size) / 2
    return box_mesh(0.01 - half, 0.01 + half)


MODELS = {
    i: ObjectModel(obj_id=i, name=f"box {i}", mesh=box((0.05, 0.07, 0.02 * i))) for i in (2, 4)
}
SCENE = Scene(
    name="boxes",
    objects=tuple(
        ObjectPose(
            obj_id=i, instance=k, verdict="accepted",
            T_world_obj=se3.from_rt(se3.exp_so3([0, 0, 0.4 * i]), [0.05 * (2 * k - 1), 0.0, 0.03]),
        )
        for k, i in enumerate((2, 4))
    ),
    plane=SupportPlane(T_world_table=np.eye(4)),
)  # fmt: skip
CAMERAS = [
    se3.look_at([0.2, 0.1, 0.4], [0, 0, 0]),
    se3.look_at([-0.1, 0.3, 0.2], [0, 0, 0]),
    se3.look_at([0.1, 0.0, 0.25], [0.17, 0.03, 0]),  # objects leave the picture
    se3.look_at([0.3, 0.0, 0.3], [2.0, 0.0, 0.0]),  # no object at all
]


def make_session(folder: Path, size: tuple[int, int] | None = None) -> SessionStore:
    store = begun(folder, CAMERA)
    placed = [PlacedMesh(o.instance, MODELS[o.obj_id].mesh, o.T_world_obj) for o in SCENE.objects]
    renderer = LabelRenderer([*placed, PlacedMesh(-1, table_slab(ALL), np.eye(4))])
    add_drawn(store, renderer, CAMERAS)
    if size is not None:
        store.set_cameras(replace(CAMERA, width=size[0], height=size[1]), {})
    return store


def written(store: SessionStore) -> dict[str, bytes]:
    """Return what was written but for the file that carries the date of the session."""
    return {k: v for k, v in annotation_of(store.folder).items() if "coco" not in k}


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> SessionStore:
    store = make_session(tmp_path_factory.mktemp("s") / "boxes")
    summary = annotate(store, SCENE, MODELS, [], ALL)
    assert summary.empty_views == (3,) and summary.flagged_views == ()
    assert any("1 view shows no object: 3." in note for note in summary.notes)
    assert "1 without any object" in str(summary)
    return store


def deep_rgb(store: SessionStore, name: str, view: int) -> UInt16:
    path = store.path(f"labels/{name}/{view:06d}.png")
    return np.ascontiguousarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1])


def part(store: SessionStore, view: int) -> dict[str, Any]:
    return store.read_json(f"annotations/{view:06d}.json")


def mask(store: SessionStore, folder: str, view: int, k: int) -> Mask:
    return images.read_grey(store.path(f"{folder}/{view:06d}_{k:06d}.png")) > 0


@pytest.mark.parametrize("view", [0, 2])
def test_the_instance_map_is_the_visible_masks(done: SessionStore, view: int) -> None:
    ids = label_maps.instances_of(done.read_image(f"labels/instance/{view:06d}.png"))
    for k, o in enumerate(SCENE.objects):
        np.testing.assert_array_equal(ids == o.instance, mask(done, "mask_visib", view, k))


@pytest.mark.parametrize("view", [0, 3])
def test_the_clean_depth_is_what_an_exact_camera_stored(done: SessionStore, view: int) -> None:
    clean = done.read_image(f"labels/depth/{view:06d}.png")
    np.testing.assert_array_equal(clean, done.read_image(f"depth/{view:06d}.png"))


@pytest.mark.parametrize("view", [0, 2])
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
    for view in range(len(CAMERAS)):
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
    annotate(store, SCENE, MODELS, [], ALL, workers=2, progress=lambda d, n: ticks.append((d, n)))
    assert written(store) == written(done)
    assert ticks == [(k, 4) for k in range(5)]
    assert annotate(store, SCENE, MODELS, [], ALL, workers=2).skipped == 4
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
    store = make_session(tmp_path / "s", size=(320, 240))
    refused(r"rgb/000000\.png is 160x120.*320x240", annotate, store, SCENE, MODELS, [])
    assert not store.has("scene_gt.json")


def test_a_camera_inside_an_object_and_pixels_without_a_ray_are_told(tmp_path: Path) -> None:
    folded = replace(CAMERA, distortion=np.array([-0.9, 0.1, 0.0, 0.0, 0.0]))
    store = begun(tmp_path / "s", folded)
    big = ObjectModel(obj_id=2, name="crate", mesh=box((0.4, 0.4, 0.4)))
    scene = replace(SCENE, objects=(SCENE.objects[0],), plane=None)
    T = scene.objects[0].T_world_obj @ se3.from_translation([0.05, 0.05, 0.05])
    store.add_view(View(index=7, T_world_cam=T), np.zeros((120, 160, 3), np.uint8))
    summary = annotate(store, scene, {2: big}, [])
    assert summary.flagged_views == (7,)
    assert "view 7: the camera stands inside crate" in summary.notes[0]
    said = part(store, 7)
    assert said["camera_inside"] == [0] and said["px_without_ray"] > 0
    assert any("cannot be inverted" in note for note in summary.notes)
