"""Scenes as MJCF, URDF and USD: read back by MuJoCo, PyBullet, Pinocchio, Pixar's library.

Registered scenes as engines take them: bodies, names, table; what cannot be is refused.
"""

import importlib
import importlib.util
import json
from dataclasses import replace

import mujoco
import numpy as np
import pybullet
import pytest
import trimesh
from PIL import Image
from pxr import Gf, Usd, UsdGeom, UsdPhysics, UsdSemantics, UsdShade
from pybullet_utils.bullet_client import BulletClient

import placed_scenes
from realsim.errors import MissingLibraryError
from realsim.formats.export_folder import ExportFolder
from realsim.formats.robot_scenes.mjcf import write_mjcf_scene
from realsim.formats.robot_scenes.placed_scene import (
    RigidBody,
    collision_parts,
    file_name,
    look_of,
    seen_from,
    unique_names,
)
from realsim.formats.robot_scenes.placing import TABLE_MARGIN_M, place_scene
from realsim.formats.robot_scenes.urdf import write_urdf_scene
from realsim.formats.robot_scenes.usd_scene import write_usd_scene
from realsim.geometry import se3
from realsim.geometry.mesh import mass_properties
from realsim.interop import T_from_pybullet, import_pinocchio, quiet_output
from refusals import refused


def folder_of(write, scene, tmp_path_factory):
    path = tmp_path_factory.mktemp("written") / "scene"
    placed_scenes.written(write, scene, path)
    return path


@pytest.fixture(scope="module")
def model(scene, tmp_path_factory):
    folder = folder_of(write_mjcf_scene, scene, tmp_path_factory)
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
    lens = replace(placed_scenes.CAMERA, distortion=np.array([0.1, 0, 0, 0, 0]))
    views = (replace(scene.cameras[0], intrinsics=lens),)
    told = placed_scenes.written(write_mjcf_scene, replace(scene, cameras=views), tmp_path / "s")
    assert any("distortion of view_0" in n for n in told.notes)


def test_another_world_frame_moves_everything_alike_and_back(scene):
    T = se3.random_transform(np.random.default_rng(0))
    moved = seen_from(scene, T)
    a, b = scene.objects[0], moved.objects[0]
    assert np.allclose(T @ b.T_world_obj, a.T_world_obj)
    assert np.allclose(T[:3, :3] @ moved.gravity, scene.gravity)
    assert np.allclose(T @ moved.cameras[0].T_world_cam, scene.cameras[0].T_world_cam)
    placed_scenes.same_bodies(scene, seen_from(moved, se3.invert(T)), 1e-12)


def test_gravity_and_table_follow_the_plane_wherever_the_world_is():
    scene, models, matter = placed_scenes.registered()
    T = se3.random_transform(np.random.default_rng(1))
    objects = tuple(replace(o, T_world_obj=T @ o.T_world_obj) for o in scene.objects)
    plane = replace(scene.plane, T_world_table=T @ scene.plane.T_world_table)
    turned = place_scene(replace(scene, objects=objects, plane=plane), models, matter)
    straight = place_scene(scene, models, matter)
    assert np.allclose(turned.gravity, T[:3, :3] @ straight.gravity)
    assert np.allclose(turned.table.T_world_table, T @ straight.table.T_world_table)
    assert np.allclose(turned.table.size_m, straight.table.size_m)


def test_the_table_carries_all_objects_with_its_margin(scene):
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for o in scene.objects:
        at = se3.invert(scene.table.T_world_table) @ o.T_world_obj
        points = se3.transform(at, scene.body(o).model.mesh.vertices)
        low, high = np.minimum(low, points[:, :2].min(0)), np.maximum(high, points[:, :2].max(0))
        assert abs(points[:, 2].min()) < 1e-12
    half = np.array(scene.table.size_m) / 2
    assert np.allclose(low, -half + TABLE_MARGIN_M) and np.allclose(high, half - TABLE_MARGIN_M)


def test_an_object_without_known_matter_has_its_hull_and_its_density_and_a_note_says_so(scene):
    box = scene.bodies[2]
    assert box.parts is None and np.isclose(box.mass_kg, 1000 * 0.05 * 0.06 * 0.1)
    assert any("2 box" in n and "hull" in n and "0.3 kg" in n for n in scene.notes)
    assert not any("bracket" in n for n in scene.notes)


def test_convex_parts_are_closed_and_keep_their_volume(scene):
    foot, back = placed_scenes.bracket_bars()
    parts = scene.bodies[1].parts
    solids = [mass_properties(p, 1.0) for p in parts]
    assert all(s.is_watertight for s in solids)
    assert np.allclose([s.volume_m3 for s in solids], [foot.volume, back.volume])


def test_scenes_that_cannot_be_simulated_are_refused():
    scene, models, matter = placed_scenes.registered()
    for change, says in (({"plane": None}, "no supporting plane"), ({"objects": ()}, "no objects")):
        refused(says, place_scene, replace(scene, **change), models, matter)
    one_model = {1: models[1]}
    refused(r"object 2 .* has no model; there are: bracket", place_scene, scene, one_model, matter)
    flat = {1: replace(matter[1], parts=[np.zeros((5, 3))])}
    refused(r"part 0 of object 'bracket' .* flat", place_scene, scene, models, flat)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"mass_kg": 0.0}, "mass"),
        ({"mass_kg": float("nan")}, "mass"),
        ({"inertia": np.diag([1.0, 1.0, 3.0])}, "two exceed the third"),
        ({"inertia": -np.eye(3)}, "positive"),
        ({"inertia": np.array([[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]])}, "not symmetric"),
        ({"inertia": np.full((3, 3), np.nan)}, "NaN"),
        ({"friction": -0.1}, "friction"),
        ({"parts": ()}, "convex parts"),
    ],
)
def test_bodies_that_cannot_be_are_refused(scene, change, what):
    body = scene.bodies[1]
    refused(what, replace, body, **change)
    assert isinstance(body, RigidBody)


def test_names_are_files_and_prims_and_differ(scene):
    assert file_name("2 box/é") == "_2_box" and file_name("") == "object"
    names = unique_names({0: "mug", 1: "Mug", 2: "table", 3: "can", 4: "mug_0"})
    assert len({n.lower() for n in names.values()}) == 5 and names[3] == "can"
    assert all(n == file_name(n) and n != "table" for n in names.values())
    refused("letters, digits", replace, scene.objects[0], name="a b")
    twice = tuple(replace(o, name="one") for o in scene.objects)
    refused("used twice", replace, scene, objects=twice)


def test_colours_of_vertices_become_a_texture_of_the_faces_mean_colours():
    model, _ = placed_scenes.bracket()
    look = look_of(model.mesh)
    height, width = look.texture.shape[:2]
    at = look.corner_uv[:, 0]
    shown = look.texture[((1 - at[:, 1]) * height).astype(int), (at[:, 0] * width).astype(int)]
    wanted = np.rint(model.mesh.colors[model.mesh.faces].mean(axis=1))
    assert np.array_equal(shown, wanted)


# --- folders of URDFs ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(scene, tmp_path_factory):
    return folder_of(write_urdf_scene, scene, tmp_path_factory)


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


# --- USD: all that Isaac Sim needs is found -------------------------------------------------------


@pytest.fixture(scope="module")
def stage(scene, tmp_path_factory):
    folder = folder_of(write_usd_scene, scene, tmp_path_factory)
    return Usd.Stage.Open(str(folder / "scene.usda"))


def pose(prim):
    """USD's matrices act on rows."""
    return np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0)).T


def of(stage, scene):
    for o in scene.objects:
        yield stage.GetPrimAtPath(f"/World/{o.name}"), o, scene.body(o)


def test_the_stage_is_in_metres_and_kilograms_with_z_up_and_gravity(scene, stage):
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert UsdPhysics.GetStageKilogramsPerUnit(stage) == 1.0
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z
    physics = UsdPhysics.Scene(stage.GetPrimAtPath("/World/physics"))
    down = np.array(physics.GetGravityDirectionAttr().Get())
    assert np.allclose(down * physics.GetGravityMagnitudeAttr().Get(), scene.gravity)
    assert stage.GetDefaultPrim().GetPath() == "/World"
    assert not stage.GetCompositionErrors()


def test_objects_stand_at_their_poses_with_their_matter(scene, stage):
    for prim, o, body in of(stage, scene):
        assert np.allclose(pose(prim), o.T_world_obj, rtol=0, atol=1e-14)
        assert prim.HasAPI(UsdPhysics.RigidBodyAPI)
        mass = UsdPhysics.MassAPI(prim)
        assert np.isclose(mass.GetMassAttr().Get(), body.mass_kg, rtol=1e-6)
        assert np.allclose(mass.GetCenterOfMassAttr().Get(), body.center_of_mass, rtol=0, atol=1e-8)
        axes = Gf.Matrix3d(Gf.Rotation(Gf.Quatd(mass.GetPrincipalAxesAttr().Get())))
        R, moments = np.array(axes).T, np.array(mass.GetDiagonalInertiaAttr().Get())
        found = R @ np.diag(moments) @ R.T
        assert np.allclose(found, body.inertia, rtol=0, atol=1e-6 * body.inertia.max())
        labels = UsdSemantics.LabelsAPI(prim, "class").GetLabelsAttr().Get()
        assert list(labels) == [body.model.name]


def test_what_is_seen_has_its_triangles_and_what_collides_its_convex_parts(scene, stage):
    for prim, _, body in of(stage, scene):
        visual = UsdGeom.Mesh(prim.GetChild("visual"))
        counts = visual.GetFaceVertexCountsAttr().Get()
        assert len(counts) == len(body.model.mesh.faces) and set(counts) == {3}
        points = np.array(visual.GetPointsAttr().Get())
        assert np.allclose(points, body.model.mesh.vertices, rtol=0, atol=1e-8)
        assert visual.GetSubdivisionSchemeAttr().Get() == "none"
        assert visual.ComputePurpose() == "default"
        assert not visual.GetPrim().HasAPI(UsdPhysics.CollisionAPI)
        parts = prim.GetChild("collision").GetChildren()
        known = collision_parts(body)
        assert len(parts) == len(known)
        for part, mesh in zip(parts, known, strict=True):
            assert part.HasAPI(UsdPhysics.CollisionAPI)
            assert UsdPhysics.MeshCollisionAPI(part).GetApproximationAttr().Get() == "convexHull"
            assert UsdGeom.Imageable(part).ComputePurpose() == "guide"
            assert len(UsdGeom.Mesh(part).GetFaceVertexCountsAttr().Get()) == len(mesh.faces)


def test_friction_holds_for_what_collides_and_is_multiplied(scene, stage):
    shapes = [p for prim, *_ in of(stage, scene) for p in prim.GetChild("collision").GetChildren()]
    for prim in [*shapes, stage.GetPrimAtPath("/World/table")]:
        bound, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")
        friction = UsdPhysics.MaterialAPI(bound.GetPrim())
        wanted = 1.0 if prim.GetName() == "table" else placed_scenes.FRICTION
        assert np.isclose(friction.GetStaticFrictionAttr().Get(), wanted)
        assert np.isclose(friction.GetDynamicFrictionAttr().Get(), wanted)
        combine = bound.GetPrim().GetAttribute("physxMaterial:frictionCombineMode").Get()
        assert combine == "multiply"


def test_the_table_stands_still_and_its_top_is_the_plane(scene, stage):
    prim = stage.GetPrimAtPath("/World/table")
    assert prim.HasAPI(UsdPhysics.CollisionAPI) and not prim.HasAPI(UsdPhysics.RigidBodyAPI)
    box, table = pose(prim), scene.table
    assert np.allclose(box @ [0, 0, 0.5, 1], table.T_world_table[:, 3])
    sides = np.linalg.norm(box[:3, :3], axis=0)
    assert np.allclose(sides, [*table.size_m, table.thickness_m])


def test_a_point_is_seen_at_its_pixel(scene, stage):
    view = scene.cameras[0]
    frustum = UsdGeom.Camera(stage.GetPrimAtPath(f"/World/{view.name}")).GetCamera(0).frustum
    projection = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
    K = view.intrinsics
    for X in np.random.default_rng(0).normal([0.5, 0.1, 0.75], 0.1, (20, 3)):
        x, y, _ = projection.Transform(Gf.Vec3d(*X.tolist()))
        seen = [(x + 1) / 2 * K.width - 0.5, (1 - y) / 2 * K.height - 0.5]
        at = (np.linalg.inv(view.T_world_cam) @ [*X, 1])[:3]
        assert np.allclose(seen, (K.K @ at)[:2] / at[2], atol=1e-3)


def test_without_the_extra_the_error_says_how_to_install_it(scene, tmp_path, monkeypatch):
    """The import itself fails, as where the extra is not there."""
    real = importlib.import_module

    def without(name, package=None):
        if name.startswith("pxr"):
            raise ModuleNotFoundError(f"No module named '{name}'")
        return real(name, package)

    monkeypatch.setattr(importlib, "import_module", without)
    out = ExportFolder.begin(tmp_path / "s", {})
    refused(r"realsim\[usd\]", write_usd_scene, scene, out, error=MissingLibraryError)
    assert list((tmp_path / "s").iterdir()) == [tmp_path / "s/.export"]
