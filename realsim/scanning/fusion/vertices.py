"""What every vertex rests on: how many views measured it, how well, and its colour."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.compiled import njit
from realsim.scanning.fusion.crops import Crops, pixel_of
from realsim.scanning.fusion.result import FusionConfig, FusionFrame

Array = NDArray[np.float64]
AGREE_SIGMAS = 4.0
"""A view measured a vertex if its depth there is within so many sigmas (and half a truncation)."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class VertexEvidence:
    """Per vertex, from all views."""

    views: NDArray[np.int32]
    """(V,) number of views that measured it."""
    noise_sigma_m: Array
    """(V,) 1-sigma of the mean distance from the depth noise [m]; inf without views."""
    spread_m: Array
    """(V,) standard deviation of the views' distances along the normal [m]; 0 below two views."""
    colors: NDArray[np.uint8] | None
    """(V, 3) mean RGB of the views that measured it; grey where none did."""


@njit
def _look(
    view: tuple[NDArray[np.float32], NDArray[np.int64], Array],
    camera: Array,
    noise: Array,
    surface: tuple[Array, Array],
    limits: tuple[float, float, float],
    image: NDArray[np.uint8],
    sums: Array,
) -> None:
    """Add one view to sums (V, 8): views, sum w, sum w r, sum w r^2, sum of weights and RGB."""
    depth, corner, T = view
    points, normals = surface
    sigmas, reach, least_cos = limits
    h, w = depth.shape
    for m in range(len(points)):
        x, y, z = points[m]
        a = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        b = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        c = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if c < 0.02:
            continue
        u, v = pixel_of(camera, a, b, c)
        u, v = u - corner[0], v - corner[1]
        if u < 0 or v < 0 or u >= w or v >= h or depth[v, u] <= 0.0:
            continue
        n = normals[m]
        mx = T[0, 0] * n[0] + T[0, 1] * n[1] + T[0, 2] * n[2]
        my = T[1, 0] * n[0] + T[1, 1] * n[1] + T[1, 2] * n[2]
        mz = T[2, 0] * n[0] + T[2, 1] * n[1] + T[2, 2] * n[2]
        ray = np.sqrt(a * a + b * b + c * c)
        cosine = -(mx * a + my * b + mz * c) / ray
        d = depth[v, u]
        sigma = max(noise[1], noise[0] * d * d)
        r = (d - c) * ray / c * cosine
        if cosine < least_cos or abs(r) > min(reach, sigmas * sigma * cosine + 0.25 * reach):
            continue
        g = 1.0 / (sigma * sigma)
        sums[m, 0] += 1.0
        sums[m, 1] += g
        sums[m, 2] += g * r
        sums[m, 3] += g * r * r
        if image.shape[0] > 1:
            k = g * cosine * cosine
            sums[m, 4] += k
            for channel in range(3):
                sums[m, 5 + channel] += k * image[v + corner[1], u + corner[0], channel]


def vertex_evidence(
    points: Array,
    normals: Array,
    crops: Crops,
    Ts_cam_table: Array,
    frames: Sequence[FusionFrame],
    config: FusionConfig,
) -> VertexEvidence:
    """Return what the views say at the vertices of the surface.

    Args:
        points: (V, 3) in the table's frame [m].
        normals: (V, 3) outward.
        crops: the trusted depth.
        Ts_cam_table: (F, 4, 4).
        frames: for the colours.
        config: see there.
    """
    sums = np.zeros((len(points), 8))
    nothing = np.zeros((1, 1, 3), np.uint8)
    limits = (AGREE_SIGMAS, config.truncation_m, config.least_cos)
    for number, frame in enumerate(frames):
        image = nothing if frame.rgb is None else np.ascontiguousarray(frame.rgb)
        view = (
            crops.depths[number],
            crops.corners[number],
            np.ascontiguousarray(Ts_cam_table[number]),
        )
        _look(view, crops.camera, crops.noise, (points, normals), limits, image, sums)
    weight = np.maximum(sums[:, 1], 1e-12)
    mean = sums[:, 2] / weight
    spread = np.sqrt(np.maximum(sums[:, 3] / weight - mean**2, 0))
    colors = None
    if any(f.rgb is not None for f in frames):
        colored = sums[:, 4:5] > 0
        rgb = np.where(colored, sums[:, 5:] / np.maximum(sums[:, 4:5], 1e-12), 128.0)
        colors = np.clip(np.round(rgb), 0, 255).astype(np.uint8)
    return VertexEvidence(
        views=sums[:, 0].astype(np.int32),
        noise_sigma_m=np.where(sums[:, 1] > 0, 1 / np.sqrt(weight), np.inf),
        spread_m=spread,
        colors=colors,
    )
