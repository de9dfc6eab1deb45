"""Depth images of a board with a known bias, noise and warp."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from pictured_targets import pose
from realsim.arrays import Array, Array32
from realsim.geometry import se3
from realsim.geometry.camera import pixel_grid, project, undistort
from realsim.records import CameraIntrinsics, TagBoard
from realsim.records.calibration import DepthBias
from realsim_calibration.depth.bias import DepthBiasReport, estimate_depth_bias
from realsim_calibration.depth.board import DepthBoardView
from realsim_calibration.depth.fit import DepthBiasConfig
from realsim_calibration.views import TargetDetection

BOARD = TagBoard(rows=5, columns=7, tag_size_m=0.03, gap_m=0.01)
CAMERA = CameraIntrinsics(width=320, height=200, fx=162.0, fy=161.0, cx=161.0, cy=98.0)
BASELINE = 0.018
EXACT = DepthBiasConfig(board_scale_sd=0.0, focal_sd=1e-9)
FAR = np.linspace(0.2, 0.5, 12)


def pose_at(rng: np.random.Generator, distance: float) -> Array:
    """Return T_cam_board of a camera that looks at the board's middle."""
    tilt, azimuth = 35.0 * rng.uniform(0.3, 1.0), rng.uniform(0, 360)
    return pose(BOARD, tilt, azimuth, rng.uniform(-180, 180), distance)


@cache
def rays_of(camera: CameraIntrinsics) -> Array:
    """Return the rays (H, W, 3) of the pixels, z = 1."""
    xy, _ = undistort(camera, pixel_grid(camera.width, camera.height))
    return np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], -1)


def exact_depth(T: Array, camera: CameraIntrinsics, warp: Array | None = None) -> Array:
    """Return (H, W) depth of the board's surface by bisection along every ray; 0 = not in front."""
    T_board_cam = se3.invert(T)
    rays = rays_of(camera) @ T_board_cam[:3, :3].T
    eye = T_board_cam[:3, 3]
    flat = -eye[2] / rays[..., 2]
    if warp is None:
        return np.where(flat > 0, flat, 0.0)

    def over(t: Array) -> Array:
        p = eye + t[..., None] * rays
        L = max(BOARD.size_m) / 2
        x, y = (p[..., 0] - BOARD.size_m[0] / 2) / L, (p[..., 1] - BOARD.size_m[1] / 2) / L
        return p[..., 2] - L * (warp[0] * x * x + warp[1] * x * y + warp[2] * y * y)

    low, high = flat * 0.9, flat * 1.1
    sign = np.sign(over(low))
    for _ in range(24):  # halves a tenth of the depth to nanometres
        mid = (low + high) / 2
        same = np.sign(over(mid)) == sign
        low, high = np.where(same, mid, low), np.where(same, high, mid)
    return np.where(flat > 0, low, 0.0)


def sensed(
    depth: Array, truth: DepthBias, rng: np.random.Generator, noise_px: float = 0.08
) -> Array32:
    """Return what a stereo camera with this bias reports: correlated noise, holes, fliers."""
    from scipy.ndimage import gaussian_filter

    jitter = gaussian_filter(rng.normal(size=depth.shape), 2.0)
    jitter *= noise_px / jitter.std() / (CAMERA.fx * BASELINE)
    inverse = np.where(depth > 0, 1 / truth.measured(np.where(depth > 0, depth, 1.0)), 0.0) + jitter
    if noise_px > 0:
        flying = rng.random(depth.shape) < 0.05
        inverse = np.where(flying, inverse * rng.uniform(0.5, 1.0, depth.shape), inverse)
        inverse[rng.random(depth.shape) < 0.1] = 0
        u, v = rng.integers(0, CAMERA.width), rng.integers(0, CAMERA.height)
        inverse[max(v - 20, 0) : v + 20, max(u - 20, 0) : u + 20] = 0  # a hole without cause
    z = np.where(inverse > 0.2, 1 / np.maximum(inverse, 1e-6), 0.0)
    return (np.round(z / 1e-4) * 1e-4).astype(np.float32)


def detected(
    T: Array, rng: np.random.Generator, corner_px: float, points: Array | None = None
) -> TargetDetection:
    uv = project(CAMERA, se3.transform(T, BOARD.points_board if points is None else points))
    uv = uv + rng.normal(scale=corner_px, size=uv.shape) if corner_px else uv
    ids = np.flatnonzero(np.all((uv > 0) & (uv < [CAMERA.width - 1, CAMERA.height - 1]), axis=-1))
    return TargetDetection(point_ids=ids, uv=uv[ids], image_size=(CAMERA.width, CAMERA.height))


def views_of(
    truth: DepthBias, seed: int = 0, *, distances: Array = FAR, noise_px: float = 0.08,
    corner_px: float = 0.1, pose_sd: tuple[float, float] = (0.0, 0.0),
) -> list[DepthBoardView]:  # fmt: skip
    """Return views; `pose_sd` shakes the depth camera per view: an error common to a view."""
    bias = (truth.scale, truth.offset_per_m)
    return list(drawn_views(bias, seed, tuple(distances), noise_px, corner_px, pose_sd))


@cache
def drawn_views(
    bias: tuple[float, float], seed: int, distances: tuple[float, ...], noise_px: float,
    corner_px: float, pose_sd: tuple[float, float],
) -> tuple[DepthBoardView, ...]:  # fmt: skip
    """Return the views; several tests look at the same ones."""
    truth = DepthBias(scale=bias[0], offset_per_m=bias[1])
    rng = np.random.default_rng(seed)
    found: list[DepthBoardView] = []
    for k, distance in enumerate(distances):
        T = pose_at(rng, distance)
        shake = np.concatenate([rng.normal(scale=sd, size=3) for sd in pose_sd])
        depth = sensed(exact_depth(T @ se3.exp(shake), CAMERA), truth, rng, noise_px)
        depth.setflags(write=False)
        found.append(DepthBoardView(index=k, depth_m=depth, detection=detected(T, rng, corner_px)))
    return tuple(found)


def sensed_views(
    rng: np.random.Generator,
    depth_at: Callable[[Array], Array | Array32],
    corner_px: float = 0.0,
    points: Array | None = None,
) -> list[DepthBoardView]:
    """Return views at the distances FAR, of whose board poses `depth_at` makes the depth."""
    found: list[DepthBoardView] = []
    for k, distance in enumerate(FAR):
        T = pose_at(rng, distance)
        depth, seen = depth_at(T), detected(T, rng, corner_px, points)
        found.append(DepthBoardView(index=k, depth_m=depth, detection=seen))
    return found


def run(views: list[DepthBoardView], **given: Any) -> DepthBiasReport:
    return estimate_depth_bias(views, BOARD, CAMERA, EXACT, **given)
