"""Meshes of a scene: files inside its folder in the unit that their scale says; convex parts."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Int64
from realsim.errors import InputError, UnitError
from realsim.formats.robot_scenes.placed_scene import RigidBody
from realsim.geometry.mesh import load_mesh, mass_properties
from realsim.records import Mesh
from realsim.untrusted.files import checked_text, file_bytes
from realsim.untrusted.values import path_inside


def convex_part(points: ArrayLike, name: str) -> Mesh:
    """Return the hull of points (V, 3) [m] as a mesh, its faces outward.

    Raises:
        InputError: the points are flat: engines need a volume (MuJoCo four corners and more).
    """
    from scipy.spatial import ConvexHull, QhullError

    points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
    try:
        hull: Any = ConvexHull(points)
    except (QhullError, ValueError) as error:
        raise InputError(
            f"{name} ({len(points)} points) is flat: it has no volume that could be collided with. "
            "Leave it out."
        ) from error
    corners: Int64 = np.sort(hull.vertices)
    number = np.full(len(points), -1)
    number[corners] = np.arange(len(corners))
    faces = number[hull.simplices]
    at = points[corners]
    a, b, c = np.moveaxis(at[faces], 1, 0)
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return Mesh(vertices=at, faces=faces.astype(np.int32))


def collision_parts(body: RigidBody) -> tuple[Mesh, ...]:
    """Return the convex meshes that collide for a body.

    Raises:
        InputError: the mesh is flat.
    """
    if body.parts is not None:
        return body.parts
    return (convex_part(body.model.mesh.vertices, f"the mesh of '{body.model.name}'"),)


MOST_MESH_BYTES = 200e6
"""[bytes]: three million triangles as text; a body of a scene has ten thousand."""
MILLIMETRE_SCALE = 0.01
"""Scales up to this are taken as the conversion of a file in millimetres."""
CONVEX_FILL = 0.98
"""A mesh that fills less of its hull is not convex."""
WORDS_OF_FILES = ("mtllib", "map_", "bump", "disp", "decal", "refl", "norm")
"""Statements of OBJ and MTL that name files."""


def scene_mesh(folder: Path, name: str, scale: Array, where: str, notes: list[str]) -> Mesh:
    """Return a mesh of a scene [m], its scale applied.

    Args:
        folder: which nothing may lead out of.
        name: of the mesh file, as the scene gives it, relative to the folder.
        scale: (3,) that the scene gives.
        where: the place in the scene that names it.
        notes: what is missing of its look is added.

    Raises:
        InputError: the file is missing, broken, too large, or leads out of the folder.
        UnitError: the size of the mesh contradicts the unit.
    """
    if name.startswith(("package://", "model://")):
        raise InputError(
            f"{where} names the mesh '{name[:80]}', which only ROS can look up. Put the file "
            "beside the scene and name it by its path there."
        )
    if "://" in name:
        raise InputError(f"{where} names the mesh '{name[:80]}'; only files in {folder} are read.")
    path = path_inside(folder, name, where)
    file_bytes(path, MOST_MESH_BYTES)
    if path.suffix.lower() == ".obj":
        _require_files_inside(path, folder, where)
    if not (np.all(np.isfinite(scale)) and np.all(np.abs(scale) > 0)):
        raise InputError(f"{where} has the scale {scale.tolist()}; three numbers, none 0, are.")
    # A scale of thousandths is what makes metres of a file in millimetres.
    is_mm = float(np.abs(scale).max()) <= MILLIMETRE_SCALE
    try:
        mesh = load_mesh(path, "mm" if is_mm else "m", notes)
    except UnitError as error:
        raise UnitError(
            f"{where}: with the scale {scale.tolist()} the mesh {path.name} cannot be in metres: "
            f'{error} In a scene, scale="0.001 0.001 0.001" says that a mesh is in millimetres.'
        ) from error
    except (ValueError, IndexError, TypeError) as error:
        # Vertices of two numbers, and what else the reader of the format lets pass.
        raise InputError(f"{where}: {path.name} cannot be read as a mesh ({error}).") from error
    vertices = mesh.vertices * (scale / (1e-3 if is_mm else 1.0))
    faces = mesh.faces[:, ::-1] if np.prod(np.sign(scale)) < 0 else mesh.faces
    return Mesh(
        vertices=vertices, faces=faces, colors=mesh.colors, uv=mesh.uv, texture=mesh.texture
    )


def colliding(mesh: Mesh, where: str, notes: list[str]) -> Mesh:
    """Return the hull of a shape that collides, as engines make it; a note if that changes it.

    Raises:
        InputError: it is flat.
    """
    hull = convex_part(mesh.vertices, where)
    solid = mass_properties(mesh, 1.0)
    if solid.is_watertight and solid.hull_volume_fraction < CONVEX_FILL:
        notes.append(f"{where} is not convex: its hull collides, as engines take it.")
    return hull


def _require_files_inside(path: Path, folder: Path, where: str) -> None:
    """Raise if an OBJ, or a material file of it, names a file outside the folder."""
    for library in _files_named(path):
        found = path_inside(folder, _from(folder, path, library), f"{where}, {path.name}")
        if library.lower().endswith(".mtl") and found.is_file():
            for picture in _files_named(found):
                path_inside(folder, _from(folder, found, picture), f"{where}, {found.name}")


def _files_named(path: Path) -> list[str]:
    lines = checked_text(path, MOST_MESH_BYTES).splitlines()
    found: list[str] = []
    for line in lines:
        words = line.split(maxsplit=1)
        if len(words) == 2 and words[0].lower().startswith(WORDS_OF_FILES):
            found.append(words[1].strip())
    return found


def _from(folder: Path, path: Path, name: str) -> str:
    """Return a name beside a file as one from the folder; a way out stays one."""
    if name.startswith("/") or name[1:2] == ":":
        return name
    return (path.parent.relative_to(folder) / name).as_posix()
