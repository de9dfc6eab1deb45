"""A Mitsuba scene of placed meshes under an environment."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.rendering.appearance import Environment
from realsim.rendering.photoreal.looks import BsdfOptions, bsdf_of, look_of
from realsim.rendering.photoreal.mesh_parts import MeshPart, mesh_parts, scene_center
from realsim.rendering.rays import PlacedMesh

Array = NDArray[np.float64]
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
    geometry_of_shape: NDArray[np.int32]
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
    center = scene_center(meshes)
    content: dict[str, Any] = {"type": "scene"}
    geometry_of: dict[str, int] = {}
    bsdfs: dict[tuple[int, BsdfOptions], Any] = {}
    kept: list[Any] = []  # an id is only good as long as its object lives
    radius = 0.1
    for index, p in enumerate(meshes):
        material, colors = look_of(index, p)
        kept.append(material)
        for part in mesh_parts(p, material, colors, center):
            options = BsdfOptions(
                has_vertex_colors=colors is not None,
                repeats=part.repeats,
                is_mirrored=part.is_mirrored,
            )
            key = (id(material), options)
            if key not in bsdfs:
                bsdfs[key] = mi.load_dict(bsdf_of(mi, material, options))
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


def _rows_to_the_poles(panorama: NDArray[np.float32]) -> NDArray[np.float32]:
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
