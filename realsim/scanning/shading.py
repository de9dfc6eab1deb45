"""A mesh seen from a side, shaded and coloured by a figure per vertex: orthographic ray casting."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Image, Int32
from realsim.geometry.mesh import vertex_normals
from realsim.records import Mesh
from realsim.rendering.rays import PlacedMesh, RayScene

Paint = Callable[[Int32, Array], Array]
"""Colours (N, 3) of points by the vertices (N, 3) of their faces and their weights (N, 3)."""
UNSEEN = (118, 123, 130)
"""Grey of a surface of which nothing is known."""
DIVERGING = np.array(
    [
        [5, 48, 97], [33, 102, 172], [67, 147, 195], [146, 197, 222], [209, 229, 240],
        [247, 247, 247],
        [253, 219, 199], [244, 165, 130], [214, 96, 77], [178, 24, 43], [103, 0, 31],
    ], dtype=np.float64,
)  # fmt: skip
"""Blue, white, red: -1, 0 and +1. Told apart by colour-blind people, too (ColorBrewer's RdBu)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ShadingConfig:
    """How a mesh is drawn."""

    size_px: int = 420
    """Width and height of one view [px]: four of them fill a page's width."""
    margin: float = 0.06
    """Free rim [share of the picture]."""
    sides_deg: tuple[tuple[float, float], ...] = (
        (20.0, 22.0), (110.0, 22.0), (200.0, 22.0), (290.0, 22.0),
    )  # fmt: skip
    """Where the eye stands: from x to y in the table's plane, not along the axes, where a box shows
    one side only; and above it, so that the top is seen as well [deg]."""
    ambient: float = 0.8
    """Brightness of what is turned away from the light: a shaded white must not look like the grey
    of what was not measured."""


def diverging(values: Array, limit: float) -> Array:
    """Return colours (..., 3) of 0 to 255 for values between -limit and limit; grey for NaN."""
    at = (np.clip(np.nan_to_num(values) / limit, -1, 1) + 1) / 2 * (len(DIVERGING) - 1)
    steps = np.arange(len(DIVERGING))
    rgb = np.stack([np.interp(at, steps, DIVERGING[:, k]) for k in range(3)], -1)
    return np.where(np.isfinite(values)[..., None], rgb, np.array(UNSEEN, dtype=np.float64))


def half_width(vertices: Array, config: ShadingConfig) -> float:
    """Return half the width of the square that shows vertices (V, 3) from every side [m]."""
    around = vertices - 0.5 * (vertices.min(0) + vertices.max(0))
    axes = np.concatenate([_eye_axes(*side)[1:] for side in config.sides_deg])
    return float(np.abs(around @ axes.T).max()) / (1 - 2 * config.margin)


def _eye_axes(azimuth_deg: float, elevation_deg: float) -> Array:
    """Return (3, 3) rows: from the object to the eye, the picture's right, the picture's down."""
    az, el = np.radians([azimuth_deg, elevation_deg])
    eye = np.array([np.cos(az) * np.cos(el), np.sin(az) * np.cos(el), np.sin(el)])
    right = np.array([-np.sin(az), np.cos(az), 0.0])
    return np.stack([eye, right, -np.cross(eye, right)])


def shaded_views(mesh: Mesh, paint: Paint, config: ShadingConfig) -> list[Image]:
    """Return a mesh [m], z up, from every side; white where there is nothing.

    Args:
        mesh: the mesh, turned so that z is up [m].
        paint: returns the colours (N, 3) of 0 to 255 of points in faces, given the faces' vertices
            (N, 3) and the points' weights (N, 3).
        config: sides, size and light.
    """
    n = config.size_px
    half_m, centre = half_width(mesh.vertices, config), mesh.bounds.mean(0)
    reach = float(np.linalg.norm(mesh.extent))
    scene = RayScene([PlacedMesh(0, mesh, np.eye(4))], centre)
    all_normals = vertex_normals(mesh)
    step = (np.arange(n) + 0.5) / n * 2 - 1
    across, along = np.meshgrid(half_m * step, half_m * step)
    views: list[Image] = []
    for side in config.sides_deg:
        eye, right, down = _eye_axes(*side)
        plane = across[..., None] * right + along[..., None] * down
        directions = np.tile((-eye).astype(np.float32), (n * n, 1))
        hits = scene.cast(centre + reach * eye + plane.reshape(-1, 3), directions)
        seen = hits.face >= 0
        corners = mesh.faces[hits.face[seen]]
        u, v = hits.uv[seen].T.astype(np.float64)
        weights = np.stack([1 - u - v, u, v], -1)
        normals = np.einsum("nc,nck->nk", weights, all_normals[corners])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        light = eye + 0.5 * np.array([0.0, 0.0, 1.0]) - 0.35 * right
        bright = np.abs(normals @ (light / np.linalg.norm(light)))
        colors = paint(corners, weights)
        colors = colors * (config.ambient + (1 - config.ambient) * bright)[:, None]
        out = np.full((n * n, 3), 255, np.uint8)
        out[seen] = np.clip(np.round(colors), 0, 255).astype(np.uint8)
        views.append(out.reshape(n, n, 3))
    return views


def value_paint(values: Array, limit: float) -> Paint:
    """Return the paint of a figure (V,) per vertex; NaN is grey.

    Inside faces it is that of the known corners where these lie nearer than the others: large faces
    with one unseen corner would else lose all that was measured on them.
    """

    def paint(corners: Int32, weights: Array) -> Array:
        found = values[corners]
        known = np.isfinite(found)
        w = np.where(known, weights, 0.0)
        total = w.sum(1)
        mean = np.sum(w * np.nan_to_num(found), axis=1) / np.maximum(total, 1e-12)
        return diverging(np.where(total > 0.5, mean, np.nan), limit)

    return paint


def color_paint(colors: Array) -> Paint:
    """Return the paint of colours (V, 3) of 0 to 255."""
    return lambda corners, weights: np.einsum("nk,nkc->nc", weights, colors[corners])
