"""Scenes of GraspIT written: scene.yaml, assets/*.stl, grasps.hdf5, as their authors lay them out.

Quaternions are w x y z, as the authors' own scene proves. Grasps stand in world, each beside its
half turn about the approach axis. Meshes are STL in metres.
"""

import io
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.export_folder import ExportFolder
from realsim.formats.graspit.grasps import GRASP_FILE, WorldGrasps
from realsim.formats.graspit.scene import SCENE_FILE, TABLE
from realsim.formats.labelled_scene import WrittenScene
from realsim.formats.robot_scenes.placed_scene import (
    PlacedScene,
    TableBox,
    part_file,
    seen_from,
    unique_names,
)
from realsim.geometry import se3
from realsim.geometry.mesh import box_mesh, face_normals
from realsim.records import GraspSet, Mesh

ASSETS = "assets"
UPRIGHT_RAD = 0.02
"""A table that leans less in world is level: calibrations are off by so much."""
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
PLAIN_TEXT = re.compile(r"[A-Za-z_][A-Za-z0-9_./-]*")
NOT_TEXT = frozenset(("y", "n", "yes", "no", "on", "off", "true", "false", "null"))
"""What YAML would take for something else."""


def paired_grasps(grasps: GraspSet) -> WorldGrasps:
    """Return tried grasps with their half turns about the approach axis."""
    T = grasps.Ts_obj_grasp
    return WorldGrasps(
        obj_id=grasps.obj_id,
        instance=grasps.instance,
        Ts_obj_grasp=np.stack([T, T @ HALF_TURN], axis=1),
        widths_m=grasps.widths_m,
    )


def write_graspit(
    scene: PlacedScene,
    grasps: Sequence[WorldGrasps],
    folder: ExportFolder,
    *,
    progress: Callable[[], None] | None = None,
) -> WrittenScene:
    """Write a scene and its grasps.

    Args:
        scene: the scene. Where its table leans in world, it is written in the table's frame: the
            format has z up.
        grasps: of its objects, in the objects' frames; see `paired_grasps`.
        folder: what is filled; a mesh is a piece.
        progress: called once a mesh.

    Raises:
        InputError: grasps of an object that is not in the scene.
        StorageError: the disk is full, or refuses.
    """
    scene, notes = _upright(scene)
    names = unique_names({o.instance: o.name for o in scene.objects})
    files = scene.body_names()
    for obj_id, name in files.items():
        piece = f"{ASSETS}/{name}"
        if not folder.has(piece):
            folder.write_piece(piece, {f"{piece}.stl": stl_bytes(scene.bodies[obj_id].model.mesh)})
        if progress is not None:
            progress()
    bare = [n for i, n in files.items() if scene.bodies[i].model.mesh.texture is not None]
    bare += [n for i, n in files.items() if scene.bodies[i].model.mesh.colors is not None]
    if bare:
        notes.append(f"STL has no colours; those of {', '.join(bare)} are not written.")
    grasp_path = (folder.place / GRASP_FILE).relative_to(folder.folder).as_posix()
    rows = {"grasp_path": grasp_path, **_rows(scene, names, files)}
    last = {SCENE_FILE: yaml_text(rows).encode("utf-8")}
    last[f"{ASSETS}/{TABLE}.obj"] = part_file(table_mesh(scene.table))
    by_name = _world_grasps(scene, grasps, names)
    if by_name:
        last[GRASP_FILE] = hdf5_bytes(by_name)
    folder.write_piece(SCENE_FILE, last)
    counts = {"meshes": len(files), "grasps": sum(len(T) for T in by_name.values())}
    return WrittenScene(
        name=scene.name, folder=folder.place, frames=0, frames_written=0,
        objects=len(scene.objects), notes=tuple(notes), counts=counts,
    )  # fmt: skip


def _upright(scene: PlacedScene) -> tuple[PlacedScene, list[str]]:
    """Return the scene with z up, and what was done."""
    up = scene.table.T_world_table[:3, 2]
    if np.arccos(np.clip(up[2], -1.0, 1.0)) <= UPRIGHT_RAD:
        return scene, []
    said = "the table leans in world; poses are in the table's frame, whose z is up."
    return seen_from(scene, scene.table.T_world_table), [said]


# --- scene.yaml ---------------------------------------------------------------------------------


def _rows(scene: PlacedScene, names: Mapping[int, str], files: Mapping[int, str]) -> dict[str, Any]:
    """Return the objects and the table, in the order of the authors' file."""
    rows: dict[str, Any] = {}
    for k, o in enumerate(scene.objects):
        rows[f"object{k + 1}"] = {
            "file_path": f"{ASSETS}/{files[o.obj_id]}.stl",
            "name": names[o.instance],
            "orientation": se3.quaternion_wxyz(o.T_world_obj[:3, :3]).tolist(),
            "position": o.T_world_obj[:3, 3].tolist(),
            "scale": [1, 1, 1],
        }
    rows[TABLE] = {
        "file_path": f"{ASSETS}/{TABLE}.obj",
        "name": TABLE,
        "orientation": [1.0, 0.0, 0.0, 0.0],
        "position": [0.0, 0.0, 0.0],
        "scale": [1, 1, 1],
    }
    return rows


def yaml_text(rows: Mapping[str, Any]) -> str:
    """Return values as the authors' files have them: a line a value, lists in brackets."""
    lines: list[str] = []
    for key, value in rows.items():
        if isinstance(value, Mapping):
            inner = cast("Mapping[str, Any]", value)
            lines.append(f"{_scalar(key)}:")
            lines += [f"  {_scalar(k)}: {_scalar(v)}" for k, v in inner.items()]
        else:
            lines.append(f"{_scalar(key)}: {_scalar(value)}")
    return "\n".join(lines) + "\n"


def _scalar(value: Any) -> str:
    """Return a plain value; numbers come back bit for bit."""
    if isinstance(value, str):
        is_plain = PLAIN_TEXT.fullmatch(value) and value.lower() not in NOT_TEXT
        return value if is_plain else json.dumps(value)
    if isinstance(value, float):
        text = repr(value)
        # PyYAML takes 1e-05 for a text: it wants the dot.
        return text.replace("e", ".0e") if "e" in text and "." not in text else text
    if isinstance(value, Sequence):
        return f"[{', '.join(_scalar(v) for v in cast('Sequence[Any]', value))}]"
    return json.dumps(value)


# --- grasps and meshes --------------------------------------------------------------------------


def _world_grasps(
    scene: PlacedScene, grasps: Sequence[WorldGrasps], names: Mapping[int, str]
) -> dict[str, Array]:
    """Return Ts_world_grasp (N, 2, 4, 4) by the object's name."""
    Ts_world_obj = {o.instance: o.T_world_obj for o in scene.objects}
    found: dict[str, Array] = {}
    for one in grasps:
        if one.instance not in Ts_world_obj:
            raise InputError(
                f"there are grasps of instance {one.instance}, which is not in scene "
                f"'{scene.name}'; it has {', '.join(map(str, Ts_world_obj)) or 'no objects'}."
            )
        Ts = Ts_world_obj[one.instance] @ np.asarray(one.Ts_obj_grasp, dtype=np.float64)
        found[names[one.instance]] = Ts
    return found


def hdf5_bytes(by_name: Mapping[str, Array]) -> bytes:
    """Return grasps.hdf5; the same grasps give the same bytes."""
    import h5py

    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for name in sorted(by_name):
            file.create_dataset(name, data=by_name[name], track_times=False)
    return buffer.getvalue()


def stl_bytes(mesh: Mesh) -> bytes:
    """Return a mesh as binary STL [m]; corners are float32."""
    table = np.zeros(
        len(mesh.faces),
        dtype=[("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")],
    )
    table["normal"] = face_normals(mesh)
    table["corners"] = mesh.vertices[mesh.faces]
    header = b"realsim: metres".ljust(80, b" ")
    return header + np.array(len(mesh.faces), dtype="<u4").tobytes() + table.tobytes()


def table_mesh(table: TableBox) -> Mesh:
    """Return the table in world, 12 triangles [m]."""
    half = np.array([*table.size_m, table.thickness_m]) / 2.0
    box = box_mesh(-half, half)
    return replace(box, vertices=se3.transform(table.T_world_box, box.vertices))
