"""Pieces of a mesh file, each with its own surface colour, before they become one mesh."""

from collections.abc import Hashable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.models.model_records import ScanUnit, UpAxis

Array = NDArray[np.float64]
Image = NDArray[np.uint8]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Piece:
    """A part of a mesh file that has one material, in the file's units and axes."""

    name: str
    """What the file calls it."""
    vertices: Array
    """(V, 3)."""
    faces: NDArray[np.int32]
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


def srgb_from_linear(linear: ArrayLike) -> Array:
    """Return sRGB values in [0, 1] of linear ones (IEC 61966-2-1)."""
    x = np.clip(np.asarray(linear, dtype=np.float64), 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1.0 / 2.4) - 0.055)


def linear_from_srgb(srgb: ArrayLike) -> Array:
    """Return linear values in [0, 1] of sRGB ones (IEC 61966-2-1)."""
    x = np.clip(np.asarray(srgb, dtype=np.float64), 0.0, 1.0)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def rgb8(linear: ArrayLike) -> tuple[int, int, int]:
    """Return the RGB bytes of a linear colour (3,) in [0, 1], as glTF and USD state them."""
    r, g, b = np.rint(255.0 * srgb_from_linear(linear)).astype(int).tolist()[:3]
    return r, g, b


def tinted(image: Image, factor: ArrayLike) -> Image:
    """Return the image with its linear values multiplied by a factor (3,) in [0, 1]."""
    scale = np.asarray(factor, dtype=np.float64)[:3]
    if np.allclose(scale, 1.0, atol=0.5 / 255.0):
        return image
    table = linear_from_srgb(np.arange(256) / 255.0)
    out = [np.rint(255.0 * srgb_from_linear(table * s)).astype(np.uint8) for s in scale]
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
