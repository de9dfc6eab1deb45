"""GraspNet's annotations: what is written is read.

GraspNet-1Billion's scenes: objects come back in the table's frame, whatever camera saw them.

What GraspNet has no place for is converted and said, or refused; kills leave equal bytes.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from file_trees import bytes_of
from labelled_scenes import INTRINSICS, MODELS, labelled_scene
from labelled_scenes import graspnet_tree as write
from labelled_scenes import opened_graspnet as opened
from realsim import images
from realsim.errors import InputError, NotRigidError, UnitError
from realsim.formats.export_folder import ExportFolder
from realsim.formats.graspnet.annotations import (
    annotation_bytes,
    object_fields,
    pose_of,
    read_objects,
)
from realsim.formats.graspnet.scene import read_annotation, read_graspnet_scene
from realsim.formats.graspnet.writing import GraspnetWriteConfig, write_graspnet_scene
from realsim.formats.labelled_scene import RenumberedScene
from realsim.geometry import se3
from realsim.geometry.camera import undistort
from realsim.geometry.mesh import load_mesh
from refusals import refused
from upgradable_datasets import annotation_xml


def test_poses_lose_nothing_in_the_text():
    Ts = se3.random_transform(np.random.default_rng(2), 300, spread=0.5)
    for T in Ts:
        off = se3.invert(T) @ pose_of(object_fields(4, T))
        assert np.linalg.norm(off[:3, 3]) < 1e-9 and se3.angle(off) < 1e-8


def test_what_is_written_is_read_and_unknown_elements_survive(tmp_path):
    Ts = se3.random_transform(np.random.default_rng(3), 3, spread=0.3)
    rows = [object_fields(n, T) | {"obj_name": "a <b> & c"} for n, T in zip((4, 0, 4), Ts)]  # noqa: B905
    rows[1] |= {"judge": "good", "not a tag": "gone"}
    path = tmp_path / "0000.xml"
    path.write_bytes(annotation_bytes(rows))
    found = read_objects(path)
    assert [o.number for o in found] == [4, 0, 4]
    assert dict(found[0].fields) == rows[0]
    assert found[1].fields["judge"] == "good" and "not a tag" not in found[1].fields
    path.write_bytes(annotation_bytes([o.fields for o in found]))
    assert [dict(o.fields) for o in read_objects(path)] == [dict(o.fields) for o in found]
    path.write_bytes(annotation_bytes([]))
    assert read_objects(path) == ()


@pytest.mark.parametrize(
    ("change", "error", "what"),
    [
        ({"pos_in_world": "412.1000 10.0000 502.0000"}, UnitError, "millimetres"),
        ({"ori_in_world": "2.0 0.0 0.0 0.0"}, InputError, "length 2"),
        ({"ori_in_world": "1.0 0.0 nan 0.0"}, InputError, "4 finite"),
        ({"obj_id": "1e400"}, InputError, "obj_id"),
        ({"obj_id": "-1"}, InputError, "whole numbers from 0"),
        ({"obj_id": "0.5"}, InputError, "whole numbers from 0"),
        ({"pos_in_world": "1 2"}, InputError, "3 finite"),
    ],
)
def test_what_cannot_be_is_named(tmp_path, change, error, what):
    path = tmp_path / "0000.xml"
    path.write_bytes(annotation_bytes([object_fields(1, np.eye(4)) | change]))
    refused(what, read_objects, path, error=error)


NUMBERS = (0, 27, 5)
DECIMALS_M = 1e-4
"""The text has four decimals: half of the last one on each axis, and on the quaternion."""


def poses_on_table():
    Ts = se3.random_transform(np.random.default_rng(4), len(NUMBERS), spread=0.2)
    return dict(zip(NUMBERS, Ts, strict=True))


@pytest.fixture
def dataset(tmp_path):
    """Return the folder of a scene of a data set."""
    import trimesh

    rng, root = np.random.default_rng(8), tmp_path / "scenes/scene_0007/kinect"
    first, relative = se3.random_transform(rng), se3.random_transform(rng, 3, spread=0.3)
    relative[0] = np.eye(4)
    (root / "annotations").mkdir(parents=True)
    np.save(root / "camera_poses.npy", relative)
    np.save(root / "cam0_wrt_table.npy", first)
    for i, T in enumerate(relative):
        inverse = se3.invert(first @ T)
        seen = {n: inverse @ T_obj for n, T_obj in poses_on_table().items()}
        (root / "annotations" / f"{i:04d}.xml").write_text(annotation_xml(seen))
    for n in NUMBERS:
        folder = tmp_path / "models" / f"{n:03d}"
        folder.mkdir(parents=True)
        mesh = trimesh.creation.box((0.05, 0.06, 0.1))
        (folder / "nontextured.ply").write_bytes(mesh.export(file_type="ply"))
    return root.parent


def test_the_poses_on_the_table_are_the_same_from_every_image(dataset):
    found = read_graspnet_scene(dataset)
    for o, (number, T) in zip(found.scene.objects, poses_on_table().items(), strict=True):
        assert o.obj_id == number + 1
        off = se3.invert(T) @ o.T_world_obj
        assert np.linalg.norm(off[:3, 3]) < 2 * DECIMALS_M and se3.angle(off) < 4 * DECIMALS_M
    assert np.array_equal(found.scene.plane.T_world_table, np.eye(4))
    assert found.models[28].name == "027" and found.scene.name == "scene_0007 kinect"
    assert not any("elsewhere" in n for n in found.notes)


def test_an_image_that_disagrees_is_named(dataset):
    path = dataset / "kinect/annotations/0002.xml"
    seen = read_annotation(path)
    seen[27] = se3.from_translation([0.02, 0, 0]) @ seen[27]
    path.write_text(annotation_xml(seen))
    (note,) = [n for n in read_graspnet_scene(dataset).notes if "elsewhere" in n]
    assert "object 027" in note and "image 2" in note and "20." in note


def test_a_scene_without_objects_and_an_object_twice_are_named(dataset):
    path = dataset / "kinect/annotations/0000.xml"
    text = path.read_text()
    path.write_text(text.replace("<obj_id>27<", "<obj_id>0<"))
    refused("each once", read_graspnet_scene, dataset)
    path.write_text("<scene></scene>")
    refused("holds no <obj>", read_graspnet_scene, dataset)


def test_missing_and_broken_files_are_named(dataset, tmp_path):
    refused("no realsense or kinect/camera_poses", read_graspnet_scene, tmp_path)
    refused("no mesh", read_graspnet_scene, dataset, tmp_path)
    root = dataset / "kinect"
    (root / "annotations/0000.xml").rename(root / "annotations/0009.xml")
    refused("annotation of image 0", read_graspnet_scene, root)
    (root / "annotations/0009.xml").rename(root / "annotations/0000.xml")
    np.save(root / "cam0_wrt_table.npy", np.diag([1.0, 1.0, -1.0, 1.0]))
    refused("mirrored", read_graspnet_scene, dataset, error=NotRigidError)
    np.save(root / "cam0_wrt_table.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    refused("only numbers", read_graspnet_scene, dataset)


HOME = "scenes/scene_0003/realsense"


@pytest.fixture
def source(tmp_path):
    return labelled_scene(tmp_path / "source", range(3))


def test_an_interrupted_export_ends_with_the_same_bytes_and_notes(source, tmp_path):
    def exported(out, progress=None):
        folder = ExportFolder.begin(out, {"what": "test"})
        done = write_graspnet_scene(source, folder, GraspnetWriteConfig(), progress=progress)
        folder.finish({})
        return done

    whole = exported(tmp_path / "whole")
    for frames in (1, 3):
        ticks = iter(range(frames - 1))
        with pytest.raises(StopIteration):
            exported(tmp_path / "killed", progress=partial(next, ticks))
    killed = exported(tmp_path / "killed")
    assert bytes_of(tmp_path / "whole") == bytes_of(tmp_path / "killed")
    assert whole.notes == killed.notes and whole.counts == killed.counts
    assert (whole.frames_written, killed.frames_written) == (3, 0)


def test_images_with_gaps_are_numbered_from_zero_and_the_numbers_are_kept(tmp_path):
    source = labelled_scene(tmp_path / "source", (4, 9, 1000))
    result = write(source, tmp_path / "out")
    assert any("frames.json" in n for n in result.notes)
    text = (tmp_path / "out" / HOME / "frames.json").read_text()
    assert '"0001": 9' in text and '"0002": 1000' in text
    scene = opened(tmp_path / "out")
    assert scene.indices == (0, 1, 2)
    for k, index in enumerate((4, 9, 1000)):
        a, b = source.frame(index).objects[2], scene.frame(k).objects[2]
        assert np.abs(a.T_cam_obj - b.T_cam_obj).max() < 1e-6


def test_a_lens_with_distortion_is_refused_with_its_pixels_unless_accepted(source, tmp_path):
    lens = replace(INTRINSICS, distortion=np.array([-0.08, 0.02, 0.001, -0.001, 0.0]))
    source.change_frames(intrinsics=lens)
    refused(r"moves pixels by up to \d+\.\d px", write, source, tmp_path / "out")
    result = write(source, tmp_path / "accepted", ignore_distortion=True)
    (note,) = [n for n in result.notes if "distortion" in n]
    # Corner of the image: ideal x = (0 - 78.7) / 150 moved by k1 r^2 x and so on.
    xy, _ = undistort(lens, np.zeros(2))
    off = np.linalg.norm(xy * [lens.fx, lens.fy] + [lens.cx, lens.cy])
    assert float(note.split("up to ")[1].split()[0]) >= round(float(off), 1) - 0.05


def test_cameras_without_poses_follow_from_the_objects(source, tmp_path):
    whole = write(source, tmp_path / "whole")
    before = np.load(whole.folder / "camera_poses.npy")
    source.change_frames(T_world_cam=None)
    refused("knows no table", write, source, tmp_path / "none")
    result = write(source, tmp_path / "out", table_is_world=True)
    after = np.load(result.folder / "camera_poses.npy")
    assert np.abs(after - before).max() < 1e-9
    assert any("NO TABLE IS KNOWN" in n for n in result.notes)
    assert np.array_equal(np.load(result.folder / "cam0_wrt_table.npy"), np.eye(4))


def test_cameras_that_share_no_object_or_that_disagree_are_refused(source, tmp_path):
    source.change_frames(T_world_cam=None, objects=lambda f: f.objects[f.index : f.index + 1])
    refused("no object in common", write, source, tmp_path / "out", table_is_world=True)
    moved = labelled_scene(tmp_path / "moved", range(2)).change_frames(T_world_cam=None)
    first, *others = moved.frames[1].objects
    T = first.T_cam_obj @ se3.from_translation([0.05, 0, 0])
    moved.frames[1] = replace(moved.frames[1], objects=(replace(first, T_cam_obj=T), *others))
    refused(r"disagree by \d+ mm", write, moved, tmp_path / "out", table_is_world=True)


def test_another_depth_unit_is_converted_and_the_rounding_said(tmp_path):
    fine = labelled_scene(tmp_path / "source", range(2), unit_m=1e-4)
    result = write(fine, tmp_path / "out")
    assert any("rounded" in n and "0.50 mm" in n for n in result.notes)
    scene = opened(tmp_path / "out")
    before = images.read_depth(fine.depth_file(0), 1e-4)
    after = images.read_depth(scene.depth_file(0), 1e-3)
    assert np.array_equal(before > 0, after > 0)
    assert np.abs(before - after).max() <= 0.5e-3 + 1e-7


def test_grey_images_and_other_formats_become_colour_pngs(source, tmp_path):
    grey = np.arange(120 * 160, dtype=np.uint32).reshape(120, 160).astype(np.uint8)
    source.colour_file(0).write_bytes(images.png_bytes(grey))
    write(source, tmp_path / "out")
    written = images.read_image(tmp_path / "out" / HOME / "rgb/0000.png")
    assert np.array_equal(written, np.dstack([grey] * 3))


def test_numbers_beyond_graspnets_are_noted(source, tmp_path):
    result = write(RenumberedScene(source, {7: 301}), tmp_path / "out")
    assert any("up to 300" in n for n in result.notes)
    scene = opened(tmp_path / "out")
    assert 300 in scene.object_numbers and 301 in scene.models()
    label = images.read_image(tmp_path / "out" / HOME / "label/0000.png")
    assert label.dtype == np.uint16 and 301 in label
    plain = images.read_image(write(source, tmp_path / "plain").folder / "label/0000.png")
    assert np.array_equal(np.where(label == 301, 7, label), plain)


def test_missing_masks_and_depth_are_refused_with_what_to_do(source, tmp_path):
    masks = source.masks
    source.masks = {}
    refused("realsim upgrade", write, source, tmp_path / "out")
    result = write(source, tmp_path / "bare", without_labels=True)
    assert result.counts["labels"] == 0 and not (result.folder / "label").exists()
    source.masks = masks
    source.depth_file(1).unlink()
    refused("no depth image", write, source, tmp_path / "nothing")


def test_a_pixel_of_two_masks_is_the_nearer_objects(source, tmp_path):
    both = source.masks[0, 0, True] | source.masks[0, 1, True]
    source.masks[0, 0, True] = source.masks[0, 1, True] = both
    result = write(source, tmp_path / "out")
    assert any(f"{both.sum()} pixels were in two masks" in n for n in result.notes)
    objects = source.frame(0).objects
    nearer = min(objects[:2], key=lambda o: o.T_cam_obj[2, 3])
    label = images.read_image(result.folder / "label/0000.png")
    assert np.array_equal(label == nearer.obj_id, both)


def test_an_upgraded_pose_is_written_and_not_the_sources_old_text(source, tmp_path):
    write(source, tmp_path / "out")
    scene = opened(tmp_path / "out")
    frame = scene.frame(0)
    nudge = se3.from_translation([0.0004, 0.0, 0.0])
    moved = [replace(o, T_cam_obj=nudge @ o.T_cam_obj) for o in frame.objects]
    source.frames = {0: replace(frame, objects=tuple(moved))}
    write(source, tmp_path / "again")
    after = opened(tmp_path / "again").frame(0)
    for a, b in zip(frame.objects, after.objects, strict=True):
        assert abs(b.T_cam_obj[0, 3] - a.T_cam_obj[0, 3] - 0.0004) < 1e-7


def test_a_textured_model_comes_back_with_its_texture(source, tmp_path):
    rng = np.random.default_rng(2)
    plain = MODELS[1].mesh
    texture = rng.integers(0, 255, (16, 32, 3), dtype=np.uint8)
    mesh = replace(plain, colors=None, uv=rng.uniform(0, 1, (8, 2)), texture=texture)
    source.models_by_id = {1: replace(MODELS[1], mesh=mesh)}
    result = write(source, tmp_path / "out")
    assert any("no mesh of object(s) 006, 029" in n for n in result.notes)
    found = load_mesh(tmp_path / "out/models/000/textured.obj", "m")
    assert np.array_equal(found.texture, mesh.texture)
    assert np.abs(found.vertices[found.faces] - mesh.vertices[mesh.faces]).max() < 1e-8
    assert np.abs(found.uv[found.faces] - mesh.uv[mesh.faces]).max() < 1e-8


def test_grasp_labels_go_along_with_a_graspnet_source_that_keeps_its_numbers(source, tmp_path):
    write(source, tmp_path / "out")
    rng = np.random.default_rng(3)
    names = (
        f"{HOME}/rect/0001.npy", "scenes/scene_0003/rs_wrt_kn.npy", "grasp_label/006_labels.npz",
        "collision_label/scene_0003/collision_labels.npz",
    )  # fmt: skip
    for name in (*names, "grasp_label/050_labels.npz"):
        path = tmp_path / "out" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(rng.bytes(100))
    result = write(opened(tmp_path / "out"), tmp_path / "again", number=9)
    assert result.counts["copied_labels"] == 3
    for name in names:
        after = tmp_path / "again" / name.replace("scene_0003", "scene_0009")
        assert after.read_bytes() == (tmp_path / "out" / name).read_bytes()
    assert not (tmp_path / "again/grasp_label/050_labels.npz").exists()
    mapped = write(RenumberedScene(opened(tmp_path / "out"), {7: 8}), tmp_path / "mapped")
    assert mapped.counts["copied_labels"] == 0 and not (mapped.folder / "rect").exists()


def test_images_of_several_cameras_keep_their_own_matrix_in_the_meta_files(source, tmp_path):
    other = replace(INTRINSICS, fx=150.2, fy=151.2, cx=78.9)
    source.frames[1] = replace(source.frames[1], intrinsics=other)
    result = write(source, tmp_path / "out")
    assert any("different camera matrices (up to 0.20 px)" in n for n in result.notes)
    scene = opened(tmp_path / "out")
    assert scene.frame(1).intrinsics.cx == 78.9 and scene.frame(0).intrinsics.cx == 78.7
