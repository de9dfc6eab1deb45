"""Faces of a USD mesh as triangles, and its values per face, vertex or corner at their corners."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.models.mesh_pieces import Array, Piece, srgb_from_linear
from realsim.models.mesh_topology import Ints, equal_rows


def triangles_of(counts: Ints, holes: Sequence[int]) -> tuple[Ints, Ints]:
    """Return the corners (T, 3) of fans over polygons, and the polygon (T,) of each triangle.

    Args:
        counts: (F,) corners per polygon; the corners of all polygons are numbered through.
        holes: polygons that are no surface.
    """
    keep = counts >= 3
    keep[np.asarray(holes, dtype=np.int64)] = False
    starts = np.cumsum(counts) - counts
    triangles = np.where(keep, counts - 2, 0)
    face = np.repeat(np.arange(len(counts)), triangles)
    step = np.arange(len(face)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    first = starts[face]
    return np.stack([first, first + step + 1, first + step + 2], axis=-1), face


def corner_values(
    primvars: Any, name: str, counts: Ints, indices: Ints, face: Ints, corners: Ints
) -> Array | None:
    """Return a primvar's values (T, 3, D) at the corners of triangles, or None if there is none.

    Args:
        primvars: the mesh's UsdGeom.PrimvarsAPI.
        name: of the primvar.
        counts: (F,) corners per polygon.
        indices: (C,) vertex of every corner.
        face: (T,) polygon of every triangle.
        corners: (T, 3) corners of every triangle.

    Raises:
        InputError: it has fewer values than the mesh needs.
    """
    primvar = primvars.FindPrimvarWithInheritance(name) if name else None
    if not primvar or not primvar.HasValue():
        return None
    raw = primvar.ComputeFlattened()
    if raw is None or len(raw) == 0:
        return None
    values = np.array(raw, dtype=np.float64)
    values = values.reshape(len(raw), -1)
    kind = str(primvar.GetInterpolation())
    rows = {
        "constant": np.zeros_like(corners),
        "uniform": np.broadcast_to(face[:, None], corners.shape),
        "vertex": indices[corners],
        "varying": indices[corners],
        "faceVarying": corners,
    }[kind]
    if rows.max() >= len(values):
        raise InputError(
            f"primvar '{name}' of '{primvars.GetPath()}' has {len(values)} {kind} values, and "
            f"{int(rows.max()) + 1} or more are needed: the file is broken. Export it again."
        )
    return values[rows]


def vertex_colors_of(piece: Piece, linear: Array) -> Piece:
    """Return the piece with linear colours (T, 3, 3) at its corners as sRGB per vertex."""
    rgb = np.rint(255.0 * srgb_from_linear(linear.reshape(-1, 3))).astype(np.int64)
    first, index = equal_rows(np.column_stack([piece.faces.ravel().astype(np.int64), rgb]))
    return replace(
        piece,
        vertices=piece.vertices[piece.faces.ravel()[first]],
        faces=index.reshape(-1, 3).astype(np.int32),
        colors=rgb[first].astype(np.uint8),
    )


def with_corner_uv(piece: Piece, uv: Array) -> Piece:
    """Return the piece with texture coordinates (T, 3, 2) at its corners, split at seams."""
    _, kind = equal_rows(uv.reshape(-1, 2))
    vertex: NDArray[np.int64] = piece.faces.ravel().astype(np.int64)
    first, index = equal_rows(np.column_stack([vertex, kind]))
    return replace(
        piece,
        vertices=piece.vertices[vertex[first]],
        faces=index.reshape(-1, 3).astype(np.int32),
        uv=uv.reshape(-1, 2)[first],
    )


def joined_corners(piece: Piece) -> Piece:
    """Return the piece without vertices that none of its faces uses."""
    used = np.unique(piece.faces)
    if len(used) == len(piece.vertices):
        return piece
    index = np.zeros(len(piece.vertices), dtype=np.int32)
    index[used] = np.arange(len(used))
    return replace(
        piece,
        vertices=piece.vertices[used],
        faces=index[piece.faces],
        colors=None if piece.colors is None else piece.colors[used],
    )
