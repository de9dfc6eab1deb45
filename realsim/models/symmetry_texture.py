"""Whether colours or a texture differ where a symmetry of the shape lays one point on another."""

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.models.symmetry_config import SymmetryConfig
from realsim.models.symmetry_surface import Surface
from realsim.records import Mesh

Array = NDArray[np.float64]

POINTS = 600
"""Surface points whose colours are compared."""
STEP = 0.02
"""How far off the neighbours are that tell how lively the texture is [share of the diameter]: what
a symmetry may miss by."""
MOST_MOTIONS = 24
"""Motions tried; a texture that breaks a group breaks most of its elements."""


def texture_breaks(mesh: Mesh, surface: Surface, Ts: Array, config: SymmetryConfig) -> bool:
    """Return whether one of the symmetries brings other colours to the same place.

    Args:
        mesh: with colours or a texture; without, nothing can differ.
        surface: the same, normalised.
        Ts: symmetries (K, 4, 4) of the normalised frame, without the identity.
        config: the difference that counts.
    """
    if (mesh.colors is None and (mesh.texture is None or mesh.uv is None)) or not len(Ts):
        return False
    points = surface.points[:POINTS]
    here = _colors(mesh, surface, points)
    rng = np.random.default_rng(config.seed)
    step = rng.standard_normal(points.shape)
    beside = points + STEP * step / np.linalg.norm(step, axis=1, keepdims=True)
    lively = float(np.mean(np.abs(_colors(mesh, surface, beside) - here)))
    for T in Ts[:: max(1, len(Ts) // MOST_MOTIONS)]:
        there = _colors(mesh, surface, se3.transform(T, points))
        if np.mean(np.abs(there - here)) > lively + config.color_difference:
            return True
    return False


def _colors(mesh: Mesh, surface: Surface, points: Array) -> Array:
    """Return the RGB (N, 3) [0..255] of the surface points closest to some points."""
    _, face, uv = surface.closest(points)
    # Embree's barycentric coordinates belong to the second and the third corner.
    weights = np.stack([1.0 - uv.sum(axis=1), uv[:, 0], uv[:, 1]], axis=1)
    corners = mesh.faces[face]
    if mesh.colors is not None or mesh.texture is None or mesh.uv is None:
        assert mesh.colors is not None
        return np.einsum("nk,nkc->nc", weights, mesh.colors[corners].astype(np.float64))
    at = np.einsum("nk,nkc->nc", weights, mesh.uv[corners])
    height, width = mesh.texture.shape[:2]
    column = np.floor((at[:, 0] % 1.0) * width).astype(int) % width
    row = np.floor(((1.0 - at[:, 1]) % 1.0) * height).astype(int) % height
    return mesh.texture[row, column].astype(np.float64)
