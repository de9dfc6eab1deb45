"""Photographs of boards of tags, drawn with OpenCV's markers alone."""

from functools import cache

import numpy as np

from realsim.arrays import Array, UInt8
from realsim.records import CameraIntrinsics, TagBoard

MODULES, TEXTURE, FINE = 8, 10, 2
"""Modules of a tag with its border, texture pixels a module, supersampling."""


@cache
def printed_sheet(board: TagBoard) -> tuple[UInt8, float, int]:
    """Return the sheet, its pixels per metre, and the width of its margin [pixels]."""
    from cv2 import aruco

    tag = MODULES * TEXTURE
    per_m, margin = tag / board.tag_size_m, tag // 2
    pitch = round((board.tag_size_m + board.gap_m) * per_m)
    width, height = (round(v * per_m) + 2 * margin for v in board.size_m)
    sheet = np.full((height, width), 215, np.uint8)
    dictionary = aruco.getPredefinedDictionary(aruco.DICT_APRILTAG_36h11)
    for k, number in enumerate(board.ids):
        row, column = divmod(k, board.columns)
        y, x = margin + row * pitch, margin + column * pitch
        marker = aruco.generateImageMarker(dictionary, int(number), MODULES)
        large = np.kron(marker, np.ones((TEXTURE, TEXTURE), np.uint8))
        sheet[y : y + tag, x : x + tag] = np.where(large > 0, 215, 30)
    return sheet, per_m, margin


def photograph(
    camera: CameraIntrinsics, boards: list[tuple[TagBoard, Array]], rng: np.random.Generator
) -> UInt8:
    """Return a picture (H, W, 3) of boards at T_cam_board on grey, the later ones in front."""
    import cv2

    half = (FINE - 1) / 2
    finer = np.array([[FINE, 0, half], [0, FINE, half], [0, 0, 1.0]])
    fine = np.full((camera.height * FINE, camera.width * FINE), 120, np.uint8)
    for board, T in boards:
        if T[2, 2] < 0.3 or T[2, 3] < 0.1:
            continue  # seen from behind or too flatly, or too near
        sheet, per_m, margin = printed_sheet(board)
        to_sheet = np.array([[per_m, 0, margin - 0.5], [0, per_m, margin - 0.5], [0, 0, 1.0]])
        H = finer @ camera.K @ T[:3, [0, 1, 3]] @ np.linalg.inv(to_sheet)
        size = fine.shape[::-1]
        cv2.warpPerspective(sheet, H, size, fine, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT)
    grey = cv2.resize(fine, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    noisy = np.clip(np.rint(grey + rng.normal(scale=1.5, size=grey.shape)), 0, 255)
    return np.repeat(noisy.astype(np.uint8)[..., None], 3, axis=2)
