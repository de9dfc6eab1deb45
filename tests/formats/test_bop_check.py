"""Labels that agree are passed, and each that does not is named with what was said and found."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from plain_meshes import box
from realsim.formats.bop.check import Sheet, check_bop_scene, check_info, pose_findings, silhouette
from realsim.formats.bop.layout import SceneLayout
from realsim.formats.bop.opening import open_labelled_bop
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.records import CameraIntrinsics, Mesh
from realsim_sim_bridge.annotation.annotate import AnnotationConfig, annotate
from tests.support.bop_scenes import edit, write_boxes
from tests.support.synthetic_scenes import MODELS, captured_session, two_boxes


def test_labels_that_realsim_computed_agree_with_a_lens(tmp_path):
    store = captured_session(tmp_path / "test/000001", 3)
    annotate(store, two_boxes(), MODELS, [], AnnotationConfig())
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
