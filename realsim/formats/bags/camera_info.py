"""From sensor_msgs/CameraInfo to a camera: which matrix, which distortion, which size."""

from collections.abc import Collection
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.records import CameraIntrinsics

OPENCV_MODELS = ("plumb_bob", "rational_polynomial", "brown conrady", "brown_conrady")
"""Models whose coefficients are OpenCV's k1 k2 p1 p2 k3 (k4 k5 k6)."""
INVERSE = "inverse brown conrady"
FISHEYE = ("equidistant", "fisheye", "kannala_brandt4")
TRANSPORTS = ("compressed", "compressedDepth", "ffmpeg", "theora")


def without_transport(topic: str) -> str:
    """Return the topic of the images before image_transport compressed them."""
    parent, _, last = topic.rpartition("/")
    return parent if last in TRANSPORTS else topic


def is_rectified(topic: str) -> bool:
    """Return whether a topic's name says that its images have been undistorted."""
    return "rect" in without_transport(topic).rpartition("/")[2]


def info_topic(image_topic: str, available: Collection[str]) -> str | None:
    """Return the CameraInfo topic that belongs to an image topic by name, if it is there.

    ROS puts `camera_info` beside the image; RealSense's own files put it under `info` or `image`.
    """
    image = without_transport(image_topic)
    parent = image.rpartition("/")[0]
    grandparent = parent.rpartition("/")[0]
    names = [f"{parent}/camera_info", f"{image}/camera_info", f"{grandparent}/info/camera_info"]
    return next((n for n in names if n in available), None)


def _field(message: Any, name: str) -> Array:
    """Return K, D or P; ROS1 writes them in capitals, ROS2 does not."""
    value = getattr(message, name, None)
    value = getattr(message, name.upper()) if value is None else value
    return np.asarray(value, dtype=np.float64)


def camera_of(
    message: Any, topic: str, width: int, height: int, rectified: bool
) -> CameraIntrinsics:
    """Return the camera of images of a size, from their CameraInfo.

    Args:
        message: the CameraInfo.
        topic: what errors call it.
        width: of the images [px].
        height: of the images [px].
        rectified: the images are undistorted: P and no distortion count, instead of K and D.

    Raises:
        InputError: not calibrated, a model that OpenCV's does not cover, or another size.
    """
    K, D, P = _field(message, "k"), _field(message, "d"), _field(message, "p")
    K = K.reshape(3, 3)
    if rectified and P.size == 12 and P[0] > 0:
        K, D = P.reshape(3, 4)[:, :3].copy(), np.zeros(0)
    if not (K[0, 0] > 0 and K[1, 1] > 0):
        raise InputError(
            f"{topic}: the focal lengths are {K[0, 0]:g} and {K[1, 1]:g}; the driver had no "
            "calibration. Give the camera in a file (intrinsics=), or record a calibrated one."
        )
    distortion = _distortion(D, str(message.distortion_model), topic)
    K, size = _binned(K, message)
    if size != (width, height):
        raise InputError(
            f"{topic} describes images of {size[0]}x{size[1]}, but they are {width}x{height}. "
            "Choose the CameraInfo of these images (camera_info=), or give the camera in a file "
            "(intrinsics=)."
        )
    return CameraIntrinsics.from_K(K, width, height, distortion)


def _distortion(D: Array, model: str, topic: str) -> Array:
    if not np.any(D != 0):
        return np.zeros(0)
    name = model.strip().lower().replace("modified ", "")
    if name in OPENCV_MODELS:
        return D
    hint = "It is a fisheye model." if name in FISHEYE else ""
    if name.replace("_", " ") == INVERSE:
        hint = "It undistorts where OpenCV's distorts."
    raise InputError(
        f"{topic}: the distortion model is '{model}' with coefficients {D.tolist()}; plumb_bob and "
        f"rational_polynomial are accepted. {hint} Use a rectified topic if one was recorded, or "
        "calibrate the camera and give it in a file (intrinsics=)."
    )


def _binned(K: Array, message: Any) -> tuple[Array, tuple[int, int]]:
    """Return the camera matrix and the size after CameraInfo's region of interest and binning.

    K speaks of the full image. A binned pixel's centre is the centre of its block.
    """
    roi = message.roi
    width, height = int(message.width), int(message.height)
    if int(roi.width) and int(roi.height):
        width, height = int(roi.width), int(roi.height)
        K = K - np.array([[0, 0, roi.x_offset], [0, 0, roi.y_offset], [0, 0, 0]], dtype=np.float64)
    bx, by = max(1, int(message.binning_x)), max(1, int(message.binning_y))
    K = K.copy()
    K[0, 0], K[1, 1] = K[0, 0] / bx, K[1, 1] / by
    K[0, 2], K[1, 2] = (K[0, 2] + 0.5) / bx - 0.5, (K[1, 2] + 0.5) / by - 0.5
    return K, (width // bx, height // by)
