"""Models as the browser takes them: a budget of triangles, binary glTF with a small texture.

The glTF is written here, since only few of its features are needed and the general writers store
textures as PNG, at seconds for one of 4096 pixels. Specification: Khronos glTF 2.0, section 3.7
(geometry, little-endian, V of textures downwards) and GLB, section 4.
"""

import json
import struct
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array, Array32, UInt8, UInt16
from realsim.errors import DegenerateError
from realsim.geometry import mesh as mesh_tools
from realsim.geometry.colors import light_of_bytes
from realsim.pages.pictures import jpeg_bytes
from realsim.records import Mesh
from realsim.review.content.config import SceneConfig

PLAIN_RGB = (176, 182, 190)
"""Colour of a mesh without colours of its own."""
ROUGH = 0.9
"""glTF's roughness: the default material is a mirror in the browser's light."""
TEXTURE_QUALITY = 85
"""JPEG quality of a texture [%]: no block can be told in print of a few pixels."""
CELL_SHARE = 0.006
"""Cells in which vertices become one are at most this share of a mesh's size: 0.6 mm at 10 cm, of
which the surface moves a fraction."""
MOST_OVER = 1.5
"""So many times its budget a mesh may keep: on a screen that is no difference."""
FLOAT, UINT16, UINT32 = 5126, 5123, 5125
VERTICES, INDICES = 34962, 34963
"""glTF's codes of types and of buffers."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class DisplayMesh:
    """A model as it is sent."""

    vertices: Array32
    """(V, 3) in the object's frame [m]."""
    faces: NDArray[np.uint32]
    """(F, 3)."""
    glb: bytes
    """The same with its looks, as binary glTF."""
    low: Array
    """(3,) least corner of its bounds [m]."""
    high: Array
    """(3,) greatest corner [m]."""


def display_mesh(mesh: Mesh, config: SceneConfig) -> DisplayMesh:
    """Return a model for the browser, with no more triangles than it can turn."""
    few = within_budget(mesh, config)
    vertices = np.ascontiguousarray(few.vertices, dtype=np.float32)
    faces = np.ascontiguousarray(few.faces, dtype=np.uint32)
    glb, (low, high) = glb_of(few, config.most_texels), mesh.bounds
    return DisplayMesh(vertices=vertices, faces=faces, glb=glb, low=low, high=high)


def within_budget(mesh: Mesh, config: SceneConfig) -> Mesh:
    """Return the mesh, or one of fewer triangles with the same outline where it has too many.

    The vertices of small cells become one: a fiftieth of the time that the careful decimation takes
    (`realsim.models.simplify`), and off by less than can be seen. What that cannot thin out is
    decimated. What has a texture may have more triangles, since fewer cost it the texture: it
    becomes colours of the vertices.
    """
    textured = mesh.texture is not None and mesh.uv is not None
    budget = config.most_textured_triangles if textured else config.most_triangles
    if len(mesh.faces) <= budget:
        return mesh
    from realsim.models.mesh_topology import topology
    from realsim.models.simplify import clustered, simplified

    few = clustered(topology(mesh), budget, CELL_SHARE)
    try:
        if few is None or len(few.faces) > MOST_OVER * budget:
            return simplified(mesh, budget)
    except DegenerateError:
        return mesh
    colors = mesh_tools.vertex_colors(mesh)
    return few if colors is None else replace(few, colors=_nearest(mesh, colors, few.vertices))


def _nearest(mesh: Mesh, colors: UInt8, points: Array) -> UInt8:
    """Return the colours (N, 3) of the mesh's vertices nearest to points (N, 3)."""
    from scipy.spatial import KDTree

    return colors[np.asarray(KDTree(mesh.vertices).query(points)[1])]


def glb_of(mesh: Mesh, most_texels: int) -> bytes:
    """Return a mesh as binary glTF: with its texture, its vertex colours, or plain grey.

    Args:
        mesh: in metres.
        most_texels: longest side of the texture [px].
    """
    parts = _Parts()
    primitive: dict[str, Any] = {"attributes": {}, "material": 0}
    positions = np.ascontiguousarray(mesh.vertices, dtype=np.float32)
    primitive["attributes"]["POSITION"] = parts.add(
        positions, FLOAT, "VEC3", VERTICES,
        min=positions.min(0).tolist(), max=positions.max(0).tolist(),
    )  # fmt: skip
    primitive["indices"] = parts.add(
        np.ascontiguousarray(mesh.faces, dtype=np.uint32).ravel(), UINT32, "SCALAR", INDICES
    )
    material: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": ROUGH}
    extra: dict[str, Any] = {}
    if mesh.texture is not None and mesh.uv is not None:
        uv = np.stack([mesh.uv[:, 0], 1.0 - mesh.uv[:, 1]], -1).astype(np.float32)
        primitive["attributes"]["TEXCOORD_0"] = parts.add(uv, FLOAT, "VEC2", VERTICES)
        view = parts.view(_texture_jpeg(mesh.texture, most_texels), None)
        material["baseColorTexture"] = {"index": 0}
        extra = {
            "images": [{"bufferView": view, "mimeType": "image/jpeg"}],
            "samplers": [{"wrapS": 10497, "wrapT": 10497}],
            "textures": [{"source": 0, "sampler": 0}],
        }
    else:
        colors = mesh_tools.vertex_colors(mesh)
        if colors is None:
            material["baseColorFactor"] = [*light_of_bytes(PLAIN_RGB).tolist(), 1.0]
        else:
            primitive["attributes"]["COLOR_0"] = parts.add(
                _colors16(colors), UINT16, "VEC4", VERTICES, normalized=True
            )
    tree: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "realsim"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"pbrMetallicRoughness": material, "doubleSided": True}],
        **extra,
    }
    return parts.glb(tree)


class _Parts:
    """The binary chunk of a GLB, and what stands in it."""

    def __init__(self) -> None:
        self._data = bytearray()
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []

    def view(self, data: bytes, target: int | None) -> int:
        """Append bytes, and return the number of their buffer view."""
        self._data.extend(b"\0" * (-len(self._data) % 4))
        view = {"buffer": 0, "byteOffset": len(self._data), "byteLength": len(data)}
        self._views.append(view if target is None else view | {"target": target})
        self._data.extend(data)
        return len(self._views) - 1

    def add(self, values: NDArray[Any], component: int, kind: str, target: int, **more: Any) -> int:
        """Append an array, and return the number of its accessor."""
        view = self.view(values.tobytes(), target)
        accessor = {"bufferView": view, "componentType": component, "count": len(values)}
        self._accessors.append(accessor | {"type": kind} | more)
        return len(self._accessors) - 1

    def glb(self, tree: dict[str, Any]) -> bytes:
        """Return the file of this tree and the bytes."""
        self._data.extend(b"\0" * (-len(self._data) % 4))
        tree |= {
            "accessors": self._accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": len(self._data)}],
        }
        text = json.dumps(tree).encode()
        text += b" " * (-len(text) % 4)
        length = 12 + 8 + len(text) + 8 + len(self._data)
        return b"".join((
            struct.pack("<4sII", b"glTF", 2, length),
            struct.pack("<I4s", len(text), b"JSON"), text,
            struct.pack("<I4s", len(self._data), b"BIN\0"), bytes(self._data),
        ))  # fmt: skip


def _texture_jpeg(texture: UInt8, most_texels: int) -> bytes:
    import cv2

    factor = most_texels / max(texture.shape[:2])
    small = texture
    if factor < 1:
        size = tuple(max(1, round(n * factor)) for n in texture.shape[1::-1])
        small = np.asarray(cv2.resize(texture, size, interpolation=cv2.INTER_AREA), np.uint8)
    return jpeg_bytes(small, TEXTURE_QUALITY)


def _colors16(rgb: UInt8) -> UInt16:
    """Return vertex colours (V, 4) as glTF wants them: linear, of 16 bit, opaque."""
    table = np.rint(65535 * light_of_bytes(np.arange(256))).astype(np.uint16)
    opaque = np.full((len(rgb), 1), 65535, np.uint16)
    return np.concatenate([table[rgb], opaque], axis=1)
