"""The models folder of GraspNet-1Billion: one folder an object, named by its number, in metres.

Each holds nontextured.ply, textured.obj, mtl and png. An OBJ's texture coordinates have v up, as
realsim's meshes do. Read is a BOP models folder, too: obj_000001.ply is GraspNet's object 000.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from realsim import images
from realsim.errors import InputError
from realsim.formats.bop.models import INFO_FILE, model_file
from realsim.formats.bop.models import load_models as bop_models
from realsim.geometry.mesh import load_mesh, ply_bytes
from realsim.records import Mesh, ObjectModel

PLAIN, TEXTURED, MATERIAL, TEXTURE = (
    "nontextured.ply", "textured.obj", "textured.mtl", "texture_map.png",
)  # fmt: skip
MESH_FILES = ("nontextured.ply", "textured.ply", "textured.obj", "nontextured_simplified.ply")
"""Looked for in a model's folder, in this order."""


def mesh_file(models: Path, number: int) -> Path | None:
    """Return the mesh of an object, None where there is none."""
    home = models / f"{number:03d}"
    found = next((home / name for name in MESH_FILES if (home / name).is_file()), None)
    as_bop = models / model_file(number + 1)
    return as_bop if found is None and as_bop.is_file() else found


def require_meshes(wanted: Collection[int], present: Collection[int], where: str) -> None:
    """Raise if an object id has no mesh.

    Args:
        wanted: ids of a scene.
        present: ids that have one.
        where: what was looked in.

    Raises:
        InputError: what is missing, and what to give.
    """
    missing = sorted(set(wanted) - set(present))
    if missing:
        raise InputError(f"{what_to_give(missing)} Looked in: {where}.")


def what_to_give(missing: Sequence[int]) -> str:
    """Return which meshes are missing, by object ids, and how they are given."""
    first = missing[0]
    return (
        f"there is no mesh of object(s) {', '.join(map(str, missing[:12]))} (GraspNet's "
        f"{', '.join(f'{i - 1:03d}' for i in missing[:12])}). Give "
        f"the models with --models FOLDER: {first - 1:03d}/{PLAIN} or {TEXTURED} [m], as GraspNet "
        f"has them, or {model_file(first)} and {INFO_FILE} [mm], as BOP has them (ids are "
        "GraspNet's numbers + 1)."
    )


def load_models(models: Path, numbers: Collection[int], notes: list[str]) -> dict[int, ObjectModel]:
    """Return the models by id (number + 1); those without a mesh are not there.

    Args:
        models: folder of the models.
        numbers: of the objects.
        notes: what is missing of a model's look is added to it.

    Raises:
        InputError: a mesh is broken.
        UnitError: a mesh is not in metres.
    """
    found: dict[int, ObjectModel] = {}
    files = {number: mesh_file(models, number) for number in sorted(numbers)}
    as_bop = [n + 1 for n, file in files.items() if file and file.parent == models]
    if as_bop:
        found |= bop_models(models, as_bop, notes=notes)
    for number, file in files.items():
        if file is not None and number + 1 not in found:
            mesh = load_mesh(file, "m", notes)
            found[number + 1] = ObjectModel(obj_id=number + 1, name=f"{number:03d}", mesh=mesh)
    return found


def model_files(model: ObjectModel) -> dict[str, bytes]:
    """Return the files of a model's folder, by name."""
    mesh = model.mesh
    files = {PLAIN: ply_bytes(replace(mesh, uv=None, texture=None), "m")}
    textured = mesh.texture is not None and mesh.uv is not None
    if textured and mesh.texture is not None:
        files[TEXTURE] = images.png_bytes(mesh.texture)
    files[MATERIAL] = _material(textured).encode("ascii")
    files[TEXTURED] = _obj(mesh, textured)
    return files


def _material(textured: bool) -> str:
    lines = ["newmtl surface", "Ka 0.2 0.2 0.2", "Kd 1.0 1.0 1.0", "Ks 0.0 0.0 0.0", "d 1.0"]
    return "\n".join([*lines, *([f"map_Kd {TEXTURE}"] if textured else []), ""])


def _obj(mesh: Mesh, textured: bool) -> bytes:
    """Return an OBJ; colours of the vertices stand behind their places, as many programs do it."""
    parts = [f"mtllib {MATERIAL}\n"]
    rows = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices.tolist()]
    if mesh.colors is not None and not textured:
        shades = (mesh.colors / np.float64(255)).tolist()
        rows = [f"{v} {r:.6g} {g:.6g} {b:.6g}" for v, (r, g, b) in zip(rows, shades, strict=True)]
    parts.append("\n".join(rows) + "\n")
    corner = "{0}"
    if textured and mesh.uv is not None:
        parts.append("\n".join(f"vt {u:.9g} {v:.9g}" for u, v in mesh.uv.tolist()) + "\n")
        corner = "{0}/{0}"
    parts.append("usemtl surface\n")
    for a, b, c in (mesh.faces + 1).tolist():
        parts.append(f"f {corner.format(a)} {corner.format(b)} {corner.format(c)}\n")
    return "".join(parts).encode("ascii")
