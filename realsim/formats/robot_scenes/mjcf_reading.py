"""Scenes of MJCF: rigid bodies in the world, free or fixed, and the table.

The file is looked through first (no doctype, nothing outside its folder, no plugins), then MuJoCo
compiles it in a process of its own (`mjcf_worker`).
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array
from realsim.errors import InputError, MissingLibraryError, UnitError
from realsim.formats.robot_scenes.mesh_reading import convex_part
from realsim.formats.robot_scenes.mjcf_worker import FAILED, FOUND, MOST_CPU_S, SHAPES
from realsim.formats.robot_scenes.placed_scene import (
    TABLE_NAME,
    PlacedObject,
    PlacedScene,
    RigidBody,
    TableBox,
    unique_names,
)
from realsim.geometry import se3
from realsim.geometry.mesh import check_unit, merged, transformed
from realsim.records import Mesh, ObjectModel
from realsim.untrusted import values
from realsim.untrusted.arrays import read_npz
from realsim.untrusted.files import file_bytes
from realsim.untrusted.json_text import read_json
from realsim.untrusted.xml_tree import read_xml

MOST_FILES = 10_000
MOST_FILE_BYTES = 500e6
"""Most bytes of a mesh or a texture."""
WALL_S = 3.0 * MOST_CPU_S
"""The process is ended after so long by the clock."""
REFUSED = ("extension", "plugin")
"""Elements that load programs."""
FILE_KEYS = ("file", "fileright", "fileleft", "fileup", "filedown", "filefront", "fileback")
FOLDER_KEYS = ("meshdir", "texturedir", "assetdir")
SMALLEST_M = 0.002
PLANE_M = 4.0
"""Side of a table that the file has as an endless plane [m]."""
PLANE_THICKNESS_M = 0.05


def read_mjcf_scene(path: Path | str) -> PlacedScene:
    """Read a scene of MJCF.

    Bodies of the world, free or without joints, become objects; the geom of the world called
    'table', or its only box or plane, is the table.

    Args:
        path: the file, or the folder of a scene.xml.

    Raises:
        InputError: missing, damaged, articulated, or it names files outside of its folder.
        UnitError: a mesh whose size cannot be in metres.
        MissingLibraryError: the extra `mujoco` is not installed.
    """
    path = Path(path)
    path = path / "scene.xml" if path.is_dir() else path
    _require_harmless(path)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _compile(path, folder)
        found = values.mapping(read_json(folder / FOUND), f"what MuJoCo found in {path}")
        shapes = read_npz(folder / SHAPES)
    return _Compiled(path, found, shapes).scene()


# --- before MuJoCo sees it ----------------------------------------------------------------------


def _require_harmless(path: Path) -> None:
    """Raise if a file, or one that it includes, names what is outside or loads programs."""
    folder, todo, seen, count = path.parent, [path], set[Path](), 0
    while todo:
        file = todo.pop()
        if file in seen:
            raise InputError(f"{path} includes {file.name} twice or in a circle.")
        seen.add(file)
        root = read_xml(file)
        if root.tag not in ("mujoco", "mujocoinclude"):
            raise InputError(f"{file} begins with <{root.tag[:40]}>; <mujoco> is expected.")
        for element in root.iter():
            if element.tag in REFUSED:
                raise InputError(f"{file} has <{element.tag}>, which loads programs: remove it.")
            for key in (*FOLDER_KEYS, *FILE_KEYS):
                if not element.get(key):
                    continue
                count += 1
                inner = values.path_inside(folder, element.get(key), f"{key} in {file}")
                if element.tag == "include":
                    todo.append(inner)
                elif inner.is_file():
                    file_bytes(inner, MOST_FILE_BYTES)
        if count > MOST_FILES:
            raise InputError(f"{path} names more than {MOST_FILES} files.")


def _compile(path: Path, folder: Path) -> None:
    command = [sys.executable, "-m", "realsim.formats.robot_scenes.mjcf_worker"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    try:
        done = subprocess.run(
            [*command, str(path.resolve()), str(folder)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            # MuJoCo writes its log where it stands.
            cwd=folder,
            env=environment,
            timeout=WALL_S,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise InputError(f"{path}: MuJoCo had not compiled it after {WALL_S:g} s.") from error
    if (folder / FOUND).is_file():
        return
    if not (folder / FAILED).is_file():
        raise InputError(
            f"{path}: MuJoCo ended while it compiled it (code {done.returncode}): the file takes "
            "more memory or time than a scene needs, or crashes the compiler."
        )
    kind, _, said = (folder / FAILED).read_text(encoding="utf-8").partition(": ")
    if kind == "import":
        raise MissingLibraryError(
            f"reading MJCF needs MuJoCo's compiler, which cannot be imported ({said}). Install the "
            "extra: `pip install 'realsim[mujoco]'` (or `uv sync --extra mujoco`)."
        )
    words = " ".join(said.split())[:400] or "no reason given"
    raise InputError(f"{path} cannot be compiled by MuJoCo: {words}.")


# --- what it found ------------------------------------------------------------------------------


class _Compiled:
    """A compiled file."""

    def __init__(self, path: Path, found: dict[str, Any], shapes: dict[str, NDArray[Any]]) -> None:
        self._path, self._found, self._shapes = path, found, shapes
        self._notes: list[str] = []

    def scene(self) -> PlacedScene:
        """Return the scene."""
        bodies: list[dict[str, Any]] = self._found["bodies"]
        for body in bodies[1:]:
            if body["joints"] == "other" or body["parent"] != 0:
                raise InputError(
                    f"{self._path}: the body '{body['name']}' has joints or hangs on another body; "
                    "scenes of rigid bodies in the world, free or fixed, are read."
                )
        names = unique_names({k: b["name"] or f"body {k}" for k, b in enumerate(bodies) if k})
        known = {
            k: self._body(k, b["name"] or names[k], b)
            for k, b in enumerate(bodies)
            if k and self._geoms(k)
        }
        return PlacedScene(
            name=self._found["name"] or self._path.stem,
            bodies=known,
            objects=tuple(
                PlacedObject(
                    instance=k - 1,
                    name=names[k],
                    obj_id=k,
                    T_world_obj=_pose(bodies[k]),
                    is_fixed=bodies[k]["joints"] == "none",
                )
                for k in known
            ),
            table=self._table(),
            gravity=np.array(self._found["gravity"], dtype=np.float64),
            notes=tuple(dict.fromkeys(self._notes)),
        )

    def _geoms(self, body: int) -> list[dict[str, Any]]:
        geoms: list[dict[str, Any]] = self._found["geoms"]
        return [g for g in geoms if g["body"] == body]

    def _table(self) -> TableBox | None:
        flat = [g for g in self._geoms(0) if g["type"] in ("box", "plane")]
        named = [g for g in flat if g["name"] == TABLE_NAME]
        chosen = named or (flat if len(flat) == 1 else [])
        others = len(self._geoms(0)) - len(chosen[:1])
        if others:
            self._notes.append(f"{others} other shapes of the world were left out.")
        if not chosen:
            return None
        geom = chosen[0]
        x, y, z = (2.0 * float(s) for s in geom["size"])
        if geom["type"] == "plane":
            size = (x or PLANE_M, y or PLANE_M)
            return TableBox(T_world_table=_pose(geom), size_m=size, thickness_m=PLANE_THICKNESS_M)
        T = _pose(geom) @ se3.from_translation([0.0, 0.0, z / 2.0])
        return TableBox(T_world_table=T, size_m=(x, y), thickness_m=z)

    def _body(self, obj_id: int, name: str, body: dict[str, Any]) -> RigidBody:
        geoms = self._geoms(obj_id)
        hits = [g for g in geoms if g["collides"]]
        seen = [g for g in geoms if not g["collides"]] or hits
        parts = tuple(
            convex_part(self._shape(g, name).vertices, f"a shape of '{name}' of {self._path}")
            for g in hits
        )
        if not parts:
            self._notes.append(f"'{name}' has no shape that collides; its hull does.")
        frictions = {float(g["friction"]) for g in hits} or {1.0}
        if len(frictions) > 1:
            self._notes.append(f"'{name}' has shapes of several frictions; the largest is taken.")
        R = se3.from_quaternion_wxyz(np.array(body["iquat"], dtype=np.float64))
        inertia = R @ np.diag(np.array(body["inertia"], dtype=np.float64)) @ R.T
        return RigidBody(
            model=ObjectModel(
                obj_id=obj_id, name=name, mesh=merged([self._shape(g, name) for g in seen])
            ),
            mass_kg=float(body["mass"]),
            center_of_mass=np.array(body["ipos"], dtype=np.float64),
            inertia=0.5 * (inertia + inertia.T),
            friction=max(frictions),
            parts=parts or None,
        )

    def _shape(self, geom: dict[str, Any], name: str) -> Mesh:
        """Return a geom's surface in its body's frame [m]."""
        where = f"a shape of '{name}' of {self._path}"
        if geom["type"] != "mesh":
            return transformed(_primitive(geom, where), _pose(geom))
        k = int(geom["mesh"])
        vertices, faces = self._shapes[f"vertices_{k}"], self._shapes[f"faces_{k}"]
        extent = float(np.ptp(vertices, axis=0).max())
        try:
            check_unit(extent, "m", where)
        except UnitError as error:
            raise UnitError(f'{error} In MJCF that is scale="0.001 0.001 0.001".') from error
        if extent < SMALLEST_M:
            raise UnitError(
                f"{where} is {1e3 * extent:.4g} mm large; at least {1e3 * SMALLEST_M:g} mm is "
                "accepted. Is a mesh in metres scaled by 0.001?"
            )
        uv, texture = self._shapes.get(f"corner_uv_{k}"), None
        if geom["texture"] >= 0 and uv is not None:
            texture = self._shapes.get(f"texture_{int(geom['texture'])}")
        if texture is None or uv is None:
            rgb = np.clip(np.rint(255.0 * np.array(geom["rgba"][:3])), 0, 255).astype(np.uint8)
            mesh = Mesh(vertices=vertices, faces=faces, colors=np.tile(rgb, (len(vertices), 1)))
            return transformed(mesh, _pose(geom))
        # MuJoCo has v down. Corners that share a vertex may have texture coordinates of their own.
        flat = uv.reshape(-1, 2) * [1.0, -1.0] + [0.0, 1.0]
        mesh = Mesh(
            vertices=vertices[faces.ravel()],
            faces=np.arange(faces.size, dtype=np.int32).reshape(-1, 3),
            uv=flat,
            texture=texture,
        )
        return transformed(mesh, _pose(geom))


def _pose(entry: dict[str, Any]) -> Array:
    R = se3.from_quaternion_wxyz(np.array(entry["quat"], dtype=np.float64))
    return se3.from_rt(R, np.array(entry["pos"], dtype=np.float64))


def _primitive(geom: dict[str, Any], where: str) -> Mesh:
    import trimesh

    a, b, c = (float(s) for s in geom["size"])
    kind = geom["type"]
    if kind == "box":
        solid = trimesh.creation.box((2 * a, 2 * b, 2 * c))
    elif kind == "sphere":
        solid = trimesh.creation.icosphere(radius=a)
    elif kind == "cylinder":
        solid = trimesh.creation.cylinder(a, 2 * b, sections=48)
    elif kind == "capsule":
        solid = trimesh.creation.capsule(2 * b, a)
        solid.apply_translation(-solid.bounds.mean(axis=0))
    elif kind == "ellipsoid":
        solid = trimesh.creation.icosphere(radius=1.0)
        solid.apply_scale((a, b, c))
    else:
        raise InputError(
            f"{where} is a {kind}; mesh, box, sphere, cylinder, capsule and ellipsoid are read."
        )
    return Mesh(vertices=np.array(solid.vertices), faces=np.array(solid.faces))
