"""The pose of the board in one view, and its mirror twin.

A plane seen from afar fits two poses almost equally well (it may tip towards or away from the
viewer). Both are kept, each refined in pixels through the full lens model, and told apart by their
reprojection; the hand-eye gates may choose the twin where the motion of the hand says so.
"""

from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.camera import undistort
from realsim.records import CameraIntrinsics
from realsim_calibration.fit.view_system import camera_vector, refined_pose

REFINE_STEPS = 15
"""Gauss-Newton from IPPE's solution converges in four; the twin may take longer."""
FIRST_DAMPING = 1e-4
"""Levenberg-Marquardt's first damping, relative: nearly a Gauss-Newton step."""
RELATIVE_GAIN = 1e-9
"""A step that gains less of the cost is the last: the pose moves by 3e-5 of its own noise."""
SAME_POSE_RAD = 1e-3
"""Solutions nearer than this are one: a planar pose's own noise is ten times as large."""
MIN_POINTS = 4
"""A planar pose needs four points."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BoardPose:
    """Where the board is in the camera frame."""

    T_cam_board: Array
    """(4, 4) the pose of least reprojection [m]."""
    rms_px: float
    """Its reprojection RMS [px]."""
    twin: Array | None
    """(4, 4) the other planar solution [m]; None where there is none."""
    twin_rms_px: float
    """Its reprojection RMS [px]; infinite where there is none."""


def estimate_board_pose(points: Array, uv: Array, intrinsics: CameraIntrinsics) -> BoardPose | None:
    """Return the board's pose in the camera, None where no pose in front of the camera fits.

    Args:
        points: (n, 3) points in the board frame [m].
        uv: (n, 2) where they are in the image [px].
        intrinsics: the camera.
    """
    found = planar_poses(points, uv, intrinsics)
    if not found:
        return None
    best, twin = found[0], found[1] if len(found) > 1 else (np.inf, None)
    return BoardPose(T_cam_board=best[1], rms_px=best[0], twin=twin[1], twin_rms_px=twin[0])


def planar_poses(
    points: Array, uv: Array, intrinsics: CameraIntrinsics, drawn: Array | None = None
) -> list[tuple[float, Array]]:
    """Return (RMS [px], T_cam_board) of all planar solutions, refined, the best first.

    IPPE (Collins & Bartoli, IJCV 2014) gives both planar solutions and SQPnP one more start; all
    are refined in pixels. `drawn` (n, 3) is a flat board to start from where the points are warped.
    """
    import cv2

    xy, valid = undistort(intrinsics, uv)
    if valid.sum() < MIN_POINTS:
        return []
    flat, lens = points if drawn is None else drawn, camera_vector(intrinsics)
    found: list[tuple[float, Array]] = []
    for flag in (cv2.SOLVEPNP_IPPE, cv2.SOLVEPNP_SQPNP):
        _, rotations, translations, _ = cv2.solvePnPGeneric(
            flat[valid], xy[valid], np.eye(3), None, flags=flag
        )
        for r, t in zip(rotations, translations, strict=True):
            start = se3.from_rt(se3.exp_so3(np.ravel(r)), np.ravel(t))
            refined, rms = refine_board_pose(start, points, uv, lens)
            turns = [se3.angle(se3.invert(refined) @ other) for _, other in found]
            if np.isfinite(rms) and all(turn > SAME_POSE_RAD for turn in turns):
                found.append((rms, refined))
    return sorted(found, key=lambda pair: pair[0])


def refine_board_pose(
    T_cam_board: Array, points: Array, uv: Array, lens: Array
) -> tuple[Array, float]:
    """Return the pose of locally least reprojection and its RMS [px] (Levenberg-Marquardt).

    `lens` is (12,) fx fy cx cy and the distortion.
    """
    T, cost = refined_pose(
        np.ascontiguousarray(T_cam_board), lens, np.ascontiguousarray(points),
        np.ascontiguousarray(uv), REFINE_STEPS, FIRST_DAMPING, RELATIVE_GAIN,
    )  # fmt: skip
    return T, float(np.sqrt(cost / len(points)))
