"""Meshes as Wavefront OBJ in metres, with the look that engines show: one texture, or one colour.

Engines do not read colours per vertex, so that these become a texture: every triangle gets a small
square of its own in its mean colour.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, UInt8
from realsim.errors import InputError
from realsim.formats.robot_scenes.placed_scene import RigidBody
from realsim.geometry.mesh_shape import hull_triangles
from realsim.images.png import encode_png
from realsim.records import Mesh

PLAIN_RGB = (0.7, 0.7, 0.7)
"""Colour of meshes without colours."""
TABLE_RGB = (0.72, 0.66, 0.58)
CELL_PX = 4
"""Side of a triangle's square: its middle is two pixels from the next colour, so that smoothing
does not mix them."""
VISUAL, MATERIAL, TEXTURE = "visual.obj", "visual.mtl", "texture.png"


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Look:
    """What a mesh looks like, as every engine can show it."""

    corner_uv: Array | None
    """(F, 3, 2) texture coordinates of the faces' corners, v up; None = there is no texture."""
    texture: UInt8 | None
    """(H, W, 3) RGB, first row at v = 1."""


def look_of(mesh: Mesh) -> Look:
    """Return the look of a mesh."""
    if mesh.uv is not None and mesh.texture is not None:
        return Look(corner_uv=mesh.uv[mesh.faces], texture=mesh.texture)
    if mesh.colors is None:
        return Look(corner_uv=None, texture=None)
    colors = np.rint(mesh.colors[mesh.faces].mean(axis=1)).astype(np.uint8)
    side = math.ceil(math.sqrt(len(colors)))
    rows = math.ceil(len(colors) / side)
    cells = np.zeros((rows * side, 3), dtype=np.uint8)
    cells[: len(colors)] = colors
    texture = cells.reshape(rows, side, 3).repeat(CELL_PX, axis=0).repeat(CELL_PX, axis=1)
    row, column = np.divmod(np.arange(len(colors)), side)
    middle = np.stack([(column + 0.5) / side, 1.0 - (row + 0.5) / rows], axis=-1)
    return Look(corner_uv=np.repeat(middle[:, None], 3, axis=1), texture=texture)


def visual_files(mesh: Mesh) -> dict[str, bytes]:
    """Return the files of a mesh that is seen: OBJ [m], MTL and, where it has one, its texture."""
    look = look_of(mesh)
    files: dict[str, bytes] = {}
    r, g, b = PLAIN_RGB if look.texture is None else (1.0, 1.0, 1.0)
    material = ["newmtl surface", f"Ka {r} {g} {b}", f"Kd {r} {g} {b}", "Ks 0 0 0", "d 1"]
    if look.texture is not None:
        files[TEXTURE] = encode_png(np.ascontiguousarray(look.texture))
        material.append(f"map_Kd {TEXTURE}")
    files[MATERIAL] = _text(material)
    lines = ["# realsim: metres", f"mtllib {MATERIAL}", "o visual", *_vertices(mesh)]
    if look.corner_uv is None:
        faces = [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    else:
        uv, index = np.unique(look.corner_uv.reshape(-1, 2), axis=0, return_inverse=True)
        lines += [f"vt {u!r} {v!r}" for u, v in uv.tolist()]
        corners = np.stack([mesh.faces, index.reshape(-1, 3)], axis=-1).reshape(-1, 6) + 1
        faces = [f"f {a}/{i} {b}/{j} {c}/{k}" for a, i, b, j, c, k in corners.tolist()]
    files[VISUAL] = _text([*lines, "usemtl surface", *faces])
    return files


def part_name(k: int) -> str:
    """Return the name of a convex part."""
    return f"part_{k:03d}"


def mesh_files(home: str, mesh: Mesh, parts: Sequence[Mesh]) -> dict[str, bytes]:
    """Return the files of a body in a folder: of the mesh that is seen, and of each convex part."""
    files = {f"{home}/{name}": data for name, data in visual_files(mesh).items()}
    return files | {f"{home}/{part_name(k)}.obj": part_file(p) for k, p in enumerate(parts)}


def part_file(part: Mesh) -> bytes:
    """Return one convex part as OBJ [m]; coordinates come back bit for bit."""
    faces = [f"f {a} {b} {c}" for a, b, c in (part.faces + 1).tolist()]
    return _text(["# realsim: convex part, metres", "o part", *_vertices(part), *faces])


def _vertices(mesh: Mesh) -> list[str]:
    return [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist()]


def _text(lines: list[str]) -> bytes:
    return ("\n".join(lines) + "\n").encode("ascii")


# --- what collides ------------------------------------------------------------------------------


def convex_part(points: ArrayLike, name: str) -> Mesh:
    """Return the hull of points (V, 3) [m] as a mesh, its faces outward.

    Raises:
        InputError: the points are flat: engines need a volume (MuJoCo four corners and more).
    """
    from scipy.spatial import QhullError

    points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
    try:
        corners, faces = hull_triangles(points)
    except (QhullError, ValueError) as error:
        raise InputError(
            f"{name} ({len(points)} points) is flat: it has no volume that could be collided with. "
            "Leave it out."
        ) from error
    return Mesh(vertices=corners, faces=faces.astype(np.int32))


def collision_parts(body: RigidBody) -> tuple[Mesh, ...]:
    """Return the convex meshes that collide for a body.

    Raises:
        InputError: the mesh is flat.
    """
    if body.parts is not None:
        return body.parts
    return (convex_part(body.model.mesh.vertices, f"the mesh of '{body.model.name}'"),)
