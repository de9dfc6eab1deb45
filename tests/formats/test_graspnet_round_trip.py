"""GraspNet's tree, out and in again: equal to the last digit that the format keeps."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from file_trees import bytes_of
from labelled_scenes import MODELS, TABLE, labelled_scene
from realsim import images
from realsim.errors import InputError
from realsim.formats.bop.models import save_models
from realsim.formats.bop.opening import open_labelled_bop
from realsim.formats.bop.writing import BopWriteConfig, write_bop_scene
from realsim.formats.export_folder import ExportFolder
from realsim.formats.graspnet.annotations import read_objects
from realsim.formats.graspnet.opening import open_scene
from realsim.formats.graspnet.tree import open_graspnet
from realsim.formats.graspnet.writing import GraspnetWriteConfig, write_graspnet_scene
from realsim.geometry import se3

SINGLE_M, SINGLE_RAD = 1e-7, 1e-6
HOME = "scenes/scene_0003/realsense"


def written(scene, out, **config):
    folder = ExportFolder.begin(out, {"what": "test"})
    return write_graspnet_scene(scene, folder, GraspnetWriteConfig(**config))


def opened(out, **which):
    (ref,) = open_graspnet(out, **which).scenes
    return open_scene(ref)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return labelled_scene(tmp_path_factory.mktemp("source"))


@pytest.fixture(scope="module")
def tree(source, tmp_path_factory):
    out = tmp_path_factory.mktemp("tree") / "out"
    written(source, out)
    return out


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
        assert [o.obj_id for o in after.objects] == [o.obj_id for o in before.objects]
        assert [o.instance for o in after.objects] == [0, 1, 2]
        for a, b in zip(before.objects, after.objects, strict=True):
            off = se3.invert(a.T_cam_obj) @ b.T_cam_obj
            assert np.linalg.norm(off[:3, 3]) < SINGLE_M and se3.angle(off) < SINGLE_RAD


def test_without_meta_files_poses_come_back_from_the_text(source, tree, tmp_path):
    import shutil

    bare = tmp_path / "bare"
    shutil.copytree(tree, bare)
    shutil.rmtree(bare / HOME / "meta")
    scene = opened(bare)
    assert any("no meta file" in n for n in scene.notes)
    worst_mm = worst_deg = 0.0
    for index in source.indices:
        pairs = zip(source.frame(index).objects, scene.frame(index).objects, strict=True)
        for a, b in pairs:
            off = se3.invert(a.T_cam_obj) @ b.T_cam_obj
            worst_mm = max(worst_mm, 1e3 * np.linalg.norm(off[:3, 3]))
            worst_deg = max(worst_deg, float(np.degrees(se3.angle(off))))
    assert worst_mm < 1e-5 and worst_deg < 1e-5


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
        assert [o.obj_id for o in a.objects] == [o.obj_id for o in b.objects]
        assert np.abs(a.T_world_cam - b.T_world_cam).max() < 1e-9
        assert np.abs(a.intrinsics.K - b.intrinsics.K).max() < 1e-9
        for k, (x, y) in enumerate(zip(a.objects, b.objects, strict=True)):
            off = se3.invert(x.T_cam_obj) @ y.T_cam_obj
            assert np.linalg.norm(off[:3, 3]) < SINGLE_M and se3.angle(off) < SINGLE_RAD
            assert np.array_equal(
                bop.mask(index, k, visible=True), again.mask(index, k, visible=True)
            )
        for file in (bop.colour_file, bop.depth_file):
            other = getattr(again, file.__name__)(index)
            assert np.array_equal(images.read_image(file(index)), images.read_image(other))


def test_a_table_that_is_upside_down_is_named(tmp_path):
    written(labelled_scene(tmp_path / "images"), tmp_path / "tree")
    file = next((tmp_path / "tree").glob("scenes/*/*/cam0_wrt_table.npy"))
    np.save(file, np.linalg.inv(np.load(file)))
    with pytest.raises(InputError, match="seems to be inverted: as the pose of camera 0"):
        open_scene(open_graspnet(tmp_path / "tree").scenes[0])
