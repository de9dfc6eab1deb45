"""Simulated board views of a camera in a hand, and a least-squares fit of its own."""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from pictured_targets import pose
from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.records import CameraIntrinsics, Check, TagBoard, Target
from realsim_calibration.results import BoardShape, HandEyeReport, ViewReport

BOARD = TagBoard(rows=3, columns=4, tag_size_m=0.03, gap_m=0.01)
CAMERA = CameraIntrinsics(width=1280, height=720, fx=648.0, fy=648.0, cx=639.5, cy=359.5)
SIGMA, RATIO, DISTANCE = 0.1, 3.0, 0.4
FREE = np.array([*range(12), 12, 13, 14, 15, 16, 24])
"""X, Z, fx fy cx cy k1 and the board's scale are estimated."""
PRIOR_SD = np.array([13.0, 13.0, 19.0, 19.0, 0.15, 0.01])
X0 = se3.from_rt(se3.exp_so3([0.1, -0.05, 1.5]), [0.03, -0.06, 0.05])
Z0 = se3.from_rt(np.diag([1.0, -1.0, -1.0]), [0.33, 0.16, 0.02])
ROBOT_SD = RATIO * SIGMA / 648.0 * np.array([1.0] * 3 + [DISTANCE] * 3)


def board_at(tilt: float, azimuth: float, roll: float, distance: float = DISTANCE) -> Array:
    """Return T_cam_board; angles in degrees."""
    return pose(BOARD, tilt, azimuth, roll, distance)


def hand_at(T_cam_board: Array, mode: str = "eye_in_hand") -> Array:
    """Return T_base_ee at which the camera sees the board so."""
    if mode == "eye_in_hand":
        return Z0 @ se3.invert(T_cam_board) @ se3.invert(X0)
    return X0 @ T_cam_board @ se3.invert(Z0)


def random_hands(
    rng: np.random.Generator, n: int, tilt: float = 40.0, roll: float = 180.0
) -> Array:
    rows = [
        board_at(rng.uniform(0, tilt), rng.uniform(0, 360), rng.uniform(-roll, roll),
                 rng.uniform(0.32, 0.5))
        for _ in range(n)
    ]  # fmt: skip
    return np.stack([hand_at(T) for T in rows])


# ---- a Gauss-Newton of its own: numerical derivatives, generalised least squares


def lens_of(theta: Array) -> CameraIntrinsics:
    fx, fy, cx, cy = np.array([648.0, 648.0, 639.5, 359.5]) + theta[12:16]
    return replace(CAMERA, fx=fx, fy=fy, cx=cx, cy=cy, distortion=theta[16] * np.eye(8)[0])


def predict(theta: Array, A: Array, errors: Array, mode: str, board: Target = BOARD) -> Array:
    """Return pixels (p, 2); theta (18,) steps about X0, Z0, CAMERA and scale 1."""
    X, Z = X0 @ se3.exp(theta[:6]), Z0 @ se3.exp(theta[6:12])
    middle = np.array([*board.size_m, 0.0]) / 2
    points = middle + (1 + theta[17]) * (board.points_board - middle)
    hand = A @ se3.exp(errors)
    hand = se3.invert(hand) if mode == "eye_in_hand" else hand
    return project(lens_of(theta), se3.transform(se3.invert(X) @ hand @ Z, points))


@lru_cache(maxsize=512)
def linear(hand: bytes, mode: str) -> tuple[Array, Array, Array]:
    """Return d uv / d theta (2p, 18) at theta 0, the weights (2p, 2p) and the information."""
    A, zero = np.frombuffer(hand).reshape(4, 4), np.zeros(6)
    units = np.array([1e-6] * 12 + [1e-3] * 4 + [1e-6] * 2)
    columns = [
        (predict(s, A, zero, mode) - predict(-s, A, zero, mode)).ravel() / (2 * u)
        for s, u in zip(np.diag(units), units, strict=True)
    ]
    errors = [
        (predict(np.zeros(18), A, s, mode) - predict(np.zeros(18), A, -s, mode)).ravel() / 2e-6
        for s in np.eye(6) * 1e-6
    ]
    J, E = np.stack(columns, -1), np.stack(errors, -1)
    W = np.linalg.inv(SIGMA**2 * np.eye(len(J)) + E @ np.diag(ROBOT_SD**2) @ E.T)
    return J, W, J.T @ W @ J


def solved(
    hands: Array, seen: Sequence[Array], mode: str = "eye_in_hand"
) -> tuple[Array, Array, Array]:
    """Return theta (18,), its information (18, 18) and residuals (n, p, 2)."""
    prior = np.diag([*[0.0] * 12, *PRIOR_SD**-2.0])
    parts = [linear(np.ascontiguousarray(A, np.float64).tobytes(), mode) for A in hands]
    H = prior + np.sum([part[2] for part in parts], axis=0)
    theta, residuals = np.zeros(18), np.zeros((len(hands), len(BOARD.points_board), 2))
    for _ in range(3):
        g = -prior @ theta
        for k, (A, uv, (J, W, _)) in enumerate(zip(hands, seen, parts, strict=True)):
            residuals[k] = predict(theta, A, np.zeros(6), mode) - uv
            g -= J.T @ W @ residuals[k].ravel()
        theta = theta + np.linalg.solve(H, g)
    return theta, H, residuals


def held_out(hands: Array, residuals: Array, H: Array, mode: str) -> float:
    """Return the RMS of views predicted without them [px]: theta_-i = theta + (H - H_i)^-1 c_i."""
    squares: list[Array] = []
    for A, r in zip(hands, residuals, strict=True):
        J, W, H_i = linear(np.ascontiguousarray(A, np.float64).tobytes(), mode)
        unseen = r.ravel() + J @ np.linalg.lstsq(H - H_i, J.T @ W @ r.ravel(), rcond=None)[0]
        squares.append(np.sum(unseen.reshape(-1, 2) ** 2, -1))
    return float(np.sqrt(np.mean(squares)))


def report_of(
    hands: Array, seen: Sequence[Array] | None = None, mode: Any = "eye_in_hand",
    checks: tuple[Check, ...] = (),
) -> HandEyeReport:  # fmt: skip
    """Return the calibration of views; without pixels, at the truth."""
    if seen is None:
        seen = [predict(np.zeros(18), A, np.zeros(6), mode) for A in hands]
    theta, H, residuals = solved(hands, seen, mode)
    C, held_out_px = np.linalg.inv(H), held_out(hands, residuals, H, mode)
    information = np.zeros((29, 29))
    information[np.ix_(FREE, FREE)] = H
    camera_cov = np.zeros((12, 12))
    camera_cov[:5, :5] = C[12:17, 12:17]
    sd = np.array([np.sqrt(C[17, 17]), 0, 0, 0, 0])
    lens = lens_of(theta)
    X, Z = X0 @ se3.exp(theta[:6]), Z0 @ se3.exp(theta[6:12])
    views = tuple(
        ViewReport(
            index=k, label=str(k), used=True, reason="", T_base_ee=A, joints=None,
            point_ids=np.arange(len(uv)), uv=uv, residuals=r,
            seen_px=float(np.sqrt(np.mean(np.sum(r**2, -1)))), unseen_px=held_out_px,
            unseen_mm=0.2, unseen_deg=0.05, robot_error=np.zeros(6),
        )
        for k, (A, uv, r) in enumerate(zip(hands, seen, residuals, strict=True))
    )  # fmt: skip
    return HandEyeReport(
        mode=mode, target=BOARD, X=X, X_covariance=C[:6, :6], Z=Z, X_alone=X,
        X_alone_covariance=C[:6, :6], Z_alone=Z, intrinsics_alone=lens, intrinsics=lens,
        intrinsics_covariance=camera_cov,
        board=BoardShape(scale=1 + theta[17], aspect=0.0, warp=np.zeros(3), sd=sd,
                         half_extent_m=max(BOARD.size_m) / 2),
        robot_map=None, map_name="none", map_scores=(("none", held_out_px),), joint_offsets=None,
        sigma_px=SIGMA, robot_ratio=RATIO, views=views, seen_px=0.2, held_out_px=held_out_px,
        held_out_mm=0.2, held_out_deg=0.05, starts=(), mismatch_deg=0.1, screw_ratio=1.0,
        roll_range_deg=180.0, checks=checks, information=information,
    )  # fmt: skip


def measured(rng: np.random.Generator, A: Array) -> Array:
    """Return noisy pixels of a view whose robot is off as the model says."""
    uv = predict(np.zeros(18), A, rng.normal(size=6) * ROBOT_SD, "eye_in_hand")
    return uv + rng.normal(scale=SIGMA, size=uv.shape)
