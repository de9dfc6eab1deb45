"""Decode square markers: OpenCV finds the quads and reads the codes, corners stay rough."""

from functools import lru_cache
from typing import Any

import numpy as np

from realsim.arrays import Array, Int64, Mask, UInt8
from realsim_calibration.targets.marker_sets import load_dictionary

WEAK_DICTIONARIES = ("DICT_APRILTAG_16h5", "DICT_4X4_", "DICT_ARUCO_ORIGINAL")
"""Few bits or codes that differ in few: no bit is corrected, else clutter decodes."""
TOUCHING_KERNELS = (3, 5)
"""Widths of the white dilation that parts tags from squares at their corners [px]."""
TWO_BOARDS = "two equal boards are in view: cover one"
"""Why nothing is used where markers are seen twice."""
TWICE_SHARE = 0.15
"""Share of the markers seen more than once from which two boards are in view; one is clutter."""


def several_boards(ids: Int64) -> bool:
    """Return whether so many markers (n,) are seen more than once that it must be two boards."""
    values, counts = np.unique(ids, return_counts=True)
    twice = int((counts > 1).sum())
    return twice >= 2 and twice >= TWICE_SHARE * len(values)


@lru_cache(maxsize=16)
def _detector(name: str, border: int) -> Any:
    """Return the quad finder and decoder; its own corner refinement stays off."""
    from cv2 import aruco

    parameters = aruco.DetectorParameters()
    parameters.cornerRefinementMethod = aruco.CORNER_REFINE_NONE
    parameters.markerBorderBits = border
    if name.startswith(WEAK_DICTIONARIES):
        parameters.errorCorrectionRate = 0.0
    return aruco.ArucoDetector(load_dictionary(name), parameters)


def decode_markers(
    gray: UInt8, name: str, *, touching: bool = False, border: int = 1
) -> tuple[Int64, Array]:
    """Return ids (n,) and rough corners (n, 4, 2), clockwise from the code's top left [px].

    Args:
        gray: (H, W) image.
        name: one of OpenCV's predefined dictionaries.
        touching: black squares touch the markers' corners, as on Kalibr's AprilGrid: white is
            widened before, which parts them.
        border: width of the black border in modules.
    """
    detector = _detector(name, border)
    if not touching:
        return _decoded(detector, gray)
    import cv2

    ids, corners = _decoded(detector, gray)
    for width in TOUCHING_KERNELS:
        parted = cv2.dilate(gray, np.ones((width, width), np.uint8))
        more_ids, more = _decoded(detector, np.asarray(parted, dtype=np.uint8))
        more = _grown(more, width // 2)
        fresh = ~_near(more, corners)
        ids, corners = (
            np.concatenate([ids, more_ids[fresh]]),
            np.concatenate([corners, more[fresh]]),
        )
    return ids, corners


def _decoded(detector: Any, gray: UInt8) -> tuple[Int64, Array]:
    quads, found, _ = detector.detectMarkers(gray)
    ids = np.zeros(0, np.int64) if found is None else np.asarray(found, np.int64).ravel()
    return ids, np.asarray(quads, dtype=np.float64).reshape(-1, 4, 2)


def _grown(quads: Array, by: float) -> Array:
    """Return clockwise quads (n, 4, 2) with all sides moved outwards [px]."""
    along = np.roll(quads, -1, axis=1) - quads
    along = along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-9)
    after = np.stack([along[..., 1], -along[..., 0]], -1)
    before = np.roll(after, 1, axis=1)
    cosine = np.maximum((before * after).sum(-1, keepdims=True), -0.9)
    return quads + by * (before + after) / (1 + cosine)


def _near(quads: Array, others: Array) -> Mask:
    """Return which quads (n,) have their middle inside half a side of another's."""
    if not len(others) or not len(quads):
        return np.zeros(len(quads), dtype=bool)
    side = np.linalg.norm(quads[:, 0] - quads[:, 2], axis=-1)
    apart = np.linalg.norm(quads.mean(1)[:, None] - others.mean(1)[None], axis=-1)
    return np.any(apart < 0.35 * side[:, None], axis=1)
