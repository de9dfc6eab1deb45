"""Scenes as MJCF: read back by MuJoCo, and at rest there."""

import dataclasses

import mujoco
import numpy as np
import pytest

import placed_scenes
from realsim.formats.robot_scenes.mesh_obj import collision_parts, look_of
from realsim.formats.robot_scenes.mjcf import write_mjcf_scene


def write(scene, folder):
    return placed_scenes.written(write_mjcf_scene, scene, folder)


@pytest.fixture(scope="module")
def model(folder):
    return mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))


@pytest.fixture
def data(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def turned_by(quaternion):
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, quaternion)
    return R.reshape(3, 3)


def test_mujoco_finds_meshes_parts_and_textures(scene, model):
    """MuJoCo keeps meshes as float32, in their own principal frame."""
    for o in scene.objects:
        name, body = o.name, scene.body(o)
        geom = model.geom(f"{name}_visual")
        mesh = model.mesh(int(geom.dataid[0]))
        first = int(mesh.vertadr[0])
        points = model.mesh_vert[first : first + int(mesh.vertnum[0])]
        at = points @ turned_by(geom.quat).T + geom.pos
        known = body.model.mesh.vertices
        far = np.linalg.norm(at[:, None] - known[None], axis=2)
        assert far.min(axis=0).max() < 1e-8 and far.min(axis=1).max() < 1e-8
        parts = [g for g in range(model.ngeom) if model.geom(g).name.startswith(f"{name}_part")]
        assert len(parts) == len(collision_parts(body))
        texture = model.texture(int(model.mat_texid[int(geom.matid[0])].max()))
        look = look_of(body.model.mesh).texture
        assert (int(texture.height[0]), int(texture.width[0])) == look.shape[:2]


def test_mujoco_finds_masses_inertias_and_poses(scene, model, data):
    for o in scene.objects:
        body, known = model.body(o.name), scene.body(o)
        R = turned_by(body.iquat)
        inertia = R @ np.diag(body.inertia) @ R.T
        assert np.isclose(body.mass[0], known.mass_kg, rtol=1e-9)
        assert np.allclose(inertia, known.inertia, rtol=0, atol=1e-9 * known.inertia.max())
        assert np.allclose(body.ipos, known.center_of_mass, rtol=0, atol=1e-12)
        assert np.allclose(data.xpos[body.id], o.T_world_obj[:3, 3], rtol=0, atol=1e-12)
        assert np.allclose(data.xmat[body.id], o.T_world_obj[:3, :3].ravel(), rtol=0, atol=1e-12)


def test_the_objects_rest_where_they_were_registered_with_their_own_friction(scene, model, data):
    before = data.xpos.copy()
    for _ in range(250):
        mujoco.mj_step(model, data)
    assert np.abs(data.xpos - before).max() < 5e-5
    assert data.ncon >= 9
    frictions = {round(float(c.friction[0]), 6) for c in data.contact}
    assert frictions == {placed_scenes.FRICTION}
    touching = {model.geom(int(g)).name for c in data.contact for g in c.geom}
    assert "table" in touching and not any("visual" in name for name in touching)


def test_the_cameras_frustum_is_that_of_its_intrinsics(scene, model, data):
    view, camera = mujoco.MjvScene(model, 100), mujoco.MjvCamera()
    camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
    mujoco.mjv_updateScene(
        model, data, mujoco.MjvOption(), None, camera, mujoco.mjtCatBit.mjCAT_ALL, view
    )
    K, eye = placed_scenes.CAMERA, view.camera[0]
    left, right = (-0.5 - K.cx) / K.fx, (K.width - 0.5 - K.cx) / K.fx
    top, bottom = (K.cy + 0.5) / K.fy, (K.cy + 0.5 - K.height) / K.fy
    found = np.array([eye.frustum_center, eye.frustum_width, eye.frustum_top, eye.frustum_bottom])
    wanted = [(left + right) / 2, (right - left) / 2, top, bottom]
    assert np.allclose(found / eye.frustum_near, wanted, atol=1e-5)
    T = scene.cameras[0].T_world_cam
    # MuJoCo draws for two eyes, a little beside the camera.
    assert np.allclose(data.cam_xpos[0], T[:3, 3]) and np.allclose(eye.forward, T[:3, 2], atol=1e-6)
    assert np.allclose(eye.up, -T[:3, 1], atol=1e-6)


def test_distortion_that_has_no_place_is_told(scene, tmp_path):
    lens = dataclasses.replace(placed_scenes.CAMERA, distortion=np.array([0.1, 0, 0, 0, 0]))
    views = (dataclasses.replace(scene.cameras[0], intrinsics=lens),)
    told = write(dataclasses.replace(scene, cameras=views), tmp_path / "s")
    assert any("distortion of view_0" in n for n in told.notes)
