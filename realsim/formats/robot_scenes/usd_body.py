"""One body as a stage of USD, by Pixar's library, which comes with an extra."""

from typing import Any

import numpy as np

from realsim.formats.robot_scenes.mesh_obj import PLAIN_RGB, Look, collision_parts, look_of
from realsim.formats.robot_scenes.placed_scene import RigidBody, principal_inertia
from realsim.geometry import se3
from realsim.images.png import encode_png
from realsim.records import Mesh

MODULES = ("Gf", "Sdf", "Usd", "UsdGeom", "UsdPhysics", "UsdSemantics", "UsdShade", "Vt")
"""Those of Pixar's modules that a scene is written by."""
LABEL = "class"
"""Kind of the semantic label; Isaac's Replicator takes its classes from it."""
COMBINE_MODE = "physxMaterial:frictionCombineMode"
"""PhysX's own attribute: without it two frictions are averaged, not multiplied."""


def body_stage(pxr: Any, body: RigidBody, name: str, texture: str) -> Any:
    """Return the stage of a body.

    Args:
        pxr: Any's modules.
        body: the body.
        name: of its prim.
        texture: file of its texture, beside it; see `texture_png`.
    """
    stage = new_stage(pxr)
    root = pxr.UsdGeom.Xform.Define(stage, f"/{name}").GetPrim()
    stage.SetDefaultPrim(root)
    pxr.UsdPhysics.RigidBodyAPI.Apply(root)
    _set_mass(pxr, root, body)
    labels = pxr.UsdSemantics.LabelsAPI.Apply(root, LABEL)
    labels.CreateLabelsAttr().Set([body.model.name])
    mesh, look = body.model.mesh, look_of(body.model.mesh)
    visual = define_mesh(pxr, stage, f"/{name}/visual", mesh)
    if look.corner_uv is not None:
        primvar = pxr.UsdGeom.PrimvarsAPI(visual).CreatePrimvar(
            "st", pxr.Sdf.ValueTypeNames.TexCoord2fArray, pxr.UsdGeom.Tokens.faceVarying
        )
        st = look.corner_uv.reshape(-1, 2).astype(np.float32)
        primvar.Set(pxr.Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(st)))
    material = _surface(pxr, stage, f"/{name}/Looks/surface", look, texture)
    pxr.UsdShade.MaterialBindingAPI.Apply(visual.GetPrim()).Bind(material)
    guide = pxr.UsdGeom.Scope.Define(stage, f"/{name}/collision")
    guide.CreatePurposeAttr().Set(pxr.UsdGeom.Tokens.guide)
    rubbing = friction_material(pxr, stage, f"/{name}/Looks/friction", body.friction)
    for k, part in enumerate(collision_parts(body)):
        shape = define_mesh(pxr, stage, f"/{name}/collision/part_{k:03d}", part).GetPrim()
        pxr.UsdPhysics.CollisionAPI.Apply(shape)
        approximation = pxr.UsdPhysics.MeshCollisionAPI.Apply(shape).CreateApproximationAttr()
        approximation.Set(pxr.UsdPhysics.Tokens.convexHull)
        bind_friction(pxr, shape, rubbing)
    return stage


def texture_png(body: RigidBody) -> bytes | None:
    """Return the texture of a body, None if it has none."""
    texture = look_of(body.model.mesh).texture
    return None if texture is None else encode_png(np.ascontiguousarray(texture))


def new_stage(pxr: Any) -> Any:
    """Return an empty stage in metres and kilograms, z up."""
    stage = pxr.Usd.Stage.CreateInMemory("scene.usda")
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.z)
    pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    pxr.UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    return stage


def define_mesh(pxr: Any, stage: Any, path: str, mesh: Mesh) -> Any:
    """Define a mesh of triangles; points are float32, as USD has them."""
    found = pxr.UsdGeom.Mesh.Define(stage, path)
    points = np.ascontiguousarray(mesh.vertices, dtype=np.float32)
    found.CreatePointsAttr().Set(pxr.Vt.Vec3fArray.FromNumpy(points))
    counts = np.full(len(mesh.faces), 3, dtype=np.int32)
    found.CreateFaceVertexCountsAttr().Set(pxr.Vt.IntArray.FromNumpy(counts))
    corners = np.ascontiguousarray(mesh.faces.ravel(), dtype=np.int32)
    found.CreateFaceVertexIndicesAttr().Set(pxr.Vt.IntArray.FromNumpy(corners))
    # Else USD takes the triangles for the cage of a smooth surface.
    found.CreateSubdivisionSchemeAttr().Set(pxr.UsdGeom.Tokens.none)
    extent = np.stack([points.min(axis=0), points.max(axis=0)])
    found.CreateExtentAttr().Set(pxr.Vt.Vec3fArray.FromNumpy(extent))
    return found


def friction_material(pxr: Any, stage: Any, path: str, friction: float) -> Any:
    """Define the material of a surface with a Coulomb friction."""
    material = pxr.UsdShade.Material.Define(stage, path)
    physics = pxr.UsdPhysics.MaterialAPI.Apply(material.GetPrim())
    physics.CreateStaticFrictionAttr().Set(friction)
    physics.CreateDynamicFrictionAttr().Set(friction)
    physics.CreateRestitutionAttr().Set(0.0)
    kind = pxr.Sdf.ValueTypeNames.Token
    material.GetPrim().CreateAttribute(COMBINE_MODE, kind, custom=False).Set("multiply")
    return material


def bind_friction(pxr: Any, prim: Any, material: Any) -> None:
    """Make a shape rub as a material says; its look stays its own."""
    strength = pxr.UsdShade.Tokens.weakerThanDescendants
    pxr.UsdShade.MaterialBindingAPI.Apply(prim).Bind(material, strength, "physics")


def _set_mass(pxr: Any, prim: Any, body: RigidBody) -> None:
    """Set mass, centre of mass, moments and the rotation from principal axes to the object's."""
    moments, R_obj_principal = principal_inertia(body.inertia)
    # Quaternions are w first in Pixar's library.
    w, x, y, z = se3.quaternion_wxyz(R_obj_principal).tolist()
    mass = pxr.UsdPhysics.MassAPI.Apply(prim)
    mass.CreateMassAttr().Set(body.mass_kg)
    mass.CreateCenterOfMassAttr().Set(pxr.Gf.Vec3f(*body.center_of_mass.tolist()))
    mass.CreateDiagonalInertiaAttr().Set(pxr.Gf.Vec3f(*moments.tolist()))
    mass.CreatePrincipalAxesAttr().Set(pxr.Gf.Quatf(w, x, y, z))


def _surface(pxr: Any, stage: Any, path: str, look: Look, texture: str) -> Any:
    """Define a UsdPreviewSurface with a texture, or a plain colour."""
    types, shade = pxr.Sdf.ValueTypeNames, pxr.UsdShade
    material = shade.Material.Define(stage, path)
    surface = shade.Shader.Define(stage, f"{path}/preview")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", types.Float).Set(0.7)
    surface.CreateInput("metallic", types.Float).Set(0.0)
    color = surface.CreateInput("diffuseColor", types.Color3f)
    output = surface.CreateOutput("surface", types.Token)
    material.CreateSurfaceOutput().ConnectToSource(output)
    if look.corner_uv is None:
        color.Set(pxr.Gf.Vec3f(*PLAIN_RGB))
        return material
    reader = shade.Shader.Define(stage, f"{path}/st")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", types.String).Set("st")
    picture = shade.Shader.Define(stage, f"{path}/texture")
    picture.CreateIdAttr("UsdUVTexture")
    picture.CreateInput("file", types.Asset).Set(pxr.Sdf.AssetPath(texture))
    picture.CreateInput("sourceColorSpace", types.Token).Set("sRGB")
    for side in ("wrapS", "wrapT"):
        picture.CreateInput(side, types.Token).Set("repeat")
    at = reader.CreateOutput("result", types.Float2)
    picture.CreateInput("st", types.Float2).ConnectToSource(at)
    color.ConnectToSource(picture.CreateOutput("rgb", types.Float3))
    return material
