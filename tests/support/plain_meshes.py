"""Boxes and squares of a few triangles, and a wedge with a texture."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from realsim.geometry.mesh import box_mesh
from realsim.geometry.parts import part
from realsim.records import Mesh
from realsim.rendering.appearance import Material
from realsim.rendering.rays import PlacedMesh


def box(size: Sequence[float], color: tuple[int, int, int] | None = None) -> Mesh:
    """A box round the origin."""
    half = np.array(size) / 2
    paint = None if color is None else np.tile(np.array(color, np.uint8), (8, 1))
    return replace(box_mesh(-half, half), colors=paint)


def square(half: float = 0.5) -> Mesh:
    """A level square round the origin, to be seen from above, with texture coordinates."""
    ring = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    vertices, faces = half * (2 * ring - [1, 1, 0]), np.array([[0, 1, 2], [0, 2, 3]])
    return Mesh(vertices=vertices, faces=faces, uv=ring[:, :2])


def card(
    instance: int, z: float, half: float, material: Material | None = None, x: float = 0.0
) -> PlacedMesh:
    """A square before a camera at the origin that looks along z."""
    mesh = Mesh(vertices=square(half).vertices + np.array([x, 0, z]), faces=square().faces[:, ::-1])
    return PlacedMesh(instance, mesh, np.eye(4), material)


def textured_wedge() -> Mesh:
    """The wedge of the shipped parts, painted with noise from above."""
    mesh = part("wedge").mesh
    image = np.random.default_rng(3).integers(0, 255, (16, 8, 3), dtype=np.uint8)
    uv = (mesh.vertices[:, :2] - mesh.bounds[0, :2]) / mesh.extent[:2]
    return replace(mesh, colors=None, uv=uv, texture=image)
