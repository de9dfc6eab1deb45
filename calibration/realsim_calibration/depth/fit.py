"""The robust fit of a depth camera's scale and offset over views, and errors common to them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.camera import projection_jacobian
from realsim.records import CameraIntrinsics
from realsim_calibration.depth.area import BoardDepth
from realsim_calibration.depth.board import DepthSetup, pose_jacobian

ROUNDS = 15
"""Rounds of reweighting views; five are typical."""
SMALL = 1e-3
"""Share of a standard deviation that is stepped for a numerical derivative."""
SCALE_PRIOR_SD = 0.02
"""Prior of the scale around 1: data sheets promise 1 to 2 %."""
OFFSET_PRIOR_SD_PER_M = 0.02
"""Prior of the inverse depth offset [1/m]: 0.23 px of a D405's disparity."""
HUBER_SIGMAS = 2.0
"""Views further off than this many sigma lose weight."""


@dataclass(frozen=True, kw_only=True, slots=True)
class DepthBiasConfig:
    """What is known of the camera and the board."""

    focal_sd: float = 0.003
    """Relative 1-sigma of the focal length where no covariance of the intrinsics is given: a
    factory's."""
    board_scale_sd: float = 0.003
    """Relative 1-sigma of the board's size where no measured shape is given: printers are off by
    0.1 to 0.5 %."""
    baseline_m: float = 0.018
    """Baseline that turns the offset into disparity [m]; the D405's."""
    focal_px: float | None = None
    """Focal length that turns the offset into disparity [px]; None = the depth image's own."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ViewFit:
    """The robust fit over views."""

    theta: Array
    """(4,) scale, offset [1/m], shift x, y [x/z]."""
    information: Array
    """(4, 4) priors included."""
    prior: Array
    """(4, 4) information of the priors."""
    gain: Array
    """(4, views) d theta / d predicted."""
    scatter: float
    """tau [1/m]."""
    without: Array
    """(views, 4) the parameters fitted without each view."""

    @property
    def covariance(self) -> Array:
        """(4, 4) from jackknife and information, as for the hand-eye.

        Times (n - 1) / (n - 3): a spread that few views show is itself unsure (the mean of
        Hotelling's T^2).
        """
        n = len(self.without)
        inverse = np.linalg.inv(self.information)
        away = self.without - self.without.mean(0)
        jackknife = (n - 1) / n * away.T @ away + inverse @ self.prior @ inverse
        kappa = np.trace(np.linalg.solve(inverse[:2, :2], jackknife[:2, :2])) / 2
        few = (n - 1) / max(n - 3, 1)
        return few * (jackknife + max(kappa, 1.0) * inverse) / 2


def fit_views(used: Sequence[BoardDepth], shift_sd: Array) -> ViewFit:
    """Return the robust fit of scale, offset and shift over views.

    Args:
        used: the views.
        shift_sd: (2,) prior of the shift [x/z, y/z].
    """
    y = np.array([d.predicted for d in used])
    D = np.array([[d.measured, 1.0, *(-d.predicted_slope)] for d in used])
    pose = np.array([d.by_pose @ d.pose_covariance @ d.by_pose for d in used])
    sd = np.array([SCALE_PRIOR_SD, OFFSET_PRIOR_SD_PER_M, *shift_sd])
    prior, start = np.diag(sd**-2), np.array([1.0, 0.0, 0.0, 0.0])
    r = y - D @ start
    scatter2 = float(np.var(r)) + 1e-12
    huber: Array = np.ones(len(y))
    weights, theta, H = huber, start, prior
    for _ in range(ROUNDS):
        weights = huber / (pose + scatter2)
        H = D.T @ (weights[:, None] * D) + prior
        theta = np.asarray(np.linalg.solve(H, D.T @ (weights * y) + prior @ start), np.float64)
        r = y - D @ theta
        free = float(huber.sum() - np.trace(np.linalg.solve(H, H - prior)))
        scatter2 = _paule_mandel(np.sqrt(huber) * r, pose, max(free, 1.0))
        z = np.abs(r) / np.sqrt(pose + scatter2 + 1e-18)
        huber = np.minimum(1.0, HUBER_SIGMAS / np.maximum(z, 1e-12))
    gain = np.asarray(np.linalg.solve(H, D.T * weights), np.float64)
    without: list[Array] = []
    for i in range(len(y)):
        w = np.where(np.arange(len(y)) == i, 0.0, weights)
        rest = D.T @ (w[:, None] * D) + prior
        without.append(np.linalg.solve(rest, D.T @ (w * y) + prior @ start))
    return ViewFit(
        theta=theta, information=H, prior=prior, gain=gain, scatter=float(np.sqrt(scatter2)),
        without=np.stack(without),
    )  # fmt: skip


def _paule_mandel(r: Array, variance: Array, free: float) -> float:
    """Return tau^2 with sum r^2 / (variance + tau^2) = free; 0 where the variances suffice."""
    low, high = 0.0, float(r @ r) / free + 1e-18
    if np.sum(r**2 / np.maximum(variance, 1e-18)) <= free:
        return 0.0
    for _ in range(60):
        middle = (low + high) / 2
        over = np.sum(r**2 / (variance + middle)) > free
        low, high = (middle, high) if over else (low, middle)
    return high


def common_errors(
    used: Sequence[BoardDepth],
    setup: DepthSetup,
    config: DepthBiasConfig,
    intrinsics_covariance: Array | None,
    aligned: bool,
) -> Array:
    """Return d predicted (views, q) for one sigma of the board's size and of the lens' q - 1 axes.

    Another lens moves the target's pose, xi = -(J^T J)^-1 J^T J_k dk, and where depth is aligned
    to colour also the rays of its pixels.
    """
    camera = setup.color
    C = intrinsics_covariance
    if C is None:
        f = config.focal_sd * np.array([camera.fx, camera.fy, *np.zeros(10)])
        C = np.outer(f, f)
    values, vectors = np.linalg.eigh(C)
    axes = (vectors * np.sqrt(np.maximum(values, 0.0)))[:, values > 1e-15 * values.max()]
    scale_sd = config.board_scale_sd
    if setup.shape is not None and setup.shape.sd[0] > 0:
        scale_sd = float(setup.shape.sd[0])
    rows: list[Array] = []
    for d in used:
        J, Jk = pose_jacobian(d.T_cam_board, d.points, camera)
        xi = -np.linalg.lstsq(J, Jk @ axes, rcond=None)[0]
        row = [-d.predicted * scale_sd]
        for k in range(axes.shape[1]):
            rays = d.rays + (SMALL * _ray_change(camera, d.rays, axes[:, k]) if aligned else 0.0)
            w, _ = setup.inverse_depth(d.T_cam_board @ se3.exp(SMALL * xi[:, k]), rays)
            row.append((float(d.weights @ w) - d.predicted) / SMALL)
        rows.append(np.array(row))
    return np.stack(rows)


def _ray_change(camera: CameraIntrinsics, rays: Array, dk: Array) -> Array:
    """Return how rays (n, 2) of fixed pixels move when the camera (12,) changes by dk."""
    points = np.concatenate([rays, np.ones((len(rays), 1))], -1)
    _, d_point, d_cam = projection_jacobian(camera, points)
    change = np.linalg.solve(d_point[:, :, :2], (d_cam @ dk)[..., None])[..., 0]
    return np.asarray(-change, np.float64)
