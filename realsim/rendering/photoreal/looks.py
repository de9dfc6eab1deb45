"""What each placed mesh looks like, as the embedded renderer chooses it, in Mitsuba's terms."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.rendering.appearance import LEAST_ROUGHNESS, Material
from realsim.rendering.developing import srgb_decoded
from realsim.rendering.embedded.materials import PLAIN_COLORS, speckle_texture, wood_texture
from realsim.rendering.embedded.surface_table import (
    OBJECT_ROUGHNESS,
    TABLE_ROUGHNESS,
    check_projection,
)
from realsim.rendering.rays import BACKGROUND, PlacedMesh

UInt8 = NDArray[np.uint8]
Bsdf = dict[str, Any]
WOOD_PERIOD_M = 0.5
SPECKLE_PERIOD_M = 0.12


def look_of(number: int, placed: PlacedMesh) -> tuple[Material, UInt8 | None]:
    """Return the material of a placed mesh and its vertex colours (V, 3), None = they are unused.

    Its own material; else the mesh's texture, its vertex colours, wood for the background, or
    paint by its instance.

    Args:
        number: of the mesh in the scene, for messages.
        placed: the mesh.

    Raises:
        InputError: the material needs texture coordinates and the mesh has none.
    """
    mesh, material = placed.mesh, placed.material
    if material is not None:
        check_projection(number, placed)
        return material, None
    rough = TABLE_ROUGHNESS if placed.instance == BACKGROUND else OBJECT_ROUGHNESS
    white = (1.0, 1.0, 1.0)
    if mesh.texture is not None and mesh.uv is not None:
        own = Material(
            base_color=white, base_color_image=mesh.texture, roughness=rough, projection="uv",
            name="the mesh's own texture",
        )  # fmt: skip
        return own, None
    if mesh.colors is not None:
        return Material(base_color=white, roughness=rough, name="vertex colours"), mesh.colors
    if placed.instance == BACKGROUND:
        wood = Material(
            base_color=white, base_color_image=wood_texture(), roughness=rough,
            period_m=WOOD_PERIOD_M, name="light wood",
        )  # fmt: skip
        return wood, None
    paint = srgb_decoded(np.array(PLAIN_COLORS[placed.instance % len(PLAIN_COLORS)]) / 255.0)
    painted = Material(
        base_color=(float(paint[0]), float(paint[1]), float(paint[2])),
        base_color_image=speckle_texture(), roughness=rough,
        period_m=SPECKLE_PERIOD_M, name="paint",
    )  # fmt: skip
    return painted, None


@dataclass(frozen=True, kw_only=True, slots=True)
class BsdfOptions:
    """How a material's images lie on the part of a mesh that carries them."""

    has_vertex_colors: bool = False
    """Whether the colour comes from the mesh's attribute `vertex_color`."""
    repeats: bool = True
    """Whether the images repeat; else their border continues."""
    is_mirrored: bool = False
    """Whether v turns the other way round the normal: the normal map's v is turned too."""


def bsdf_of(mi: Any, material: Material, options: BsdfOptions) -> Bsdf:
    """Return a material as a Mitsuba BSDF: `principled` is the metallic-roughness model.

    Args:
        mi: the module mitsuba, set to a variant.
        material: the look.
        options: how its images lie.
    """
    wrap = "repeat" if options.repeats else "clamp"

    def bitmap(values: NDArray[np.floating]) -> Bsdf:
        return {
            "type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(values, np.float32)),
            "raw": True, "wrap_mode": wrap, "format": "fp16",
        }  # fmt: skip

    tint = np.array(material.base_color, np.float32)
    if options.has_vertex_colors:
        color: Any = {"type": "mesh_attribute", "name": "vertex_color"}
    elif material.base_color_image is not None:
        decode = srgb_decoded(np.arange(256) / 255.0).astype(np.float32)
        color = bitmap(decode[material.base_color_image] * tint)
    else:
        color = {"type": "rgb", "value": tint.tolist()}
    rough: Any = material.roughness
    if material.roughness_image is not None:
        values = material.roughness_image.astype(np.float32) * (material.roughness / 255.0)
        rough = bitmap(np.maximum(values, LEAST_ROUGHNESS)[..., None])
    surface: Bsdf = {
        "type": "principled", "base_color": color, "roughness": rough,
        "metallic": material.metallic,
    }  # fmt: skip
    if material.normal_image is not None:
        # 8-bit images say 128 for "not bent", half a step off the middle.
        normals = np.maximum((material.normal_image.astype(np.float32) - 128) / 127, -1)
        if options.is_mirrored:
            normals[..., 1] *= -1
        normals = 0.5 * normals + 0.5
        surface = {"type": "normalmap", "normalmap": bitmap(normals), "of": surface}
    return {"type": "twosided", "of": surface}
