"""Render and compare: does a pose explain what the cameras measured? No ground truth is needed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array, Int64, Mask
from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from realsim.geometry.depth import edge_mask
from realsim.records import CameraIntrinsics, SupportPlane
from realsim.registration.body import Body, footprint, pixel_box
from realsim.registration.evidence import DepthFrame, DepthNoise
from realsim.registration.table_planes import table_depth

TAU_M = 0.003
"""Depth difference that agrees whatever the noise: pose, mesh and bias errors [m]."""
TAU_SIGMAS = 1.5
"""Plus so many sigma_z: a camera a metre away is noisier than one at 30 cm."""
TAU_BIAS_PER_M = 0.003
"""Plus this times z^2 [1/m]: a disparity bias grows so. 0.3 mm at 30 cm, 3 mm at 1 m, which is
what rendered annotations differ by from real structured-light depth (1 to 3 mm)."""
FRONT_PENALTY = 0.3
"""Cost of a pixel where something measured stands in front: an occluder or a wrong pose."""
RAYS = 1500
"""Rays per object and frame aimed at; sets the stride."""
FRAMES = 6
"""Frames in which a hypothesis is rendered, spread in direction."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Comparer:
    """The frames, camera and table against which poses are rendered."""

    intrinsics: CameraIntrinsics
    frames: tuple[DepthFrame, ...]
    edges: tuple[Mask, ...]
    """Per frame (H, W): pixels at depth jumps, which are not compared."""
    noise: DepthNoise
    plane: SupportPlane | None
    rays: int
    """Rays per object and frame aimed at."""

    def tau(self, z: NDArray[np.floating]) -> Array:
        """Return the depth difference that agrees at depth z [m]."""
        return TAU_M + TAU_SIGMAS * self.noise.sigma(z) + self.bias(z)

    def bias(self, z: NDArray[np.floating]) -> Array:
        """Return the depth bias that must be expected at depth z [m]."""
        return TAU_BIAS_PER_M * np.square(np.asarray(z, dtype=np.float64))

    def likelihood(self, measured: Array, rendered: Array) -> Array:
        """Return per pixel 1 (agrees) down to -1 (the camera saw through the rendered surface).

        max(floor, 1 - 2 (d / tau)^2) with floor -1 behind and -0.3 in front of the surface.
        """
        d = measured - rendered
        value = 1.0 - 2.0 * np.square(d / self.tau(measured))
        return np.maximum(value, np.where(d < 0, -FRONT_PENALTY, -1.0))

    def table(self, frame: DepthFrame, rows: Int64, columns: Int64) -> Array:
        """Return the table's depth (N,) at pixels [m]; inf without a table."""
        if self.plane is None:
            return np.full(len(rows), np.inf)
        return table_depth(self.plane, frame.T_world_cam, ray_table(self.intrinsics)[rows, columns])

    def gain(self, body: Body, T_world_obj: Array, stride: int) -> tuple[float, float]:
        """Return how much better the pose explains the images than the bare table does.

        Returns:
            The sum over rendered pixels of likelihood(object) - likelihood(table), scaled to
            stride 1, and its mean per rendered pixel.
        """
        total, pixels = 0.0, 0
        for frame, edges in zip(self.frames, self.edges, strict=True):
            T_cam_obj = se3.invert(frame.T_world_cam) @ T_world_obj
            seen = footprint(body, self.intrinsics, T_cam_obj, stride)
            measured = frame.depth_m[seen.rows, seen.columns].astype(np.float64)
            use = (measured > 0) & ~edges[seen.rows, seen.columns]
            table = self.table(frame, seen.rows[use], seen.columns[use])
            z, m = np.minimum(seen.z[use], table), measured[use]
            old = np.where(np.isfinite(table), self.likelihood(m, np.minimum(table, 1e3)), 0.0)
            total += float(np.sum(self.likelihood(m, z) - old))
            pixels += int(np.count_nonzero(use))
        return total * stride**2, total / max(pixels, 1)

    def stride_of(self, body: Body, T_world_obj: Array) -> int:
        """Return the stride that casts about the wanted number of rays at the body."""
        areas: list[int] = []
        for frame in self.frames:
            T_cam_obj = se3.invert(frame.T_world_cam) @ T_world_obj
            left, top, right, bottom = pixel_box(body, self.intrinsics, T_cam_obj)
            areas.append((right - left) * (bottom - top))
        return max(1, int(np.sqrt(np.mean(areas) / self.rays)))


def make_comparer(
    intrinsics: CameraIntrinsics,
    frames: Sequence[DepthFrame],
    noise: DepthNoise,
    plane: SupportPlane | None,
    rays: int = RAYS,
) -> Comparer:
    """Return a comparer for these frames."""
    edges: list[Mask] = []
    for frame in frames:
        z = frame.depth_m
        # Within 3 px a surface seen at 70 degrees spans about 6 pixel pitches.
        jump = TAU_M + 6.0 * z / intrinsics.fx + 6.0 * noise.sigma(z)
        edges.append(edge_mask(z, jump))
    return Comparer(
        intrinsics=intrinsics,
        frames=tuple(frames),
        edges=tuple(edges),
        noise=noise,
        plane=plane,
        rays=rays,
    )


def spread(Ts_world_cam: Array, center: Array, count: int) -> list[int]:
    """Return cameras (F, 4, 4) that look at `center` (3,) from directions far apart.

    The first is the nearest, each next one has the greatest angle to those before, so the first
    few are spread too.
    """
    offsets = Ts_world_cam[:, :3, 3] - center
    distances = np.linalg.norm(offsets, axis=1)
    directions = offsets / np.maximum(distances, 1e-9)[:, None]
    chosen = [int(np.argmin(distances))]
    nearest = directions @ directions[chosen[0]]
    while len(chosen) < min(count, len(offsets)):
        nearest[chosen] = np.inf
        chosen.append(int(np.argmin(nearest)))
        nearest = np.maximum(nearest, directions @ directions[chosen[-1]])
    return chosen


def spread_frames(frames: Sequence[DepthFrame], center: Array, n: int) -> list[DepthFrame]:
    """Return n frames that look at `center` (3,) from directions far apart, in their order."""
    Ts = np.stack([f.T_world_cam for f in frames])
    return [frames[i] for i in sorted(spread(Ts, center, n))]
