"""Boxes and balls of a few triangles."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from realsim.geometry.mesh import box_mesh
from realsim.records import Mesh


def box(size: Sequence[float], color: tuple[int, int, int] | None = None) -> Mesh:
    """A box round the origin."""
    half = np.array(size) / 2
    paint = None if color is None else np.tile(np.array(color, np.uint8), (8, 1))
    return replace(box_mesh(-half, half), colors=paint)


def ball(radius: float, rings: int = 16) -> Mesh:
    """A ball round the origin, open at its poles."""
    polar = np.linspace(0.02, np.pi - 0.02, rings)
    around = np.arange(2 * rings) * np.pi / rings
    p, a = np.meshgrid(polar, around, indexing="ij")
    xyz = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], -1).reshape(-1, 3)
    m = 2 * rings
    i, j = np.divmod(np.arange((rings - 1) * m), m)
    k = i * m + (j + 1) % m
    q = i * m + j
    faces = np.concatenate([np.stack([q, q + m, k + m], -1), np.stack([q, k + m, k], -1)])
    return Mesh(vertices=radius * xyz, faces=faces)
