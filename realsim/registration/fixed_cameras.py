"""Cameras that stand still beside the one in the hand.

A scene that does not move looks the same in every image of such a camera: all its images are one
view. Their median has less noise and shows what an arm that passes hides now and then; and where
the camera stands is one unknown, however many images there are.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from realsim.arrays import Array, Array32
from realsim.errors import InputError
from realsim.geometry.depth import depth_noise_per_m
from realsim.records import CameraIntrinsics
from realsim.records.depth_bias import DepthBias
from realsim.registration.evidence import DepthNoise

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
