"""Roll, pitch and yaw as URDF means them: fixed axes, R = Rz(yaw) Ry(pitch) Rx(roll)."""

from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import ArrayLike

from realsim import interop
from realsim.arrays import Array
from realsim.formats.export_folder import ExportFolder
from realsim.formats.labelled_scene import WrittenScene
from realsim.formats.robot_scenes.placed_scene import (
    TABLE_NAME,
    TABLE_RGB,
    VISUAL,
    WORLD_NAME,
    PlacedObject,
    PlacedScene,
    RigidBody,
    SceneCamera,
    TableBox,
    collision_parts,
    mesh_files,
    part_name,
    spaced,
    told,
)
from realsim.geometry import se3
from realsim.store import atomic


def rpy_from_R(R: ArrayLike) -> Array:
    """Return roll, pitch, yaw (3,) [rad] of a rotation (3, 3).

    Straight up and down (pitch of a right angle) roll and yaw are one turn: yaw takes what it can
    read, roll the rest, so that the rotation comes back in any case.
    """
    R = np.asarray(R, dtype=np.float64)
    yaw = np.arctan2(R[1, 0], R[0, 0])
    s, c = np.sin(yaw), np.cos(yaw)
    pitch = np.arctan2(-R[2, 0], c * R[0, 0] + s * R[1, 0])
    roll = np.arctan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    return np.array([roll, pitch, yaw])


SCENE_FILE, SCRIPT, WORLD_FILE = "scene.json", "load_pybullet.py", "world.urdf"
FORMAT, VERSION = "realsim URDF scene", 1
ABOUT = (
    "Metres, kilograms, seconds. position and orientation_xyzw (quaternion, x y z w) are those of "
    "the URDF's link frame in world, which T_world_obj (4 x 4) says again; not of the centre of "
    "mass. friction is the Coulomb coefficient against the table, which has 1. Cameras look along "
    "+z, x right, y down; K in pixels, integers are pixel centres."
)
TENSOR = ("xx", "xy", "xz", "yy", "yz", "zz")
"""URDF's entries of an inertia."""
TABLE_DENSITY = 700.0
"""Wood's [kg/m^3]: the table stands still, but a link without matter is warned of."""


def write_urdf_scene(
    scene: PlacedScene, folder: ExportFolder, *, progress: Callable[[], None] | None = None
) -> WrittenScene:
    """Write a scene as a folder of URDFs.

    Args:
        scene: the scene.
        folder: what is filled; a body is a piece.
        progress: called once a body.

    Raises:
        InputError: a body without convex parts is flat.
        StorageError: the disk is full, or refuses.
    """
    names = scene.body_names()
    shapes = 0
    for obj_id, name in names.items():
        body = scene.bodies[obj_id]
        parts = collision_parts(body)
        shapes += len(parts)
        piece = f"objects/{name}"
        if not folder.has(piece):
            files = mesh_files(f"objects/meshes/{name}", body.model.mesh, parts)
            link = body_link(body, name, f"meshes/{name}", len(parts))
            files[f"objects/{name}.urdf"] = _robot(name, [link])
            folder.write_piece(piece, files)
        if progress is not None:
            progress()
    files = {SCENE_FILE: atomic.json_bytes(scene_json(scene, names))}
    files[SCRIPT] = Path(__file__).with_name(SCRIPT).read_bytes()
    files[f"{TABLE_NAME}.urdf"] = _robot(TABLE_NAME, [table_link(scene.table)])
    files[WORLD_FILE] = _world(scene, names)
    folder.write_piece(SCENE_FILE, files)
    counts = {"bodies": len(names), "collision shapes": shapes, "cameras": len(scene.cameras)}
    return told(scene, folder.place, counts)


# --- links --------------------------------------------------------------------------------------


def body_link(body: RigidBody, name: str, meshes: str, parts: int) -> ET.Element:
    """Return a body's link: inertial about its centre of mass, visual, convex parts.

    Args:
        body: the body.
        name: of the link.
        meshes: folder of its meshes, from the URDF's.
        parts: how many convex parts there are.
    """
    link = ET.Element("link", name=name)
    _inertial(link, body.mass_kg, body.center_of_mass, body.inertia)
    _mesh_shape(link, "visual", "visual", f"{meshes}/{VISUAL}")
    for k in range(parts):
        _mesh_shape(link, "collision", part_name(k), f"{meshes}/{part_name(k)}.obj")
    _contact(link, body.friction)
    return link


def _inertial(link: ET.Element, mass_kg: float, center: Array, inertia: Array) -> None:
    inertial = ET.SubElement(link, "inertial")
    # The tensor is about this origin, along its axes: the link's, since rpy is zero.
    ET.SubElement(inertial, "origin", xyz=spaced(center), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=repr(float(mass_kg)))
    entries = {f"i{a}{b}": repr(float(inertia["xyz".index(a), "xyz".index(b)])) for a, b in TENSOR}
    ET.SubElement(inertial, "inertia", entries)


def table_link(table: TableBox) -> ET.Element:
    """Return the table's link, whose frame is in the middle of its top face."""
    link = ET.Element("link", name=TABLE_NAME)
    x, y, z = *table.size_m, table.thickness_m
    mass = TABLE_DENSITY * x * y * z
    moments = mass / 12.0 * np.array([y * y + z * z, x * x + z * z, x * x + y * y])
    _inertial(link, mass, np.array([0.0, 0.0, -z / 2.0]), np.diag(moments))
    for kind in ("visual", "collision"):
        shape = ET.SubElement(link, kind, name=f"{TABLE_NAME}_{kind}")
        ET.SubElement(shape, "origin", xyz=spaced([0.0, 0.0, -z / 2.0]), rpy="0 0 0")
        geometry = ET.SubElement(shape, "geometry")
        ET.SubElement(geometry, "box", size=spaced([x, y, z]))
        if kind == "visual":
            material = ET.SubElement(shape, "material", name="table_top")
            ET.SubElement(material, "color", rgba=f"{spaced(TABLE_RGB)} 1")
    _contact(link, 1.0)
    return link


def _mesh_shape(link: ET.Element, kind: str, name: str, file: str) -> None:
    shape = ET.SubElement(link, kind, name=name)
    ET.SubElement(shape, "origin", xyz="0 0 0", rpy="0 0 0")
    ET.SubElement(ET.SubElement(shape, "geometry"), "mesh", filename=file, scale="1 1 1")


def _contact(link: ET.Element, friction: float) -> None:
    """Add what PyBullet reads; other programs pass over it."""
    contact = ET.SubElement(link, "contact")
    ET.SubElement(contact, "lateral_friction", value=repr(float(friction)))


def _robot(name: str, elements: list[ET.Element]) -> bytes:
    robot = ET.Element("robot", name=name)
    robot.extend(elements)
    ET.indent(robot)
    return b'<?xml version="1.0"?>\n' + ET.tostring(robot) + b"\n"


# --- the scene ----------------------------------------------------------------------------------


def _world(scene: PlacedScene, names: dict[int, str]) -> bytes:
    """Return one URDF of everything: the bodies hang on the world by floating joints."""
    elements = [ET.Element("link", name=WORLD_NAME), table_link(scene.table)]
    elements.append(_joint(TABLE_NAME, "fixed", scene.table.T_world_table))
    for o in scene.objects:
        body, name = scene.body(o), names[o.obj_id]
        count = len(collision_parts(body))
        elements.append(body_link(body, o.name, f"objects/meshes/{name}", count))
        elements.append(_joint(o.name, "floating", o.T_world_obj))
    return _robot(scene.name, elements)


def _joint(child: str, kind: str, T: Array) -> ET.Element:
    joint = ET.Element("joint", name=f"{WORLD_NAME}_to_{child}", type=kind)
    ET.SubElement(joint, "parent", link=WORLD_NAME)
    ET.SubElement(joint, "child", link=child)
    rpy = rpy_from_R(T[:3, :3])
    ET.SubElement(joint, "origin", xyz=spaced(T[:3, 3]), rpy=spaced(rpy))
    return joint


def scene_json(scene: PlacedScene, names: dict[int, str]) -> dict[str, Any]:
    """Return what scene.json holds."""
    table = scene.table
    return {
        "format": FORMAT,
        "version": VERSION,
        "about": ABOUT,
        "name": scene.name,
        "gravity": scene.gravity.tolist(),
        "table": {
            "urdf": f"{TABLE_NAME}.urdf",
            **_pose(table.T_world_table, "T_world_table"),
            "size_m": list(table.size_m),
            "thickness_m": table.thickness_m,
        },
        "objects": [_object(o, scene.body(o), names[o.obj_id]) for o in scene.objects],
        "cameras": [_camera(c) for c in scene.cameras],
    }


def _object(o: PlacedObject, body: RigidBody, name: str) -> dict[str, Any]:
    return {
        "name": o.name,
        "instance": o.instance,
        "obj_id": o.obj_id,
        "model": body.model.name,
        "urdf": f"objects/{name}.urdf",
        "fixed": False,
        "friction": body.friction,
        **_pose(o.T_world_obj, "T_world_obj"),
    }


def _camera(c: SceneCamera) -> dict[str, Any]:
    K = c.intrinsics
    return {
        "name": c.name,
        "width": K.width,
        "height": K.height,
        "K": K.K.tolist(),
        "distortion": K.distortion.tolist(),
        **_pose(c.T_world_cam, "T_world_cam"),
    }


def _pose(T: Array, name: str) -> dict[str, Any]:
    position, xyzw = interop.pybullet_from_T(se3.check_rigid(T, name))
    return {"position": position, "orientation_xyzw": xyzw, name: T.tolist()}
