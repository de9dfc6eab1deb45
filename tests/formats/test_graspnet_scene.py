"""GraspNet-1Billion's scenes: objects come back in the table's frame, whatever camera saw them."""

import numpy as np
import pytest

from realsim.errors import NotRigidError
from realsim.formats.graspnet.scene import read_annotation, read_graspnet_scene
from realsim.geometry import se3
from refusals import refused

NUMBERS = (0, 27, 5)
DECIMALS_M = 1e-4
"""The text has four decimals: half of the last one on each axis, and on the quaternion."""


def poses_on_table():
    Ts = se3.random_transform(np.random.default_rng(4), len(NUMBERS), spread=0.2)
    return dict(zip(NUMBERS, Ts, strict=True))


def cameras():
    rng = np.random.default_rng(8)
    first = se3.random_transform(rng)
    relative = se3.random_transform(rng, 3, spread=0.3)
    relative[0] = np.eye(4)
    return first, relative


def annotation(Ts_cam_obj):
    rows = []
    for number, T in Ts_cam_obj.items():
        q, t = se3.quaternion_wxyz(T[:3, :3]), T[:3, 3]
        rows.append(
            f"<obj><obj_id>{number}</obj_id><obj_name>{number:03d}.ply</obj_name>"
            f"<obj_path>models/{number:03d}.ply</obj_path>"
            f"<pos_in_world>{t[0]:.4f} {t[1]:.4f} {t[2]:.4f}</pos_in_world>"
            f"<ori_in_world>{q[0]:.4f} {q[1]:.4f} {q[2]:.4f} {q[3]:.4f}</ori_in_world></obj>"
        )
    return f"<scene>{''.join(rows)}</scene>"


@pytest.fixture
def dataset(tmp_path):
    import trimesh

    first, relative = cameras()
    root = tmp_path / "scenes" / "scene_0007" / "kinect"
    (root / "annotations").mkdir(parents=True)
    np.save(root / "camera_poses.npy", relative)
    np.save(root / "cam0_wrt_table.npy", first)
    for i, T in enumerate(relative):
        inverse = se3.invert(first @ T)
        seen = {n: inverse @ T_obj for n, T_obj in poses_on_table().items()}
        (root / "annotations" / f"{i:04d}.xml").write_text(annotation(seen))
    for n in NUMBERS:
        folder = tmp_path / "models" / f"{n:03d}"
        folder.mkdir(parents=True)
        mesh = trimesh.creation.box((0.05, 0.06, 0.1))
        (folder / "nontextured.ply").write_bytes(mesh.export(file_type="ply"))
    return tmp_path


def scene_of(dataset):
    return dataset / "scenes" / "scene_0007"


def test_the_poses_on_the_table_are_the_same_from_every_image(dataset):
    found = read_graspnet_scene(scene_of(dataset))
    for o, (number, T) in zip(found.scene.objects, poses_on_table().items(), strict=True):
        assert o.obj_id == number + 1
        off = se3.invert(T) @ o.T_world_obj
        assert np.linalg.norm(off[:3, 3]) < 2 * DECIMALS_M and se3.angle(off) < 4 * DECIMALS_M
    assert np.array_equal(found.scene.plane.T_world_table, np.eye(4))
    assert found.models[28].name == "027" and found.scene.name == "scene_0007 kinect"
    assert not any("elsewhere" in n for n in found.notes)


def test_an_image_that_disagrees_is_named(dataset):
    path = scene_of(dataset) / "kinect/annotations/0002.xml"
    seen = read_annotation(path)
    seen[27] = se3.from_translation([0.02, 0, 0]) @ seen[27]
    path.write_text(annotation(seen))
    (note,) = [n for n in read_graspnet_scene(scene_of(dataset)).notes if "elsewhere" in n]
    assert "object 027" in note and "image 2" in note and "20." in note


def test_a_scene_without_objects_and_an_object_twice_are_named(dataset):
    path = scene_of(dataset) / "kinect/annotations/0000.xml"
    text = path.read_text()
    path.write_text(text.replace("<obj_id>27<", "<obj_id>0<"))
    refused("each once", read_graspnet_scene, scene_of(dataset))
    path.write_text("<scene></scene>")
    refused("holds no <obj>", read_graspnet_scene, scene_of(dataset))


def test_missing_and_broken_files_are_named(dataset, tmp_path):
    refused("no realsense or kinect/camera_poses", read_graspnet_scene, tmp_path)
    refused("no mesh", read_graspnet_scene, scene_of(dataset), tmp_path)
    root = scene_of(dataset) / "kinect"
    (root / "annotations/0000.xml").rename(root / "annotations/0009.xml")
    refused("annotation of image 0", read_graspnet_scene, root)
    (root / "annotations/0009.xml").rename(root / "annotations/0000.xml")
    np.save(root / "cam0_wrt_table.npy", np.diag([1.0, 1.0, -1.0, 1.0]))
    refused("mirrored", read_graspnet_scene, scene_of(dataset), error=NotRigidError)
    np.save(root / "cam0_wrt_table.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    refused("only numbers", read_graspnet_scene, scene_of(dataset))
