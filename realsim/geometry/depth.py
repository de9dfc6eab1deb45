"""From a depth image to points and normals, and where a depth image is not to be trusted."""

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Array32, Int64, Mask
from realsim.errors import InputError, UnitError
from realsim.geometry.camera import ray_table
from realsim.geometry.robust import MAD_TO_SIGMA
from realsim.records import CameraIntrinsics

SECOND_DIFFERENCE_STEP_PX = 8
"""Stereo noise is correlated over a few pixels: at 4 px differences still missed three tenths."""
FARTHEST_M = 20.0
"""Half of a depth image beyond this is in another unit: no hand camera sees so far."""
UNIT_STRIDE = 16
"""Every so many rows and columns tell the unit."""


def check_depth(depth_m: Array32, intrinsics: CameraIntrinsics) -> None:
    """Check that a depth image belongs to the camera and is in metres.

    Raises:
        InputError: its size or type is not what is expected.
        UnitError: its values cannot be metres.
    """
    wanted = (intrinsics.height, intrinsics.width)
    if depth_m.shape != wanted:
        raise InputError(
            f"the depth image has shape {depth_m.shape}; the camera's is {wanted} (height, width)."
        )
    if depth_m.dtype.kind != "f":
        raise InputError(
            f"the depth image has type {depth_m.dtype}; float32 metres are expected. "
            "Multiply the raw counts by the depth unit."
        )
    some = depth_m[::UNIT_STRIDE, ::UNIT_STRIDE]
    some = some[np.isfinite(some) & (some > 0)]
    if len(some) and float(np.median(some)) > FARTHEST_M:
        middle = float(np.median(some))
        raise UnitError(
            f"half of the depth image lies beyond {middle:.4g} m; at most {FARTHEST_M:g} m is "
            f"accepted. In millimetres it would be {middle / 1e3:.4g} m: multiply it by the depth "
            "unit."
        )


def points_from_depth(
    depth_m: Array32, intrinsics: CameraIntrinsics, stride: int = 1
) -> tuple[Array, Int64]:
    """Return the measured points of a depth image and the pixels they come from.

    Args:
        depth_m: (H, W) depth along z [m]; 0 or NaN = none.
        intrinsics: the camera; its distortion is undone.
        stride: every how many rows and columns a pixel is used.

    Returns:
        points_cam (N, 3) [m] and pixels (N, 2) as x, y.
    """
    check_depth(depth_m, intrinsics)
    rays = ray_table(intrinsics)[::stride, ::stride]
    z = depth_m[::stride, ::stride]
    valid = (z > 0) & np.isfinite(z) & np.isfinite(rays[..., 0])
    v, u = np.nonzero(valid)
    points = rays[v, u].astype(np.float64) * z[v, u, None]
    return points, np.stack([u, v], -1).astype(np.int64) * stride


def edge_mask(depth_m: Array32, jump: ArrayLike, margin_px: int = 1) -> Mask:
    """Return where (H, W) a depth image jumps: flying pixels live there.

    A pixel is at an edge if the measured depths within `margin_px` of it span more than `jump`.

    Args:
        depth_m: (H, W) depth along z [m]; 0 = none (a hole is not an edge).
        jump: span that is an edge [m]; a number or one per pixel (H, W).
        margin_px: half the width of the window [px].
    """
    import cv2

    kernel = np.ones((2 * margin_px + 1, 2 * margin_px + 1), dtype=np.uint8)
    depth = np.ascontiguousarray(depth_m, dtype=np.float32)
    far = cv2.dilate(depth, kernel)
    near = cv2.erode(np.where(depth > 0, depth, np.float32(np.inf)), kernel)
    return np.asarray((far > 0) & (far - near > np.asarray(jump)), dtype=bool)


def depth_noise_per_m(depths_m: list[Array32]) -> float:
    """Return k of the stereo noise model sigma_z = k z^2 [1/m], measured from the images.

    Of a plane, however it lies, the inverse depth w = 1 / z is linear in the pixel, so the second
    difference w(u-s) - 2 w(u) + w(u+s) is noise of variance 6 sigma_w^2, and sigma_w = sigma_z /
    z^2 = k (s = 8 px, so that the correlation of a matching window does not hide it). The median
    absolute value over all pixels is blind to edges.

    Args:
        depths_m: depth images (H, W) [m]; 0 = none.

    Raises:
        InputError: there are too few measured pixels to tell.
    """
    s = SECOND_DIFFERENCE_STEP_PX
    samples: list[Array] = []
    for depth in depths_m:
        z = depth[::s].astype(np.float64)
        a, b, c = z[:, : -2 * s], z[:, s:-s], z[:, 2 * s :]
        known = (a > 0) & (b > 0) & (c > 0)
        samples.append(np.abs(1 / a[known] - 2 / b[known] + 1 / c[known]))
    values = np.concatenate(samples) if samples else np.zeros(0)
    if len(values) < 100:
        raise InputError(
            f"only {len(values)} places in {len(depths_m)} depth images have measured neighbours; "
            "at least 100 are needed. Is the depth all zero?"
        )
    return float(np.median(values) * MAD_TO_SIGMA / np.sqrt(6.0))
