"""Hand-eye calibration from camera poses of the target, where images are not at hand.

A virtual 3x3 grid of points is seen through every measured camera-to-target pose by a nominal
camera; lens and board are held, and lambda is 1: the pose measurement and the robot count alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.geometry.dh import DhArm
from realsim.records import CameraIntrinsics, Chessboard
from realsim_calibration.fit.joint_solve import JointConfig
from realsim_calibration.hand_eye import HandEyeConfig, calibrate_hand_eye_report
from realsim_calibration.results import HandEyeReport
from realsim_calibration.views import BoardView, detection_of

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class VirtualGrid:
    """The points that stand for a pose."""

    pitch_m: float = 0.1
    """Half the grid's edge: an angle error then weighs like the same error of a 0.2 m board."""
    focal_px: float = 900.0
    """Focal length of the nominal camera [px]; only the unit of the residuals depends on it."""
    robot_ratio: float = 1.0
    """lambda of the fit."""

    @property
    def target(self) -> Chessboard:
        """The grid as a target."""
        return Chessboard(rows=3, columns=3, square_m=self.pitch_m)

    @property
    def camera(self) -> CameraIntrinsics:
        """The nominal camera; its image has no border."""
        size = int(4 * self.focal_px)
        middle = (size - 1) / 2
        return CameraIntrinsics(
            width=size, height=size, fx=self.focal_px, fy=self.focal_px, cx=middle, cy=middle
        )

    @property
    def T_grid_board(self) -> Array:
        """(4, 4) the measured target frame, in the middle of the grid."""
        return se3.from_rt(np.eye(3), [self.pitch_m, self.pitch_m, 0.0])


def held_lens_and_board(ratio: float) -> JointConfig:
    """Return the joint fit in which only poses are estimated."""
    return JointConfig(
        robot_ratio=ratio,
        focal_sd=0.0,
        center_sd=0.0,
        distortion_sd=(0.0,) * 8,
        scale_sd=0.0,
        board_aspect_sd=0.0,
        warp_sd=0.0,
    )


def calibrate_from_poses(
    Ts_base_ee: ArrayLike,
    Ts_cam_board: ArrayLike,
    *,
    labels: Sequence[str] | None = None,
    joints: ArrayLike | None = None,
    config: HandEyeConfig | None = None,
    grid: VirtualGrid | None = None,
    arm: DhArm | None = None,
) -> HandEyeReport:
    """Return the hand-eye calibration from poses alone.

    Args:
        Ts_base_ee: (N, 4, 4) the controller's tool poses [m].
        Ts_cam_board: (N, 4, 4) the target in the camera [m].
        labels: a name per view.
        joints: (N, 6) joint angles [rad].
        config: as for images; its joint fit is replaced by one with lens and board held.
        grid: the virtual grid.
        arm: the arm's kinematics, used with the joints.

    Raises:
        InputError: the stacks differ in length, or a pose puts the grid behind the camera.
        DegenerateError: the poses do not determine the hand-eye.
    """
    grid = grid or VirtualGrid()
    A = np.asarray(Ts_base_ee, dtype=np.float64).reshape(-1, 4, 4)
    C = np.asarray(Ts_cam_board, dtype=np.float64).reshape(-1, 4, 4)
    if len(A) != len(C):
        raise InputError(
            f"hand-eye: {len(A)} hand poses and {len(C)} camera poses were given; every view needs "
            "one of each."
        )
    camera, target = grid.camera, grid.target
    q = None if joints is None else np.asarray(joints, dtype=np.float64)
    views: list[BoardView] = []
    for n, T in enumerate(C):
        uv = project(camera, se3.transform(T @ se3.invert(grid.T_grid_board), target.points_board))
        name = labels[n] if labels is not None else ""
        if not np.all(np.isfinite(uv)):
            raise InputError(
                f"hand-eye: the camera pose of view {name or n} puts the target behind the camera. "
                "T_cam_board maps target points into the camera; was its inverse given?"
            )
        views.append(
            BoardView(
                index=n, T_base_ee=A[n], name=name, joints=None if q is None else q[n],
                detection=detection_of(target, uv, (camera.width, camera.height)),
            )
        )  # fmt: skip
    config = replace(config or HandEyeConfig(), joint=held_lens_and_board(grid.robot_ratio))
    report = calibrate_hand_eye_report(views, target, camera, config, arm)
    return replace(report, Z=report.Z @ grid.T_grid_board)
