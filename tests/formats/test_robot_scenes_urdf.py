"""Folders of URDFs: read back by PyBullet and Pinocchio, at rest in PyBullet."""

import importlib.util
import json

import numpy as np
import pybullet
import pytest
import trimesh
from PIL import Image
from pybullet_utils.bullet_client import BulletClient

from realsim.formats.export_folder import ExportFolder
from realsim.formats.robot_scenes.urdf import write_urdf_scene
from realsim.interop import T_from_pybullet, import_pinocchio, quiet_output

WRITE = write_urdf_scene


@pytest.fixture
def loaded(folder):
    """Return the engine, the script's module and the bodies that it loaded."""
    spec = importlib.util.spec_from_file_location("loader", folder / "load_pybullet.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    with quiet_output():
        engine = BulletClient(pybullet.DIRECT)
    yield engine, script, script.load_scene(engine, folder)
    engine._client >= 0 and pybullet.disconnect(engine._client)


def pose_of(engine, script, body):
    return T_from_pybullet(*script.link_pose(engine, body))


def test_scene_json_and_the_meshes_hold_every_digit(scene, folder):
    data = json.loads((folder / "scene.json").read_text())
    assert data["gravity"] == scene.gravity.tolist()
    camera, known = data["cameras"][0], scene.cameras[0]
    assert camera["K"] == known.intrinsics.K.tolist()
    assert camera["T_world_cam"] == known.T_world_cam.tolist()
    for told, o in zip(data["objects"], scene.objects, strict=True):
        assert told["T_world_obj"] == o.T_world_obj.tolist()
        seen = scene.body(o).model.mesh
        path = folder / told["urdf"].replace("objects/", "objects/meshes/").removesuffix(".urdf")
        found = trimesh.load_mesh(path / "visual.obj", process=False)
        assert np.array_equal(found.triangles, seen.vertices[seen.faces])
    texture = np.array(Image.open(folder / "objects/meshes/_2_box/texture.png"))
    assert np.array_equal(texture, scene.bodies[2].model.mesh.texture)


def test_pinocchio_finds_the_same_scene_in_the_world_file(scene, folder):
    pinocchio = import_pinocchio()
    model = pinocchio.buildModelFromUrdf(str(folder / "world.urdf"))
    data = model.createData()
    pinocchio.framesForwardKinematics(model, data, pinocchio.neutral(model))
    for o in scene.objects:
        known = scene.body(o)
        joint = model.getJointId(f"world_to_{o.name}")
        assert np.allclose(data.oMi[joint].homogeneous, o.T_world_obj, rtol=0, atol=1e-14)
        found = model.inertias[joint]
        assert found.mass == known.mass_kg
        assert np.allclose(found.lever, known.center_of_mass, rtol=0, atol=1e-15)
        largest = np.abs(known.inertia).max()
        assert np.allclose(found.inertia, known.inertia, rtol=0, atol=1e-12 * largest)
    frame = data.oMf[model.getFrameId("table")].homogeneous
    assert np.allclose(frame, scene.table.T_world_table, rtol=0, atol=1e-12)


def test_pybullet_finds_masses_inertias_poses_and_parts(scene, loaded):
    engine, script, bodies = loaded
    assert set(bodies) == {"table", *(o.name for o in scene.objects)}
    for o in scene.objects:
        body, known = bodies[o.name], scene.body(o)
        info = engine.getDynamicsInfo(body, -1)
        R = np.array(engine.getMatrixFromQuaternion(info[4])).reshape(3, 3)
        inertia = R @ np.diag(info[2]) @ R.T
        assert np.isclose(info[0], known.mass_kg, rtol=1e-9)
        assert np.allclose(inertia, known.inertia, rtol=0, atol=1e-6 * known.inertia.max())
        assert np.allclose(info[3], known.center_of_mass, rtol=0, atol=1e-9)
        assert np.isclose(info[1], known.friction)
        shapes = engine.getCollisionShapeData(body, -1)
        assert len(shapes) == (1 if known.parts is None else len(known.parts))
        assert np.allclose(pose_of(engine, script, body), o.T_world_obj, rtol=0, atol=1e-6)
    assert engine.getDynamicsInfo(bodies["table"], -1)[1] == 1.0


def test_the_objects_rest_where_they_were_registered(scene, loaded):
    """No jump in the first milliseconds, no fall, no creep worth a word in half a second."""
    engine, script, bodies = loaded
    for _ in range(120):
        engine.stepSimulation()
        for o in scene.objects:
            T = pose_of(engine, script, bodies[o.name])
            assert np.abs(T - o.T_world_obj)[:3, 3].max() < 3e-4
            assert np.linalg.norm(engine.getBaseVelocity(bodies[o.name])[0]) < 0.05


def test_several_scenes_go_into_one_export(scene, tmp_path):
    out = ExportFolder.begin(tmp_path / "out", {})
    steps = []
    for name in ("a", "b"):
        place = out.below(f"scenes/{name}")
        told = write_urdf_scene(scene, place, progress=lambda: steps.append(1))
        assert told.folder == tmp_path / "out/scenes" / name
        assert told.objects == 3 and told.counts["collision shapes"] == 3
    out.finish({})
    for name in ("a", "b"):
        data = json.loads((tmp_path / "out/scenes" / name / "scene.json").read_text())
        assert [o["name"] for o in data["objects"]] == [o.name for o in scene.objects]
    assert len(steps) == 4
