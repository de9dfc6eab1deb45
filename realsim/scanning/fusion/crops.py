"""The parts of the depth images in which the object can be, cleaned and side by side in memory."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.compiled import njit
from realsim.geometry import se3
from realsim.geometry.camera import project, ray_table
from realsim.geometry.lens_loops import pixel
from realsim.records import CameraIntrinsics
from realsim.registration.evidence import DepthNoise
from realsim.scanning.fusion.evidence import trusted_depth
from realsim.scanning.fusion.result import FusionConfig, FusionFrame

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Crops:
    """The part of every depth image in which the object can be, trusted pixels only."""

    depths: Array32
    """(F, h, w) depth [m], 0 = none, negative = an edge (see `trusted_depth`);
    parts smaller than the largest are filled up with 0."""
    corners: NDArray[np.int64]
    """(F, 2) pixel x, y of the parts' first pixel."""
    camera: Array
    """(13,) fx fy cx cy, the eight distortion terms, and the greatest squared radius of the
    lens model's range in normalised coordinates."""
    noise: Array
    """(2,) k [1/m] and least sigma_z [m]."""


def cropped(
    intrinsics: CameraIntrinsics,
    frames: Sequence[FusionFrame],
    box: tuple[Array, Array, Array],
    noise: DepthNoise,
    config: FusionConfig,
) -> Crops:
    """Return the parts of the frames that see a box, cleaned.

    Args:
        intrinsics: the camera.
        frames: the frames.
        box: T_world_table (4, 4), least and greatest corner (3,) in that frame [m].
        noise: of the camera.
        config: see there.
    """
    T_world_table, low, high = box
    grid = np.stack(np.meshgrid(*[np.linspace(0, 1, 5)] * 3, indexing="ij"), -1).reshape(-1, 3)
    corners_world = se3.transform(T_world_table, low + grid * (high - low))
    size = np.array([intrinsics.width, intrinsics.height])
    parts: list[Array32] = []
    starts: list[NDArray[np.int64]] = []
    for frame in frames:
        local = se3.transform(se3.invert(frame.T_world_cam), corners_world)
        uv = project(intrinsics, local[local[:, 2] > 0.02])
        uv = uv if len(uv) else np.zeros((1, 2))
        pad = 2 + config.edge_px
        first = np.clip(np.floor(uv.min(0)).astype(np.int64) - pad, 0, size - 1)
        last = np.clip(np.ceil(uv.max(0)).astype(np.int64) + pad + 1, first + 1, size)
        part = frame.depth_m[first[1] : last[1], first[0] : last[0]]
        parts.append(trusted_depth(part, intrinsics, noise, config))
        starts.append(first)
    shape = np.max([p.shape for p in parts], axis=0)
    depths = np.zeros((len(parts), *shape), np.float32)
    for number, p in enumerate(parts):
        depths[number, : p.shape[0], : p.shape[1]] = p
    rays = ray_table(intrinsics)[::8, ::8, :2]
    radius2 = float(np.nanmax(np.sum(np.square(rays, dtype=np.float64), axis=-1)))
    i = intrinsics
    return Crops(
        depths=depths,
        corners=np.stack(starts),
        camera=np.array([i.fx, i.fy, i.cx, i.cy, *i.distortion, radius2]),
        noise=np.array([noise.per_m, noise.floor_m]),
    )


@njit(inline="always")
def pixel_of(camera: Array, x: float, y: float, z: float) -> tuple[int, int]:
    """Return the pixel (u, v) that sees a camera point, (-1, -1) if the lens model has none."""
    a, b = x / z, y / z
    if a * a + b * b > camera[12]:
        return -1, -1
    u, v = pixel(camera, a, b)
    return int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
