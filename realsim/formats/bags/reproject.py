"""A depth image as another camera would have measured it: forward projection with a z-buffer.

Every depth pixel is a small square at its depth. Where its footprint in the other image covers a
pixel's centre, the pixel gets the depth along z of that camera. The nearer surface wins; of one
surface the sample that lies nearest to the centre, because the nearest in depth would pull every
slope towards the camera. Integer pixels are centres, so equal cameras at one place give the same
image back, count for count.
"""

from typing import Any

import numpy as np

from realsim.arrays import Array, UInt16
from realsim.compiled import njit
from realsim.geometry.camera import ray_table
from realsim.geometry.point_loops import pixel
from realsim.records import CameraIntrinsics

COUNT_MAX = 65535
MAX_FOOTPRINT_PX = 8.0
"""Half size at most: a pixel at a few millimetres would otherwise paint the image."""

OVERLAP = 1.1
"""Footprints are this much wider, so that slopes, lens distortion and rounding leave no seams
between neighbours; the sample nearest to the centre still wins."""
SAME_SURFACE = 0.01
"""Depths that differ by less than this share are of one surface: 80 deg of slope at 1 px."""


@njit
def _project(
    depth: Any, rays: Any, R: Any, t: Any, camera: Any, scale: Any, count_m: float, out: Any
) -> None:
    """Draw depth (H, W) [counts] into `out`; `camera` is fx fy cx cy and 8 distortion numbers.

    `scale` (2,) is the size of a depth pixel in `out` at equal depth: 0.5 * scale * z / z' is half
    its footprint.
    """
    height, width = out.shape
    off = np.full((height, width), np.inf, dtype=np.float32)
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            count = depth[v, u]
            rx, ry = rays[v, u, 0], rays[v, u, 1]
            if count == 0 or not np.isfinite(rx):
                continue
            z = count * count_m
            X = z * (R[0, 0] * rx + R[0, 1] * ry + R[0, 2]) + t[0]
            Y = z * (R[1, 0] * rx + R[1, 1] * ry + R[1, 2]) + t[1]
            Z = z * (R[2, 0] * rx + R[2, 1] * ry + R[2, 2]) + t[2]
            if Z <= 0:
                continue
            px, py = pixel(camera, X / Z, Y / Z)
            hx = min(0.5 * scale[0] * z / Z, MAX_FOOTPRINT_PX)
            hy = min(0.5 * scale[1] * z / Z, MAX_FOOTPRINT_PX)
            # A pixel is covered where its centre is in [p - h, p + h).
            u0, u1 = max(0, int(np.ceil(px - hx))), min(width - 1, int(np.ceil(px + hx)) - 1)
            v0, v1 = max(0, int(np.ceil(py - hy))), min(height - 1, int(np.ceil(py + hy)) - 1)
            new = int(np.rint(Z / count_m))
            if new < 1 or new > COUNT_MAX:
                continue
            for j in range(v0, v1 + 1):
                for i in range(u0, u1 + 1):
                    old = out[j, i]
                    away = (i - px) ** 2 + (j - py) ** 2
                    one_surface = abs(new - old) <= SAME_SURFACE * old
                    if old == 0 or (away < off[j, i] if one_surface else new < old):
                        out[j, i] = new
                        off[j, i] = away


def depth_in_colour(
    counts: UInt16,
    depth_camera: CameraIntrinsics,
    colour_camera: CameraIntrinsics,
    T_colour_depth: Array,
    unit_m: float,
) -> UInt16:
    """Return depth (H, W) on the colour camera's pixels, in the same unit, 0 = none.

    Args:
        counts: (H, W) depth along z of the depth camera.
        depth_camera: the camera that measured it; its distortion is undone.
        colour_camera: the camera to be looked through; its distortion is applied.
        T_colour_depth: (4, 4) depth camera in the colour camera [m].
        unit_m: metres per count.
    """
    c = colour_camera
    out = np.zeros((c.height, c.width), dtype=np.uint16)
    camera = np.concatenate([[c.fx, c.fy, c.cx, c.cy], c.distortion])
    T = np.asarray(T_colour_depth, dtype=np.float64)
    # The box around the turned pixel, so that a rolled camera leaves no holes.
    pitch = np.array([1 / depth_camera.fx, 1 / depth_camera.fy])
    scale = OVERLAP * np.array([c.fx, c.fy]) * (np.abs(T[:2, :2]) @ pitch)
    # The table is float32, which is 1e-4 px; the footprint's edge is at half pixels, never near it.
    rays = ray_table(depth_camera)
    R, t = np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])
    _project(np.ascontiguousarray(counts), rays, R, t, camera, scale, unit_m, out)
    return out
