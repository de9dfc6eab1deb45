"""Scenes of URDFs: a folder with scene.json, as `urdf` writes it, or one URDF of a world."""

from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.robot_scenes.placed_scene import (
    GRAVITY,
    TABLE_NAME,
    PlacedObject,
    PlacedScene,
    RigidBody,
    SceneCamera,
    TableBox,
    unique_names,
)
from realsim.formats.robot_scenes.urdf import FORMAT, SCENE_FILE, VERSION
from realsim.formats.robot_scenes.urdf_links import Link, read_links
from realsim.geometry import se3
from realsim.interop import T_from_pybullet
from realsim.records import CameraIntrinsics, ObjectModel
from realsim.untrusted import values
from realsim.untrusted.json_text import read_json

MOST_OBJECTS = 10_000
SAME_POSE = 1e-5
"""Position [m] and rotation entries of two ways to say one pose agree to this."""
ASSUMED_FRICTION = 1.0


def read_urdf_scene(path: Path | str) -> PlacedScene:
    """Read a scene of URDFs.

    Args:
        path: a folder with scene.json, that file, or a URDF whose bodies hang on its root by fixed
            and floating joints. A fixed link of the name 'table' that is a box is the table.

    Raises:
        InputError: something is missing, damaged, outside of the folder, or articulated.
        UnitError: a mesh whose size contradicts its unit.
    """
    path = Path(path)
    path = path / SCENE_FILE if path.is_dir() else path
    if path.suffix.lower() in (".urdf", ".xml"):
        return _world(path)
    return _folder(path)


# --- a folder -----------------------------------------------------------------------------------


def _folder(path: Path) -> PlacedScene:
    data = values.mapping(read_json(path, most_bytes=50e6), str(path))
    if data.get("format") != FORMAT or data.get("version") != VERSION:
        raise InputError(
            f"{path} says it is '{str(data.get('format'))[:60]}' of version "
            f"{str(data.get('version'))[:20]}; '{FORMAT}' of version {VERSION} is read."
        )
    folder, notes = path.parent, list[str]()
    listed: Any = data.get("objects")
    if not isinstance(listed, list) or len(listed) > MOST_OBJECTS:  # pyright: ignore[reportUnknownArgumentType]
        raise InputError(f"'objects' of {path} is no list of at most {MOST_OBJECTS} objects.")
    bodies: dict[int, RigidBody] = {}
    files: dict[int, str] = {}
    objects: list[PlacedObject] = []
    rows: list[Any] = list(listed)  # pyright: ignore[reportUnknownArgumentType]
    for k, value in enumerate(rows):
        where = f"object {k + 1} of {path}"
        row = values.mapping(value, where)
        obj_id = values.whole(row.get("obj_id"), f"'obj_id' of {where}", 1, 2**31)
        file = values.text(row.get("urdf"), f"'urdf' of {where}")
        if files.setdefault(obj_id, file) != file:
            raise InputError(f"{where}: object {obj_id} is in {files[obj_id]} and in {file}.")
        if obj_id not in bodies:
            name = values.text(row.get("model", row.get("name")), f"'model' of {where}")
            bodies[obj_id] = _single(folder, file, obj_id, name, row, where, notes)
        objects.append(
            PlacedObject(
                instance=values.whole(row.get("instance"), f"'instance' of {where}", 0, 2**31),
                name=values.text(row.get("name"), f"'name' of {where}"),
                obj_id=obj_id,
                T_world_obj=_pose(row, "T_world_obj", where),
                is_fixed=row.get("fixed") is True,
            )
        )
    return PlacedScene(
        name=values.text(data.get("name"), f"'name' of {path}"),
        bodies=bodies,
        objects=tuple(objects),
        table=_table(data.get("table"), path),
        gravity=values.numbers(data.get("gravity"), 3, f"'gravity' of {path}"),
        cameras=_cameras(data.get("cameras", []), path),
        notes=tuple(dict.fromkeys(notes)),
    )


def _single(
    folder: Path,
    file: str,
    obj_id: int,
    name: str,
    row: dict[str, Any],
    where: str,
    notes: list[str],
) -> RigidBody:
    """Return the body of a URDF with one link."""
    path = values.path_inside(folder, file, f"'urdf' of {where}")
    _, links = read_links(path, folder, notes)
    if len(links) != 1 or links[0].movement != "root":
        raise InputError(
            f"{path} has {len(links)} links with a shape; an object of a scene is one link, the "
            "root."
        )
    friction = row.get("friction", links[0].friction)
    known = None if friction is None else values.number(friction, f"'friction' of {where}", 0.0)
    return _body(links[0], obj_id, name, known, notes)


def _pose(row: dict[str, Any], name: str, where: str) -> Array:
    """Return the pose of an entry, which its position and quaternion have to say too."""
    T: Array | None = None
    if name in row:
        value: Any = row[name]
        if not isinstance(value, list) or len(value) != 4:  # pyright: ignore[reportUnknownArgumentType]
            raise InputError(f"'{name}' of {where} is no list of 4 rows.")
        rows: list[Any] = list(value)  # pyright: ignore[reportUnknownArgumentType]
        T = np.stack([values.numbers(r, 4, f"a row of '{name}' of {where}") for r in rows])
        T = se3.check_rigid(T, f"'{name}' of {where}")
    if "position" not in row and T is not None:
        return T
    position = values.numbers(row.get("position"), 3, f"'position' of {where}")
    xyzw = values.numbers(row.get("orientation_xyzw"), 4, f"'orientation_xyzw' of {where}")
    if abs(float(np.linalg.norm(xyzw)) - 1.0) > 0.01:
        raise InputError(f"'orientation_xyzw' of {where} is {xyzw.tolist()}, not of length 1.")
    other = T_from_pybullet(position, xyzw)
    if T is not None and np.abs(T - other).max() > SAME_POSE:
        raise InputError(
            f"{where} says two poses: '{name}' and position/orientation_xyzw differ by "
            f"{float(np.abs(T - other).max()):.3g}. Leave one of them away."
        )
    return other if T is None else T


def _table(value: Any, path: Path) -> TableBox | None:
    if value is None:
        return None
    where = f"'table' of {path}"
    row = values.mapping(value, where)
    x, y = values.numbers(row.get("size_m"), 2, f"'size_m' of {where}").tolist()
    return TableBox(
        T_world_table=_pose(row, "T_world_table", where),
        size_m=(x, y),
        thickness_m=values.number(row.get("thickness_m"), f"'thickness_m' of {where}"),
    )


def _cameras(value: Any, path: Path) -> tuple[SceneCamera, ...]:
    if not isinstance(value, list) or len(value) > MOST_OBJECTS:  # pyright: ignore[reportUnknownArgumentType]
        raise InputError(f"'cameras' of {path} is no list of at most {MOST_OBJECTS} cameras.")
    rows: list[Any] = list(value)  # pyright: ignore[reportUnknownArgumentType]
    found: list[SceneCamera] = []
    for k, item in enumerate(rows):
        where = f"camera {k + 1} of {path}"
        row = values.mapping(item, where)
        K: Any = row.get("K")
        if not isinstance(K, list) or len(K) != 3:  # pyright: ignore[reportUnknownArgumentType]
            raise InputError(f"'K' of {where} is no list of 3 rows.")
        lines: list[Any] = list(K)  # pyright: ignore[reportUnknownArgumentType]
        intrinsics = CameraIntrinsics.from_K(
            np.stack([values.numbers(r, 3, f"a row of 'K' of {where}") for r in lines]),
            values.whole(row.get("width"), f"'width' of {where}", 1, 1e6),
            values.whole(row.get("height"), f"'height' of {where}", 1, 1e6),
            values.numbers(row.get("distortion", []), None, f"'distortion' of {where}"),
        )
        found.append(
            SceneCamera(
                name=values.text(row.get("name"), f"'name' of {where}"),
                intrinsics=intrinsics,
                T_world_cam=_pose(row, "T_world_cam", where),
            )
        )
    return tuple(found)


# --- one file of a world ------------------------------------------------------------------------


def _world(path: Path) -> PlacedScene:
    notes: list[str] = []
    name, links = read_links(path, path.parent, notes)
    tables = [k for k in links if k.name == TABLE_NAME and k.box and k.movement != "floating"]
    links = [k for k in links if k not in tables]
    names = unique_names({k: link.name for k, link in enumerate(links)})
    if len(links) > MOST_OBJECTS:
        raise InputError(f"{path} has {len(links)} bodies; at most {MOST_OBJECTS} are read.")
    notes.append(f"a URDF says nothing of gravity; {GRAVITY} m/s^2 along -z is assumed.")
    return PlacedScene(
        name=name,
        bodies={
            k + 1: _body(link, k + 1, link.name, link.friction, notes)
            for k, link in enumerate(links)
        },
        objects=tuple(
            PlacedObject(
                instance=k,
                name=names[k],
                obj_id=k + 1,
                T_world_obj=link.T_root_link,
                is_fixed=link.movement == "fixed",
            )
            for k, link in enumerate(links)
        ),
        table=_table_of(tables[0]) if tables else None,
        gravity=np.array([0.0, 0.0, -GRAVITY]),
        notes=tuple(dict.fromkeys(notes)),
    )


def _table_of(link: Link) -> TableBox:
    assert link.box is not None
    T_link_box, size = link.box
    T = link.T_root_link @ T_link_box @ se3.from_translation([0.0, 0.0, size[2] / 2.0])
    return TableBox(
        T_world_table=T, size_m=(float(size[0]), float(size[1])), thickness_m=float(size[2])
    )


def _body(
    link: Link, obj_id: int, name: str, friction: float | None, notes: list[str]
) -> RigidBody:
    if friction is None:
        notes.append(f"'{name}' has no friction; {ASSUMED_FRICTION:g} is assumed.")
        friction = ASSUMED_FRICTION
    if not link.parts:
        notes.append(f"'{name}' has no collision shape; its hull collides.")
    return RigidBody(
        model=ObjectModel(obj_id=obj_id, name=name, mesh=link.visual),
        mass_kg=link.matter.mass_kg,
        center_of_mass=link.matter.center_of_mass,
        inertia=link.matter.inertia,
        friction=friction,
        parts=link.parts or None,
    )
