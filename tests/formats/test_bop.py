"""BOP scenes: what is written is read again, also as frames and maps; broken data is named."""

import json
import shutil

import numpy as np
import pytest

from begun_sessions import begun, random_views
from bop_scenes import edit
from map_formulas import normal_counts
from realsim.errors import InputError, NotRigidError, UnitError
from realsim.formats import label_maps
from realsim.formats.bop import labels as bop_labels
from realsim.formats.bop import models as bop_models
from realsim.formats.bop import scene as bop
from realsim.formats.bop.source import open_bop
from realsim.geometry import se3
from realsim.geometry.mesh import save_ply, symmetry_transforms
from realsim.records import CameraIntrinsics, Mesh, ObjectModel
from refusals import refused
from trimesh_solids import box

CAMERA = CameraIntrinsics(width=64, height=48, fx=60, fy=60, cx=32, cy=24)


def make_scene(folder, n=2):
    """Return a session with n images and the annotations that were written into it."""
    store = begun(folder, CAMERA)
    rng = np.random.default_rng(0)
    annotations = {}
    random_views(store, range(n))
    for i in range(n):
        poses = se3.random_transform(rng, 2, spread=0.05)
        poses[:, 2, 3] += 0.5
        annotations[i] = [(3, poses[0]), (5, poses[1])]
    bop_labels.write_scene_gt(store, annotations)
    return store, annotations


def read(folder):
    (ref,) = bop.find_scenes(folder)
    return bop.read_scene(ref)


# --- round trips ---------------------------------------------------------------------------------


def test_poses_and_cameras_come_back(tmp_path):
    store, annotations = make_scene(tmp_path / "test/000003")
    scene = read(tmp_path)
    assert scene.ground_truth_file == "scene_gt.json" and not scene.approximate
    for i, rows in annotations.items():
        for (obj_id, T), found in zip(rows, scene.ground_truth[i], strict=True):
            assert found.obj_id == obj_id
            np.testing.assert_allclose(found.T_cam_obj, T, atol=1e-12)
        T = store.session.view(i).T_world_cam
        np.testing.assert_allclose(scene.Ts_world_cam[i], T, atol=1e-12)
        assert np.array_equal(scene.rgb(i), store.rgb(i))
        assert np.array_equal(scene.depth_m(i), store.depth_m(i))


def test_the_file_holds_bops_units_and_row_major_lists(tmp_path):
    store, annotations = make_scene(tmp_path)
    T = annotations[1][0][1]
    entry = store.read_json("scene_gt.json")["1"][0]
    assert entry["obj_id"] == 3
    assert entry["cam_R_m2c"] == T[:3, :3].ravel().tolist()
    np.testing.assert_allclose(entry["cam_t_m2c"], 1e3 * T[:3, 3])
    camera = store.read_json("scene_camera.json")["1"]
    assert camera["cam_K"] == [60, 0, 32, 0, 60, 24, 0, 0, 1] and camera["depth_scale"] == 0.1


def test_models_come_back(tmp_path):
    texture = np.random.default_rng(0).integers(0, 256, (8, 8, 3), dtype=np.uint8)
    plain = box((0.06, 0.06, 0.06))
    uv = np.random.default_rng(1).random((8, 2))
    textured = Mesh(vertices=plain.vertices, faces=plain.faces, uv=uv, texture=texture)
    flip = se3.from_rt(np.diag([1.0, -1, -1]), [0.001, 0, 0])
    can = ObjectModel(
        obj_id=9, name="can", mesh=textured, symmetries=np.stack([np.eye(4), flip]),
        symmetry_axes=(((0.0, 0.0, 1.0), (0.002, 0.0, 0.0)),),
    )  # fmt: skip
    models = {2: ObjectModel(obj_id=2, name="die", mesh=plain, density=640.0), 9: can}
    bop_models.save_models(tmp_path, models)
    back = bop_models.load_models(tmp_path)
    assert set(back) == {2, 9} and set(bop_models.load_models(tmp_path, [9])) == {9}
    assert (back[2].name, back[2].density, back[9].name) == ("die", 640.0, "can")
    for i, model in models.items():
        np.testing.assert_allclose(back[i].mesh.vertices, model.mesh.vertices, atol=1e-8)
        ours, theirs = symmetry_transforms(model), symmetry_transforms(back[i])
        np.testing.assert_allclose(theirs, ours, atol=1e-12)
    np.testing.assert_array_equal(back[9].mesh.texture, texture)
    np.testing.assert_allclose(back[9].mesh.uv, uv, atol=1e-7)
    info = json.loads((tmp_path / "models_info.json").read_text())
    assert info["2"]["diameter"] == pytest.approx(60 * np.sqrt(3))
    assert info["2"]["size_x"] == pytest.approx(60) and info["2"]["min_x"] == pytest.approx(-30)
    assert "symmetries_discrete" not in info["2"]
    assert info["9"]["symmetries_discrete"][0][3] == pytest.approx(1.0)
    assert info["9"]["symmetries_continuous"][0]["offset"] == pytest.approx([2, 0, 0])
    # Saving what was loaded changes nothing any more.
    bop_models.save_models(tmp_path / "again", back)
    for name in ("obj_000002.ply", "obj_000009.ply", "obj_000009.png"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / name).read_bytes()


# --- labels --------------------------------------------------------------------------------------


def blobs():
    rng = np.random.default_rng(3)
    for density in (0.0, 0.02, 0.5, 1.0):
        yield rng.random((48, 64)) < density
    square = np.zeros((48, 64), bool)
    square[10:20, 5:9] = True
    yield square


def test_run_lengths_come_back_and_go_down_the_columns():
    for mask in blobs():
        rle = bop_labels.rle_of(mask)
        assert np.array_equal(bop_labels.mask_of(rle), mask)
        assert sum(rle["counts"]) == mask.size and rle["size"] == [48, 64]
        assert all(n > 0 for n in rle["counts"][1:])
    assert bop_labels.rle_of(np.array([[0, 1], [1, 1]], bool))["counts"] == [1, 3]
    assert bop_labels.rle_of(np.array([[1, 0], [1, 1]], bool))["counts"] == [0, 2, 1, 1]
    refused("add up to 5", bop_labels.mask_of, {"counts": [2, 3], "size": [2, 3]})


def test_boxes_are_bops_in_gt_info_and_cocos_in_coco():
    *_, square = blobs()
    assert bop_labels.bbox_of(square) == (5, 10, 3, 9)
    assert bop_labels.bbox_of(square, inclusive=True) == (5, 10, 4, 10)
    assert bop_labels.bbox_of(square & False) == (-1, -1, -1, -1)


def test_poses_that_cannot_be_are_not_written(tmp_path):
    store, _ = make_scene(tmp_path, 1)
    before = (tmp_path / "scene_gt.json").read_bytes()
    far = {0: [(1, se3.from_translation([0, 0, 600.0]))]}
    refused("would be 600 m away", bop_labels.write_scene_gt, store, far, error=UnitError)
    assert (tmp_path / "scene_gt.json").read_bytes() == before


# --- broken data ---------------------------------------------------------------------------------


def translated(factor):
    def change(data):
        row = data["0"][0]
        row["cam_t_m2c"] = [factor * x for x in row["cam_t_m2c"]]

    return change


def rotation(*diagonal):
    return lambda data: data["0"][0].update(cam_R_m2c=np.diag(diagonal).ravel().tolist())


BROKEN = {
    "metres": ("gt", translated(1e-3), UnitError, "looks like metres in a millimetre file"),
    "converted twice": ("gt", translated(1e3), UnitError, "Divide cam_t_m2c by"),
    "a scaled rotation": ("gt", rotation(2, 2, 2), NotRigidError, "mean scale 2"),
    "a mirrored rotation": ("gt", rotation(1, 1, -1), NotRigidError, "mirrored"),
    "no unit": ("camera", lambda d: d["0"].pop("depth_scale"), InputError, "no depth_scale"),
    "another camera": (
        "camera", lambda d: d["1"]["cam_K"].__setitem__(0, 61), InputError,
        "images 0 and 1 have different cameras",
    ),
    "another unit": (
        "camera", lambda d: d["1"].update(depth_scale=1.0), InputError, "different depth_scale",
    ),
    "half a pose": ("camera", lambda d: d["1"].pop("cam_t_w2c"), InputError, "only one of"),
}  # fmt: skip


@pytest.mark.parametrize(("name", "change", "error", "says"), BROKEN.values(), ids=BROKEN)
def test_broken_scenes_are_named(tmp_path, name, change, error, says):
    make_scene(tmp_path)
    file = f"scene_{name}.json"
    edit(tmp_path / file, change)
    assert file in refused(says, read, tmp_path, error=error)


def test_folders_without_a_scene_are_named(tmp_path):
    refused("not a folder", bop.find_scenes, tmp_path / "nowhere")
    (tmp_path / "pictures").mkdir()
    refused(r"Looked for scene_camera\.json .* has: pictures", bop.find_scenes, tmp_path)


def test_an_empty_scene_is_an_error_and_missing_images_are_listed(tmp_path):
    make_scene(tmp_path, 3)
    (tmp_path / "rgb/000001.png").unlink()
    scene = read(tmp_path)
    assert scene.missing_images == (1,) and [v.index for v in scene.session.views] == [0, 2]
    shutil.rmtree(tmp_path / "rgb")
    refused("empty scene", read, tmp_path)


def test_another_ground_truth_is_used_but_said_to_be_approximate(tmp_path):
    make_scene(tmp_path, 1)
    (tmp_path / "scene_gt.json").rename(tmp_path / "scene_gt_rough.json")
    scene = read(tmp_path)
    assert scene.approximate and scene.ground_truth_file == "scene_gt_rough.json"
    assert len(scene.ground_truth[0]) == 2
    shutil.copy(tmp_path / "scene_gt_rough.json", tmp_path / "scene_gt_other.json")
    refused(r"scene_gt_other\.json, scene_gt_rough\.json", read, tmp_path)
    for file in tmp_path.glob("scene_gt*"):
        file.unlink()
    bare = read(tmp_path)
    assert bare.ground_truth == {} and bare.ground_truth_file is None and not bare.approximate


def test_a_truncated_image_is_named(tmp_path):
    make_scene(tmp_path, 1)
    path = tmp_path / "depth/000000.png"
    path.write_bytes(path.read_bytes()[:-20])
    refused(r"depth.000000\.png is truncated", read(tmp_path).depth_m, 0)
    shutil.copy(tmp_path / "rgb/000000.png", path)
    refused("one channel of 16 bit", read(tmp_path).depth_m, 0)


def test_models_in_the_wrong_unit_are_found_out(tmp_path):
    models = {1: ObjectModel(obj_id=1, name="die", mesh=box((0.06, 0.06, 0.06)))}
    bop_models.save_models(tmp_path, models)
    edit(tmp_path / "models_info.json", lambda d: d["1"].update(diameter=0.104))
    refused(r"models_info\.json says 0\.104 mm", bop_models.load_models, tmp_path, error=UnitError)
    save_ply(tmp_path / "obj_000001.ply", box((0.06, 0.06, 0.06)), "m")
    refused("scan import FILE --unit m` makes", bop_models.load_models, tmp_path, error=UnitError)
    refused("nowhere does not exist; files obj", bop_models.load_models, tmp_path / "nowhere")


# --- BOP scenes as frame sources: cameras, counts and poses exactly as the scene has them.


LENS = CameraIntrinsics(
    width=64, height=48, fx=60.1, fy=60.2, cx=31.3, cy=24.7, distortion=np.array([0.1, -0.01])
)


def with_gaps(folder, n=4):
    """Return a session of n images whose numbers have gaps."""
    store = begun(folder, LENS)
    random_views(store, range(0, 3 * n, 3))
    return store


def test_a_scene_comes_back_as_frames(tmp_path):
    """Law: cameras to 1e-9, pixels and counts exactly, in the order of the images' numbers."""
    store = with_gaps(tmp_path / "000007")
    source = open_bop(tmp_path / "000007")
    frames = list(source.frames())
    assert [f.time_s for f in frames] == [0, 3, 6, 9] and source.depth_unit_m == 1e-4
    np.testing.assert_allclose(source.intrinsics.K, LENS.K, atol=1e-9)
    np.testing.assert_allclose(source.intrinsics.distortion, LENS.distortion, atol=1e-9)
    for frame, view in zip(frames, store.session.views, strict=True):
        np.testing.assert_allclose(frame.T_world_cam, view.T_world_cam, atol=1e-9)
        assert np.array_equal(frame.rgb, store.rgb(view.index))
        assert frame.depth_counts is not None
        metres = (frame.depth_counts * np.float64(1e-4)).astype(np.float32)
        assert np.array_equal(metres, store.depth_m(view.index))


def test_images_without_depth_are_named_and_left_out(tmp_path):
    with_gaps(tmp_path / "1")
    (tmp_path / "1/depth/000003.png").unlink()
    source = open_bop(tmp_path / "1")
    assert len(source) == 3 and any("no depth" in n and " 3." in n for n in source.notes)
    colour = open_bop(tmp_path / "1", use_depth=False)
    assert len(colour) == 4 and colour.depth_unit_m is None


def test_several_scenes_are_listed(tmp_path):
    for k in (4, 9):
        with_gaps(tmp_path / f"test/{k:06d}", 1)
    refused(r"2 scenes: 4 \(test/000004\), 9.*--scene", open_bop, tmp_path)
    assert open_bop(tmp_path, scene=9).extra["scene"] == 9
    refused("no scene 5", open_bop, tmp_path, scene=5)


def test_missing_poses_are_said(tmp_path):
    with_gaps(tmp_path / "1")
    for key in ("cam_R_w2c", "cam_t_w2c"):
        edit(tmp_path / "1/scene_camera.json", lambda entries, k=key: entries["3"].pop(k))
    source = open_bop(tmp_path / "1")
    assert any("1 of 4 images have no camera pose" in n for n in source.notes)
    assert [f.T_world_cam is None for f in source.frames()] == [False, True, False, False]


# --- Label maps: round trips within a count, and zeros that mean 'nothing' alone.


def test_instances_come_back():
    ids = np.random.default_rng(0).integers(-1, 300, (20, 30)).astype(np.int32)
    np.testing.assert_array_equal(label_maps.instances_of(label_maps.instance_counts(ids)), ids)
    refused("65535 are in this view", label_maps.instance_counts, np.full((2, 2), 65535, np.int32))


def test_normals_come_back_and_nothing_stays_nothing():
    rng = np.random.default_rng(2)
    n = rng.normal(size=(40, 50, 3)).astype(np.float32)
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    n[0, :3] = [[0, 0, -1], [-1, 0, 0], [1, 0, 0]]
    n[5:9] = 0
    counts = normal_counts(n)
    assert not counts[5:9].any() and counts[:5].any(axis=-1).all()
    np.testing.assert_array_equal(counts[0, 0], [32768, 32768, 0])
    np.testing.assert_allclose(label_maps.normals_of(counts), n, atol=2e-5)


def test_run_lengths_of_a_window_are_those_of_the_image():
    rng = np.random.default_rng(3)
    for x, y, w, h in [(0, 0, 7, 5), (2, 0, 3, 5), (2, 1, 4, 3), (6, 4, 1, 1), (1, 1, 0, 0)]:
        for density in (0.0, 0.5, 1.0):
            window = rng.random((h, w)) < density
            image = np.zeros((5, 7), bool)
            image[y : y + h, x : x + w] = window
            rle = bop_labels.rle_of(window, origin=(x, y), shape=(5, 7))
            assert rle == bop_labels.rle_of(image)
            np.testing.assert_array_equal(bop_labels.mask_of(rle), image)
            area, box = bop_labels.rle_area_and_bbox(rle)
            assert area == image.sum() and box == bop_labels.bbox_of(image, inclusive=True)
    refused("reaches out", bop_labels.rle_of, np.ones((3, 3), bool), origin=(5, 0), shape=(5, 7))
