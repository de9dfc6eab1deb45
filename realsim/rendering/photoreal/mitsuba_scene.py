"""A Mitsuba scene of placed meshes under an environment."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array, Array32, Int32, UInt8
from realsim.geometry import se3
from realsim.geometry.colors import srgb_decoded
from realsim.rendering.appearance import LEAST_ROUGHNESS, Environment, Material
from realsim.rendering.embedded.materials import box_uv, corner_normals, look_of, repeats
from realsim.rendering.rays import PlacedMesh, rotated, scene_center


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
    is_mirrored: bool
    """Whether (u, v up, normal) is left-handed on these faces."""
    repeats: bool
    """Whether the images repeat beyond [0, 1]; else their border continues."""


def mesh_parts(
    placed: PlacedMesh, material: Material, colors: UInt8 | None, center: Array
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
                is_mirrored=side,
                repeats=wraps,
            )
        )
    return parts


def _signed_area(uv: Array32) -> Array32:
    """Return twice the area (F,) of the faces in the image; negative = wound clockwise."""
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], np.float32)


Bsdf = dict[str, Any]


def bsdf_of(mi: Any, material: Material, part: MeshPart) -> Bsdf:
    """Return a material as a Mitsuba BSDF: `principled` is the metallic-roughness model.

    Args:
        mi: the module mitsuba, set to a variant.
        material: the look.
        part: what it lies on.
    """
    wrap = "repeat" if part.repeats else "clamp"

    def bitmap(values: NDArray[np.floating]) -> Bsdf:
        return {
            "type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(values, np.float32)),
            "raw": True, "wrap_mode": wrap, "format": "fp16",
        }  # fmt: skip

    tint = np.array(material.base_color, np.float32)
    if part.colors is not None:
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
        if part.is_mirrored:
            normals[..., 1] *= -1
        normals = 0.5 * normals + 0.5
        surface = {"type": "normalmap", "normalmap": bitmap(normals), "of": surface}
    return {"type": "twosided", "of": surface}


SUN_FAR = 1000.0
"""Distance of the sun's disc in radii of the scene: it is seen under the same angle to 0.06 deg
from everywhere."""
R_WORLD_ENVMAP = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Mitsuba's envmap has +y up and its left border at -z; ours +z and +x, with the columns the
other way round (they are turned over)."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class MitsubaScene:
    """The scene and what its shapes are."""

    scene: Any
    """mitsuba.Scene, in world axes about `center`."""
    center: Array
    """(3,) origin of the scene's coordinates in world [m]."""
    geometry_of_shape: Int32
    """(S + 1,) index of the placed mesh of each of Mitsuba's shapes; -1 = the sun, and the last
    entry, which answers shape -1 (nothing)."""


def mitsuba_scene(mi: Any, placed: Sequence[PlacedMesh], environment: Environment) -> MitsubaScene:
    """Return the scene of placed meshes under an environment.

    Args:
        mi: the module mitsuba, set to a variant.
        placed: the meshes.
        environment: panorama and sun.
    """
    meshes = tuple(placed)
    center = scene_center([se3.transform(p.T_world_obj, p.mesh.vertices) for p in meshes])
    content: dict[str, Any] = {"type": "scene"}
    geometry_of: dict[str, int] = {}
    bsdfs: dict[tuple[int, bool, bool, bool], Any] = {}
    kept: list[Any] = []  # an id is only good as long as its object lives
    radius = 0.1
    for index, p in enumerate(meshes):
        material, colors = look_of(index, p)
        kept.append(material)
        for part in mesh_parts(p, material, colors, center):
            key = (id(material), colors is None, part.repeats, part.is_mirrored)
            if key not in bsdfs:
                bsdfs[key] = mi.load_dict(bsdf_of(mi, material, part))
            name = f"mesh_{index}_{int(part.is_mirrored)}"
            content[name] = _shape(mi, part, bsdfs[key], name)
            geometry_of[name] = index
            radius = max(radius, float(np.linalg.norm(part.positions, axis=1).max()))
    content.update(_lights(mi, environment, radius))
    scene = mi.load_dict(content)
    shapes = [geometry_of.get(str(s.id()), -1) for s in scene.shapes()]
    return MitsubaScene(
        scene=scene, center=center, geometry_of_shape=np.array([*shapes, -1], np.int32)
    )


def _shape(mi: Any, part: MeshPart, bsdf: Any, name: str) -> Any:
    """Return one part as a Mitsuba mesh."""
    properties = mi.Properties()
    properties.set_id(name)
    properties["bsdf"] = bsdf
    n = len(part.positions)
    mesh = mi.Mesh(
        name, n, n // 3, props=properties,
        has_vertex_normals=True, has_vertex_texcoords=part.uv is not None,
    )  # fmt: skip
    if part.colors is not None:
        mesh.add_attribute("vertex_color", 3, part.colors.ravel())
    params = mi.traverse(mesh)
    params["vertex_positions"] = part.positions.ravel()
    params["faces"] = np.arange(n, dtype=np.uint32)
    params["vertex_normals"] = part.normals.astype(np.float32).ravel()
    if part.uv is not None:
        params["vertex_texcoords"] = part.uv.astype(np.float32).ravel()
    params.update()
    return mesh


def _rows_to_the_poles(panorama: Array32) -> Array32:
    """Return a panorama (H, W, 3) with 2 H + 1 rows, the first and last of them at the poles.

    Mitsuba's first row looks straight up; ours half a row beside it. Between the rows' borders and
    their middles both interpolate alike.
    """
    out = np.empty((2 * len(panorama) + 1, *panorama.shape[1:]), np.float32)
    out[1::2] = panorama
    out[2:-1:2] = 0.5 * (panorama[:-1] + panorama[1:])
    out[0], out[-1] = panorama[0].mean(0), panorama[-1].mean(0)
    return out


def _lights(mi: Any, environment: Environment, radius: float) -> dict[str, Any]:
    """Return the emitters of an environment; a part of it that is dark is left out."""
    lights: dict[str, Any] = {}
    if float(environment.panorama.max()) > 0:
        to_world = np.eye(4)
        to_world[:3, :3] = R_WORLD_ENVMAP
        lights["sky"] = {
            "type": "envmap",
            "bitmap": mi.Bitmap(_rows_to_the_poles(environment.panorama[:, ::-1])),
            "to_world": mi.ScalarTransform4f(to_world),
        }
    if max(environment.sun) <= 0:
        return lights
    toward = np.array(environment.sun_direction) / np.linalg.norm(environment.sun_direction)
    half_angle = np.radians(environment.sun_radius_deg)
    sun = np.array(environment.sun)
    if half_angle == 0:
        lights["sun"] = {
            "type": "directional",
            "direction": (-toward).tolist(),
            "irradiance": {"type": "rgb", "value": (np.pi * sun).tolist()},
        }
        return lights
    # A disc of radiance L seen under the half angle a gives the irradiance pi L sin(a)^2.
    distance = SUN_FAR * radius
    target = mi.ScalarTransform4f().look_at(
        (distance * toward).tolist(), [0.0, 0.0, 0.0], np.eye(3)[np.abs(toward).argmin()].tolist()
    )
    lights["sun"] = {
        "type": "disk",
        "to_world": target.scale(distance * float(np.tan(half_angle))),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
        "emitter": {
            "type": "area",
            "radiance": {"type": "rgb", "value": (sun / np.sin(half_angle) ** 2).tolist()},
        },
    }
    return lights
