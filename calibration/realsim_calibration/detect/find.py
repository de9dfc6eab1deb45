"""Find a target's points in an image, whatever kind of target it is."""

from dataclasses import replace

import numpy as np

from realsim.arrays import UInt8
from realsim.errors import InputError
from realsim.records import CameraIntrinsics
from realsim.records.targets import CharucoBoard, Chessboard, CircleGrid, TagBoard, Target
from realsim_calibration.detect.blur import blur_reason
from realsim_calibration.detect.charuco import find_charuco
from realsim_calibration.detect.chessboard import find_chessboard
from realsim_calibration.detect.circles import find_circles
from realsim_calibration.detect.drawings import drawing_reason
from realsim_calibration.detect.images import gray_image, size_of
from realsim_calibration.detect.tags import TagDetections, detect_tags
from realsim_calibration.views import TargetDetection

FEW_POINTS = 8
"""With fewer points it is looked at whether the picture is blurred."""


def find_target(
    image: UInt8, target: Target, *, intrinsics: CameraIntrinsics | None = None
) -> TargetDetection:
    """Return the points of a target that can be trusted; none is no error, `rejected` says why.

    Tags and ChArUco boards may be seen in part, chessboards and circle grids must be whole. Points
    of a target with `half_turn` are numbered along the image's x; the true end is not known.

    Args:
        image: (H, W, 3) RGB or (H, W) gray, uint8.
        target: what was printed.
        intrinsics: with them the lens is taken into account: straight edges may look bent, and
            ellipses lie askew. Rough ones will do.

    Raises:
        InputError: the image is not 8 bit, the intrinsics belong to another image size, or the
            marker dictionary is not known.
    """
    gray = gray_image(image)
    if intrinsics is not None and size_of(gray) != (intrinsics.width, intrinsics.height):
        width, height = size_of(gray)
        raise InputError(
            f"the image is {width}x{height} px, the intrinsics are for {intrinsics.width}x"
            f"{intrinsics.height}: give the intrinsics of this image size, or none."
        )
    found = _points(gray, target, intrinsics)
    if len(found) < FEW_POINTS:
        blurred = blur_reason(gray)
        if blurred:
            return replace(found, rejected=(blurred, *found.rejected))
    drawn = drawing_reason(image, found.uv)
    return replace(found, rejected=(drawn, *found.rejected)) if drawn else found


def _points(gray: UInt8, target: Target, intrinsics: CameraIntrinsics | None) -> TargetDetection:
    """Return the points by the search for the target's kind."""
    if isinstance(target, TagBoard):
        return tag_points(detect_tags(gray, target, intrinsics=intrinsics), target, size_of(gray))
    if isinstance(target, CharucoBoard):
        return find_charuco(gray, target, intrinsics=intrinsics)
    if isinstance(target, Chessboard):
        return find_chessboard(gray, target, intrinsics=intrinsics)
    assert isinstance(target, CircleGrid)
    return find_circles(gray, target, intrinsics=intrinsics)


def tag_points(
    detections: TagDetections, board: TagBoard, image_size: tuple[int, int]
) -> TargetDetection:
    """Return tags as points of the board, four a tag.

    Raises:
        InputError: a tag does not belong to the board.
    """
    row_of = {int(tag): row for row, tag in enumerate(board.ids)}
    wrong = [int(i) for i in detections.ids if int(i) not in row_of]
    if wrong:
        raise InputError(
            f"tags {wrong} are not on the board, whose ids run from {board.ids.min()} to "
            f"{board.ids.max()}."
        )
    rows = np.array([row_of[int(i)] for i in detections.ids], dtype=np.int64)
    return TargetDetection(
        point_ids=(4 * rows[:, None] + np.arange(4)).ravel(),
        uv=detections.corners_px.reshape(-1, 2),
        # A tag's figure is for both axes together.
        sd_px=np.repeat(detections.corner_sd_px / np.sqrt(2.0), 4),
        image_size=image_size,
        rejected=tuple(f"tag {i}: {reason}" for i, reason in detections.rejected),
    )
