"""What every view measured, thinned out and freed of depth edges, in its own camera's axes.

All steps after this one work on these points: 256 images of 1280x720 pixels become 60 MB.

Cameras that stand still beside the one in the hand.

A scene that does not move looks the same in every image of such a camera: all its images are one
view. Their median has less noise and shows what an arm that passes hides now and then; and where
the camera stands is one unknown, however many images there are.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from realsim.arrays import Array, Array32, Int32
from realsim.compiled import njit
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from realsim.geometry.depth import depth_noise_per_m
from realsim.records import CameraIntrinsics
from realsim.records.calibration import DepthBias
from realsim.registration.evidence import Cloud, DepthFrame, DepthNoise, seen_cloud

SAME_M = 0.01
"""Depths of one pixel that differ by less are of the same surface [m]."""
SAME_SHARE = 0.5
"""A pixel counts where more than this share of its measurements is of the same surface."""
NOISE_FLOOR_M = 0.0002
"""Least sigma_z, as of the camera in the hand [m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FixedCamera:
    """A camera that stands still, and what its calibration says of it."""

    name: str
    intrinsics: CameraIntrinsics
    T_world_cam: Array
    """(4, 4) where it is said to stand [m]."""
    sigma_mm: float
    """1-sigma of its place along an axis [mm]."""
    sigma_deg: float
    """1-sigma of its rotation about an axis [deg]."""
    bias: DepthBias = field(default_factory=DepthBias.unmeasured)
    """Bias of its depth with its covariance; by default as little is known as of any camera."""
    noise: DepthNoise = field(default_factory=lambda: DepthNoise(per_m=0.0, floor_m=NOISE_FLOOR_M))
    """Noise of the median of its images; see `noise_of`."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FixedFrames:
    """A fixed camera with its depth images."""

    camera: FixedCamera
    read: Callable[[], Iterable[Array32]]
    """Gives its depth images (H, W), as measured [m]."""


def still_depth(images: Iterable[Array32]) -> Array32:
    """Return the depth (H, W) that most images (H, W) of a scene agree on; 0 = none do [m].

    Raises:
        InputError: there is no image, or their sizes differ.
    """
    stack = [np.asarray(image, dtype=np.float32) for image in images]
    sizes = sorted({image.shape for image in stack})
    if len(sizes) != 1:
        raise InputError(
            f"a fixed camera's depth images have the sizes {sizes}; one or more images of one size "
            "are needed."
        )
    depths = np.stack(stack)
    measured = depths > 0
    depths[~measured] = np.nan
    empty = ~np.any(measured, axis=0)
    depths[:, empty] = 0.0
    middle = np.nanmedian(depths, axis=0)
    same = np.count_nonzero(np.abs(depths - middle) < SAME_M, axis=0)
    agreed = same > SAME_SHARE * np.maximum(np.count_nonzero(measured, axis=0), 0.5 * len(stack))
    return np.where(agreed & ~empty, middle, 0.0).astype(np.float32)


def noise_of(depth_m: Array32) -> DepthNoise:
    """Return the noise of a fixed camera's depth (H, W) [m], measured from it.

    Raises:
        InputError: it holds next to nothing.
    """
    return DepthNoise(per_m=depth_noise_per_m([depth_m]), floor_m=NOISE_FLOOR_M)


@dataclass(frozen=True, kw_only=True, slots=True)
class SampleConfig:
    """How a depth image is thinned out."""

    stride: int = 4
    """Every how many rows and columns a pixel is used: stereo noise is correlated over as many."""
    edge_reach_px: int = 3
    """Pixels around one that are looked at for a depth edge."""
    edge_jump_m: float = 0.010
    """Span of depth around a pixel beyond which it may be flying [m]; plus slope and noise."""
    edge_slope: float = 8.0
    """Plus so many pixel pitches: what a surface seen at 75 degrees spans over the reach."""
    edge_sigmas: float = 6.0
    """Plus so many sigma_z."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ViewPoints:
    """The trusted points of one view."""

    index: int
    """Number of the view."""
    T_world_cam: Array
    """(4, 4) where the camera is said to be [m]."""
    points: Array32
    """(N, 3) in camera axes [m]."""
    pixels: Int32
    """(N, 2) their column and row."""
    area_px: float
    """Pixels that each of them stands for."""
    measured_share: float
    """Share of the sampled pixels that hold any depth, trusted or not."""
    fixed: FixedCamera | None = None
    """The camera that stands still and saw this view; None = the one in the hand."""

    def noise(self, of_hand: DepthNoise) -> DepthNoise:
        """Return the noise of this view's camera, given that of the one in the hand."""
        return of_hand if self.fixed is None else self.fixed.noise

    def intrinsics(self, of_hand: CameraIntrinsics) -> CameraIntrinsics:
        """Return this view's camera, given the one in the hand."""
        return of_hand if self.fixed is None else self.fixed.intrinsics

    def world(self, T_world_cam: Array | None = None) -> Array:
        """Return the points (N, 3) in world, of the claimed camera or of another."""
        T = self.T_world_cam if T_world_cam is None else T_world_cam
        return se3.transform(T, self.points.astype(np.float64))


@njit
def _trusted_pixels(
    depth: Array32, stride: int, reach: int, limits: tuple[float, float, float, float, float]
) -> tuple[Int32, int]:
    """Return the columns and rows (N, 2) of trusted sampled pixels, and how many hold depth.

    Args:
        depth: (H, W) [m]; 0 or not finite = none.
        stride: of the sampling.
        reach: pixels around one that are looked at.
        limits: jump [m], slope per metre of depth, sigmas, noise per m and its floor.
    """
    jump, slope, sigmas, per_m, floor = limits
    height, width = depth.shape
    out = np.empty((((height - 1) // stride + 1) * ((width - 1) // stride + 1), 2), np.int32)
    n, measured = 0, 0
    for i in range(0, height, stride):
        for j in range(0, width, stride):
            z = depth[i, j]
            if not (z > 0.0 and z < np.inf):
                continue
            measured += 1
            allowed = jump + slope * z + sigmas * max(floor, per_m * z * z)
            low, high = z, z
            good = True
            for a in range(max(0, i - reach), min(height, i + reach + 1)):
                for b in range(max(0, j - reach), min(width, j + reach + 1)):
                    y = depth[a, b]
                    if y > 0.0 and y < np.inf:
                        low, high = min(low, y), max(high, y)
                if high - low > allowed:
                    good = False
                    break
            if good:
                out[n, 0], out[n, 1] = j, i
                n += 1
    return out[:n].copy(), measured


def sample_view(
    intrinsics: CameraIntrinsics, frame: DepthFrame, noise: DepthNoise, config: SampleConfig
) -> ViewPoints:
    """Return the trusted points of one frame."""
    depth = np.ascontiguousarray(frame.depth_m, dtype=np.float32)
    pitch = config.edge_slope / min(intrinsics.fx, intrinsics.fy)
    pixels, measured = _trusted_pixels(
        depth, config.stride, config.edge_reach_px,
        (config.edge_jump_m, pitch, config.edge_sigmas, noise.per_m, noise.floor_m),
    )  # fmt: skip
    u, v = pixels[:, 0], pixels[:, 1]
    rays = ray_table(intrinsics)[v, u]
    known = np.isfinite(rays[:, 0])
    u, v, rays = u[known], v[known], rays[known]
    sampled = -(-depth.shape[0] // config.stride) * -(-depth.shape[1] // config.stride)
    return ViewPoints(
        index=frame.index,
        T_world_cam=frame.T_world_cam,
        points=(rays * depth[v, u, None]).astype(np.float32),
        pixels=pixels[known],
        area_px=float(config.stride**2),
        measured_share=measured / max(sampled, 1),
    )


def sample_views(
    intrinsics: CameraIntrinsics,
    frames: Sequence[DepthFrame],
    noise: DepthNoise,
    config: SampleConfig,
) -> tuple[ViewPoints, ...]:
    """Return the trusted points of every frame; each image is looked at once."""
    return tuple(sample_view(intrinsics, frame, noise, config) for frame in frames)


def world_cloud(views: Sequence[ViewPoints], noise: DepthNoise) -> Cloud:
    """Return the points of all views in world, where the cameras are said to be."""
    points = np.concatenate([v.world() for v in views])
    eyes = np.concatenate([np.tile(v.T_world_cam[:3, 3], (len(v.points), 1)) for v in views])
    sigmas = np.concatenate([v.noise(noise).sigma(v.points[:, 2]) for v in views])
    return seen_cloud(points, eyes, sigmas)
