"""Simulated calibrations, whose truth is known: CPU seconds, efficiency, coverage.

Imported by `calibration.py`. A camera (1280x720 px, f = 644 px, of which 640 is known beforehand)
on the hand looks from a hemisphere of 0.35 to 0.5 m, fully rolled, at a chessboard of 14x10 corners
of 20 mm that is misprinted and bent; corners are off by 0.2 px.
"""

import time
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.stats import chi2

from realsim.arrays import Array
from realsim.errors import RealsimError
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.records import CameraIntrinsics, Chessboard
from realsim.robots.arm import UR5E
from realsim.robots.arm import UR5E as UR5E_ARM
from realsim_calibration import (
    BoardView,
    HandEyeConfig,
    JointConfig,
    TargetDetection,
    calibrate_hand_eye_report,
)
from realsim_calibration.fit.joint_solve import JointProblem, JointState, Setup, ViewCorners
from realsim_calibration.fit.linear_model import LinearModel
from realsim_calibration.fit.robust_fit import solve
from realsim_calibration.fit.view_system import camera_vector

Rng = np.random.Generator
BOARD = Chessboard(rows=10, columns=14, square_m=0.02)
MIDDLE = (BOARD.points_board.max(0) + BOARD.points_board.min(0)) / 2
HALF_EXTENT = float(np.ptp(BOARD.points_board, axis=0).max() / 2)
CAMERA = CameraIntrinsics(
    width=1280, height=720, fx=644.0, fy=643.0, cx=643.0, cy=356.0,
    distortion=np.array([-0.05, 0.04, 0.0006, -0.0004]),
)  # fmt: skip
KNOWN = CameraIntrinsics(width=1280, height=720, fx=640.0, fy=640.0, cx=639.5, cy=359.5)
"""What is known of the camera beforehand."""
X_TRUE = se3.from_rt(se3.exp_so3([0.1, -0.05, 1.5]), [0.03, -0.06, 0.05])
Z_TRUE = se3.from_rt(np.diag([1.0, -1.0, -1.0]), [0.27, 0.19, 0.02])
CORNER_PX = 0.2
SCALE_SD, ASPECT_SD, WARP_SD = 0.003, 0.002, 0.005
"""How boards are misprinted and bent, 1-sigma."""
MAX_TILT = np.radians(45.0)
DISTANCE_M = (0.35, 0.5)
AIM_SD_M = 0.03
"""How far from the board's middle the camera aims."""
WHITE = (3e-4, 3e-4)
"""1-sigma of white robot noise per axis [rad, m]."""
DH_SD = (2e-4, 1e-4)
"""1-sigma of the errors of an arm's angles [rad] and lengths [m]."""
REPEAT = (5e-5, 3e-5)
"""1-sigma of the arm's repeatability per axis [rad, m]."""
START_OFF = 3e-3
"""1-sigma of a closed form's error [rad, m]."""
WARM_UP_VIEWS = 20
COVER = 0.95
Kind = Literal["white", "kinematic", "unknown_arm"]
KINDS: tuple[Kind, ...] = ("white", "kinematic", "unknown_arm")


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Session:
    """Simulated views and their truth."""

    views: tuple[BoardView, ...]
    board: Array
    """(5,) scale, aspect, warps."""
    errors: Array
    """(n, 6) log(reported^-1 true) of the robot's poses."""


def shaped_points(board: Array) -> Array:
    """Return the points (140, 3) of the misprinted, bent board."""
    x, y = (BOARD.points_board - MIDDLE)[:, :2].T
    scale, aspect, *w = board
    lift = (w[0] * x * x + w[1] * x * y + w[2] * y * y) / HALF_EXTENT
    return MIDDLE + scale * np.stack([x, (1 + aspect) * y, lift], -1)


def hemisphere(rng: Rng, n: int) -> Array:
    """Return poses of the hand (n, 4, 4) from which the camera sees the board."""
    poses: list[Array] = []
    for _ in range(n):
        tilt, azimuth = rng.uniform(0, MAX_TILT), rng.uniform(-np.pi, np.pi)
        s = np.sin(tilt)
        away = np.array([s * np.cos(azimuth), s * np.sin(azimuth), -np.cos(tilt)])
        aim = MIDDLE + np.append(rng.normal(size=2) * AIM_SD_M, 0.0)
        side = np.append(rng.normal(size=2) * AIM_SD_M, 0.0)
        eye = MIDDLE + rng.uniform(*DISTANCE_M) * away + side
        T_base_cam = Z_TRUE @ se3.look_at(eye, aim, rng.uniform(-np.pi, np.pi))
        poses.append(T_base_cam @ se3.invert(X_TRUE))
    return np.array(poses)


def reachable(rng: Rng, n: int) -> Array:
    """Return joints (n, 6) of a UR5e on the hemisphere, in one configuration.

    Of the up to eight ways to reach a pose the one nearest to the first pose's is taken: planners
    keep elbow and shoulder on one side.
    """
    joints: list[Array] = []
    while len(joints) < n:
        q, owner = UR5E.inverse_branches(hemisphere(rng, n))
        for pose in np.unique(owner):
            branches = q[owner == pose]
            turn = np.angle(np.exp(1j * (branches - (joints[0] if joints else branches[0]))))
            joints.append(branches[int(np.argmin(np.abs(turn).sum(1)))])
    return np.array(joints[:n])


def draw(rng: Rng, n: int, kind: Kind) -> Session:
    """Return a session of n views."""
    board = np.append(
        [1 + rng.normal() * SCALE_SD, rng.normal() * ASPECT_SD], rng.normal(size=3) * WARP_SD
    )
    joints: Array | None = None

    def noise(sd: tuple[float, float]) -> Array:
        return rng.normal(size=(n, 6)) * np.repeat(sd, 3)

    if kind == "white":
        reported, errors = hemisphere(rng, n), noise(WHITE)
        true = reported @ se3.exp(errors)
    else:
        joints = reachable(rng, n)
        reported = UR5E_ARM.forward(joints)
        arm = UR5E_ARM.corrected(rng.normal(size=24) * np.repeat(DH_SD, 12))
        true = arm.forward(joints) @ se3.exp(noise(REPEAT))
        errors = se3.log(se3.invert(reported) @ true)
    points = shaped_points(board)
    views: list[BoardView] = []
    for k, T in enumerate(true):
        uv = project(CAMERA, se3.transform(se3.invert(T @ X_TRUE) @ Z_TRUE, points))
        uv += rng.normal(size=uv.shape) * CORNER_PX
        seen = np.all((uv > 0) & (uv < [CAMERA.width - 1, CAMERA.height - 1]), -1)
        detection = TargetDetection(
            point_ids=np.flatnonzero(seen), uv=uv[seen], image_size=(CAMERA.width, CAMERA.height)
        )
        views.append(
            BoardView(
                index=k, T_base_ee=reported[k], detection=detection,
                joints=None if joints is None else joints[k],
            )
        )  # fmt: skip
    return Session(views=tuple(views), board=board, errors=errors)


def error_of(X: Array) -> Array:
    """Return the right perturbation (6,) of an estimate of X."""
    return se3.log(se3.invert(X_TRUE) @ X)


def normalized(X: Array, covariance: Array) -> float:
    """Return the squared error of X in units of a covariance, chi^2 of 6 if that is true."""
    e = error_of(X)
    return float(e @ np.linalg.solve(covariance, e))


@dataclass(frozen=True, kw_only=True, slots=True)
class CoverageTrial:
    """One calibration against its own covariance."""

    kind: Kind
    chi2: float
    chi2_alone: float
    """chi2 of the X that is fitted without a map."""
    mm: float
    deg: float
    map_name: str = ""
    said: str = ""
    """The refusal, where there was one; nothing is covered then."""

    @property
    def covered(self) -> bool:
        """Whether the truth is inside the 95 % region."""
        return bool(self.chi2 < chi2.ppf(COVER, 6))

    @property
    def covered_alone(self) -> bool:
        """The same of the X without a map."""
        return bool(self.chi2_alone < chi2.ppf(COVER, 6))


def coverage_trial(task: tuple[Kind, int, int]) -> CoverageTrial:
    """Return a trial of a kind, a number of views, and a seed."""
    kind, n, seed = task
    session = draw(np.random.default_rng([seed, KINDS.index(kind), n]), n, kind)
    arm = UR5E_ARM if kind == "kinematic" else None
    try:
        r = calibrate_hand_eye_report(session.views, BOARD, KNOWN, arm=arm)
    except RealsimError as error:
        bad = float("inf")
        return CoverageTrial(
            kind=kind, chi2=bad, chi2_alone=bad, mm=bad, deg=bad, said=str(error)
        )  # fmt: skip
    e = error_of(r.X)
    return CoverageTrial(
        kind=kind, chi2=normalized(r.X, r.X_covariance), map_name=r.map_name,
        chi2_alone=normalized(r.X_alone, r.X_alone_covariance),
        mm=1e3 * float(np.linalg.norm(e[3:])), deg=float(np.degrees(np.linalg.norm(e[:3]))),
    )  # fmt: skip


def joint_setup(session: Session) -> Setup:
    """Return the joint fit's input."""
    corners = tuple(
        ViewCorners(
            index=v.index, T_base_ee=np.ascontiguousarray(v.T_base_ee),
            xy=np.ascontiguousarray((v.detection.points(BOARD) - MIDDLE)[:, :2]),
            uv=np.ascontiguousarray(v.detection.uv),
        )
        for v in session.views
    )  # fmt: skip
    return Setup(
        views=corners, to_hand=False, middle=MIDDLE, half_extent=HALF_EXTENT, intrinsics0=KNOWN
    )


def cramer_rao(session: Session, robot_sd: tuple[float, float]) -> Array:
    """Return the bound (6, 6) of X's covariance: inverse information at the truth, true noise.

    Robot errors of 1-sigma `robot_sd` [rad, m] are integrated out; priors of lens and board count.
    """
    problem = JointProblem(joint_setup(session), JointConfig())
    truth = JointState(
        X=X_TRUE, Z=Z_TRUE, camera=camera_vector(CAMERA), board=session.board,
        weights=np.zeros(0), errors=session.errors,
    )  # fmt: skip
    ratio = np.array(robot_sd) / (CORNER_PX * problem.unit_robot_sd(truth)[[0, 3]])
    model = LinearModel(problem, truth, problem.ones())
    # No rounds: sigma is the true one.
    information = model.fit(None, ratio, CORNER_PX, rounds=0).information
    return np.asarray(np.linalg.inv(information), dtype=np.float64)[:6, :6]


def efficiency_trial(task: tuple[int, int]) -> float:
    """Return e^T CRB^-1 e of X for a number of views and a seed; white robot noise."""
    n, seed = task
    session = draw(np.random.default_rng([seed, 7, n]), n, "white")
    try:
        X = calibrate_hand_eye_report(session.views, BOARD, KNOWN).X
    except RealsimError:
        return float("inf")
    return normalized(X, cramer_rao(session, WHITE))


def solve_cpu_s(n: int, repeats: int = 3) -> tuple[float, float, int]:
    """Return CPU seconds of the whole calibration, of its `solve` alone, and the corners' number.

    Corners are given; a small run warms up (compiled code, imports), then the median is taken.
    """
    rng = np.random.default_rng(0)
    calibrate_hand_eye_report(draw(rng, WARM_UP_VIEWS, "white").views, BOARD, KNOWN)
    session = draw(rng, n, "white")
    setup, config = joint_setup(session), HandEyeConfig()
    start = (X_TRUE @ se3.exp(rng.normal(size=6) * START_OFF),
             Z_TRUE @ se3.exp(rng.normal(size=6) * START_OFF))  # fmt: skip
    whole: list[float] = []
    alone: list[float] = []
    for _ in range(repeats):
        begin = time.process_time()
        calibrate_hand_eye_report(session.views, BOARD, KNOWN)
        middle = time.process_time()
        solve(setup, start, config, None, None)
        whole.append(middle - begin)
        alone.append(time.process_time() - middle)
    corners = sum(len(v.uv) for v in setup.views)
    return float(np.median(whole)), float(np.median(alone)), corners
