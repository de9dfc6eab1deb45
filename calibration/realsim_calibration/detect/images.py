"""What every finder takes: a gray 8-bit image. Integer pixels are pixel centres."""

import numpy as np

from realsim.arrays import UInt8
from realsim.errors import InputError
from realsim_calibration.views import TargetDetection

MIN_IMAGE_PX = 32
"""Least width and height [px]; no target has its points apart in less."""


def gray_image(rgb: UInt8) -> UInt8:
    """Return the (H, W) gray image of an RGB (H, W, 3) or gray (H, W) one.

    Raises:
        InputError: the image is not 8 bit, or not (H, W) or (H, W, 3), or hardly an image.
    """
    import cv2

    image = np.asarray(rgb)
    colour = image.ndim == 3 and image.shape[2] == 3
    if image.dtype != np.uint8 or not (image.ndim == 2 or colour):
        raise InputError(
            f"the image has type {image.dtype} and shape {image.shape}; 8-bit RGB (H, W, 3) or "
            "gray (H, W) is accepted. Scale 16-bit or floating images to 0..255 first."
        )
    if min(image.shape[:2]) < MIN_IMAGE_PX:
        raise InputError(
            f"the image is {image.shape[1]}x{image.shape[0]} px; at least {MIN_IMAGE_PX} px along "
            "both sides are needed. Was the file read completely?"
        )
    if image.ndim == 2:
        return np.ascontiguousarray(image)
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def size_of(gray: UInt8) -> tuple[int, int]:
    """Return width and height [px]."""
    return int(gray.shape[1]), int(gray.shape[0])


def no_points(gray: UInt8, *reasons: str) -> TargetDetection:
    """Return a detection without points, with those of the reasons that are not empty."""
    return TargetDetection(
        point_ids=np.zeros(0, np.int64),
        uv=np.zeros((0, 2)),
        image_size=size_of(gray),
        rejected=tuple(r for r in reasons if r),
    )
