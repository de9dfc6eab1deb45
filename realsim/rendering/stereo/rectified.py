"""The rectified pair in which a stereo camera matches, and the way back to a distorted image."""

import numpy as np

from realsim.arrays import Array32
from realsim.geometry import camera
from realsim.records import CameraIntrinsics

GREATEST_GROWTH = 1.5
"""The rectified picture is at most this many times as wide and high as the raw one: the rim of a
strong lens would need a boundless one, and is left without depth."""
SAME_SURFACE_PX = 1.0
"""Neighbouring disparities that differ by more are not blended [px]."""


def rectified_pinhole(intrinsics: CameraIntrinsics) -> CameraIntrinsics:
    """Return the undistorted camera at the same place that sees what `intrinsics` sees.

    The focal lengths stay, so a disparity means the same; without distortion nothing changes.
    """
    i = intrinsics
    if not i.is_distorted:
        return i
    rays = camera.ray_table(i)
    grow_x, grow_y = (GREATEST_GROWTH - 1) / 2 * i.width, (GREATEST_GROWTH - 1) / 2 * i.height
    u, v = rays[..., 0] * i.fx + i.cx, rays[..., 1] * i.fy + i.cy
    left = int(np.floor(max(float(np.nanmin(u)), -grow_x)))
    top = int(np.floor(max(float(np.nanmin(v)), -grow_y)))
    right = int(np.ceil(min(float(np.nanmax(u)), i.width - 1 + grow_x)))
    bottom = int(np.ceil(min(float(np.nanmax(v)), i.height - 1 + grow_y)))
    return CameraIntrinsics(
        width=right - left + 1, height=bottom - top + 1,
        fx=i.fx, fy=i.fy, cx=i.cx - left, cy=i.cy - top,
    )  # fmt: skip


def on_raw_grid(
    disparity: Array32, pinhole: CameraIntrinsics, intrinsics: CameraIntrinsics
) -> Array32:
    """Return a rectified disparity (H', W') on the raw image's pixels (H, W), 0 = none.

    Between four measured pixels of one surface it is interpolated; at edges and holes the nearest
    pixel counts, so that nothing is invented between two surfaces. Depth along z is the same in
    both, because they share the optical axis.
    """
    import cv2

    if not intrinsics.is_distorted:
        return disparity
    rays = camera.ray_table(intrinsics)
    x = (rays[..., 0] * pinhole.fx + pinhole.cx).astype(np.float32)
    y = (rays[..., 1] * pinhole.fy + pinhole.cy).astype(np.float32)
    outside = ~np.isfinite(x)
    x[outside] = y[outside] = -2.0
    kernel = np.ones((3, 3), np.uint8)
    even = cv2.dilate(disparity, kernel) - cv2.erode(disparity, kernel) < SAME_SURFACE_PX
    smooth = cv2.remap(disparity, x, y, cv2.INTER_LINEAR, borderValue=0)
    nearest = cv2.remap(disparity, x, y, cv2.INTER_NEAREST, borderValue=0)
    blend = cv2.remap(even.astype(np.uint8), x, y, cv2.INTER_NEAREST, borderValue=0) > 0
    return np.where(blend & (nearest > 0), smooth, nearest).astype(np.float32)
