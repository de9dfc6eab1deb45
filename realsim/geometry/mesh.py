"""Triangle meshes in metres: where everything about them is found.

Reading and writing is in `mesh_files`, shape and mass in `mesh_shape`; here are the meshes made of
meshes, their symmetries, and their forms in other libraries.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, UInt8
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.mesh_files import check_unit, load_mesh, ply_bytes, save_ply
from realsim.geometry.mesh_shape import (
    MassProperties,
    decimated,
    diameter,
    face_normals,
    hull_vertices,
    mass_properties,
    sample_surface,
    vertex_normals,
    welded_mesh,
)
from realsim.records import Mesh, ObjectModel

__all__ = [
    "MassProperties",
    "box_corners",
    "box_mesh",
    "check_unit",
    "decimated",
    "diameter",
    "face_normals",
    "hull_vertices",
    "load_mesh",
    "mass_properties",
    "merged",
    "ply_bytes",
    "sample_surface",
    "save_ply",
    "symmetry_transforms",
    "tensor_mesh",
    "texels",
    "to_trimesh",
    "transformed",
    "vertex_colors",
    "vertex_normals",
    "welded_mesh",
]

GREY = 160
"""Colour of a part without colour when it is merged with parts that have one."""
BOX_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
     [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]], dtype=np.int32,
)  # fmt: skip
"""(12, 3) of a box's corners in the order z fastest, outward."""


def box_corners(low: Array, high: Array) -> Array:
    """Return the corners (8, 3) of a box along the axes, z fastest."""
    return low + np.array(list(product((0, 1), repeat=3))) * (high - low)


def box_mesh(low: ArrayLike, high: ArrayLike) -> Mesh:
    """Return a closed box along the axes, from its least corner (3,) to its greatest one."""
    ends = np.array([low, high], dtype=np.float64)
    return Mesh(vertices=np.array(list(product(*ends.T))), faces=BOX_FACES)


def slab_mesh(edge_m: float, thickness_m: float) -> Mesh:
    """Return a square table as a closed box under the plane z = 0, about the origin."""
    half = edge_m / 2
    return box_mesh((-half, -half, -thickness_m), (half, half, 0.0))


def transformed(mesh: Mesh, T: ArrayLike) -> Mesh:
    """Return the mesh with its vertices mapped by a rigid T (4, 4)."""
    T = se3.check_rigid(T, "the transform of the mesh")
    return replace(mesh, vertices=se3.transform(T, mesh.vertices))


def vertex_colors(mesh: Mesh) -> UInt8 | None:
    """Return RGB per vertex (V, 3): its own, or the texture's at its coordinates, or None."""
    if mesh.colors is not None or mesh.texture is None or mesh.uv is None:
        return mesh.colors
    return texels(mesh.texture, mesh.uv)


def texels(texture: UInt8, uv: Array) -> UInt8:
    """Return the RGB (N, 3) of the texels nearest to coordinates (N, 2); the texture repeats."""
    height, width = texture.shape[:2]
    column = np.floor((uv[:, 0] % 1.0) * width).astype(int) % width
    row = np.floor(((1.0 - uv[:, 1]) % 1.0) * height).astype(int) % height
    return texture[row, column]


def merged(meshes: Sequence[Mesh]) -> Mesh:
    """Return one mesh of all; textures become vertex colours, since one mesh has one texture."""
    if not meshes:
        raise InputError("no meshes were given to merge.")
    if len(meshes) == 1:
        return meshes[0]
    starts = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    colors = [vertex_colors(m) for m in meshes]
    grey = [np.full((len(m.vertices), 3), GREY, dtype=np.uint8) for m in meshes]
    has_colors = any(c is not None for c in colors)
    filled = [g if c is None else c for c, g in zip(colors, grey, strict=True)]
    return Mesh(
        vertices=np.concatenate([m.vertices for m in meshes]),
        faces=np.concatenate([m.faces + s for m, s in zip(meshes, starts, strict=True)]),
        colors=np.concatenate(filled) if has_colors else None,
    )


def tensor_mesh(mesh: Mesh) -> Any:
    """Return the open3d.t.geometry.TriangleMesh (float32 positions, int32 triangles)."""
    from realsim.interop import import_open3d

    o3d = import_open3d()
    return o3d.t.geometry.TriangleMesh(
        o3d.core.Tensor(np.ascontiguousarray(mesh.vertices, dtype=np.float32)),
        o3d.core.Tensor(np.ascontiguousarray(mesh.faces, dtype=np.int32)),
    )


def to_trimesh(mesh: Mesh) -> Any:
    """Return the trimesh.Trimesh of the same vertices and faces, nothing merged."""
    import trimesh

    return trimesh.Trimesh(mesh.vertices.copy(), mesh.faces.copy(), process=False)


def symmetry_transforms(model: ObjectModel, max_step_rad: float = 0.1) -> Array:
    """Return all symmetries T_obj_obj (S, 4, 4): discrete times sampled continuous ones.

    As in BOP, a continuous symmetry becomes equal steps about its axis, at most `max_step_rad`
    wide, and every discrete symmetry is followed by every step. The identity comes first.
    """
    if not (0 < max_step_rad <= math.pi):
        raise InputError(f"a step of {max_step_rad} rad is not in (0, pi].")
    if not model.symmetry_axes:
        return model.symmetries.copy()
    turns: list[Array] = []
    for axis, point in model.symmetry_axes:
        direction = np.asarray(axis, dtype=np.float64)
        length = float(np.linalg.norm(direction))
        if not length > 0:
            raise InputError(f"a symmetry axis of '{model.name}' has no direction: {axis}.")
        steps = math.ceil(2 * math.pi / max_step_rad)
        angles = np.arange(0 if not turns else 1, steps) * (2 * math.pi / steps)
        R = se3.exp_so3(angles[:, None] * direction / length)
        p = np.asarray(point, dtype=np.float64)
        turns.append(se3.from_rt(R, p - R @ p))
    continuous = np.concatenate(turns)
    product: Array = continuous[None] @ model.symmetries[:, None]
    return product.reshape(-1, 4, 4)
