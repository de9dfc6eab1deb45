"""Folders of URDFs: read back by PyBullet, at rest there, and read back by realsim."""

import importlib.util
import json
import shutil

import numpy as np
import pybullet
import pytest
from pybullet_utils.bullet_client import BulletClient

import placed_scenes
from realsim.errors import InputError, UnitError
from realsim.formats.export_folder import ExportFolder
from realsim.formats.robot_scenes.urdf import UrdfConfig, write_urdf_scene
from realsim.formats.robot_scenes.urdf_reading import read_urdf_scene
from realsim.geometry import se3
from realsim.interop import T_from_pybullet, quiet_output


def write(scene, folder, **config):
    out = ExportFolder.begin(folder, {"scene": scene.name})
    written = write_urdf_scene(scene, out, UrdfConfig(**config))
    out.finish({})
    return written


@pytest.fixture(scope="module")
def scene():
    return placed_scenes.placed_scene()


@pytest.fixture(scope="module")
def folder(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("urdf") / "scene"
    write(scene, folder)
    return folder


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


def test_what_is_written_is_read_again_to_the_last_digit(scene, folder):
    found = read_urdf_scene(folder)
    placed_scenes.same_bodies(scene, found)
    assert np.array_equal(found.gravity, scene.gravity)
    camera, known = found.cameras[0], scene.cameras[0]
    assert np.array_equal(camera.intrinsics.K, known.intrinsics.K)
    assert np.array_equal(camera.T_world_cam, known.T_world_cam)
    assert [len(found.body(o).parts) for o in found.objects] == [2, 1, 2]
    texture = found.bodies[2].model.mesh.texture
    assert np.array_equal(texture, scene.bodies[2].model.mesh.texture)


def test_the_world_in_one_file_holds_the_same_scene(scene, folder):
    found = read_urdf_scene(folder / "world.urdf")
    placed_scenes.same_bodies(scene, found, 1e-14)
    assert not any(o.is_fixed for o in found.objects)
    assert any("gravity" in n for n in found.notes)


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
    worst = 0.0
    for _ in range(120):
        engine.stepSimulation()
        for o in scene.objects:
            T = pose_of(engine, script, bodies[o.name])
            worst = max(worst, float(np.abs(T - o.T_world_obj)[:3, 3].max()))
            speed = np.linalg.norm(engine.getBaseVelocity(bodies[o.name])[0])
            assert speed < 0.05
    assert worst < 3e-4


# --- what others write --------------------------------------------------------------------------

BOX = '<geometry><box size="0.05 0.06 0.1"/></geometry>'
MATTER = (
    '<inertial><origin xyz="0.01 0 0" rpy="0 0 1.5707963267948966"/><mass value="0.3"/>'
    '<inertia ixx="2e-4" iyy="3e-4" izz="4e-4" ixy="0" ixz="0" iyz="0"/></inertial>'
)


def test_several_scenes_go_into_one_export(scene, tmp_path):
    out = ExportFolder.begin(tmp_path / "out", {})
    steps = []
    for name in ("a", "b"):
        told = write_urdf_scene(
            scene, out, UrdfConfig(under=f"scenes/{name}"), progress=lambda: steps.append(1)
        )
        assert told.folder == tmp_path / "out/scenes" / name
        assert told.objects == 3 and told.counts["collision shapes"] == 3
    out.finish({})
    for name in ("a", "b"):
        placed_scenes.same_bodies(scene, read_urdf_scene(tmp_path / "out/scenes" / name))
    assert len(steps) == 4


def urdf(tmp_path, links, joints="", name="w.urdf"):
    path = tmp_path / name
    path.write_text(f'<robot name="r"><link name="world"/>{links}{joints}</robot>')
    return path


def joint(child, kind="floating", parent="world", origin='<origin xyz="0 0 1"/>'):
    return (
        f'<joint name="j_{child}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f"{origin}</joint>"
    )


def test_an_inertia_is_turned_with_its_own_frame(tmp_path):
    links = f'<link name="a">{MATTER}<collision>{BOX}</collision></link>'
    found = read_urdf_scene(urdf(tmp_path, links, joint("a"))).bodies[1]
    assert np.allclose(found.inertia, np.diag([3e-4, 2e-4, 4e-4]), rtol=0, atol=1e-18)
    assert np.allclose(found.center_of_mass, [0.01, 0, 0])
    assert np.allclose(found.model.mesh.extent, [0.05, 0.06, 0.1])


def test_poses_of_chains_of_fixed_links_add_up(tmp_path):
    links = '<link name="shelf"/>' + f'<link name="a">{MATTER}<visual>{BOX}</visual></link>'
    turn = '<origin xyz="0 0 1" rpy="0 0 1.5707963267948966"/>'
    joints = joint("shelf", "fixed", origin=turn) + joint(
        "a", "fixed", "shelf", '<origin xyz="1 0 0"/>'
    )
    found = read_urdf_scene(urdf(tmp_path, links, joints)).objects[0]
    assert np.allclose(found.T_world_obj[:3, 3], [0, 1, 1]) and found.is_fixed


def test_a_link_without_matter_gets_a_density_and_a_note(tmp_path):
    links = f'<link name="a"><collision>{BOX}</collision></link>'
    found = read_urdf_scene(urdf(tmp_path, links, joint("a")))
    assert np.isclose(found.bodies[1].mass_kg, 0.3)
    assert any("no inertial" in n for n in found.notes)


def stl(tmp_path, size, name="m.stl"):
    import trimesh

    (tmp_path / name).write_bytes(trimesh.creation.box(size).export(file_type="stl"))


@pytest.mark.parametrize(
    ("size", "scale"), [((50, 60, 100), "1 1 1"), ((0.05, 0.06, 0.1), "0.001 0.001 0.001")]
)
def test_a_mesh_whose_size_contradicts_its_scale_is_refused_with_the_size(tmp_path, size, scale):
    stl(tmp_path, size)
    shape = f'<geometry><mesh filename="m.stl" scale="{scale}"/></geometry>'
    links = f'<link name="a">{MATTER}<collision>{shape}</collision></link>'
    with pytest.raises(UnitError, match=r"link 'a'.*m\.stl.*(100|0\.1)"):
        read_urdf_scene(urdf(tmp_path, links, joint("a")))


def test_a_mesh_in_millimetres_with_its_scale_is_read(tmp_path):
    stl(tmp_path, (50, 60, 100))
    shape = '<geometry><mesh filename="m.stl" scale="0.001 0.001 0.001"/></geometry>'
    links = f'<link name="a">{MATTER}<collision>{shape}</collision></link>'
    found = read_urdf_scene(urdf(tmp_path, links, joint("a"))).bodies[1]
    assert np.allclose(found.model.mesh.extent, [0.05, 0.06, 0.1])


@pytest.mark.parametrize(
    ("shape", "joints", "what"),
    [
        ('<mesh filename="package://x/m.stl"/>', joint("a"), "ROS"),
        ('<mesh filename="../m.stl"/>', joint("a"), "leads out"),
        ('<mesh filename="gone.stl"/>', joint("a"), "does not exist"),
        ('<mesh filename="out.obj"/>', joint("a"), "leads out"),
        ('<mesh filename="two.obj"/>', joint("a"), "cannot be read as a mesh"),
        ('<box size="0.1 nan 0.1"/>', joint("a"), "finite"),
        ('<torus r="1"/>', joint("a"), "mesh, box, cylinder"),
        ('<box size="1 1 1"/>', joint("a", "revolute"), "'revolute'"),
        ('<box size="1 1 1"/>', joint("a", parent="b"), "no link"),
        ('<box size="1 1 1"/>', joint("a") + joint("a"), "two joints"),
        ('<box size="1 1 1"/>', joint("a") + joint("world", parent="a"), "circle"),
        ('<box size="1 1 1"/>', joint("a", origin='<origin xyz="0 0 1e400"/>'), "finite"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path, shape, joints, what):
    (tmp_path / "out.obj").write_text("mtllib ../secret.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    inner = tmp_path / "in"
    inner.mkdir()
    (inner / "two.obj").write_text("v 0 0\nv 1 0\nv 0 1\nv 1 1\nf 1 2 3\nf 2 3 4\n")
    (inner / "out.obj").write_text((tmp_path / "out.obj").read_text())
    links = f'<link name="a">{MATTER}<collision><geometry>{shape}</geometry></collision></link>'
    with pytest.raises(InputError, match=what):
        read_urdf_scene(urdf(inner, links, joints))


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"format": "other"}, "'other'"),
        ({"objects": 3}, "no list"),
        ({"objects": [{"urdf": "../x.urdf", "obj_id": 1, "name": "x"}]}, "leads out"),
        ({"objects": [{"urdf": "table.urdf", "obj_id": -1}]}, "obj_id"),
    ],
)
def test_a_damaged_scene_json_is_named(folder, tmp_path, change, what):
    data = json.loads((folder / "scene.json").read_text()) | change
    (tmp_path / "scene.json").write_text(json.dumps(data))
    shutil.copytree(folder / "objects", tmp_path / "objects")
    with pytest.raises(InputError, match=what):
        read_urdf_scene(tmp_path)


def test_two_poses_that_disagree_are_refused_with_the_difference(scene, tmp_path):
    write(scene, tmp_path / "s")
    path = tmp_path / "s/scene.json"
    data = json.loads(path.read_text())
    data["objects"][0]["position"][2] += 0.01
    path.write_text(json.dumps(data))
    with pytest.raises(InputError, match=r"two poses.*0\.01"):
        read_urdf_scene(path)
    del data["objects"][0]["T_world_obj"]
    path.write_text(json.dumps(data))
    moved = read_urdf_scene(path).objects[0].T_world_obj
    known = se3.from_translation([0, 0, 0.01]) @ scene.objects[0].T_world_obj
    assert np.allclose(moved, known, atol=1e-12)
