"""Meshes made by trimesh."""

from typing import Any

import numpy as np
import trimesh

from realsim.records import Mesh


def solid(shape: trimesh.Trimesh, at=(0.0, 0.0, 0.0), **look: Any) -> Mesh:
    return Mesh(vertices=shape.vertices + np.array(at), faces=np.array(shape.faces), **look)


def box(size=(0.1, 0.06, 0.04), at=(0.0, 0.0, 0.0)) -> Mesh:
    return solid(trimesh.creation.box(size), at)


def ball(radius=0.05, subdivisions=4, at=(0.0, 0.0, 0.0)) -> Mesh:
    return solid(trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius), at)


def wedge(half_angle: float, length: float = 0.04, thin: float = 0.008, half_height: float = 0.03):
    """Return a prism along z that grows along x: its sides +y and -y open at +-half_angle."""
    end = thin + length * np.tan(half_angle)
    x = np.array([-length / 2, length / 2])
    outline = np.array([[x[0], -thin], [x[1], -end], [x[1], end], [x[0], thin]])
    corners = np.concatenate([np.c_[outline, np.full(4, z)] for z in (-half_height, half_height)])
    return solid(trimesh.convex.convex_hull(corners))


def cup(sections=96) -> Mesh:
    """Return a tube along z, 80 mm high, with walls of 4 mm."""
    return solid(trimesh.creation.annulus(0.028, 0.032, 0.08, sections=sections))
