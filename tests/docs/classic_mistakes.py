"""Classic mistakes of a hand-eye calibration, made on purpose on views of the simulated lab."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from realsim.errors import RealsimError
from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics, TagBoard
from realsim.robots.arm import UR5 as UR5_ARM
from realsim_calibration import (
    BoardView,
    TargetDetection,
    calibrate_hand_eye_report,
    detection_of,
    diagnose,
    estimate_board_pose,
)
from realsim_capture_plans import PlanConfig, calibration_plan
from realsim_capture_plans.lab import LabConfig, SimulatedLab

PIXEL_NOISE = 0.1
VIEWS = 24
MOVED_FROM = 14
BOARD_STEP = se3.exp([0.0, 0.0, np.radians(3.0), 0.02, 0.01, 0.0])
"""The board is pushed by 22 mm and turned by 3 degrees."""


@cache
def lab_views(slip: str = "") -> tuple[tuple[BoardView, ...], Any, Any]:
    """Return the board views of a lab (points found, poses, joints), its board, its camera.

    Args:
        slip: what moves before view 14: "board" or nothing.
    """
    lab = SimulatedLab(LabConfig(seed=0, n_objects=1))
    rng = np.random.default_rng(0)
    plan = calibration_plan(VIEWS, lab.scene_center, lab.nominal_T_ee_cam, PlanConfig(), rng)
    board, lens = lab.board, lab.truth.intrinsics
    corners = se3.transform(lab.truth.T_world_board, board.points_board)
    views: list[BoardView] = []
    for k, joints in enumerate(plan.joints):
        lab.arm.move(joints)
        T_cam_world = se3.invert(lab.truth.T_world_cam(joints))
        now = corners
        if slip == "board" and k >= MOVED_FROM:
            now = se3.transform(lab.truth.T_world_board @ BOARD_STEP, board.points_board)
        uv = camera.project(lens, se3.transform(T_cam_world, now))
        seen = inside(board, lens, uv + rng.normal(scale=PIXEL_NOISE, size=uv.shape))
        state = lab.arm.state()
        views.append(
            BoardView(index=k, T_base_ee=state.T_base_ee, joints=state.joints, detection=seen)
        )
    return tuple(views), board, lab.camera.intrinsics


def inside(board: TagBoard, lens: CameraIntrinsics, uv: np.ndarray) -> TargetDetection:
    """Return the detection of those of a board's points that lie in the image."""
    ids = np.flatnonzero(np.all((uv > 0) & (uv < [lens.width - 1, lens.height - 1]), axis=1))
    return detection_of(board, uv[ids], (lens.width, lens.height), ids)


def hand_and_board() -> tuple[np.ndarray, np.ndarray]:
    """Return T_base_ee and T_cam_board (n, 4, 4) of the views."""
    views, board, factory = lab_views()
    T = np.array([v.T_base_ee for v in views])
    found = [estimate_board_pose(v.detection.points(board), v.detection.uv, factory) for v in views]
    return T, np.array([pose.T_cam_board for pose in found if pose is not None])


def said_of_poses(T: np.ndarray, C: np.ndarray) -> str:
    """Return what realsim says of poses."""
    found = diagnose(T, C, target=lab_views()[1])
    return f"[{found.fault}] {found.sentence} {found.advice}"


def turned(T: np.ndarray, Rs: Any) -> np.ndarray:
    """Return the poses with other rotations."""
    out = T.copy()
    out[:, :3, :3] = Rs.as_matrix()
    return out


def quaternion_order() -> str:
    T, C = hand_and_board()
    xyzw = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    return said_of_poses(turned(T, Rotation.from_quat(np.roll(xyzw, 1, axis=1))), C)


def scaled_print() -> str:
    """The printer's `fit to page`: 97 % of the size."""
    views, board, factory = lab_views()
    bigger = replace(board, tag_size_m=board.tag_size_m / 0.97, gap_m=board.gap_m / 0.97)
    return checks_of(views, bigger, factory)


def moved_board() -> str:
    return checks_of(*lab_views("board"))


def one_axis() -> str:
    """Every view turned about one axis only: the arm's last joint was all that was moved."""
    T, C = hand_and_board()
    X = np.eye(4)
    Z = T[0] @ X @ C[0]
    turns = np.array([T[0] @ se3.exp([0, 0, a, 0, 0, 0]) for a in np.linspace(0, 1.5, len(T))])
    _, board, factory = lab_views()
    seen: list[BoardView] = []
    for k, A in enumerate(turns):
        uv = camera.project(factory, se3.transform(se3.invert(A @ X) @ Z, board.points_board))
        seen.append(BoardView(index=k, T_base_ee=A, detection=inside(board, factory, uv)))
    return checks_of(seen, board, factory)


def checks_of(views: Any, board: Any, intrinsics: Any) -> str:
    """Return the calibration's checks that are not good, or what it refuses with."""
    try:
        report = calibrate_hand_eye_report(views, board, intrinsics, arm=UR5_ARM)
    except RealsimError as error:
        return f"[refused] {error}"
    dropped = [f"{v.label}: {v.reason}" for v in report.views if not v.used]
    return " ".join(dropped[:2]) + " ".join(
        f"[{c.name}: {c.verdict}] {c.sentence} {c.advice}"
        for c in report.checks
        if c.verdict != "good"
    )


MISTAKES = (quaternion_order, scaled_print, moved_board, one_axis)

if __name__ == "__main__":
    for mistake in MISTAKES:
        print(f"{mistake.__name__}:\n    {mistake()}\n")
