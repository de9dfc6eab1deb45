"""A scene as MJCF, MuJoCo's XML: scene.xml and its meshes and textures.

    scene.xml             option, assets, the table, a free body per object, the cameras
    assets/NAME/          visual.obj, visual.mtl, texture.png, part_000.obj ...

Every body has its `inertial`: MuJoCo moves meshes into their own principal frame and would take
mass and inertia of the shapes. Shapes of group 2 are seen, those of group 3 collide.
"""

from collections.abc import Callable
from xml.etree import ElementTree as ET

import numpy as np

from realsim import interop
from realsim.arrays import Array
from realsim.formats.export_folder import ExportFolder
from realsim.formats.labelled_scene import WrittenScene
from realsim.formats.robot_scenes import placed_scene
from realsim.formats.robot_scenes.placed_scene import (
    TABLE_NAME,
    PlacedObject,
    PlacedScene,
    RigidBody,
    SceneCamera,
    spaced,
    told,
    without_lens,
)
from realsim.geometry import se3

SCENE_FILE, ASSETS = "scene.xml", "assets"
SEEN, COLLIDING = "2", "3"
"""Groups of shapes; MuJoCo's viewer shows the first and hides the second."""
INSET_PX = 0.5
"""MuJoCo's image plane begins at the edge of the first pixel, ours in its middle."""


STEP_S = 0.002
CONTACT_TIME_S = 0.004
"""Time constant of contacts [s]: two steps, the stiffest that MuJoCo integrates; with its 20 ms
things sink in and swing."""
IMPRATIO = 100.0
"""Stiffness of friction against that of the normal: at 1, MuJoCo's own, things creep."""


def write_mjcf_scene(
    scene: PlacedScene, folder: ExportFolder, *, progress: Callable[[], None] | None = None
) -> WrittenScene:
    """Write a scene as MJCF.

    Args:
        scene: the scene.
        folder: what is filled; a body's meshes are a piece.
        progress: called once a body.

    Raises:
        InputError: a body without convex parts is flat.
        StorageError: the disk is full, or refuses.
    """
    names = scene.body_names()
    counts: dict[int, int] = {}
    for obj_id, name in names.items():
        body = scene.bodies[obj_id]
        parts = placed_scene.collision_parts(body)
        counts[obj_id] = len(parts)
        piece = f"{ASSETS}/{name}"
        if not folder.has(piece):
            folder.write_piece(piece, placed_scene.mesh_files(piece, body.model.mesh, parts))
        if progress is not None:
            progress()
    text = scene_xml(scene, names, counts)
    folder.write_piece(SCENE_FILE, {SCENE_FILE: text})
    shapes = sum(counts.values())
    counted = {"bodies": len(names), "collision shapes": shapes, "cameras": len(scene.cameras)}
    return told(scene, folder.place, counted, without_lens(scene, "MJCF"))


def scene_xml(scene: PlacedScene, names: dict[int, str], counts: dict[int, int]) -> bytes:
    """Return scene.xml.

    Args:
        scene: the scene.
        names: of the bodies' assets, by object id.
        counts: of the bodies' convex parts, by object id.
    """
    root = ET.Element("mujoco", model=scene.name)
    ET.SubElement(
        root,
        "compiler",
        angle="radian",
        autolimits="true",
        inertiafromgeom="false",
        meshdir=ASSETS,
        texturedir=ASSETS,
    )
    ET.SubElement(
        root,
        "option",
        gravity=spaced(scene.gravity),
        timestep=repr(STEP_S),
        integrator="implicitfast",
        cone="elliptic",
        impratio=repr(IMPRATIO),
    )
    ET.SubElement(ET.SubElement(root, "default"), "geom", solref=f"{CONTACT_TIME_S!r} 1")
    assets = ET.SubElement(root, "asset")
    for obj_id, name in names.items():
        _assets(assets, scene.bodies[obj_id], name, counts[obj_id])
    world = ET.SubElement(root, "worldbody")
    _light(world, scene)
    for camera in scene.cameras:
        _camera(world, camera)
    table = scene.table
    half = [table.size_m[0] / 2, table.size_m[1] / 2, table.thickness_m / 2]
    ET.SubElement(
        world,
        "geom",
        {"name": TABLE_NAME, "type": "box", "size": spaced(half), **_pose(table.T_world_box)},
        rgba=f"{spaced(placed_scene.TABLE_RGB)} 1",
        friction="1",
    )
    for o in scene.objects:
        _body(world, o, scene.body(o), names[o.obj_id], counts[o.obj_id])
    ET.indent(root)
    return ET.tostring(root) + b"\n"


def _assets(assets: ET.Element, body: RigidBody, name: str, count: int) -> None:
    mesh = body.model.mesh
    material = ET.SubElement(assets, "material", name=f"{name}_surface", specular="0.2")
    if mesh.colors is None and (mesh.uv is None or mesh.texture is None):
        material.set("rgba", f"{spaced(placed_scene.PLAIN_RGB)} 1")
    else:
        file = f"{name}/{placed_scene.TEXTURE}"
        ET.SubElement(assets, "texture", name=f"{name}_texture", type="2d", file=file)
        material.set("texture", f"{name}_texture")
    # What is seen has no matter, and may be open: the inertia of a shell always exists.
    ET.SubElement(
        assets, "mesh", name=f"{name}_visual", file=f"{name}/{placed_scene.VISUAL}", inertia="shell"
    )
    for k in range(count):
        part = placed_scene.part_name(k)
        ET.SubElement(assets, "mesh", name=f"{name}_{part}", file=f"{name}/{part}.obj")


def _body(world: ET.Element, o: PlacedObject, body: RigidBody, name: str, count: int) -> None:
    element = ET.SubElement(world, "body", {"name": o.name, **_pose(o.T_world_obj)})
    ET.SubElement(element, "freejoint", name=f"{o.name}_free")
    I = body.inertia  # noqa: E741 - the tensor's letter
    ET.SubElement(
        element,
        "inertial",
        pos=spaced(body.center_of_mass),
        mass=repr(float(body.mass_kg)),
        fullinertia=spaced([I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2]]),
    )
    ET.SubElement(
        element,
        "geom",
        name=f"{o.name}_visual",
        type="mesh",
        mesh=f"{name}_visual",
        material=f"{name}_surface",
        contype="0",
        conaffinity="0",
        group=SEEN,
    )
    for k in range(count):
        # Of two geoms the friction of the one with the higher priority holds: the object's.
        ET.SubElement(
            element,
            "geom",
            name=f"{o.name}_{placed_scene.part_name(k)}",
            type="mesh",
            mesh=f"{name}_{placed_scene.part_name(k)}",
            friction=repr(float(body.friction)),
            priority="1",
            group=COLLIDING,
        )


def _light(world: ET.Element, scene: PlacedScene) -> None:
    """Hang a lamp two metres above the scene, against gravity."""
    at = np.array([o.T_world_obj[:3, 3] for o in scene.objects] or [[0.0, 0.0, 0.0]]).mean(axis=0)
    down, _ = scene.down
    ET.SubElement(world, "light", pos=spaced(at - 2.0 * down), dir=spaced(down))


def _camera(world: ET.Element, camera: SceneCamera) -> None:
    K = camera.intrinsics
    # Only ratios count: the sensor is given in pixels of a millimetre.
    pixel = 1e-3
    shift = [K.width / 2.0 - (K.cx + INSET_PX), K.height / 2.0 - (K.cy + INSET_PX)]
    ET.SubElement(
        world,
        "camera",
        {"name": camera.name, **_pose(interop.T_world_gl_from_cam(camera.T_world_cam))},
        resolution=f"{K.width} {K.height}",
        sensorsize=spaced([K.width * pixel, K.height * pixel]),
        focalpixel=spaced([K.fx, K.fy]),
        principalpixel=spaced(shift),
    )


def _pose(T: Array) -> dict[str, str]:
    return {"pos": spaced(T[:3, 3]), "quat": spaced(se3.quaternion_wxyz(T[:3, :3]))}
