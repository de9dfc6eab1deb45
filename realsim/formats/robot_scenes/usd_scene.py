"""A scene as USD for Isaac Sim: physics by UsdPhysics, metres, z up.

    scene.usda                     physics scene, table, cameras; the objects by reference
    objects/NAME.usdc              a body: see `usd_body`
    objects/NAME.png               its texture

Open scene.usda in Isaac Sim, or reference it in another stage. Bodies are shared by all places
where they stand.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from realsim import interop
from realsim.arrays import Array
from realsim.formats.export_folder import ExportFolder
from realsim.formats.labelled_scene import WrittenScene
from realsim.formats.robot_scenes.mesh_obj import TABLE_RGB
from realsim.formats.robot_scenes.placed_scene import (
    PlacedScene,
    SceneCamera,
    TableBox,
    told,
    without_lens,
)
from realsim.formats.robot_scenes.usd_body import (
    MODULES,
    bind_friction,
    body_stage,
    friction_material,
    new_stage,
    texture_png,
)
from realsim.geometry import se3
from realsim.interop import import_pixar

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
    cube.CreateDisplayColorAttr().Set([pxr.Gf.Vec3f(*TABLE_RGB)])
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
