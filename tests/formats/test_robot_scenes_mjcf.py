"""Scenes as MJCF: read back by MuJoCo, at rest there, and read back by realsim."""

import dataclasses

import mujoco
import numpy as np
import pytest

import placed_scenes
from realsim.errors import InputError, UnitError
from realsim.formats.export_folder import ExportFolder
from realsim.formats.robot_scenes.mesh_obj import look_of
from realsim.formats.robot_scenes.mjcf import MjcfConfig, write_mjcf_scene
from realsim.formats.robot_scenes.mjcf_reading import read_mjcf_scene


def write(scene, folder, **config):
    out = ExportFolder.begin(folder, {"scene": scene.name})
    written = write_mjcf_scene(scene, out, MjcfConfig(**config))
    out.finish({})
    return written


@pytest.fixture(scope="module")
def scene():
    return placed_scenes.placed_scene()


@pytest.fixture(scope="module")
def folder(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("mjcf") / "scene"
    write(scene, folder)
    return folder


@pytest.fixture(scope="module")
def model(folder):
    return mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))


def test_what_is_written_is_read_again(scene, folder):
    """Shapes to float32, in which MuJoCo keeps meshes; everything else to a double's rounding."""
    found = read_mjcf_scene(folder)
    placed_scenes.same_bodies(scene, found, 1e-14, shapes=1e-8)
    assert found.name == scene.name and np.array_equal(found.gravity, scene.gravity)
    assert [len(found.body(o).parts) for o in found.objects] == [2, 1, 2]
    for o, p in zip(scene.objects, found.objects, strict=True):
        known, look = (look_of(s.body(x).model.mesh) for s, x in ((scene, o), (found, p)))
        assert np.array_equal(look.texture, known.texture)
        assert np.allclose(look.corner_uv, known.corner_uv, rtol=0, atol=1e-6)


def test_mujoco_finds_masses_inertias_and_poses(scene, model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for o in scene.objects:
        body, known = model.body(o.name), scene.body(o)
        R = np.zeros(9)
        mujoco.mju_quat2Mat(R, body.iquat)
        inertia = R.reshape(3, 3) @ np.diag(body.inertia) @ R.reshape(3, 3).T
        assert np.isclose(body.mass[0], known.mass_kg, rtol=1e-9)
        assert np.allclose(inertia, known.inertia, rtol=0, atol=1e-9 * known.inertia.max())
        assert np.allclose(body.ipos, known.center_of_mass, rtol=0, atol=1e-12)
        assert np.allclose(data.xpos[body.id], o.T_world_obj[:3, 3], rtol=0, atol=1e-12)
        assert np.allclose(data.xmat[body.id], o.T_world_obj[:3, :3].ravel(), rtol=0, atol=1e-12)


def test_the_objects_rest_where_they_were_registered_with_their_own_friction(scene, model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    before = data.xpos.copy()
    for _ in range(250):
        mujoco.mj_step(model, data)
    assert np.abs(data.xpos - before).max() < 5e-5
    assert data.ncon >= 9
    frictions = {round(float(c.friction[0]), 6) for c in data.contact}
    assert frictions == {placed_scenes.FRICTION}
    touching = {model.geom(int(g)).name for c in data.contact for g in c.geom}
    assert "table" in touching and not any("visual" in name for name in touching)


def test_the_cameras_frustum_is_that_of_its_intrinsics(scene, model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
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


# --- what others write --------------------------------------------------------------------------


def test_distortion_that_has_no_place_is_told(scene, tmp_path):
    lens = dataclasses.replace(placed_scenes.CAMERA, distortion=np.array([0.1, 0, 0, 0, 0]))
    views = (dataclasses.replace(scene.cameras[0], intrinsics=lens),)
    told = write(dataclasses.replace(scene, cameras=views), tmp_path / "s")
    assert any("distortion of view_0" in n for n in told.notes)


def mjcf(tmp_path, world, before=""):
    path = tmp_path / "w.xml"
    path.write_text(f"<mujoco>{before}<worldbody>{world}</worldbody></mujoco>")
    return path


def test_defaults_includes_and_degrees_are_mujocos_own(tmp_path):
    (tmp_path / "more.xml").write_text('<mujoco><default><geom friction="0.3"/></default></mujoco>')
    path = mjcf(
        tmp_path,
        '<geom type="plane" size="1 2 0.1" pos="0 0 0.5"/>'
        '<body name="a" pos="0 0 1" euler="0 0 90"><freejoint/>'
        '<geom type="box" size="0.02 0.03 0.05" mass="0.3"/></body>',
        '<include file="more.xml"/>',
    )
    found = read_mjcf_scene(path)
    body, placed = found.bodies[1], found.objects[0]
    assert np.isclose(body.friction, 0.3) and np.isclose(body.mass_kg, 0.3)
    assert np.allclose(body.model.mesh.extent, [0.04, 0.06, 0.1])
    assert np.allclose(placed.T_world_obj[:3, :3] @ [1, 0, 0], [0, 1, 0], atol=1e-9)
    assert found.table.size_m == (2.0, 4.0) and found.table.T_world_table[2, 3] == 0.5
    known = np.array([0.06**2 + 0.1**2, 0.04**2 + 0.1**2, 0.04**2 + 0.06**2]) * 0.3 / 12
    assert np.allclose(np.linalg.eigvalsh(body.inertia), np.sort(known))


FREE_MESH = (
    '<body name="a"><freejoint/><inertial pos="0 0 0" mass="0.3" diaginertia="1e-3 1e-3 1e-3"/>'
    '<geom type="mesh" mesh="m"/></body>'
)


def test_a_mesh_whose_size_cannot_be_is_refused(tmp_path):
    size, scale = (50, 60, 100), 1.0
    import trimesh

    (tmp_path / "m.stl").write_bytes(trimesh.creation.box(size).export(file_type="stl"))
    assets = f'<asset><mesh name="m" file="m.stl" scale="{scale} {scale} {scale}"/></asset>'
    with pytest.raises(UnitError, match="shape of 'a'"):
        read_mjcf_scene(mjcf(tmp_path, FREE_MESH, assets))


@pytest.mark.parametrize(
    ("world", "before", "what"),
    [
        (FREE_MESH, '<asset><mesh name="m" file="../m.stl"/></asset>', "leads out"),
        (FREE_MESH, '<include file="../other.xml"/>', "leads out"),
        (FREE_MESH, '<include file="w.xml"/>', "circle"),
        (FREE_MESH, '<extension><plugin plugin="x.y"/></extension>', "loads programs"),
        ("<body><joint/><geom size='0.1'/></body>", "", "has joints"),
        ("<body><geom size='.1'/><body><geom size='.1'/></body></body>", "", "another body"),
        ("<bodyy/>", "", "bodyy"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path, world, before, what):
    with pytest.raises(InputError, match=what):
        read_mjcf_scene(mjcf(tmp_path, world, before))
