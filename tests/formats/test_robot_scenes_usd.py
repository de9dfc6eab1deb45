"""Scenes as USD: Pixar's library finds everything that Isaac Sim needs."""

import importlib

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdPhysics, UsdSemantics, UsdShade

import placed_scenes
from realsim.errors import MissingLibraryError
from realsim.formats.export_folder import ExportFolder
from realsim.formats.robot_scenes.mesh_obj import collision_parts
from realsim.formats.robot_scenes.usd_scene import write_usd_scene
from refusals import refused

WRITE = write_usd_scene


@pytest.fixture(scope="module")
def stage(folder):
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
