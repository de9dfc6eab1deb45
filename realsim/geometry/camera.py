"""Projection of points into a distorted image, and the exact way back.

Distortion is OpenCV's (`lens`). Going back is a Newton solve
with the analytic 2x2 Jacobian, because OpenCV's fixed-point iteration is tens of pixels off on
strong distortion; pixels outside the model's invertible region are reported, never guessed.
"""

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Array32, Mask
from realsim.geometry import lens
from realsim.records import CameraIntrinsics

Kept = TypeVar("Kept")
NEWTON_STEPS = 12
"""Enough for 4e-13 px on every invertible pixel of the lenses tried (k1 down to -0.3)."""


def distort(coefficients: ArrayLike, xy: ArrayLike) -> Array:
    """Return distorted normalised coordinates (..., 2) of ideal ones (..., 2).

    Args:
        coefficients: (8,) k1 k2 p1 p2 k3 k4 k5 k6.
        xy: (..., 2) x/z, y/z.
    """
    xy = np.asarray(xy, dtype=np.float64)
    terms = np.asarray(coefficients, dtype=np.float64)
    return np.stack(lens.bent(xy[..., 0], xy[..., 1], terms), -1)


def distort_jacobian(coefficients: ArrayLike, xy: ArrayLike) -> Array:
    """Return d distort / d xy (..., 2, 2) at ideal normalised coordinates (..., 2)."""
    xy = np.asarray(xy, dtype=np.float64)
    terms = np.asarray(coefficients, dtype=np.float64)
    xx, across, yy, _, _ = lens.bent_slopes(xy[..., 0], xy[..., 1], terms)
    J = np.empty((*xy.shape[:-1], 2, 2))
    J[..., 0, 0], J[..., 1, 1] = xx, yy
    J[..., 0, 1] = J[..., 1, 0] = across
    return J


TURNING_STEPS = 20000
"""Steps of the search for the turning radius; each is half a thousandth of a focal length."""


@lru_cache(maxsize=32)
def _turning_radius(coefficients: tuple[float, ...]) -> float:
    r = np.linspace(0.0, TURNING_STEPS / 2000, TURNING_STEPS + 1)
    d = np.array(coefficients)
    d[[2, 3]] = 0.0  # the tangential terms are small and have no single turning radius
    rd = distort(d, np.stack([r, np.zeros_like(r)], -1))[:, 0]
    falling = np.flatnonzero((np.diff(rd) <= 0) | ~np.isfinite(np.diff(rd)))
    return float(r[falling[0]]) if len(falling) else float("inf")


def turning_radius(intrinsics: CameraIntrinsics) -> float:
    """Return the ideal radius sqrt(x^2 + y^2) where the lens model stops growing; inf if never.

    A polynomial fitted inside the image turns round somewhere outside: from there on it folds the
    scene back into the picture. Only what is nearer to the axis than this exists.
    """
    return _turning_radius(tuple(float(v) for v in intrinsics.distortion))


FARTHEST_RADIUS = 3.0
"""Ideal radius beyond which nobody looks: 72 degrees off the axis."""
BEND_SAMPLES = 48
"""Points per side of the square in which the bend of the lens model is looked for."""


@lru_cache(maxsize=32)
def _greatest_bend(key: tuple[float, ...], radius: float) -> float:
    fx, fy, *coefficients = key
    reach = min(_turning_radius(tuple(coefficients)), radius)
    side = np.linspace(-reach, reach, BEND_SAMPLES)
    xy = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    xy = xy[np.linalg.norm(xy, axis=1) <= reach]
    h = 1e-4
    rows: list[Array] = []
    for axis in (0, 1):
        step = np.zeros(2)
        step[axis] = h
        ahead = distort_jacobian(coefficients, xy + step)
        behind = distort_jacobian(coefficients, xy - step)
        rows.append(np.abs(ahead - behind) / (2 * h))
    second = np.stack(rows, -1) * np.array([fx, fy])[:, None, None]
    # |f(x + d) - linear| <= 0.5 sum |f_ij| |d_i| |d_j| <= 0.5 max row sum (dx^2 + dy^2).
    return 0.5 * float(np.nanmax(second.sum((-1, -2))))


def greatest_bend(intrinsics: CameraIntrinsics, radius: float) -> float:
    """Return the bound b [px] by which the lens bends: at most b (dx^2 + dy^2) over ideal dx, dy.

    Args:
        intrinsics: the camera.
        radius: to which ideal radius it must hold; it never needs to beyond the turning radius.
    """
    i = intrinsics
    return _greatest_bend((i.fx, i.fy, *(float(v) for v in i.distortion)), float(radius))


def project(intrinsics: CameraIntrinsics, points_cam: ArrayLike) -> Array:
    """Return pixels (..., 2) of camera points (..., 3) [m]; NaN where z <= 0."""
    p = np.asarray(points_cam, dtype=np.float64)
    z = p[..., 2:3]
    xy = p[..., :2] / np.where(z > 0, z, np.nan)
    if intrinsics.is_distorted:
        xy = distort(intrinsics.distortion, xy)
    return xy * [intrinsics.fx, intrinsics.fy] + [intrinsics.cx, intrinsics.cy]


def projection_jacobian(
    intrinsics: CameraIntrinsics, points_cam: ArrayLike
) -> tuple[Array, Array, Array]:
    """Return pixels and their derivatives with respect to the point and to the camera.

    Args:
        intrinsics: the camera.
        points_cam: (N, 3) points in front of the camera [m].

    Returns:
        uv (N, 2) [px], d uv / d point (N, 2, 3) [px/m], and d uv / d camera (N, 2, 12) for
        fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6.
    """
    p = np.asarray(points_cam, dtype=np.float64)
    d = intrinsics.distortion
    z = p[:, 2]
    xy = p[:, :2] / z[:, None]
    x, y = xy[:, 0], xy[:, 1]
    dxy = distort(d, xy)
    f = np.array([intrinsics.fx, intrinsics.fy])
    uv = dxy * f + [intrinsics.cx, intrinsics.cy]

    d_xy = np.zeros((len(p), 2, 3))
    d_xy[:, 0, 0] = d_xy[:, 1, 1] = 1 / z
    d_xy[:, 0, 2], d_xy[:, 1, 2] = -x / z, -y / z
    d_point = f[:, None] * (distort_jacobian(d, xy) @ d_xy)

    r2 = x * x + y * y
    *_, radial, den = lens.bent_slopes(x, y, d)
    powers = r2[:, None] ** np.array([1, 2, 3])
    d_cam = np.zeros((len(p), 2, 12))
    d_cam[:, 0, 0], d_cam[:, 1, 1] = dxy[:, 0], dxy[:, 1]
    d_cam[:, 0, 2] = d_cam[:, 1, 3] = 1.0
    for axis in (0, 1):
        a = f[axis] * xy[:, axis]
        d_cam[:, axis, [4, 5, 8]] = a[:, None] * powers / den[:, None]
        d_cam[:, axis, 9:12] = -(a * radial / den)[:, None] * powers
    d_cam[:, 0, 6], d_cam[:, 0, 7] = f[0] * 2 * x * y, f[0] * (r2 + 2 * x * x)
    d_cam[:, 1, 6], d_cam[:, 1, 7] = f[1] * (r2 + 2 * y * y), f[1] * 2 * x * y
    return uv, d_point, d_cam


def undistort(intrinsics: CameraIntrinsics, uv: ArrayLike) -> tuple[Array, Mask]:
    """Return ideal normalised coordinates of pixels, and which of them exist.

    Args:
        intrinsics: the camera.
        uv: (..., 2) pixels.

    Returns:
        xy (..., 2) with z = 1, NaN where the lens model cannot be inverted, and a mask (...).
    """
    uv = np.asarray(uv, dtype=np.float64)
    target = (uv - [intrinsics.cx, intrinsics.cy]) / [intrinsics.fx, intrinsics.fy]
    if not intrinsics.is_distorted:
        return target, np.ones(target.shape[:-1], dtype=bool)
    xy, goal = target.reshape(-1, 2).copy(), target.reshape(-1, 2)
    moving = np.arange(len(xy))
    for _ in range(NEWTON_STEPS):
        now = xy[moving]
        error = distort(intrinsics.distortion, now) - goal[moving]
        J = distort_jacobian(intrinsics.distortion, now)
        det = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
        det = np.where(np.abs(det) < 1e-9, 1e-9, det)
        step = np.stack(
            [
                J[..., 1, 1] * error[..., 0] - J[..., 0, 1] * error[..., 1],
                J[..., 0, 0] * error[..., 1] - J[..., 1, 0] * error[..., 0],
            ],
            -1,
        )
        # Half a focal length at most per step keeps a wild pixel from leaping to another branch.
        xy[moving] = after = now - np.clip(step / det[..., None], -0.5, 0.5)
        changed = after != now
        moving = moving[changed[:, 0] | changed[:, 1]]  # the others stay for good
        if not len(moving):
            break
    xy = xy.reshape(target.shape)
    error_px = np.abs(distort(intrinsics.distortion, xy) - target).max(-1) * intrinsics.fx
    J = distort_jacobian(intrinsics.distortion, xy)
    det = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
    valid = (error_px < 1e-6) & (det > 0)
    # Beyond the turning radius a solution is on a branch that no lens has.
    valid &= np.sum(xy * xy, axis=-1) < turning_radius(intrinsics) ** 2
    return np.where(valid[..., None], xy, np.nan), valid


def pixel_grid(width: int, height: int) -> Array:
    """Return (height, width, 2) pixel centres x, y, which are integers."""
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    return np.stack([u, v], -1)


def kept_by_camera(
    most: int,
) -> Callable[[Callable[[CameraIntrinsics], Kept]], Callable[[CameraIntrinsics], Kept]]:
    """Keep what a function returns of the `most` cameras that were asked for last."""

    def keeping(make: Callable[[CameraIntrinsics], Kept]) -> Callable[[CameraIntrinsics], Kept]:
        @lru_cache(maxsize=most)
        def made(key: tuple[float, ...]) -> Kept:
            width, height, fx, fy, cx, cy = key[:6]
            intrinsics = CameraIntrinsics(
                width=int(width), height=int(height), fx=fx, fy=fy, cx=cx, cy=cy,
                distortion=np.array(key[6:]),
            )  # fmt: skip
            return make(intrinsics)

        @wraps(make)
        def kept(intrinsics: CameraIntrinsics) -> Kept:
            i = intrinsics
            key = (i.width, i.height, i.fx, i.fy, i.cx, i.cy, *i.distortion.tolist())
            return made(tuple(float(v) for v in key))

        return kept

    return keeping


@kept_by_camera(8)
def ray_table(intrinsics: CameraIntrinsics) -> Array32:
    """Return the ray (height, width, 3) of every pixel centre in camera axes, z = 1.

    Because z is 1, the parameter at which a ray meets a surface IS the depth along z. Pixels that
    the lens model cannot reach are NaN. The table is computed once per camera and kept.
    """
    xy, _ = undistort(intrinsics, pixel_grid(intrinsics.width, intrinsics.height))
    table = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], -1).astype(np.float32)
    table.setflags(write=False)
    return table
