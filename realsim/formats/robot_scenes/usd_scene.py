"""A scene as USD for Isaac Sim: physics by UsdPhysics, metres, z up.

    scene.usda                     physics scene, table, cameras; the objects by reference
    objects/NAME.usdc              a body: see `usd_body`
    objects/NAME.png               its texture

Open scene.usda in Isaac Sim, or reference it in another stage. Bodies are shared by all places
where they stand.

One body as a stage of USD, by Pixar's library, which comes with an extra.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from realsim import interop
from realsim.arrays import Array
from realsim.formats.export_folder import ExportFolder
from realsim.formats.labelled_scene import WrittenScene
from realsim.formats.robot_scenes import placed_scene
from realsim.formats.robot_scenes.placed_scene import (
    PlacedScene,
    RigidBody,
    SceneCamera,
    TableBox,
    principal_inertia,
    told,
    without_lens,
)
from realsim.geometry import se3
from realsim.images.png import encode_png
from realsim.interop import import_pixar
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
    mesh, look = body.model.mesh, placed_scene.look_of(body.model.mesh)
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
    for k, part in enumerate(placed_scene.collision_parts(body)):
        shape = define_mesh(pxr, stage, f"/{name}/collision/part_{k:03d}", part).GetPrim()
        pxr.UsdPhysics.CollisionAPI.Apply(shape)
        approximation = pxr.UsdPhysics.MeshCollisionAPI.Apply(shape).CreateApproximationAttr()
        approximation.Set(pxr.UsdPhysics.Tokens.convexHull)
        bind_friction(pxr, shape, rubbing)
    return stage


def texture_png(body: RigidBody) -> bytes | None:
    """Return the texture of a body, None if it has none."""
    texture = placed_scene.look_of(body.model.mesh).texture
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


def _surface(pxr: Any, stage: Any, path: str, look: placed_scene.Look, texture: str) -> Any:
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
        color.Set(pxr.Gf.Vec3f(*placed_scene.PLAIN_RGB))
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


SCENE_FILE, OBJECTS = "scene.usda", "objects"
ROOT = "/World"
APERTURE = 20.955
"""Width of the film [tenths of a unit]; USD's own. Only its ratio to the focal length counts."""
NEAR_M, FAR_M = 0.01, 100.0
"""What a camera sees [m]; USD's own near plane, 1 m, would hide a table scene."""
HALF_PIXEL = 0.5
"""The film begins at the edge of the first pixel, whose middle is our 0."""


def write_usd_scene(
    scene: PlacedScene, folder: ExportFolder, *, progress: Callable[[], None] | None = None
) -> WrittenScene:
    """Write a scene as USD.

    Args:
        scene: the scene.
        folder: what is filled; a body is a piece.
        progress: called once a body.

    Raises:
        InputError: a body without convex parts is flat.
        MissingLibraryError: the extra `usd` is not installed.
        StorageError: the disk is full, or refuses.
    """
    pxr = import_pixar(MODULES, "writing USD", "URDF and MJCF are written without it.")
    names = scene.body_names()
    for obj_id, name in names.items():
        piece = f"{OBJECTS}/{name}"
        if not folder.has(piece):
            body = scene.bodies[obj_id]
            stage = body_stage(pxr, body, name, f"./{name}.png")
            files = {f"{piece}.usdc": _usdc(stage.GetRootLayer())}
            texture = texture_png(body)
            if texture is not None:
                files[f"{piece}.png"] = texture
            folder.write_piece(piece, files)
        if progress is not None:
            progress()
    files = {n: f"./{OBJECTS}/{name}.usdc" for n, name in names.items()}
    data = _scene_layer(pxr, scene, files).ExportToString().encode("utf-8")
    folder.write_piece(SCENE_FILE, {SCENE_FILE: data})
    counts = {"bodies": len(names), "cameras": len(scene.cameras)}
    return told(scene, folder.place, counts, without_lens(scene, "USD"))


def _usdc(layer: Any) -> bytes:
    """Return a layer as the bytes of a binary file, a fifth of the size of text."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "layer.usdc"
        layer.Export(str(path))
        return path.read_bytes()


def _scene_layer(pxr: Any, scene: PlacedScene, files: dict[int, str]) -> Any:
    """Return the layer that puts everything together.

    Args:
        pxr: Any's modules.
        scene: the scene.
        files: of the bodies, by object id.
    """
    stage = new_stage(pxr)
    root = pxr.UsdGeom.Xform.Define(stage, ROOT).GetPrim()
    stage.SetDefaultPrim(root)
    root.SetDisplayName(scene.name)
    physics = pxr.UsdPhysics.Scene.Define(stage, f"{ROOT}/physics")
    down, strength = scene.down
    physics.CreateGravityDirectionAttr().Set(pxr.Gf.Vec3f(*down.tolist()))
    physics.CreateGravityMagnitudeAttr().Set(strength)
    _add_table(pxr, stage, scene.table)
    for o in scene.objects:
        _place(pxr, stage.DefinePrim(f"{ROOT}/{o.name}", "Xform"), o.T_world_obj)
    for camera in scene.cameras:
        _add_camera(pxr, stage, camera)
    light = stage.DefinePrim(f"{ROOT}/light", "DomeLight")
    light.CreateAttribute("inputs:intensity", pxr.Sdf.ValueTypeNames.Float, custom=False).Set(1e3)
    # The files are not there yet: a stage would look for them and complain, a layer does not.
    layer = pxr.Sdf.Layer.CreateAnonymous(".usda")
    layer.TransferContent(stage.GetRootLayer())
    for o in scene.objects:
        reference = pxr.Sdf.Reference(files[o.obj_id])
        layer.GetPrimAtPath(f"{ROOT}/{o.name}").referenceList.Prepend(reference)
    return layer


def _add_table(pxr: Any, stage: Any, table: TableBox) -> None:
    """Add the table: a cube that collides and, having no rigid body, stands still."""
    cube = pxr.UsdGeom.Cube.Define(stage, f"{ROOT}/table")
    cube.CreateSizeAttr().Set(1.0)
    cube.CreateExtentAttr().Set([(-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)])
    cube.CreateDisplayColorAttr().Set([pxr.Gf.Vec3f(*placed_scene.TABLE_RGB)])
    prim = cube.GetPrim()
    _place(pxr, prim, table.T_world_box)
    sides = pxr.Gf.Vec3d(*table.size_m, table.thickness_m)
    precision = pxr.UsdGeom.XformOp.PrecisionDouble
    pxr.UsdGeom.Xformable(prim).AddScaleOp(precision).Set(sides)
    pxr.UsdPhysics.CollisionAPI.Apply(prim)
    bind_friction(pxr, prim, friction_material(pxr, stage, f"{ROOT}/Looks/table", 1.0))


def _add_camera(pxr: Any, stage: Any, camera: SceneCamera) -> None:
    """Add a pinhole camera; USD's look along -z with y up."""
    K = camera.intrinsics
    found = pxr.UsdGeom.Camera.Define(stage, f"{ROOT}/{camera.name}")
    focal = K.fx * APERTURE / K.width
    high = K.height * focal / K.fy
    found.CreateFocalLengthAttr().Set(focal)
    found.CreateHorizontalApertureAttr().Set(APERTURE)
    found.CreateVerticalApertureAttr().Set(high)
    # An offset moves the film against the axis: right and up are positive.
    right = APERTURE * (0.5 - (K.cx + HALF_PIXEL) / K.width)
    up = high * ((K.cy + HALF_PIXEL) / K.height - 0.5)
    found.CreateHorizontalApertureOffsetAttr().Set(right)
    found.CreateVerticalApertureOffsetAttr().Set(up)
    found.CreateClippingRangeAttr().Set(pxr.Gf.Vec2f(NEAR_M, FAR_M))
    _place(pxr, found.GetPrim(), interop.T_world_gl_from_cam(camera.T_world_cam))


def _place(pxr: Any, prim: Any, T: Array) -> None:
    """Set a prim's pose by the operations that Isaac Sim shows: translate, then orient."""
    w, x, y, z = se3.quaternion_wxyz(T[:3, :3]).tolist()
    xform, precision = pxr.UsdGeom.Xformable(prim), pxr.UsdGeom.XformOp.PrecisionDouble
    xform.AddTranslateOp(precision).Set(pxr.Gf.Vec3d(*T[:3, 3].tolist()))
    xform.AddOrientOp(precision).Set(pxr.Gf.Quatd(w, x, y, z))
