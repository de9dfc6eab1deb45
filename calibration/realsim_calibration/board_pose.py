"""The pose of the board in one view, and its mirror twin.

A plane seen from afar fits two poses almost equally well (it may tip towards or away from the
viewer). Both are kept, each refined in pixels through the full lens model, and told apart by their
reprojection; the hand-eye gates may choose the twin where the motion of the hand says so.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.camera import project, projection_jacobian, undistort
from realsim.records import CameraIntrinsics, TagBoard
from realsim_calibration.detection import TagDetections

Array = NDArray[np.float64]
REFINE_STEPS = 15
"""Gauss-Newton from IPPE's solution converges in four; the twin may take longer."""
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


def board_points(detections: TagDetections, board: TagBoard) -> tuple[Array, Array]:
    """Return corners in the board frame (n, 3) [m] and in the image (n, 2) [px].

    Raises:
        InputError: a tag does not belong to the board.
    """
    row = detections.ids - board.first_id
    wrong = (row < 0) | (row >= board.rows * board.columns)
    if wrong.any():
        raise InputError(
            f"tags {detections.ids[wrong].tolist()} are not on the board, whose ids run from "
            f"{board.first_id} to {board.first_id + board.rows * board.columns - 1}."
        )
    points = board.corners_board[row].reshape(-1, 3)
    return points, detections.corners_px.reshape(-1, 2)


def estimate_board_pose(
    detections: TagDetections, board: TagBoard, intrinsics: CameraIntrinsics
) -> BoardPose | None:
    """Return the board's pose in the camera, None where no pose in front of the camera fits.

    IPPE (Collins & Bartoli, IJCV 2014) gives both planar solutions and SQPnP one more start; all
    are refined in pixels.
    """
    import cv2

    points, uv = board_points(detections, board)
    xy, valid = undistort(intrinsics, uv)
    if valid.sum() < MIN_POINTS:
        return None
    starts: list[Array] = []
    for flag in (cv2.SOLVEPNP_IPPE, cv2.SOLVEPNP_SQPNP):
        _, rotations, translations, _ = cv2.solvePnPGeneric(
            points[valid], xy[valid], np.eye(3), None, flags=flag
        )
        for r, t in zip(rotations, translations, strict=True):
            starts.append(se3.from_rt(se3.exp_so3(np.ravel(r)), np.ravel(t)))
    found: list[tuple[float, Array]] = []
    for T in starts:
        refined, rms = refine_board_pose(T, points, uv, intrinsics)
        fresh = all(se3.angle(se3.invert(refined) @ other) > 1e-3 for _, other in found)
        if np.isfinite(rms) and fresh:
            found.append((rms, refined))
    if not found:
        return None
    found.sort(key=lambda pair: pair[0])
    best, twin = found[0], found[1] if len(found) > 1 else (np.inf, None)
    return BoardPose(T_cam_board=best[1], rms_px=best[0], twin=twin[1], twin_rms_px=twin[0])


def refine_board_pose(
    T_cam_board: Array, points: Array, uv: Array, intrinsics: CameraIntrinsics
) -> tuple[Array, float]:
    """Return the pose of locally least reprojection and its RMS [px] (Levenberg-Marquardt)."""
    T, damping = T_cam_board, 1e-4
    cost = _cost(T, points, uv, intrinsics)
    for _ in range(REFINE_STEPS):
        if not np.isfinite(cost):
            break
        cam = se3.transform(T, points)
        predicted, d_point, _ = projection_jacobian(intrinsics, cam)
        J = (d_point @ T[:3, :3] @ np.concatenate([-se3.hat(points), _eyes(points)], -1)).reshape(
            -1, 6
        )
        r = (uv - predicted).ravel()
        H, g = J.T @ J, J.T @ r
        step = np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
        moved = T @ se3.exp(step)
        new = _cost(moved, points, uv, intrinsics)
        if new < cost:
            done = cost - new < 1e-12 * cost
            T, cost, damping = moved, new, damping * 0.1
            if done:
                break
        else:
            damping *= 10
    return T, float(np.sqrt(cost / len(points)))


def _eyes(points: Array) -> Array:
    return np.broadcast_to(np.eye(3), (len(points), 3, 3))


def _cost(T: Array, points: Array, uv: Array, intrinsics: CameraIntrinsics) -> float:
    """Return the sum of squared 2-D errors [px^2], infinite where a point is behind the camera."""
    error = project(intrinsics, se3.transform(T, points)) - uv
    total = float(np.sum(error**2))
    return total if np.isfinite(total) else np.inf
