"""What USD says of a mesh's colours: primvars and materials, as one piece has them."""

import io
import math
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array, Image, Int64
from realsim.errors import InputError
from realsim.models.mesh_atlas import Piece, image_array, rgb8, split_by, srgb8, transformed_uv
from realsim.models.mesh_loading import escape_error
from realsim.models.mesh_topology import equal_rows


def triangles_of(counts: Int64, holes: Sequence[int]) -> tuple[Int64, Int64]:
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
    primvars: Any, name: str, indices: Int64, face: Int64, corners: Int64
) -> Array | None:
    """Return a primvar's values (T, 3, D) at the corners of triangles, or None if there is none.

    Args:
        primvars: the mesh's UsdGeom.PrimvarsAPI.
        name: of the primvar.
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
    rgb = srgb8(linear.reshape(-1, 3)).astype(np.int64)
    new, corner = split_by(piece, rgb)
    return replace(new, colors=rgb[corner].astype(np.uint8))


def with_corner_uv(piece: Piece, uv: Array) -> Piece:
    """Return the piece with texture coordinates (T, 3, 2) at its corners, split at seams."""
    _, kind = equal_rows(uv.reshape(-1, 2))
    new, corner = split_by(piece, kind)
    return replace(new, uv=uv.reshape(-1, 2)[corner])


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


DEFAULT_UV = "st"
"""The name that texture coordinates have by convention."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Material:
    """What a surface looks like."""

    color: tuple[int, int, int] | None = None
    image: Image | None = None
    image_key: str = ""
    uv_name: str = DEFAULT_UV
    uv_offset: tuple[float, float] = (0.0, 0.0)
    uv_rotation: float = 0.0
    """Counter-clockwise [rad]."""
    uv_scale: tuple[float, float] = (1.0, 1.0)


class Materials:
    """The materials of a stage, each read once."""

    def __init__(self, pxr: Any, path: Path, notes: list[str]) -> None:
        self._pxr, self._path, self._notes = pxr, path, notes
        self._known: dict[str, Material] = {}
        self._images: dict[str, Image | None] = {}

    def parts(self, prim: Any, face_count: int) -> Iterator[tuple[Int64 | None, Material]]:
        """Yield the faces and the material of every part of a mesh; None: all faces."""
        binding = self._pxr.UsdShade.MaterialBindingAPI(prim)
        left = np.ones(face_count, dtype=bool)
        for subset in binding.GetMaterialBindSubsets():
            faces = np.array(subset.GetIndicesAttr().Get() or (), dtype=np.int64)
            faces = faces[(faces >= 0) & (faces < face_count)]
            faces = faces[left[faces]]
            left[faces] = False
            yield faces, self._bound(subset.GetPrim())
        if np.all(left):
            yield None, self._bound(prim)
        elif np.any(left):
            yield np.flatnonzero(left), self._bound(prim)

    def textured(self, piece: Piece, uv: Array, material: Material) -> Piece:
        """Return the piece with a material's texture, given the coordinates (T, 3, 2)."""
        flat = transformed_uv(
            uv.reshape(-1, uv.shape[-1])[:, :2],
            material.uv_offset,
            material.uv_rotation,
            material.uv_scale,
            v_down=False,
        )
        split = joined_corners(with_corner_uv(piece, flat.reshape(-1, 3, 2)))
        return Piece(
            name=split.name,
            vertices=split.vertices,
            faces=split.faces,
            uv=split.uv,
            image=material.image,
            image_key=material.image_key,
        )

    def _bound(self, prim: Any) -> Material:
        found, _ = self._pxr.UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        if not found:
            return Material()
        key = str(found.GetPath())
        if key not in self._known:
            self._known[key] = self._read(found)
        return self._known[key]

    def _read(self, material: Any) -> Material:
        """Return what the preview surface of a material says about its colour."""
        shader = material.ComputeSurfaceSource()[0]
        if not shader or shader.GetIdAttr().Get() != "UsdPreviewSurface":
            self._notes.append(
                f"'{material.GetPath()}' is no UsdPreviewSurface; its colours are not read."
            )
            return Material()
        diffuse = shader.GetInput("diffuseColor")
        if not diffuse:
            return Material()
        source = self._source(diffuse)
        if source is not None and source.GetIdAttr().Get() == "UsdUVTexture":
            return self._textured(source)
        value = diffuse.Get()
        return Material() if value is None else Material(color=rgb8(np.array(value)))

    def _source(self, shader_input: Any) -> Any | None:
        """Return the shader that feeds an input, through any chain of connections."""
        attributes = self._pxr.UsdShade.Utils.GetValueProducingAttributes(shader_input)
        if not attributes:
            return None
        shader = self._pxr.UsdShade.Shader(attributes[0].GetPrim())
        return shader if shader and shader.GetIdAttr().Get() else None

    def _value(self, shader: Any, name: str, default: Any) -> Any:
        """Return the value of a shader's input, which may stand at a material's interface."""
        shader_input = shader.GetInput(name)
        if not shader_input:
            return default
        attributes = self._pxr.UsdShade.Utils.GetValueProducingAttributes(shader_input)
        value = attributes[0].Get() if attributes else shader_input.Get()
        return default if value is None else value

    def _textured(self, texture: Any) -> Material:
        asset = self._value(texture, "file", None)
        image = None if asset is None else self._image(asset)
        offset, rotation, scale = (0.0, 0.0), 0.0, (1.0, 1.0)
        coordinates = texture.GetInput("st")
        source = self._source(coordinates) if coordinates else None
        if source is not None and source.GetIdAttr().Get() == "UsdTransform2d":
            offset = tuple(self._value(source, "translation", offset))
            rotation = math.radians(float(self._value(source, "rotation", 0.0)))
            scale = tuple(self._value(source, "scale", scale))
            inner = source.GetInput("in")
            source = self._source(inner) if inner else None
        name = DEFAULT_UV if source is None else str(self._value(source, "varname", DEFAULT_UV))
        return Material(
            image=image,
            image_key="" if asset is None else str(asset.path),
            uv_name=name,
            uv_offset=(float(offset[0]), float(offset[1])),
            uv_rotation=rotation,
            uv_scale=(float(scale[0]), float(scale[1])),
        )

    def _image(self, asset: Any) -> Image | None:
        """Return the picture that an asset path names, or None with a note.

        Raises:
            InputError: it lies outside the file's folder.
        """
        name = str(asset.path)
        if name in self._images:
            return self._images[name]
        self._images[name] = None
        resolved = str(asset.resolvedPath) or name
        outer, inner = self._pxr.Ar.SplitPackageRelativePathOuter(resolved)
        target = (self._path.resolve().parent / outer).resolve()
        if "://" in name or not target.is_relative_to(self._path.resolve().parent):
            raise escape_error(self._path, [name])
        try:
            data = zipfile.ZipFile(target).read(inner) if inner else target.read_bytes()
        except (OSError, KeyError, zipfile.BadZipFile):
            self._notes.append(
                f"'{name}', named in the file, is not in its folder: colours from it are missing."
            )
            return None
        from PIL import Image as Pillow

        try:
            self._images[name] = image_array(Pillow.open(io.BytesIO(data)))
        except Exception as error:  # pillow raises many kinds for a broken or huge picture
            self._notes.append(f"the texture '{name}' cannot be decoded ({error}); it is left out.")
        return self._images[name]
