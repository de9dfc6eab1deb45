"""GraspNet's tree, out and in again: equal to the last digit that the format keeps."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from file_trees import bytes_of
from labelled_scenes import MODELS, TABLE, labelled_scene
from labelled_scenes import graspnet_tree as written
from labelled_scenes import opened_graspnet as opened
from realsim import images
from realsim.errors import InputError, NotRigidError, UnitError
from realsim.formats.bop.models import save_models
from realsim.formats.bop.opening import open_labelled_bop
from realsim.formats.bop.writing import BopWriteConfig, write_bop_scene
from realsim.formats.export_folder import ExportFolder
from realsim.formats.graspnet.annotations import annotation_bytes, read_objects
from realsim.formats.graspnet.image_objects import meta_bytes, read_meta
from realsim.formats.graspnet.opening import open_graspnet_frame, open_scene
from realsim.formats.graspnet.scene import open_graspnet
from realsim.geometry import se3
from refusals import refused

SINGLE_M, SINGLE_RAD = 1e-7, 1e-6
HOME = "scenes/scene_0003/realsense"
MM = np.diag([1e3, 1e3, 1e3, 1.0])


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return labelled_scene(tmp_path_factory.mktemp("source"))


@pytest.fixture(scope="module")
def tree(source, tmp_path_factory):
    out = tmp_path_factory.mktemp("tree") / "out"
    written(source, out)
    return out


def same_poses(a, b, most_m=SINGLE_M, most_rad=SINGLE_RAD):
    """Hold that two frames have the same objects, at the same poses."""
    assert [o.obj_id for o in a.objects] == [o.obj_id for o in b.objects]
    for x, y in zip(a.objects, b.objects, strict=True):
        off = se3.invert(x.T_cam_obj) @ y.T_cam_obj
        assert np.linalg.norm(off[:3, 3]) < most_m and se3.angle(off) < most_rad


def tree_bytes(folder):
    return {k: v for k, v in bytes_of(folder).items() if ".export" not in k.split("/")}


def test_a_tree_written_again_is_the_same_byte_by_byte(tree, tmp_path):
    again = tmp_path / "again"
    written(opened(tree), again)
    assert tree_bytes(again) == tree_bytes(tree)
    assert len(tree_bytes(tree)) == 6 * 5 + 3 + 1 + 3 * 3


def test_poses_come_back_to_single_precision_and_cameras_exactly(source, tree):
    scene = opened(tree)
    assert scene.indices == source.indices and scene.number == 3 and scene.camera == "realsense"
    assert np.array_equal(scene.T_world_table, np.eye(4))
    for index in source.indices:
        before, after = source.frame(index), scene.frame(index)
        T_table_cam = se3.invert(TABLE) @ before.T_world_cam
        assert np.abs(T_table_cam - after.T_world_cam).max() < 1e-12
        assert np.abs(before.intrinsics.K - after.intrinsics.K).max() == 0
        assert [o.instance for o in after.objects] == [0, 1, 2]
        same_poses(before, after)


def test_without_meta_files_poses_come_back_from_the_text(source, tree, tmp_path):
    bare = tmp_path / "bare"
    shutil.copytree(tree, bare)
    shutil.rmtree(bare / HOME / "meta")
    scene = opened(bare)
    assert any("no meta file" in n for n in scene.notes)
    for index in source.indices:
        same_poses(source.frame(index), scene.frame(index), 1e-8, np.radians(1e-5))


def test_models_come_back_in_metres(tree):
    models = opened(tree).models()
    assert models.keys() == MODELS.keys()
    for i, model in models.items():
        assert np.abs(model.mesh.vertices - MODELS[i].mesh.vertices).max() < 1e-8
        assert np.array_equal(model.mesh.faces, MODELS[i].mesh.faces)
        assert np.array_equal(model.mesh.colors, MODELS[i].mesh.colors)


def test_points_lie_on_the_models_by_the_formulas_of_graspnetapi(tree):
    """generate_scene_pointcloud and generate_scene_model, aligned with the table."""
    home = tree / HOME
    K, first = np.load(home / "camK.npy"), np.load(home / "cam0_wrt_table.npy")
    looked = 0
    for index in range(6):
        camera_pose = first @ np.load(home / "camera_poses.npy")[index]
        depth = images.read_image(home / f"depth/{index:04d}.png") / 1000.0
        label = images.read_image(home / f"label/{index:04d}.png")
        rows, columns = np.mgrid[: depth.shape[0], : depth.shape[1]]
        x = (columns - K[0, 2]) / K[0, 0] * depth
        y = (rows - K[1, 2]) / K[1, 1] * depth
        cloud = np.stack([x, y, depth], -1)
        for o in read_objects(home / f"annotations/{index:04d}.xml"):
            q = np.array([float(v) for v in o.fields["ori_in_world"].split()])
            pose = np.eye(4)
            pose[:3, :3] = Rotation.from_quat(np.roll(q, -1)).as_matrix()
            pose[:3, 3] = [float(v) for v in o.fields["pos_in_world"].split()]
            pose = camera_pose @ pose
            on_table = se3.transform(camera_pose, cloud[(label == o.number + 1) & (depth > 0)])
            in_model = se3.transform(np.linalg.inv(pose), on_table)
            half = MODELS[o.number + 1].mesh.extent / 2
            # Depth is rounded to 1 mm along rays that are up to 31 degrees off the axis.
            assert np.all(np.abs(in_model) < half + 1e-3)
            assert np.all(np.max(np.abs(in_model) - half, axis=1) > -1e-3)
            looked += len(in_model)
        assert np.abs(cloud[label == 0]).size
    assert looked > 5000


def test_bop_to_graspnet_to_bop_gives_the_same_poses_ids_and_pixels(source, tmp_path):
    folder = ExportFolder.begin(tmp_path / "bop", {})
    write_bop_scene(source, folder, BopWriteConfig())
    save_models(tmp_path / "bop/models", MODELS)
    bop = open_labelled_bop(tmp_path / "bop")
    result = written(bop, tmp_path / "graspnet", table_is_world=True)
    assert any("NO TABLE IS KNOWN" in n for n in result.notes)
    middle = opened(tmp_path / "graspnet")
    folder = ExportFolder.begin(tmp_path / "again", {})
    write_bop_scene(middle, folder, BopWriteConfig(camera=""))
    save_models(tmp_path / "again/models", middle.models())
    again = open_labelled_bop(tmp_path / "again")
    assert again.indices == bop.indices
    for index in bop.indices:
        a, b = bop.frame(index), again.frame(index)
        assert np.abs(a.T_world_cam - b.T_world_cam).max() < 1e-9
        assert np.abs(a.intrinsics.K - b.intrinsics.K).max() < 1e-9
        same_poses(a, b)
        for k in range(len(a.objects)):
            masks = [scene.mask(index, k, visible=True) for scene in (bop, again)]
            assert np.array_equal(*masks)
        for file in (bop.colour_file, bop.depth_file):
            other = getattr(again, file.__name__)(index)
            assert np.array_equal(images.read_image(file(index)), images.read_image(other))


# --- A GraspNet tree that does not mean what the format says is refused with the evidence.


@pytest.fixture
def root(tree, tmp_path):
    return Path(shutil.copytree(tree, tmp_path / "root"))


def home(root):
    return root / HOME


def change_annotations(root, change):
    """Write all annotations with their objects' texts changed; without the meta files."""
    shutil.rmtree(home(root) / "meta", ignore_errors=True)
    for path in sorted((home(root) / "annotations").iterdir()):
        rows = [change(dict(o.fields)) for o in read_objects(path)]
        path.write_bytes(annotation_bytes(rows))


def change_meta(path, **changed):
    """Write a meta file again with some of its values changed."""
    m = read_meta(path)
    values = {"numbers": m.numbers, "poses": m.poses, "K": m.K, "factor_depth": m.factor_depth}
    path.write_bytes(meta_bytes(**values | changed))


@pytest.mark.parametrize(
    ("file", "change", "error", "says"),
    [
        ("camera_poses", se3.invert, InputError,
         r"inverted poses.*wander by \d+\.\d mm.*by 0\.\d mm"),
        ("cam0_wrt_table", np.linalg.inv, InputError,
         "seems to be inverted: as the pose of camera 0"),
        ("camera_poses", lambda Ts: np.roll(Ts, 1, axis=0), InputError,
         "contradicts the annotations"),
        ("camera_poses", lambda Ts: MM @ Ts @ np.linalg.inv(MM), UnitError, "millimetres"),
        ("camera_poses", lambda Ts: Ts[:4], InputError,
         "holds 4 poses, and there are 6 images"),
    ],
)  # fmt: skip
def test_camera_poses_that_cannot_be_are_named(root, file, change, error, says):
    path = home(root) / f"{file}.npy"
    np.save(path, change(np.load(path)))
    refused(says, opened, root, error=error)


def test_millimetres_of_objects_are_named_wherever_they_are(root):
    path = home(root) / "meta/0000.mat"
    change_meta(path, poses=read_meta(path).poses * [1, 1, 1, 1000])
    refused("millimetres", opened, root, error=UnitError)

    def in_mm(fields):
        t = np.array(fields["pos_in_world"].split(), float) * 1000
        return fields | {"pos_in_world": " ".join(f"{x:.4f}" for x in t)}

    change_annotations(root, in_mm)
    refused("millimetres", opened, root, error=UnitError)


def swapped(fields):
    w, x, y, z = fields["ori_in_world"].split()
    return fields | {"ori_in_world": f"{x} {y} {z} {w}"}


def test_quaternions_in_another_order_are_named_by_the_views_and_by_the_meta_files(root):
    kept = home(root).parent / "kept"
    shutil.copytree(home(root) / "meta", kept)
    change_annotations(root, swapped)
    refused(r"x y z w: over 6 images.*turn by \d+\.\d deg", opened, root)
    shutil.copytree(kept, home(root) / "meta")
    refused(r"0000\.xml and .*0000\.mat disagree.*x y z w", opened, root)


def test_depth_of_another_unit_is_named_with_the_factor_that_would_fit(root):
    for path in (home(root) / "meta").iterdir():
        change_meta(path, factor_depth=10000.0)
    said = refused(r"counts per metre \(factor_depth", opened, root, error=UnitError)
    assert 900 < float(said.split("about ")[1].split()[0]) < 1050


def test_two_files_that_disagree_are_both_named(root):
    path = home(root) / "meta/0000.mat"
    m = read_meta(path)
    poses = m.poses.copy()
    poses[1, 0, 3] += 0.0003
    change_meta(path, poses=poses)
    refused(r"0000\.xml and .*0000\.mat disagree about object 006", opened, root)
    change_meta(path, poses=m.poses, numbers=(0, 7, 29))
    refused(r"do not have the same objects: \[0, 6, 29\] and", opened, root)
    change_meta(path, numbers=m.numbers[::-1], poses=m.poses[::-1])
    assert [o.obj_id for o in opened(root).frame(0).objects] == [1, 7, 30]
    change_meta(path, K=m.K + np.diag([1.0, 0, 0]))
    refused(r"camK\.npy and intrinsic_matrix .* 1\.00 px", opened, root)


def test_a_pose_and_an_annotation_too_many_are_told(root):
    path = home(root) / "camera_poses.npy"
    np.save(path, np.concatenate([np.load(path), np.load(path)[:1]]))
    (home(root) / "rgb/0002.png").unlink()
    notes = " ".join(opened(root).notes)
    assert "1 annotation(s) without image: 2" in notes
    assert "2 pose(s) in camera_poses.npy without image: 2, 6" in notes
    refused("no image 2", opened(root).frame, 2)


def test_labels_elsewhere_are_refused_and_strange_values_counted(root):
    folder = home(root) / "label"
    labels = {p: images.read_image(p) for p in sorted(folder.iterdir())}
    for path, label in labels.items():
        own = label.copy()
        own[label == 30] = 77
        path.write_bytes(images.png_bytes(own))
    notes = " ".join(opened(root).notes)
    assert "of 3 of 3 images looked at have values without an object: 77" in notes
    assert "3 annotated objects have no labelled pixel" in notes
    values = np.zeros(256, np.uint8)
    values[[1, 7, 30]] = 0, 6, 29  # without the one that is added
    for change, says in (
        (lambda a: np.roll(a, (60, 80), axis=(0, 1)), r"only 1 are where .*number \+ 1\)"),
        (lambda a: values[a], r"only 0 are .* 6 if a value is the number itself"),
        (lambda a: a[::2].copy(), "160x60 pixels"),
    ):
        for path, label in labels.items():
            path.write_bytes(images.png_bytes(change(label)))
        refused(says, opened, root)


def test_equal_objects_are_told_apart_by_where_they_stand_and_have_no_masks(root):
    (home(root).parent / "object_id_list.txt").unlink()

    def as_one(fields):
        return fields | {"obj_id": "6"} if fields["obj_id"] == "29" else fields

    change_annotations(root, as_one)
    odd = home(root) / "annotations/0001.xml"
    odd.write_bytes(annotation_bytes([o.fields for o in read_objects(odd)][::-1]))
    scene = opened(root)
    for index, order in ((0, [0, 1, 2]), (1, [2, 1, 0]), (5, [0, 1, 2])):
        assert [o.instance for o in scene.frame(index).objects] == order
    assert scene.mask(0, 0, visible=True).any() and scene.mask(0, 1, visible=True) is None
    assert any("told apart by where they stand" in n for n in scene.notes)


def test_incomplete_trees_are_read_and_what_is_missing_is_said(root):
    for name in ("camera_poses.npy", "cam0_wrt_table.npy", "camK.npy"):
        (home(root) / name).unlink()
    shutil.rmtree(root / "models")
    shutil.rmtree(home(root) / "label")
    shutil.rmtree(home(root) / "annotations")
    scene = opened(root)
    frame = scene.frame(4)
    assert frame.T_world_cam is None and scene.T_world_table is None and not scene.models()
    assert scene.mask(4, 0, visible=True) is None and len(frame.objects) == 3
    notes = " ".join(scene.notes)
    for what in ("camera_poses.npy", "folder 'models'", "no label image", "no annotation"):
        assert what in notes
    shutil.rmtree(home(root) / "meta")
    refused("no scene of GraspNet", opened, root)


def test_a_tree_is_found_from_its_root_its_scenes_a_scene_and_a_camera(root):
    shutil.copytree(home(root), home(root).parent / "kinect")
    for place in (root, root / "scenes", home(root).parent):
        found = open_graspnet(place).scenes
        assert [r.name for r in found] == ["scene_0003-kinect", "scene_0003-realsense"]
        assert all(r.models == root / "models" for r in found)
    (ref,) = open_graspnet(home(root)).scenes
    assert ref.camera == "realsense" and open_scene(ref).split == "train"
    assert [r.camera for r in open_graspnet(root, cameras=["kinect"]).scenes] == ["kinect"]
    refused("no scene 4; it has 3", open_graspnet, root, scenes=[4])
    refused("no camera 'azure'", open_graspnet, root, cameras=["azure"])


def test_a_meta_file_with_a_mirrored_pose_is_refused(root):
    path = home(root) / "meta/0000.mat"
    poses = read_meta(path).poses.copy()
    poses[0, :, :3] *= -1
    change_meta(path, poses=poses)
    refused("mirrored", opened, root, error=NotRigidError)


def test_one_frame_on_its_own_is_read_and_its_depth_is_checked(root, tmp_path):
    folder = tmp_path / "one"
    folder.mkdir()
    for kind, name in (("rgb", "color.png"), ("depth", "depth.png")):
        shutil.copy(home(root) / kind / "0000.png", folder / name)
    shutil.copy(home(root) / "meta/0000.mat", folder / "meta.mat")
    scene = open_graspnet_frame(folder, models=root / "models")
    tree = opened(root)
    assert [o.obj_id for o in scene.frame(0).objects] == [1, 7, 30] and scene.indices == (0,)
    for a, b in zip(scene.frame(0).objects, tree.frame(0).objects, strict=True):
        assert np.array_equal(a.T_cam_obj, b.T_cam_obj)
    assert scene.models().keys() == {1, 7, 30} and scene.mask(0, 0, visible=True) is None
    change_meta(folder / "meta.mat", factor_depth=100.0)
    refused("counts per metre", open_graspnet_frame, folder, error=UnitError)
    (folder / "depth.png").unlink()
    refused(r"has no depth\.png", open_graspnet_frame, folder)
