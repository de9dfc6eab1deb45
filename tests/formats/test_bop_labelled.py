"""BOP scenes with their labels: all is read, and what contradicts itself or is wrong is found."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from plain_meshes import box
from realsim.errors import InputError, UnitError
from realsim.formats.bop.check import Sheet, check_bop_scene, check_info, pose_findings, silhouette
from realsim.formats.bop.labels import rle_of
from realsim.formats.bop.layout import SceneLayout
from realsim.formats.bop.opening import open_labelled_bop
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.records import CameraIntrinsics, Mesh
from realsim_sim_bridge.annotation.annotate import annotate
from refusals import refused
from tests.support import synthetic_scenes as boxes
from tests.support.bop_scenes import HEIGHT, MODELS, WIDTH, K, edit, write_boxes

# --- what is there is read ----------------------------------------------------------------------


def test_a_scene_is_read_as_it_was_written(tmp_path):
    folder = write_boxes(tmp_path)
    scene = open_labelled_bop(tmp_path)
    assert (scene.name, scene.number, scene.split, scene.camera) == ("test-000003", 3, "test", "")
    assert scene.indices == (1, 5, 9, 13, 17) and scene.T_world_table is None
    documents = [folder / f"scene_{name}.json" for name in ("camera", "gt", "gt_info")]
    cameras, truth, infos = (json.loads(path.read_text()) for path in documents)
    for k, i in enumerate(scene.indices):
        frame = scene.frame(i)
        # The principal point moves from image to image, as in T-LESS.
        assert frame.intrinsics.cx == K[0, 2] + 0.5 * k and frame.entry == cameras[str(i)]
        assert frame.depth_unit_m == 1e-4
        assert [o.obj_id for o in frame.objects] == [1, 7, 1]
        for n, o in enumerate(frame.objects):
            assert o.entry == truth[str(i)][n] and o.gt_info == infos[str(i)][n]
            assert o.visible_fraction == infos[str(i)][n]["visib_fract"]
            np.testing.assert_allclose(1e3 * o.T_cam_obj[:3, 3], o.entry["cam_t_m2c"], rtol=1e-15)
            for visible, name in ((False, "mask"), (True, "mask_visib")):
                stored = cv2.imread(str(folder / f"{name}/{i:06d}_{n:06d}.png"), 0) > 0
                assert np.array_equal(scene.mask(i, n, visible=visible), stored)
    models = scene.models()
    assert {i: m.name for i, m in models.items()} == {1: "box1", 7: "box7"}
    np.testing.assert_allclose(models[7].mesh.extent, MODELS[7].mesh.extent, atol=1e-8)


def test_alike_things_keep_their_numbers_from_view_to_view(tmp_path):
    folder = write_boxes(tmp_path)

    for name in ("scene_gt.json", "scene_gt_info.json"):  # an image's rows have no order
        edit(folder / name, lambda data: data["5"].reverse())
    scene = open_labelled_bop(tmp_path)
    world = {}
    for i in scene.indices:
        frame = scene.frame(i)
        for o in frame.objects:
            world.setdefault(o.instance, []).append((frame.T_world_cam @ o.T_cam_obj)[:3, 3])
    assert len(world) == 3 and None not in world
    for positions in world.values():
        assert len(positions) == 5 and np.ptp(positions, axis=0).max() < 1e-5


def test_without_camera_poses_only_single_things_have_numbers(tmp_path):
    write_boxes(tmp_path, with_poses=False)
    scene = open_labelled_bop(tmp_path)
    numbers = [[o.instance for o in scene.frame(i).objects] for i in scene.indices]
    assert numbers == [[None, 0, None]] * 5
    assert any("instances of object 1 could not be told apart" in note for note in scene.notes)
    assert any("no camera poses" in note for note in scene.notes)


def compressed(runs):
    """COCO's rleToString, from its C source."""
    text = ""
    for k, run in enumerate(runs):
        x = run - runs[k - 2] if k > 2 else run
        more = True
        while more:
            c = x & 0x1F
            x >>= 5
            more = x != -1 if c & 0x10 else x != 0
            text += chr((c | 0x20 if more else c) + 48)
    return text


@pytest.mark.parametrize("packed", [False, True])
def test_masks_come_from_run_lengths_where_there_are_no_files(tmp_path, packed):
    folder = write_boxes(tmp_path)
    scene = open_labelled_bop(tmp_path)
    annotations, masks = [], {}
    for i in scene.indices:
        for k, o in enumerate(scene.frame(i).objects):
            masks[i, k] = scene.mask(i, k, visible=True)
            rle = rle_of(masks[i, k])
            counts = compressed(rle["counts"]) if packed else rle["counts"]
            if masks[i, k].any():
                annotations.append({
                    "image_id": i, "category_id": o.obj_id,
                    "segmentation": {"counts": counts, "size": rle["size"]},
                })  # fmt: skip
    shutil.rmtree(folder / "mask_visib")
    (folder / "scene_gt_coco.json").write_text(json.dumps({"annotations": annotations}))
    again = open_labelled_bop(tmp_path)
    for (i, k), mask in masks.items():
        found = again.mask(i, k, visible=True)
        assert np.array_equal(found, mask) if mask.any() else found is None
    # One of two alike is missing, and nothing says which: then there is none.
    infos = json.loads((folder / "scene_gt_info.json").read_text())
    assert infos["1"][0]["px_count_visib"] and infos["1"][2]["px_count_visib"]
    del annotations[0]
    (folder / "scene_gt_coco.json").write_text(json.dumps({"annotations": annotations}))
    less = open_labelled_bop(tmp_path)
    assert less.mask(1, 0, visible=True) is None and less.mask(1, 2, visible=True) is None
    assert any("could not be paired" in note for note in less.notes)


# --- what contradicts itself is found -----------------------------------------------------------


def rows_of(data):
    return [row for rows in data.values() for row in rows]


def inverted(of=dict.values, to="w2c"):
    def change(data):
        for row in of(data):
            T = se3.from_rt(np.reshape(row[f"cam_R_{to}"], (3, 3)), row[f"cam_t_{to}"])
            R, t = np.split(se3.invert(T)[:3], [3], axis=1)
            row.update({f"cam_R_{to}": R.ravel().tolist(), f"cam_t_{to}": t.ravel().tolist()})

    return change


def opengl(data):
    G = np.diag([1.0, -1, -1])
    each("cam_R_w2c", lambda R: (G @ R.reshape(3, 3)).ravel())(data)
    each("cam_t_w2c", lambda t: G @ t)(data)


def each(key, new, of=dict.values):
    """Return a change of a key's value in every row."""

    def change(data):
        for row in of(data):
            row[key] = np.asarray(new(np.array(row[key]))).tolist()

    return change


def columns(key, of=dict.values):
    return each(key, lambda R: R.reshape(3, 3).T.ravel(), of)


def scaled(key, factor, of=dict.values):
    return each(key, lambda values: factor * values, of)


def of_K(factors):
    return each("cam_K", lambda K: K * factors)


TRAPS = {
    "camera to world": ("camera", inverted(), InputError, r"camera to world is taken for world to"),
    "OpenGL's axes": ("camera", opengl, InputError, "OpenGL's camera axes"),
    "columns of w2c": ("camera", columns("cam_R_w2c"), InputError, "cam_R_w2c is written column"),
    "columns of m2c": ("gt", columns("cam_R_m2c", rows_of), InputError, "cam_R_m2c is written col"),
    "metres of w2c": ("camera", scaled("cam_t_w2c", 1e-3), UnitError, "cam_t_w2c is in metres"),
    "w2c twice": ("camera", scaled("cam_t_w2c", 1e3), UnitError, "1000 once too often"),
    "metres of m2c": ("gt", scaled("cam_t_m2c", 1e-3, rows_of), UnitError, "metres in a milli"),
    "m2c twice": ("gt", scaled("cam_t_m2c", 1e3, rows_of), UnitError, "multiplied by 1000 again"),
    "depth of 1 mm": ("camera", scaled("depth_scale", 10), UnitError, "with depth_scale 0.1 depth"),
    "depth of 10 um": ("camera", scaled("depth_scale", 0.1), UnitError, "with depth_scale 0.1 dep"),
    "a row of gt_info": ("gt_info", lambda d: d["5"].pop(), InputError, "has 2 objects in image 5"),
    "object 0": ("gt", lambda d: d["5"][0].update(obj_id=0), InputError, "obj_id of object 0"),
    "a fisheye": ("camera", lambda d: d["5"].pop("cam_K"), InputError, "no cam_K but a cam_model"),
}  # fmt: skip


@pytest.mark.parametrize(("name", "change", "error", "says"), TRAPS.values(), ids=TRAPS)
def test_traps_are_found(tmp_path, name, change, error, says):
    folder = write_boxes(tmp_path)
    open_labelled_bop(tmp_path)
    edit(folder / f"scene_{name}.json", change)
    assert str(folder) in refused(says, open_labelled_bop, tmp_path, error=error)


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        ("gt", inverted(rows_of, "m2c"), "are read inverted"),
        ("gt", columns("cam_R_m2c", rows_of), "are read transposed"),
        ("camera", of_K([1.5, 1, 1, 1, 1.5, 1, 1, 1, 1]), "focal lengths of cam_K times about 0.6"),
        ("camera", of_K([0.5] * 8 + [1]), "all of cam_K times about 2"),
    ],
)
@pytest.mark.parametrize("with_masks", [True, False])
def test_depth_finds_traps_with_and_without_masks(tmp_path, name, change, says, with_masks):
    folder = write_boxes(tmp_path, with_poses=False)
    for left_out in () if with_masks else ("mask", "mask_visib"):
        shutil.rmtree(folder / left_out)
    (folder / "scene_gt_info.json").unlink()
    assert any("checked: measured depth" in note for note in open_labelled_bop(tmp_path).notes)
    edit(folder / f"scene_{name}.json", change)
    refused(says, open_labelled_bop, tmp_path)


def test_moving_objects_are_told_not_refused(tmp_path):
    folder = write_boxes(tmp_path)

    rng = np.random.default_rng(0)
    moved = each("cam_t_m2c", lambda t: t + rng.uniform(-90, 90, 3), rows_of)
    edit(folder / "scene_gt.json", moved)
    notes = open_labelled_bop(tmp_path).notes
    assert any("do not agree under any reading" in note for note in notes)


def test_files_that_do_not_belong_together_are_named(tmp_path):
    folder = write_boxes(tmp_path)
    kept = (folder / "mask/000005_000002.png").read_bytes()
    (folder / "mask/000005_000002.png").unlink()
    refused(r"has 2 masks of image 5 .* has 3 objects", open_labelled_bop, tmp_path)
    (folder / "mask/000005_000002.png").write_bytes(kept)
    cv2.imwrite(str(folder / "mask/000005_000002.png"), np.zeros((8, 9), np.uint8))
    scene = open_labelled_bop(tmp_path)
    refused(rf"has 9x8 pixels; its image has {WIDTH}x{HEIGHT}", scene.mask, 5, 2, visible=False)
    cv2.imwrite(str(folder / "depth/000005.png"), np.ones((8, 9), np.uint16))
    refused("has 9x8 pixels of 16 bit", open_labelled_bop, tmp_path)
    refused("has no image 2; it has 1, 5, 9", scene.frame, 2)


def test_labels_without_an_image_and_a_principal_point_beside_it_are_told(tmp_path):
    folder = write_boxes(tmp_path)
    edit(folder / "scene_gt.json", lambda data: data.update({"99": data["5"]}))
    notes = open_labelled_bop(tmp_path).notes
    assert any("images that are not there; they are left out: 99." in note for note in notes)
    (folder / "scene_gt.json").unlink()  # or its boxes would speak first
    edit(folder / "scene_camera.json", each("cam_K", lambda K: K + WIDTH * (np.arange(9) == 2)))
    notes = open_labelled_bop(tmp_path).notes
    assert any("principal point outside of image 1, 5, 9" in note for note in notes)


def test_models_that_are_missing_are_named(tmp_path):
    write_boxes(tmp_path)
    (tmp_path / "models/obj_000007.ply").unlink()
    scene = open_labelled_bop(tmp_path)
    assert any("object 7 has no mesh" in note for note in scene.notes)
    assert set(scene.models()) == {1}
    given = open_labelled_bop(tmp_path, models=MODELS)
    assert set(given.models()) == {1, 7} and not any("no mesh" in n for n in given.notes)
    refused("has no models", open_labelled_bop, tmp_path, models=tmp_path)
    refused("nowhere does not exist; obj", open_labelled_bop, tmp_path, models=tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("scale", "left_out", "said"),
    [(0.5, "depth", "not seen where cam_K"), (1 / 640, "mask", "of another image size")],
)
def test_a_camera_of_another_image_size_is_named(tmp_path, scale, left_out, said):
    folder = write_boxes(tmp_path)
    shutil.rmtree(folder / left_out)
    shrunk = each("cam_K", lambda K: np.where(np.arange(9) < 6, scale * K, K))
    edit(folder / "scene_camera.json", shrunk)
    refused(said, open_labelled_bop, tmp_path)


# --- Labels that agree are passed, and each that does not is named with what was said and found.


def test_labels_that_realsim_computed_agree_with_a_lens(tmp_path):
    store = boxes.captured_session(tmp_path / "test/000001", 3)
    annotate(store, boxes.two_boxes(), boxes.MODELS, [])
    scene = open_labelled_bop(tmp_path)
    assert scene.frame(scene.indices[0]).intrinsics.is_distorted
    found = check_bop_scene(scene)
    assert found.agrees, [str(f) for f in found.findings]
    assert found.compared["pose and mask"] == found.objects == 6


def test_right_labels_agree(tmp_path):
    write_boxes(tmp_path)
    found = check_bop_scene(open_labelled_bop(tmp_path))
    assert found.agrees, [str(f) for f in found.findings]
    assert (found.frames, found.objects) == (5, 15)
    for what in ("bbox_visib", "px_count_valid", "visib_fract", "mask_visib", "pose and mask"):
        assert found.compared[what] == 15


WRONG = {
    "bbox_visib": lambda row: row["bbox_visib"].__setitem__(2, row["bbox_visib"][2] + 1),
    "px_count_visib": lambda row: row.update(px_count_visib=row["px_count_visib"] + 3),
    "px_count_valid": lambda row: row.update(px_count_valid=row["px_count_valid"] - 1),
    "px_count_all": lambda row: row.update(px_count_all=row["px_count_all"] // 2),
    "visib_fract": lambda row: row.update(visib_fract=0.5 * row["visib_fract"]),
    "bbox_obj": lambda row: row["bbox_obj"].__setitem__(0, row["bbox_obj"][0] - 4),
}


@pytest.mark.parametrize("what", WRONG)
def test_wrong_counts_are_found(tmp_path, what):
    folder = write_boxes(tmp_path)
    edit(folder / "scene_gt_info.json", lambda data: WRONG[what](data["5"][1]))
    found = check_bop_scene(open_labelled_bop(tmp_path))
    assert what in found.counts()
    where = {(f.file, f.image, f.place, f.obj_id) for f in found.findings}
    assert where == {("scene_gt_info.json", 5, 1, 7)}


def test_a_pose_that_is_off_and_a_mask_that_reaches_out_are_found(tmp_path):
    folder = write_boxes(tmp_path)

    def shift(data):
        data["9"][1]["cam_t_m2c"][0] += 25

    edit(folder / "scene_gt.json", shift)
    counts = check_bop_scene(open_labelled_bop(tmp_path)).counts()
    assert counts["pose and mask"] >= 1 and counts["pose and box"] >= 1
    shutil.copy(folder / "mask_visib/000005_000001.png", folder / "mask_visib/000005_000000.png")
    found = check_bop_scene(open_labelled_bop(tmp_path))
    assert found.counts()["mask_visib"] == 1
    told = "image 5, object 0 (id 1): mask_visib says within mask"
    assert any(told in str(f) for f in found.findings)


def test_depth_that_was_not_used_for_visibility_is_found(tmp_path):
    folder = write_boxes(tmp_path)
    path = folder / "depth/000005.png"
    counts = cv2.imread(str(path), -1)
    scene = open_labelled_bop(tmp_path)
    mask = scene.mask(5, 1, visible=True)
    near = 1e4 * scene.frame(5).objects[1].T_cam_obj[2, 3]
    for factor, what in ((0.6, "depth in front"), (1.6, "depth behind")):
        changed = counts.copy()
        changed[mask] = int(factor * near)
        cv2.imwrite(str(path), changed)
        assert what in check_bop_scene(open_labelled_bop(tmp_path)).counts()


CAMERA = CameraIntrinsics(width=320, height=240, fx=300.0, fy=300.0, cx=159.5, cy=119.5)
NOWHERE = SceneLayout(folder=Path("nowhere"))


def pose_faults(mesh, T_cam_obj, mask):
    """Return what disagrees where a mesh at a pose is said to be seen in a mask."""
    sheet = Sheet(NOWHERE, 0, 0, 1)
    pose_findings(silhouette(CAMERA, T_cam_obj, mesh), mask, mask, None, 0.015, sheet)
    assert "pose and box" in sheet.compared
    return [f.what for f in sheet.findings]


def test_a_bar_that_the_border_cuts_agrees_with_its_own_silhouette():
    T = se3.from_rt(se3.exp_so3([0.0, 0.0, np.pi / 4]), [-0.27, 0.0, 0.5])
    mesh = box((0.3, 0.02, 0.01))
    uv = project(CAMERA, se3.transform(T, mesh.vertices))
    assert uv[:, 0].min() < 0 < uv[:, 0].max()
    canvas = np.zeros((240, 320), np.uint8)
    mask = cv2.fillConvexPoly(canvas, cv2.convexHull(np.rint(uv).astype(np.int32)), 1) > 0
    assert pose_faults(mesh, T, mask) == []
    assert pose_faults(box((0.3, 0.2, 0.01)), T, mask) == ["pose and box"]


def angle(leg_x):
    """Return an L: a bar along the upper border and a leg down from it at x [m]."""
    bar, leg = box((0.3, 0.03, 0.01)), box((0.03, 0.36, 0.01))
    vertices = [
        m.vertices + np.array(t) for m, t in ((bar, (-0.2, -0.16, 0.0)), (leg, (leg_x, 0.0, 0.0)))
    ]
    faces = [bar.faces, leg.faces + len(bar.vertices)]
    return Mesh(vertices=np.concatenate(vertices), faces=np.concatenate(faces))


def test_a_hollow_that_the_border_leaves_is_not_filled():
    # The leg is beyond the border: its hull is in the image where nothing is.
    T = se3.from_translation([0.0, 0.0, 0.5])
    mesh, mask = angle(-0.33), np.zeros((240, 320), np.uint8)
    uv = project(CAMERA, se3.transform(T, mesh.vertices))
    for triangle in np.rint(uv).astype(np.int32)[mesh.faces]:
        cv2.fillConvexPoly(mask, triangle, 1)
    for leg_x, findings in ((-0.33, []), (-0.2, ["pose and box"])):
        assert pose_faults(angle(leg_x), T, mask > 0) == findings


def test_a_box_may_end_where_bops_tools_cut_it():
    T = se3.from_translation([0.0, 0.5, 0.5])
    shape = silhouette(CAMERA, T, box((0.05, 1.0, 0.01)))
    x0, y0, x1, y1 = (float(v) for v in shape.box)
    assert 2 * 240 - 1 < y1
    for end, agrees in ((y1, True), (2 * 240 - 1, True), (1.8 * 240, False)):
        info = {"bbox_obj": [x0, y0, x1 - x0, end - y0], "px_count_visib": 40}
        sheet = Sheet(NOWHERE, 0, 0, 1)
        check_info(info, None, None, None, shape, sheet)
        assert (not sheet.findings) == agrees
