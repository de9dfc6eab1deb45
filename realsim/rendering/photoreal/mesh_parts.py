"""Placed meshes with every face corner a vertex of its own, as path tracers want them.

Corners carry the crease-aware normals of the embedded renderer and texture coordinates, which
box projection makes per face. The v of the coordinates goes down here, as Mitsuba reads images.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.rendering.appearance import Material
from realsim.rendering.developing import srgb_decoded
from realsim.rendering.embedded.materials import box_uv, corner_normals, repeats
from realsim.rendering.rays import GRID_M, PlacedMesh, rotated

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class MeshPart:
    """Faces of one placed mesh that share a BSDF; 3 F vertices, one per corner."""

    positions: Array32
    """(3 F, 3) in world, relative to the scene's centre [m]."""
    normals: Array32
    """(3 F, 3) unit, world."""
    uv: Array32 | None
    """(3 F, 2) texture coordinates, v down; None = no image lies on it."""
    colors: Array32 | None
    """(3 F, 3) linear vertex colours."""
    faces_of_mesh: NDArray[np.intp]
    """(F,) which faces of the placed mesh these are."""
    is_mirrored: bool
    """Whether (u, v up, normal) is left-handed on these faces."""
    repeats: bool
    """Whether the images repeat beyond [0, 1]; else their border continues."""


def scene_center(placed: tuple[PlacedMesh, ...]) -> Array:
    """Return where the float32 coordinates have their origin (3,), the same as of `RayScene`."""
    if not placed:
        return np.zeros(3)
    world = [se3.transform(p.T_world_obj, p.mesh.vertices) for p in placed]
    low = np.min([v.min(0) for v in world], axis=0)
    high = np.max([v.max(0) for v in world], axis=0)
    return GRID_M * np.round((low + high) / (2 * GRID_M))


def mesh_parts(
    placed: PlacedMesh, material: Material, colors: NDArray[np.uint8] | None, center: Array
) -> list[MeshPart]:
    """Return a placed mesh as one part, or as two where a normal map meets mirrored coordinates.

    Args:
        placed: the mesh and its pose.
        material: its look.
        colors: (V, 3) sRGB vertex colours that are its look; None = they are not.
        center: (3,) origin of the coordinates in world [m].
    """
    mesh = placed.mesh
    world = se3.transform(placed.T_world_obj, mesh.vertices) - center
    corners = world.astype(np.float32)[mesh.faces]
    normals = rotated(corner_normals(mesh), placed.T_world_obj[:3, :3])
    has_image = any(
        image is not None
        for image in (material.base_color_image, material.roughness_image, material.normal_image)
    )
    uv: Array32 | None = None
    mirrored = np.zeros(len(mesh.faces), bool)
    wraps = True
    if has_image:
        if material.projection == "uv" and mesh.uv is not None:
            uv = mesh.uv[mesh.faces].astype(np.float32)
            wraps = repeats(mesh.uv)
        else:
            uv = box_uv(mesh, material.period_m)
        if material.normal_image is not None:
            mirrored = _signed_area(uv) < 0
    linear = None
    if colors is not None:
        decode = srgb_decoded(np.arange(256) / 255.0).astype(np.float32)
        linear = decode[colors][mesh.faces]

    parts: list[MeshPart] = []
    for side in (False, True):
        rows = np.flatnonzero(mirrored == side)
        if len(rows) == 0:
            continue
        parts.append(
            MeshPart(
                positions=corners[rows].reshape(-1, 3),
                normals=normals[rows].reshape(-1, 3),
                uv=None if uv is None else (uv[rows] * [1, -1] + [0, 1]).reshape(-1, 2),
                colors=None if linear is None else linear[rows].reshape(-1, 3),
                faces_of_mesh=rows,
                is_mirrored=side,
                repeats=wraps,
            )
        )
    return parts


def _signed_area(uv: Array32) -> Array32:
    """Return twice the area (F,) of the faces in the image; negative = wound clockwise."""
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], np.float32)
