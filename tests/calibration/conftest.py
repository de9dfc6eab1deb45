import math
import os
from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from realsim.arrays import Array
from realsim.geometry import camera, se3
from realsim.geometry.dh import DhArm
from realsim.records import ArmErrorMap, CameraIntrinsics, Check, RobotErrorMap, TagBoard, Target
from realsim.robots.arm import UR5
from realsim_calibration.hand_eye import HandEyeConfig, calibrate_hand_eye_report
from realsim_calibration.results import BoardShape, HandEyeReport, Mode, ViewReport
from realsim_calibration.views import BoardView, TargetDetection

FACTORY = CameraIntrinsics(width=1280, height=720, fx=640.0, fy=640.0, cx=639.5, cy=359.5)
DISTORTION = np.array([-0.05, 0.04, 6e-4, -4e-4, 0, 0, 0, 0])
TRUE_LENS = replace(FACTORY, fx=644.0, fy=643.0, cx=643.0, cy=356.0, distortion=DISTORTION)


def camera_at(
    rng: np.random.Generator, board: TagBoard, distance: float, max_tilt_deg: float
) -> Array:
    """Return T_cam_board of a camera that looks at the board's middle, tilted and rolled."""
    w, h = board.size_m
    tilt, azimuth = np.radians(rng.uniform(0, max_tilt_deg)), rng.uniform(0, 2 * np.pi)
    roll = rng.uniform(-np.pi, np.pi)
    middle = np.array([w / 2, h / 2, 0.0])
    # The board's z points into the paper, so the camera stands on its negative side.
    away = [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)]
    return se3.invert(se3.look_at(middle + distance * np.array(away), middle, roll))


def pose_pairs(
    seed: int, n: int, turn_sd: float = 0.0, shift_sd: float = 0.0
) -> tuple[Array, Array, Array, Array]:
    """Return X, Z and pairs of hand and board poses (n, 4, 4), the hand's with errors [rad, m]."""
    rng = np.random.default_rng(seed)
    X, Z = se3.random_transform(rng, spread=0.1), se3.random_transform(rng, spread=0.5)
    places = rng.normal([0.0, 0.0, 0.6], 0.05, (n, 3))
    C = se3.from_rt(se3.exp_so3(rng.normal(scale=0.5, size=(n, 3))), places)
    errors = rng.normal(size=(n, 6)) * np.repeat([turn_sd, shift_sd], 3)
    return X, Z, Z @ se3.invert(C) @ se3.invert(X) @ se3.exp(errors), C


class Simulation:
    """A robot with a camera in its hand that looks at a board; the truth is known."""

    def __init__(
        self,
        seed: int,
        views: int = 24,
        robot: tuple[float, float] = (0.3e-3, 0.3e-3),
        pixel: float = 0.1,
        roll: bool = True,
    ) -> None:
        rng = np.random.default_rng(seed)
        self.board = TagBoard(rows=4, columns=6, tag_size_m=0.03, gap_m=0.01)
        self.intrinsics0, self.intrinsics = FACTORY, TRUE_LENS
        R = se3.exp_so3([0.1, -0.05, 1.5]) @ se3.exp_so3(rng.normal(scale=0.1, size=3))
        self.T_ee_cam = se3.from_rt(R, [0.03, -0.06, 0.05])
        w, h = self.board.size_m
        down = np.diag([1.0, -1.0, -1.0])
        self.T_base_board = se3.from_rt(down, [0.4 - w / 2, 0.1 + h / 2, 0.02])
        self.truth_ee: list[Array] = []
        self.views: list[BoardView] = []
        rot, trans = robot
        for k in range(views):
            T_board_cam = se3.invert(camera_at(rng, self.board, rng.uniform(0.3, 0.5), 45.0))
            if not roll:
                T_board_cam = self._upright(T_board_cam)
            aim = rng.normal(scale=[0.08, 0.05, 0.0], size=3)
            T_base_cam = self.T_base_board @ T_board_cam @ se3.from_rt(se3.exp_so3(aim), [0, 0, 0])
            ee = T_base_cam @ se3.invert(self.T_ee_cam)
            noise = np.concatenate([rng.normal(scale=rot, size=3), rng.normal(scale=trans, size=3)])
            self.truth_ee.append(ee)
            seen = self.see(T_base_cam, rng, pixel)
            self.views.append(BoardView(index=k, T_base_ee=ee @ se3.exp(noise), detection=seen))

    def _upright(self, T_board_cam: Array) -> Array:
        """Return the camera at the same place with the same line of sight, without roll."""
        eye, z = T_board_cam[:3, 3], T_board_cam[:3, 2]
        x = np.array([1.0, 0.0, 0.0]) - z * z[0]
        x = x / np.linalg.norm(x)
        return se3.from_rt(np.stack([x, np.cross(z, x), z], -1), eye)

    def see(self, T_base_cam: Array, rng: np.random.Generator, pixel: float) -> TargetDetection:
        corners = se3.transform(se3.invert(T_base_cam) @ self.T_base_board, self.board.points_board)
        uv = camera.project(self.intrinsics, corners)
        uv = (uv + rng.normal(scale=pixel, size=uv.shape)).reshape(-1, 4, 2)
        size = (self.intrinsics.width, self.intrinsics.height)
        inside = np.all((uv > 0) & (uv < np.array(size) - 1), axis=(1, 2))
        points = 4 * np.flatnonzero(inside)[:, None] + np.arange(4)
        return TargetDetection(point_ids=points.ravel(), uv=uv[inside], image_size=size)


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> Iterator[None]:
    """Keep to one thread: on matrices of 30 rows two of them wait for each other for ages."""
    from threadpoolctl import threadpool_limits

    # Libraries that are loaded later read the environment.
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    with threadpool_limits(limits=1):
        yield


@pytest.fixture
def simulate() -> type[Simulation]:
    return Simulation


# --- a record with every field set, for what writes and reads records -----------------------------

HOSTILE_TEXT = 'a"b\\c <script>alert(1)</script> $x_$ -- ünï\n# : {x}'


def record_views(rng: np.random.Generator, n: int) -> tuple[ViewReport, ...]:
    views: list[ViewReport] = []
    for k in range(n):
        used = k % 4 != 3
        views.append(
            ViewReport(
                index=3 * k, label=f"{k}.png" if k else HOSTILE_TEXT, used=used,
                reason="" if used else "dropped: " + HOSTILE_TEXT,
                T_base_ee=se3.random_transform(rng),
                joints=rng.uniform(-3, 3, 6) if k % 2 else None, point_ids=np.arange(k, k + 12),
                uv=rng.uniform(0, 600, (12, 2)), residuals=rng.normal(size=(12 * used, 2)),
                seen_px=0.3 if used else math.nan, unseen_px=0.4 if used else math.nan,
                unseen_mm=0.2 if used else math.nan, unseen_deg=0.1 if used else math.nan,
                robot_error=rng.normal(size=6) * 1e-3,
            )
        )  # fmt: skip
    return tuple(views)


def record_maps(rng: np.random.Generator) -> tuple[RobotErrorMap | ArmErrorMap | None, ...]:
    rows = rng.normal(size=(4, 6))
    arm = DhArm(name="ur5", a=rows[0], d=rows[1], alpha=rows[2], delta_theta=rows[3] * 1e-3)
    mean, weights = rng.normal(size=12), rng.normal(size=(6, 12)) * 1e-4
    reach = rng.normal(size=(9, 12))
    pose = RobotErrorMap(frame="base", mean=mean, sd_m=0.1, weights=weights, reach=reach)
    errors, tool = rng.normal(size=24) * 1e-3, se3.random_transform(rng)
    return pose, None, ArmErrorMap(arm=arm, errors=errors, T_flange_tool=tool)


def record(
    X_alone: Array, mode: Mode = "eye_in_hand", target: Target | None = None, seed: int = 0
) -> HandEyeReport:
    """Return a record that no solver made: every field is set, and no two are alike."""
    rng = np.random.default_rng(seed)

    def covariance(n: int, scale: float) -> Array:
        M = rng.normal(size=(n, n)) * scale
        return M @ M.T

    terms = DISTORTION + 1e-17 * np.eye(8)[4]
    lens = replace(FACTORY, fx=644.1, fy=643.2, cx=643.3, cy=356.4, distortion=terms)
    return HandEyeReport(
        mode=mode, target=target or TagBoard(rows=4, columns=6, tag_size_m=0.03, gap_m=0.01),
        X=X_alone @ se3.exp(rng.normal(size=6) * 1e-3), X_covariance=covariance(6, 1e-4),
        Z=se3.random_transform(rng), X_alone=X_alone, X_alone_covariance=covariance(6, 1e-4),
        Z_alone=se3.random_transform(rng), intrinsics=lens,
        intrinsics_alone=replace(lens, fx=645.7, cy=355.1),
        intrinsics_covariance=covariance(12, 1e-2),
        board=BoardShape(
            scale=0.996, aspect=-0.002, warp=rng.normal(size=3) * 1e-3, half_extent_m=0.115,
            sd=np.array([1e-3, 1e-3, 1e-3, 0, 0]), half_sides_m=(0.115, 0.075),
        ),
        robot_map=record_maps(rng)[seed % 3], map_name=("base 1", "none", "arm")[seed % 3],
        map_scores=(("none", 0.51), ("base 1", 0.33), ("arm", 0.35)),
        joint_offsets=None if seed % 3 else rng.normal(size=(6, 2)), sigma_px=0.2, robot_ratio=0.3,
        views=record_views(rng, 8), seen_px=0.3, held_out_px=0.4, held_out_mm=0.3,
        held_out_deg=0.05, starts=(("park", 5.8), ("shah", math.inf)), mismatch_deg=0.2,
        screw_ratio=math.nan, roll_range_deg=200.0,
        checks=(
            Check(name="board scale", verdict="good", sentence="The scale is 0.996.", value=0.996),
            Check(name="robot", verdict="bad", sentence=HOSTILE_TEXT, advice="Do -- that.",
                  views=(3, 6)),
        ),
        information=covariance(29, 1.0),
    )  # fmt: skip


# --- calibrations of a simulated arm with errors in its joints and links -------------------------

ARM = UR5.bare()
ARM_START = np.array([0.0, -1.4, 1.9, -2.0, -1.57, 0.0])
PRINT_SCALE = 0.9958
HOSTILE_NAME = "<script>alert('$x^2$ & _y_')</script>.png"


def joints_of(T: Array) -> Array | None:
    """Return joints (6,) at which the arm's flange is at T, None where there are none."""
    found, _ = UR5.inverse_branches(T[None])
    return min(found, key=lambda q: np.abs(q - ARM_START).max(), default=None)


def printed_points(board: TagBoard) -> Array:
    """Return the points (n, 3) of a print that is smaller than its drawing, and bent."""
    points = board.points_board
    middle = (points.min(0) + points.max(0)) / 2
    half = float(np.ptp(points, axis=0).max() / 2)
    x, y = ((points - middle)[:, :2] / half).T
    lift = 0.004 * x**2 + 0.002 * x * y - 0.003 * y**2
    return middle + PRINT_SCALE * half * np.stack([x, 0.998 * y, lift], -1)


def arm_views(board: TagBoard, views: int, mode: Mode, with_joints: bool) -> list[BoardView]:
    """Return views of an arm with errors (eye to hand: of any robot); 7 and 15 are bad."""
    rng = np.random.default_rng(0)
    w, h = board.size_m
    Z = se3.from_rt(np.diag([1.0, -1.0, -1.0]), [0.45 - w / 2, 0.1 + h / 2, 0.02])
    X = se3.from_rt(se3.exp_so3([0.0, 0.0, 1.5]) @ se3.exp_so3([0.25, 0.03, 0.0]),
                    [0.012, -0.071, 0.043])  # fmt: skip
    in_hand = mode == "eye_in_hand"
    if not in_hand:
        X = se3.look_at([1.2, 0.1, 0.7], [0.5, 0.0, 0.35], 0.0)
        Z = se3.exp([0.1, 0.2, 0.3, -0.1, -0.08, 0.1])
    real = ARM.corrected(rng.normal(size=24) * np.repeat([1e-3, 3e-4], 12))
    printed, shots = printed_points(board), list[BoardView]()
    while len(shots) < views:
        T_board_cam = se3.invert(camera_at(rng, board, rng.uniform(0.28, 0.45), 45.0))
        T_board_cam = T_board_cam @ se3.exp([*rng.normal(scale=[0.16, 0.28, 0.0], size=3), 0, 0, 0])
        T_hand = Z @ T_board_cam @ se3.invert(X) if in_hand else X @ se3.invert(Z @ T_board_cam)
        q, told = None, T_hand
        A = T_hand @ se3.exp(rng.normal(scale=3e-4, size=6))
        if in_hand:
            q = joints_of(T_hand)
            if q is None:
                continue
            A = real.forward(q) @ se3.exp(rng.normal(scale=1e-4, size=6))
            told = ARM.forward(q)
        T = se3.invert(A @ X) @ Z if in_hand else se3.invert(X) @ A @ Z
        uv = camera.project(TRUE_LENS, se3.transform(T, printed))
        uv = uv + rng.normal(scale=0.12, size=uv.shape)
        inside = np.flatnonzero(np.all((uv > 2) & (uv < [1277, 717]), axis=-1))
        k = len(shots)
        bad = k == 15
        inside = inside[:4] if bad else inside
        told = told @ se3.exp([0.1 * (k == 7), 0, 0, 0, 0, 0])
        found = TargetDetection(
            point_ids=inside, uv=uv[inside], image_size=(1280, 720),
            rejected=("<b>$bold$</b>",) if bad else (),
        )  # fmt: skip
        name = HOSTILE_NAME if k == 3 else f"view_{k:03d}.png"
        shots.append(BoardView(index=k, T_base_ee=told, detection=found, name=name,
                                joints=q if with_joints else None))  # fmt: skip
    return shots


@cache
def arm_calibration(
    views: int = 24, mode: Mode = "eye_in_hand", with_joints: bool = False, with_map: bool = True
) -> HandEyeReport:
    """Return the calibration of a simulated arm."""
    board = TagBoard(rows=4, columns=6, tag_size_m=0.03, gap_m=0.01)
    config = HandEyeConfig(mode=mode, robot_map=with_map)
    shots = arm_views(board, views, mode, with_joints)
    return calibrate_hand_eye_report(shots, board, FACTORY, config, ARM if with_joints else None)
