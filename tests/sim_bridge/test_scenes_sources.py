"""Scenes of other programs: recognised by content, with everything physics needs."""

import numpy as np
import pytest

from realsim.errors import InputError
from realsim.formats.bop.models import save_models
from realsim.geometry import se3
from realsim.records import Mesh, ObjectModel
from realsim.store.atomic import write_json
from realsim_sim_bridge.scenes.importers import from_bop, load_scene_source
from realsim_sim_bridge.scenes.school_scene import Matter
from realsim_sim_bridge.scenes.stable_state import stable_state
from realsim_sim_bridge.scenes.table_world import TableWorld
from refusals import refused

SIZE = (0.06, 0.08, 0.1)


def block():
    import trimesh

    shape = trimesh.creation.box(SIZE)
    return Mesh(vertices=np.array(shape.vertices), faces=np.array(shape.faces))


def write_bop(root, cameras=1, with_poses=False, depth=True):
    """Write a dataset of one scene: two blocks on a table, seen by cameras that look down at it."""
    import cv2

    from realsim.geometry.camera import ray_table
    from realsim.records import CameraIntrinsics

    folder = root / "test" / "000003"
    K = CameraIntrinsics(fx=200.0, fy=200.0, cx=159.5, cy=119.5, width=320, height=240)
    camera, truth = {}, {}
    placed = [se3.from_translation([x, 0.0, SIZE[2] / 2]) for x in (-0.1, 0.12)]
    for k in range(cameras):
        T_world_cam = se3.look_at([0.15 * k, -0.5, 0.5], [0.0, 0.0, 0.0])
        entry = {"cam_K": K.K.ravel().tolist(), "depth_scale": 0.1}
        if with_poses:
            T = se3.invert(T_world_cam)
            entry |= {"cam_R_w2c": T[:3, :3].ravel().tolist()}
            entry |= {"cam_t_w2c": (1e3 * T[:3, 3]).tolist()}
        camera[str(k)] = entry
        Ts = [se3.invert(T_world_cam) @ T for T in placed]
        truth[str(k)] = [
            {
                "obj_id": 4,
                "cam_R_m2c": T[:3, :3].ravel().tolist(),
                "cam_t_m2c": (1e3 * T[:3, 3]).tolist(),
            }
            for T in Ts
        ]
        rays = ray_table(K) @ T_world_cam[:3, :3].T
        z = -T_world_cam[2, 3] / rays[..., 2]  # rays have z = 1 in the camera: depth of the table
        for name, image in (
            ("rgb", np.full((240, 320, 3), 90, np.uint8)),
            ("depth", np.where((z > 0) & (z < 3), z * 1e4, 0).astype(np.uint16)),
        ):
            if name == "depth" and not depth:
                continue
            (folder / name).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / name / f"{k:06d}.png"), image)
    write_json(folder / "scene_camera.json", camera)
    write_json(folder / "scene_gt.json", truth)
    save_models(root / "models", {4: ObjectModel(obj_id=4, name="block", mesh=block())})
    return root


@pytest.mark.parametrize(("cameras", "with_poses"), [(3, True), (1, False)])
def test_a_bop_scene_stands_on_the_table_that_its_depth_shows(tmp_path, cameras, with_poses):
    scene = load_scene_source(write_bop(tmp_path, cameras, with_poses))
    assert [o.obj_id for o in scene.scene.objects] == [4, 4]
    assert list(scene.names().values()) == ["block #0", "block #1"]
    for o, x in zip(scene.scene.objects, (-0.1, 0.12), strict=True):
        T = scene.T_table_world @ o.T_world_obj
        assert T[2, 3] == pytest.approx(SIZE[2] / 2, abs=5e-4)
        if with_poses:
            assert np.allclose(o.T_world_obj, se3.from_translation([x, 0, SIZE[2] / 2]), atol=1e-6)
    with TableWorld(scene) as world:
        assert stable_state(world).stable


def test_bop_scenes_that_lack_something_are_refused(tmp_path):
    with pytest.raises(InputError, match="no image with annotated objects and depth"):
        from_bop(write_bop(tmp_path / "a", depth=False))
    refused("image 7", from_bop, write_bop(tmp_path / "b"), image=7)
    refused("no scene 9", load_scene_source, tmp_path / "b", scene_id=9)


def test_a_weighed_mass_reaches_the_engine(tmp_path):
    scene = load_scene_source(write_bop(tmp_path), Matter(masses_kg={4: 0.321}))
    assert scene.solids[4].matter.mass_kg == pytest.approx(0.321)
    with TableWorld(scene) as world:
        info = world._engine.getDynamicsInfo(world.bodies[0], -1)
    sides = np.array(SIZE) ** 2
    moments = 0.321 / 12 * np.array([sides[1] + sides[2], sides[0] + sides[2], sides[0] + sides[1]])
    assert info[0] == pytest.approx(0.321)
    assert np.allclose(sorted(info[2]), sorted(moments), rtol=1e-6)


def test_what_is_no_scene_is_named_with_what_was_found(tmp_path):
    (tmp_path / "photo.jpg").write_bytes(b"")
    refused(r"photo\.jpg.*scene\.yaml.*GraspNet.*BOP", load_scene_source, tmp_path)
    refused(r"file of the kind '\.jpg'", load_scene_source, tmp_path / "photo.jpg")
    refused("does not exist", load_scene_source, tmp_path / "gone")
