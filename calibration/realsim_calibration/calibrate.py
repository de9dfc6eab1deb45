"""The whole calibration: of views the lens, then the hand-eye; or the hand-eye of poses alone."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import DegenerateError, InputError, UnitError
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.geometry.dh import DhArm
from realsim.records import CameraIntrinsics, Check, Chessboard, Target
from realsim_calibration.checks import FOCAL_SHARE, own_lens_check
from realsim_calibration.fit.closed_forms import pose_stacks
from realsim_calibration.fit.joint_solve import JointConfig
from realsim_calibration.hand_eye import HandEyeConfig, calibrate_hand_eye_report
from realsim_calibration.lens.fit import IntrinsicsConfig
from realsim_calibration.lens.intrinsics import calibrate_intrinsics
from realsim_calibration.lens.report import IntrinsicsReport
from realsim_calibration.results import HandEyeReport
from realsim_calibration.views import BoardView, TargetDetection, detection_of, measured_poses

CAMERA_SIGMAS = 4.0
"""A given focal length this many sigma of the images' own away is another one."""


@dataclass(frozen=True, kw_only=True, slots=True)
class CalibrationConfig:
    """Everything a calibration may be told."""

    hand_eye: HandEyeConfig = field(default_factory=HandEyeConfig)
    intrinsics: IntrinsicsConfig = field(default_factory=IntrinsicsConfig)
    border_px: float = 5.0
    """How far one sigma of a distortion term that the own lens calibration refused may move the
    image's corner in the hand-eye fit [px]."""
    own_focal_sd: float = 0.1
    """Prior of the focal length in the hand-eye fit around an own calibration of the same views,
    relative: hardly any, since these views say it themselves."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Calibration:
    """A calibrated camera on a robot."""

    hand_eye: HandEyeReport
    lens: IntrinsicsReport | None
    """The camera's own calibration from the same views; None where a given camera was used."""

    @property
    def checks(self) -> tuple[Check, ...]:
        """Every check of both."""
        lens = () if self.lens is None else self.lens.checks
        return (*self.hand_eye.checks, *lens)


DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
RADIAL_POWERS = {"k1": 3, "k2": 5, "k3": 7}
"""Power of the radius with which a term moves a point."""


def determined_priors(
    joint: JointConfig, lens: IntrinsicsReport, config: CalibrationConfig
) -> JointConfig:
    """Return the priors around an own lens, tight for distortion that the views do not determine.

    Freed entirely, such terms bend the lens outside of the corners until it folds inside the image;
    held, they leave what they could explain to the robot.
    """
    camera = lens.intrinsics
    radius = 0.5 * float(np.hypot(camera.width / camera.fx, camera.height / camera.fy))
    priors: list[float] = []
    for name, prior in zip(DISTORTION, joint.distortion_sd, strict=True):
        limit = np.inf
        if name not in lens.terms and name in RADIAL_POWERS:
            limit = config.border_px / (camera.fx * radius ** RADIAL_POWERS[name])
        priors.append(float(min(prior, limit)))
    return replace(joint, focal_sd=config.own_focal_sd, distortion_sd=tuple(priors))


def calibrate(
    views: Sequence[BoardView],
    target: Target,
    *,
    intrinsics0: CameraIntrinsics | None = None,
    arm: DhArm | None = None,
    config: CalibrationConfig | None = None,
) -> Calibration:
    """Return lens and hand-eye of a set of views.

    Args:
        views: views of a target that stands still (or sits in the hand), in any order.
        target: the printed target.
        intrinsics0: a camera known beforehand (the factory's); without it the lens is calibrated
            from the same views first.
        arm: the arm's kinematics; with the views' joints its errors are modelled.
        config: gates, priors, steps, and where the camera sits.

    Raises:
        InputError: wrong conventions, mixed-up views, images of several sizes, another target.
        UnitError: hand poses or target in the wrong unit.
        DegenerateError: the views do not determine lens or hand-eye; says what to add.
    """
    config = config or CalibrationConfig()
    lens: IntrinsicsReport | None = None
    hand_eye = config.hand_eye
    camera = intrinsics0
    ordered = sorted(views, key=lambda v: v.index)
    detections, names = [v.detection for v in ordered], [v.label for v in ordered]
    if camera is None:
        lens = calibrate_intrinsics(detections, target, names=names, config=config.intrinsics)
        camera = lens.intrinsics
        hand_eye = replace(hand_eye, joint=determined_priors(hand_eye.joint, lens, config))
    try:
        report = calibrate_hand_eye_report(views, target, camera, hand_eye, arm)
    except (InputError, UnitError):
        if intrinsics0 is not None:
            require_given_camera(intrinsics0, detections, target, names, config)
        raise
    if lens is not None:  # no camera was given, so nothing is said of one
        both = (lens.covariance + report.intrinsics_covariance)[2:4, 2:4]
        own = own_lens_check(camera, report.intrinsics, both)
        checks = tuple(own if c.name == "given camera" else c for c in report.checks)
        report = replace(report, checks=checks)
    return Calibration(hand_eye=report, lens=lens)


def require_given_camera(
    given: CameraIntrinsics,
    detections: Sequence[TargetDetection],
    target: Target,
    names: Sequence[str],
    config: CalibrationConfig,
) -> None:
    """Raise if the images alone show another focal length than the camera that was given.

    A wrong focal length makes every board too near or too far, and the target's size or the poses
    would be blamed: it is asked when something was.

    Args:
        given: the camera.
        detections: the target in the images.
        target: the target.
        names: of the images.
        config: how a lens is calibrated, and by how much a focal length may be off.

    Raises:
        InputError: names both focal lengths. Nothing is said where the images do not tell theirs.
    """
    try:
        lens = calibrate_intrinsics(
            list(detections), target, names=list(names), config=config.intrinsics
        )
    except (InputError, DegenerateError):
        return
    own = lens.intrinsics
    sd = float(np.sqrt(max(lens.covariance[0, 0], lens.covariance[1, 1]))) / own.fx
    off = float(np.sqrt(given.fx * given.fy / (own.fx * own.fy))) - 1
    if abs(off) < max(FOCAL_SHARE[1], CAMERA_SIGMAS * sd):
        return
    raise InputError(
        f"the given camera has a focal length of {np.sqrt(given.fx * given.fy):.1f} px, and the "
        f"images alone show {np.sqrt(own.fx * own.fy):.1f} +- {sd * own.fx:.1f} px: it is "
        f"{100 * off:+.1f} % off, so that the board seems too {'far' if off > 0 else 'near'}. Is "
        "it the camera, the resolution and the focus of these images? Leave --intrinsics out "
        "to have the lens calibrated from these views."
    )


# --- from poses alone ----------------------------------------------------------------------------
#
# A virtual 3x3 grid of points is seen through every measured camera-to-target pose by a nominal
# camera; lens and board are held, and lambda is 1: the pose measurement and the robot count alike.


@dataclass(frozen=True, kw_only=True, slots=True)
class VirtualGrid:
    """The points that stand for a pose."""

    pitch_m: float = 0.1
    """Half the grid's edge: an angle error then weighs like the same error of a 0.2 m board."""
    focal_px: float = 900.0
    """Focal length of the nominal camera [px]; only the unit of the residuals depends on it."""
    robot_ratio: float = 1.0
    """lambda of the fit."""
    z_to_camera: bool = False
    """Whether the measured frame's z axis points out of the target, towards the camera: the grid's
    points into it."""

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
        R = np.diag([1.0, -1.0, -1.0]) if self.z_to_camera else np.eye(3)
        return se3.from_rt(R, [self.pitch_m, self.pitch_m, 0.0])


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
    camera: CameraIntrinsics | None = None,
) -> HandEyeReport:
    """Return the hand-eye calibration from poses alone.

    Args:
        Ts_base_ee: (N, 4, 4) the controller's tool poses [m].
        Ts_cam_board: (N, 4, 4) the target in the camera [m].
        labels: a name per view.
        joints: (N, n) joint angles [rad].
        config: as for images; its joint fit is replaced by one with lens and board held.
        grid: the virtual grid.
        arm: the arm's kinematics, used with the joints.
        camera: the lens by which the target was measured: what the report and its files hold. None:
            a nominal one, and the report says so.

    Raises:
        InputError: the stacks differ in length, or a pose puts the grid behind the camera.
        DegenerateError: the poses do not determine the hand-eye.
    """
    A, C = pose_stacks(Ts_base_ee, Ts_cam_board, "hand-eye", others="camera poses")
    C = measured_poses(C, [f"T_cam_board of view {k}" for k in range(len(C))])
    towards = np.einsum("ni,ni->n", C[:, :3, 2], C[:, :3, 3]) < 0
    grid = replace(grid or VirtualGrid(), z_to_camera=bool(2 * towards.sum() > len(C)))
    pinhole = grid.camera if camera is None else replace(camera, distortion=np.zeros(8))
    target = grid.target
    q = None if joints is None else np.asarray(joints, dtype=np.float64)
    views: list[BoardView] = []
    for n, T in enumerate(C):
        uv = project(pinhole, se3.transform(T @ se3.invert(grid.T_grid_board), target.points_board))
        name = labels[n] if labels is not None else ""
        if not np.all(np.isfinite(uv)):
            raise InputError(
                f"hand-eye: the camera pose of view {name or n} puts the target behind the camera. "
                "T_cam_board maps target points into the camera; was its inverse given?"
            )
        views.append(
            BoardView(
                index=n, T_base_ee=A[n], name=name, joints=None if q is None else q[n],
                detection=detection_of(target, uv, (pinhole.width, pinhole.height)),
            )
        )  # fmt: skip
    config = replace(config or HandEyeConfig(), joint=held_lens_and_board(grid.robot_ratio))
    report = calibrate_hand_eye_report(views, target, pinhole, config, arm)
    to_board = grid.T_grid_board
    report = replace(
        report, Z=report.Z @ to_board, Z_alone=report.Z_alone @ to_board, T_points_board=to_board,
        nominal_lens=camera is None,
    )  # fmt: skip
    if camera is None:
        return report
    return replace(report, intrinsics=camera, intrinsics_alone=camera)
