"""BOP scenes written: the same numbers, the same pixels, the same bytes after a kill."""

import json
from collections import Counter
from dataclasses import replace

import cv2
import numpy as np
import pytest

from file_trees import bytes_of
from killed_children import killed_at
from labelled_scenes import ChangedScene
from realsim.formats.bop.models import load_models
from realsim.formats.bop.opening import open_labelled_bop, open_labelled_scene
from realsim.formats.bop.root_files import write_bop_models, write_bop_root
from realsim.formats.bop.run_lengths import decoded
from realsim.formats.bop.scene import find_scenes
from realsim.formats.bop.writing import BopWriteConfig, write_bop_scene
from realsim.formats.export_folder import ExportFolder
from realsim.geometry import se3
from realsim.images import read_rgb
from refusals import refused
from tests.support.bop_scenes import MODELS, bbox, edit, write_boxes

DOCUMENTS = ("scene_camera", "scene_gt", "scene_gt_info")


def export(scene, out, config=None):
    folder = ExportFolder.begin(out, {"what": "a test"})
    written = write_bop_scene(scene, folder, config)
    write_bop_models(scene.models(), folder, infos=scene.models_info())
    write_bop_root(folder, name="copy")
    folder.finish({})
    return written


# --- round trips --------------------------------------------------------------------------------


def test_numbers_come_back_to_the_last_digit_and_unknown_keys_survive(tmp_path):
    source = write_boxes(tmp_path / "a")
    written = export(open_labelled_bop(tmp_path / "a"), tmp_path / "b")
    assert (written.frames, written.frames_written, written.objects) == (5, 5, 15)
    assert written.counts["masks"] == 30 and written.notes == ()
    copy = tmp_path / "b/test/000003"
    for name in DOCUMENTS:
        before, after = (json.loads((f / f"{name}.json").read_text()) for f in (source, copy))
        assert before == after
    assert json.loads((copy / "scene_camera.json").read_text())["5"]["view_level"] == 2
    for kind in ("rgb", "depth"):  # byte for byte
        for file in (source / kind).iterdir():
            assert (copy / kind / file.name).read_bytes() == file.read_bytes()
    for kind in ("mask", "mask_visib"):  # pixel for pixel
        assert len(list((copy / kind).iterdir())) == 15
        for file in (source / kind).iterdir():
            same = cv2.imread(str(copy / kind / file.name), -1)
            assert np.array_equal(same, cv2.imread(str(file), -1))
    # A second time round nothing changes any more.
    export(open_labelled_bop(tmp_path / "b"), tmp_path / "c")
    assert bytes_of(tmp_path / "b") == bytes_of(tmp_path / "c")


def test_models_keep_their_numbers_and_their_own_keys(tmp_path):
    write_boxes(tmp_path / "a")

    def change(data):
        data["1"].update(diameter=data["1"]["diameter"] + 1e-4, maker="somebody")
        data["7"].update(symmetries_discrete=[[1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1]])

    edit(tmp_path / "a/models/models_info.json", change)
    export(open_labelled_bop(tmp_path / "a"), tmp_path / "b")
    infos = [json.loads((tmp_path / k / "models/models_info.json").read_text()) for k in "ab"]
    assert infos[0] == infos[1] and infos[1]["1"]["maker"] == "somebody"
    for i, model in load_models(tmp_path / "b/models_eval").items():
        np.testing.assert_allclose(model.mesh.vertices, MODELS[i].mesh.vertices, atol=1e-8)
    assert len(load_models(tmp_path / "b/models")[7].symmetries) == 2
    # What no longer holds is not kept.
    edit(tmp_path / "a/models/models_info.json", lambda d: d["1"].update(diameter=150.0))
    export(open_labelled_bop(tmp_path / "a"), tmp_path / "c")
    info = json.loads((tmp_path / "c/models/models_info.json").read_text())
    assert info["1"]["diameter"] == pytest.approx(1e3 * np.sqrt(0.06**2 + 0.05**2 + 0.09**2))


def test_a_camera_suffix_and_an_onboarding_folder_come_back(tmp_path):
    write_boxes(tmp_path / "a", camera="cam1", colour="gray")
    write_boxes(tmp_path / "a", split="onboarding_static", scene="obj_000007_up", things=[
        (7, 0, 0, 0)])  # fmt: skip
    folder = ExportFolder.begin(tmp_path / "b", {})
    for ref in find_scenes(tmp_path / "a"):
        write_bop_scene(open_labelled_scene(ref), folder)
    write_bop_root(folder, name="two")
    folder.finish({})
    for pair in zip(find_scenes(tmp_path / "a"), find_scenes(tmp_path / "b"), strict=True):
        assert pair[0].name == pair[1].name
        for name in DOCUMENTS:
            before, after = (json.loads(r.layout.document(name).read_text()) for r in pair)
            assert before == after
    assert (tmp_path / "b/test/000003/gray_cam1/000001.png").is_file()
    assert (tmp_path / "b/camera_cam1.json").is_file() and (tmp_path / "b/camera.json").is_file()
    # Another name for scene, split and camera.
    again = ExportFolder.begin(tmp_path / "c", {})
    config = BopWriteConfig(split="val", number=12, camera="")
    write_bop_scene(open_labelled_bop(tmp_path / "a", camera="cam1"), again, config)
    assert (tmp_path / "c/val/000012/scene_gt.json").is_file()
    for wrong in ({"split": "../x"}, {"number": -1}, {"jpeg_quality": 0}, {"camera": "a/b"}):
        refused(".", BopWriteConfig, **wrong)


def test_a_pose_that_changed_is_written_and_the_rest_of_its_row_kept(tmp_path):
    write_boxes(tmp_path / "a")
    scene = open_labelled_bop(tmp_path / "a")
    shift = se3.from_translation([0, 0, 0.004])

    def put_elsewhere(frame):
        moved = tuple(replace(o, T_cam_obj=shift @ o.T_cam_obj) for o in frame.objects)
        return replace(frame, objects=moved)

    export(ChangedScene(scene, put_elsewhere), tmp_path / "b")
    again = open_labelled_bop(tmp_path / "b")
    for o, p in zip(scene.frame(5).objects, again.frame(5).objects, strict=True):
        t = (shift @ o.T_cam_obj)[:3, 3]
        np.testing.assert_allclose(t, p.T_cam_obj[:3, 3], rtol=3e-16, atol=0)
        assert p.entry["score"] == 0.25 and p.entry["cam_t_m2c"] != o.entry["cam_t_m2c"]


# --- documents ----------------------------------------------------------------------------------


def test_visibility_is_counted_as_bop_defines_it(tmp_path):
    """The formulas of docs/bop_datasets_format.md and calc_gt_info.py, computed here again."""
    source = write_boxes(tmp_path / "a")
    (source / "scene_gt_info.json").unlink()
    written = export(open_labelled_bop(tmp_path / "a"), tmp_path / "b")
    assert "5 of 5 frames had no scene_gt_info: it was counted" in written.notes[0]
    copy = tmp_path / "b/test/000003"
    infos = json.loads((copy / "scene_gt_info.json").read_text())
    for image, rows in infos.items():
        depth = cv2.imread(str(copy / f"depth/{int(image):06d}.png"), -1)
        for k, row in enumerate(rows):
            name = f"{int(image):06d}_{k:06d}.png"
            masks = [cv2.imread(str(copy / kind / name), -1) for kind in ("mask", "mask_visib")]
            whole, visible = (mask > 0 for mask in masks)
            assert row["px_count_all"] == whole.sum()
            assert row["px_count_valid"] == (depth[whole] > 0).sum()
            assert row["px_count_visib"] == visible.sum()
            assert row["visib_fract"] == visible.sum() / whole.sum()
            assert row["bbox_visib"] == bbox(visible)
            assert row["bbox_obj"] == (bbox(whole) if visible.any() else [-1] * 4)


def test_coco_has_the_visible_masks_and_the_whole_boxes(tmp_path):
    write_boxes(tmp_path / "a")
    scene = open_labelled_bop(tmp_path / "a")
    export(scene, tmp_path / "b")
    coco = json.loads((tmp_path / "b/test/000003/scene_gt_coco.json").read_text())
    assert [c["name"] for c in coco["categories"]] == ["box1", "box7"]
    files = {i["id"]: i["file_name"] for i in coco["images"]}
    assert files == {i: f"rgb/{i:06d}.png" for i in scene.indices}
    assert [a["id"] for a in coco["annotations"]] == list(range(1, len(coco["annotations"]) + 1))
    rows = [(i, k, o) for i in scene.indices for k, o in enumerate(scene.frame(i).objects)]
    rows = [r for r in rows if scene.mask(*r[:2], visible=True).any()]
    for a, (i, k, o) in zip(coco["annotations"], rows, strict=True):
        visible, whole = scene.mask(i, k, visible=True), scene.mask(i, k, visible=False)
        assert (a["image_id"], a["category_id"], a["area"]) == (i, o.obj_id, visible.sum())
        assert np.array_equal(decoded(a["segmentation"], "a"), visible)
        x, y, w, h = bbox(whole)
        assert a["bbox"] == [x, y, w + 1, h + 1]
        assert a["ignore"] == (o.visible_fraction < 0.1)


def test_targets_are_the_visible_objects(tmp_path):
    source = write_boxes(tmp_path / "a")

    edit(source / "scene_gt_info.json", lambda data: data["5"][0].update(visib_fract=0.09))
    export(open_labelled_bop(tmp_path / "a"), tmp_path / "b")
    targets = json.loads((tmp_path / "b/test_targets_bop19.json").read_text())
    found = {(t["scene_id"], t["im_id"], t["obj_id"]): t["inst_count"] for t in targets}
    scene = open_labelled_bop(tmp_path / "a")
    assert len(found) == len(targets) and found[3, 5, 1] == 1
    assert found == Counter(
        (3, i, o.obj_id)
        for i in scene.indices for o in scene.frame(i).objects if o.visible_fraction >= 0.1
    )  # fmt: skip
    detection = json.loads((tmp_path / "b/test_targets_bop24.json").read_text())
    assert [t["im_id"] for t in detection] == [1, 5, 9, 13, 17]
    camera = json.loads((tmp_path / "b/camera.json").read_text())
    assert (camera["width"], camera["height"], camera["depth_scale"]) == (96, 72, 0.1)
    assert "cam_R_w2c" in (tmp_path / "b/dataset_info.md").read_text()
    open_labelled_bop(tmp_path / "b")


# --- interruption -------------------------------------------------------------------------------


def test_colour_may_be_jpeg_and_masks_left_out(tmp_path):
    source = write_boxes(tmp_path / "a")
    smooth = np.tile(np.arange(96, dtype=np.uint8), (72, 1))
    cv2.imwrite(str(source / "rgb/000001.png"), np.dstack([smooth] * 3))
    scene = open_labelled_bop(tmp_path / "a")
    config = BopWriteConfig(colour="jpeg", masks=False)
    written = export(scene, tmp_path / "b", config)
    assert any("pixels changed" in note for note in written.notes) and written.counts["masks"] == 0
    copy = open_labelled_bop(tmp_path / "b")
    assert copy.colour_file(1).suffix == ".jpg"
    off = np.abs(read_rgb(copy.colour_file(1)).astype(int) - read_rgb(scene.colour_file(1)))
    assert off.mean() < 3
    assert not (tmp_path / "b/test/000003/mask").exists()
    # JPEG is copied as it is, and PNG made of it has its pixels.
    jpeg = copy.colour_file(1)
    export(copy, tmp_path / "c")
    assert (tmp_path / "c/test/000003/rgb/000001.jpg").read_bytes() == jpeg.read_bytes()
    export(copy, tmp_path / "d", BopWriteConfig(colour="png"))
    same = read_rgb(tmp_path / "d/test/000003/rgb/000001.png")
    assert np.array_equal(same, read_rgb(jpeg))


def test_a_killed_export_goes_on_and_ends_with_the_same_bytes(tmp_path):
    write_boxes(tmp_path / "a", count=3)
    scene = open_labelled_bop(tmp_path / "a")
    export(scene, tmp_path / "whole")
    out = tmp_path / "killed"
    assert killed_at(13, lambda: export(scene, out))  # in the second frame's masks
    pieces = out / ".export/pieces.jsonl"
    there = len(pieces.read_text().splitlines()) if pieces.exists() else 0
    assert ExportFolder.begin(out, {"what": "a test"}).resumed
    written = export(scene, out)
    assert (written.frames, written.objects, written.counts["masks"]) == (3, 9, 18)
    assert written.frames_written == 3 - min(there, 3)
    assert bytes_of(out) == bytes_of(tmp_path / "whole")
