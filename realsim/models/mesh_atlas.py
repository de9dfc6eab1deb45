"""Pieces with several materials become one mesh with one texture.

One texture stays as it is. Several are laid side by side into an atlas, texel by texel, with a
border around each. A texture that repeats is laid out as often as its faces need it.
"""

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Image, Int32, Int64
from realsim.geometry.colors import light_of_bytes, srgb_encoded
from realsim.geometry.mesh import GREY
from realsim.models.mesh_topology import equal_rows
from realsim.models.model_records import ScanUnit, UpAxis
from realsim.records import Mesh


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Piece:
    """A part of a mesh file that has one material, in the file's units and axes."""

    name: str
    """What the file calls it."""
    vertices: Array
    """(V, 3)."""
    faces: Int32
    """(F, 3), outside counter-clockwise as far as the file says."""
    colors: Image | None = None
    """(V, 3) RGB per vertex."""
    uv: Array | None = None
    """(V, 2) texture coordinates, v up, any range: textures repeat."""
    image: Image | None = None
    """(H, W, 3) RGB, first row at v = 1; needs `uv`."""
    image_key: Hashable = None
    """Equal for pieces that share an image."""
    color: tuple[int, int, int] | None = None
    """RGB of the whole piece where it has neither colours nor an image; None: the file says
    nothing."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FileContent:
    """What a mesh file holds and what it says about itself."""

    pieces: tuple[Piece, ...]
    declared: dict[str, str] = field(default_factory=dict[str, str])
    """What the file states in its own words: format, generator, ..."""
    notes: tuple[str, ...] = ()
    up: UpAxis | None = None
    """The axis that points up, where the file or its format says so."""
    unit: ScanUnit | None = None
    """The unit that the file itself states."""
    format_unit: ScanUnit | None = None
    """The unit that the format prescribes, whether the program that wrote it knew or not."""


def placed(piece: Piece, matrix: ArrayLike) -> tuple[Piece, bool]:
    """Return the piece moved by an affine matrix (4, 4), and whether that mirrors it.

    A mirror turns the inside out: the winding is turned back, so that what was outside stays
    outside. glTF and USD prescribe it so.
    """
    m = np.asarray(matrix, dtype=np.float64)
    is_mirrored = bool(np.linalg.det(m[:3, :3]) < 0)
    faces = piece.faces[:, ::-1] if is_mirrored else piece.faces
    vertices = piece.vertices
    if not np.array_equal(m, np.eye(4)):
        vertices = vertices @ m[:3, :3].T + m[:3, 3]
    return replace(piece, vertices=vertices, faces=faces), is_mirrored


def srgb8(linear: ArrayLike) -> Image:
    """Return the sRGB bytes of linear light, clipped to [0, 1]."""
    light = np.clip(np.asarray(linear, dtype=np.float64), 0.0, 1.0)
    return np.rint(255.0 * srgb_encoded(light)).astype(np.uint8)


def rgb8(linear: ArrayLike) -> tuple[int, int, int]:
    """Return the RGB bytes of a linear colour (3,) in [0, 1], as glTF and USD state them."""
    r, g, b = srgb8(np.asarray(linear)[:3]).tolist()
    return r, g, b


def tinted(image: Image, factor: ArrayLike) -> Image:
    """Return the image with its linear values multiplied by a factor (3,) in [0, 1]."""
    scale = np.asarray(factor, dtype=np.float64)[:3]
    if np.allclose(scale, 1.0, atol=0.5 / 255.0):
        return image
    table = light_of_bytes(np.arange(256))
    out = [srgb8(table * s) for s in scale]
    return np.stack([out[k][image[..., k]] for k in range(3)], axis=-1)


def transformed_uv(
    uv: Array, offset: ArrayLike, rotation: float, scale: ArrayLike, *, v_down: bool
) -> Array:
    """Return texture coordinates (N, 2), v up, scaled, then turned by [rad], then shifted.

    Args:
        uv: the coordinates.
        offset: (2,) in texture widths and heights.
        rotation: counter-clockwise in the axes in which the transform is stated [rad].
        scale: (2,).
        v_down: whether the transform is stated for v pointing down (glTF's KHR_texture_transform)
            or up (USD's UsdTransform2d).
    """
    p = np.array(uv)
    if v_down:
        p[:, 1] = 1.0 - p[:, 1]
    # With v down, glTF's matrix [[c, s], [-s, c]] turns counter-clockwise as one sees it.
    c, s = np.cos(rotation), np.sin(rotation) * (-1.0 if v_down else 1.0)
    p = (p * np.asarray(scale)) @ np.array([[c, -s], [s, c]]).T + np.asarray(offset)
    if v_down:
        p[:, 1] = 1.0 - p[:, 1]
    return p


def image_array(image: Any) -> Image:
    """Return the RGB array (H, W, 3) of a PIL image; transparency is left out."""
    return np.asarray(image.convert("RGB"), dtype=np.uint8)


BORDER_PX = 4
"""Texels repeated around every texture of an atlas, so that interpolation does not mix two."""
TILE_SLACK = 1e-3
"""Texture coordinates may leave 0 .. 1 by so much from rounding [-]; more means a repeat."""
LARGEST_TEXTURE_PX = 4096 * 4096
"""A repeated texture with more texels is reduced: the largest size that every renderer takes."""
LARGEST_ATLAS_PX = 8192 * 8192
"""Bound on all textures together: 200 MB of RGB."""
SWATCH_PX = 3
"""Side of the square that a plain colour has in an atlas: its middle is mixed with nothing."""
PALETTE_COLORS = 4096
"""With more different colours of faces they are rounded to 4 bits per channel."""


@dataclass(frozen=True, eq=False, slots=True)
class _Tile:
    image: Image
    pieces: list[int]


def one_mesh(pieces: Sequence[Piece]) -> tuple[Mesh, tuple[str, ...]]:
    """Return all pieces as one mesh and what happened to their colours.

    Without any texture colours become colours per vertex. With one texture for all, the mesh has
    it. Otherwise an atlas is made, into which plain and painted pieces go as swatches, one colour
    per face.
    """
    notes: list[str] = []
    keys = {p.image_key for p in pieces if p.image is not None}
    if not keys:
        return _concatenated(pieces, _all_colors(pieces), None), ()
    shared = next(p.image for p in pieces if p.image is not None)
    if len(keys) == 1 and all(p.image is not None for p in pieces):
        if any(_repeats(p) for p in pieces):
            notes.append("the texture repeats: texture coordinates leave 0 .. 1.")
        return _concatenated(pieces, None, shared), tuple(notes)
    flat = [_unrolled(p, notes) if p.image is not None else p for p in pieces]
    flat = _with_swatches(flat, notes)
    tiles = _tiles(flat)
    atlas, corners = _packed([t.image for t in tiles], notes)
    height, width = atlas.shape[:2]
    for tile, (x, y, w, h) in zip(tiles, corners, strict=True):
        for i in tile.pieces:
            uv = flat[i].uv
            assert uv is not None  # every piece of a tile has them
            # Texel columns and rows from the top left, then back to coordinates with v up.
            u = (x + uv[:, 0] * w) / width
            v = 1.0 - (y + (1.0 - uv[:, 1]) * h) / height
            flat[i] = replace(flat[i], uv=np.stack([u, v], axis=-1))
    notes.append(f"{len(tiles)} textures were laid into one of {width} x {height} texels.")
    return _concatenated(flat, None, atlas), tuple(notes)


def _concatenated(pieces: Sequence[Piece], colors: Image | None, texture: Image | None) -> Mesh:
    starts = np.cumsum([0, *(len(p.vertices) for p in pieces[:-1])])
    uvs = [p.uv for p in pieces if p.uv is not None]
    return Mesh(
        vertices=np.concatenate([p.vertices for p in pieces]),
        faces=np.concatenate([p.faces + s for p, s in zip(pieces, starts, strict=True)]),
        colors=colors,
        uv=np.concatenate(uvs) if texture is not None else None,
        texture=texture,
    )


def _all_colors(pieces: Sequence[Piece]) -> Image | None:
    """Return colours per vertex of all pieces, grey where a piece has none, or None."""
    if all(p.colors is None and p.color is None for p in pieces):
        return None
    return np.concatenate([_own_colors(p) for p in pieces])


def _own_colors(piece: Piece) -> Image:
    if piece.colors is not None:
        return piece.colors
    return np.tile(np.array(piece.color or (GREY,) * 3, dtype=np.uint8), (len(piece.vertices), 1))


def _repeats(piece: Piece) -> bool:
    uv = piece.uv
    return uv is not None and bool(uv.min() < -TILE_SLACK or uv.max() > 1.0 + TILE_SLACK)


def split_by(piece: Piece, kinds: Int64) -> tuple[Piece, Int64]:
    """Give corners of a vertex that differ in kinds (3 F, K) vertices of their own.

    Returns:
        The piece, and for each of its vertices a corner (of 3 F) that it was made for.
    """
    corners = np.column_stack([piece.faces.ravel().astype(np.int64), kinds])
    first, index = equal_rows(corners)
    rows = corners[first, 0]
    new = replace(
        piece,
        vertices=piece.vertices[rows],
        faces=index.reshape(-1, 3).astype(np.int32),
        colors=None if piece.colors is None else piece.colors[rows],
        uv=None if piece.uv is None else piece.uv[rows],
    )
    return new, first


def _unrolled(piece: Piece, notes: list[str]) -> Piece:
    """Return the piece with texture coordinates in 0 .. 1, its texture repeated as needed."""
    assert piece.uv is not None and piece.image is not None
    if not _repeats(piece):
        return replace(piece, uv=np.clip(piece.uv, 0.0, 1.0))
    # Every face is shifted by whole repeats until its least corner lies in the first one.
    base = np.floor(piece.uv[piece.faces].min(axis=1) + TILE_SLACK).astype(np.int64)
    _, kind = equal_rows(base)
    new, corner = split_by(piece, np.repeat(kind, 3))
    face = corner // 3
    assert new.uv is not None
    uv = new.uv - base[face]
    across, up = (max(1, math.ceil(float(m) - TILE_SLACK)) for m in uv.max(axis=0))
    image = piece.image
    texels = image.shape[0] * image.shape[1] * across * up
    if texels > LARGEST_TEXTURE_PX:
        image = _shrunk(image, math.sqrt(LARGEST_TEXTURE_PX / texels))
        notes.append(
            f"'{piece.name}' repeats its texture {across} x {up} times; it was reduced to "
            f"{image.shape[1]} x {image.shape[0]} texels to fit an atlas."
        )
    return replace(
        new,
        uv=np.clip(uv / [across, up], 0.0, 1.0),
        image=np.tile(image, (up, across, 1)),
        image_key=(piece.image_key, across, up),
    )


def _shrunk(image: Image, factor: float) -> Image:
    import cv2

    height, width = (max(1, int(n * factor)) for n in image.shape[:2])
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _with_swatches(pieces: Sequence[Piece], notes: list[str]) -> list[Piece]:
    """Return the pieces, those without a texture given one of squares of their colours."""
    bare = [i for i, p in enumerate(pieces) if p.image is None]
    out = list(pieces)
    if not bare:
        return out
    of_face = [_own_colors(pieces[i])[pieces[i].faces].mean(axis=1).round() for i in bare]
    colors = np.concatenate(of_face).astype(np.int64)
    first, kind = equal_rows(colors)
    if len(first) > PALETTE_COLORS:
        colors = colors // 16 * 17  # 0 .. 15 spread over 0 .. 255
        first, kind = equal_rows(colors)
    side = math.ceil(math.sqrt(len(first)))
    squares = np.full((side * side, 3), GREY, dtype=np.uint8)
    squares[: len(first)] = colors[first]
    image = squares.reshape(side, side, 3).repeat(SWATCH_PX, axis=0).repeat(SWATCH_PX, axis=1)
    if any(pieces[i].colors is not None for i in bare):
        notes.append("pieces with colours per vertex stand beside textures: one colour per face.")
    start = 0
    for i in bare:
        mine = kind[start : start + len(pieces[i].faces)]
        start += len(mine)
        new, corner = split_by(pieces[i], np.repeat(mine, 3))
        face = corner // 3
        column, row = mine[face] % side + 0.5, mine[face] // side + 0.5
        uv = np.stack([column / side, 1.0 - row / side], axis=-1)
        out[i] = replace(new, uv=uv, image=image, image_key="swatches", colors=None)
    return out


def _tiles(pieces: Sequence[Piece]) -> list[_Tile]:
    tiles: dict[Hashable, _Tile] = {}
    for i, piece in enumerate(pieces):
        assert piece.image is not None
        tiles.setdefault(piece.image_key, _Tile(piece.image, [])).pieces.append(i)
    return list(tiles.values())


def _packed(
    images: Sequence[Image], notes: list[str]
) -> tuple[Image, list[tuple[int, int, int, int]]]:
    """Return an atlas of the images, laid in rows, and (column, row, width, height) of each."""
    texels = sum(i.shape[0] * i.shape[1] for i in images)
    if texels > LARGEST_ATLAS_PX:
        factor = math.sqrt(LARGEST_ATLAS_PX / texels)
        images = [_shrunk(i, factor) for i in images]
        notes.append(f"all textures were reduced by {factor:.2g} to fit one atlas.")
    padded = [(i.shape[1] + 2 * BORDER_PX, i.shape[0] + 2 * BORDER_PX) for i in images]
    square = math.ceil(math.sqrt(sum(w * h for w, h in padded)))
    wide = max(square, *(w for w, _ in padded))
    x = y = row_height = 0
    places: list[tuple[int, int]] = [(0, 0)] * len(images)
    for i in sorted(range(len(images)), key=lambda i: (-padded[i][1], i)):
        w, h = padded[i]
        if x + w > wide:
            x, y, row_height = 0, y + row_height, 0
        places[i] = (x, y)
        x, row_height = x + w, max(row_height, h)
    atlas = np.full((y + row_height, wide, 3), GREY, dtype=np.uint8)
    corners: list[tuple[int, int, int, int]] = []
    for image, (left, top) in zip(images, places, strict=True):
        b = BORDER_PX
        bordered = np.pad(image, ((b, b), (b, b), (0, 0)), mode="edge")
        atlas[top : top + bordered.shape[0], left : left + bordered.shape[1]] = bordered
        corners.append((left + b, top + b, image.shape[1], image.shape[0]))
    return atlas, corners
