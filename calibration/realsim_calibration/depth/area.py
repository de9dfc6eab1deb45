"""What a depth camera measures on a printed target, beside what the target's pose predicts there.

Everything is in inverse depth 1/z [1/m]: there the noise of a stereo camera is the same at every
distance and has no bias, and a plane is linear in the pixel. Per view the measured (m) and the
predicted (w) inverse depth are averaged over the target's area, because errors within a view
(pose, matching window) are common to its pixels: a view is one observation.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array, Mask
from realsim.geometry import se3
from realsim.geometry.camera import project, undistort
from realsim.geometry.robust import mad_sigma, tukey_weights
from realsim_calibration.depth.board import DepthBoardView, DepthSetup, PosedBoard, board_poses

POSE_STEP = 1e-5
"""Step of the numerical derivatives by the pose [rad, m]: errors of 1e-9 relative."""
WINDOW_PX = 50.0
"""Pixels that share one matching window's noise."""
FIT_STEPS = 8
"""Rounds of reweighting in the plane fit; the weights settle in five."""
SHRINK = 0.08
"""Share of the target's area border that is left out on each side: matching windows smear
depth over edges by a few pixels."""
MAX_PIXELS = 4000
"""Pixels used per view; neighbours share one matching window, so more add nothing."""
MIN_PIXELS = 150
"""Fewest valid depth pixels: about four windows of independent noise."""
MIN_VALID_SHARE = 0.3
"""Least share of the target's area that has depth: glare or no texture beyond that."""
MIN_INLIER_SHARE = 0.6
"""Least share of the valid pixels that lie on one surface: else something is in front."""
TUKEY_SIGMAS = 4.685
"""Cut of the robust plane fit: 95 % efficient for normal noise, blind to flying pixels."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BoardDepth:
    """One view, measured and predicted; arrays are empty where `reason` says why not."""

    index: int
    label: str
    reason: str
    T_cam_board: Array
    """(4, 4) the pose that was used, in the colour camera [m]."""
    points: Array
    """(n, 3) places on the target that gave the pose [m]."""
    corner_sd_px: float
    pose_covariance: Array
    """(6, 6) of the right perturbation of T_cam_board [rad, m]."""
    rays: Array
    """(p, 2) x/z, y/z of the depth pixels used."""
    weights: Array
    """(p,) their robust weights, sum 1."""
    measured: float
    """Mean measured inverse depth [1/m]."""
    predicted: float
    """Mean predicted inverse depth at the same pixels [1/m]."""
    by_pose: Array
    """(6,) derivative of `predicted` by the right perturbation of T_cam_board."""
    predicted_slope: Array
    """(2,) its change per unit of x/z and y/z."""
    slope_error: Array
    """(2,) predicted slope minus measured slope."""
    slope_sd: Array
    """(2,) 1-sigma of slope_error: pose and depth noise."""
    mean_ray: Array
    """(2,) mean x/z, y/z of the pixels."""
    bowl: tuple[float, float]
    """Curvature of predicted - measured, 1 = that of distances along the ray, and its weight."""
    noise_per_m: float
    """1-sigma of one pixel's inverse depth over the target's area [1/m]."""
    temporal_per_m: float
    """1-sigma of one pixel's inverse depth over the frames [1/m]; NaN for a single frame."""
    valid_share: float
    """Share of the target's area that has depth."""
    inlier_share: float
    """Share of those pixels that lie on the measured surface."""

    @property
    def tilt_error_rad(self) -> float:
        """Angle between the measured and the predicted plane [rad]."""
        n = np.array([*self.predicted_slope, self.predicted - self.predicted_slope @ self.mean_ray])
        change = np.array([*self.slope_error, -self.slope_error @ self.mean_ray])
        m = n - change
        cross = np.linalg.norm(np.cross(n, m))
        return float(np.arctan2(cross, n @ m))

    @property
    def tilt_noise_rad(self) -> float:
        """1-sigma of that angle that pose and noise explain [rad]."""
        n = [*self.predicted_slope, self.predicted - self.predicted_slope @ self.mean_ray]
        return float(np.linalg.norm(self.slope_sd) / np.linalg.norm(n))


def measure_board(view: DepthBoardView, setup: DepthSetup) -> BoardDepth:
    """Return measured and predicted inverse depth of one view.

    A planar pose and its mirror twin are both tried; the one whose tilt the depth confirms is kept.
    """
    poses = board_poses(view, setup)
    if isinstance(poses, str):
        return _unused(view, poses)
    found = [_measure(view, pose, setup) for pose in poses]
    return min(found, key=lambda d: (d.reason != "", d.tilt_error_rad))


def _unused(view: DepthBoardView, reason: str) -> BoardDepth:
    nan, two = float("nan"), np.full(2, np.nan)
    return BoardDepth(
        index=view.index, label=view.label, reason=reason, T_cam_board=np.eye(4),
        points=np.zeros((0, 3)), corner_sd_px=nan, pose_covariance=np.zeros((6, 6)),
        rays=np.zeros((0, 2)), weights=np.zeros(0), measured=nan, predicted=nan,
        by_pose=np.zeros(6), predicted_slope=two, slope_error=two, slope_sd=two, mean_ray=two,
        bowl=(nan, 0.0), noise_per_m=nan, temporal_per_m=nan, valid_share=0.0, inlier_share=0.0,
    )  # fmt: skip


def _outline(view: DepthBoardView, setup: DepthSetup) -> Array:
    """Return the corners (k, 2) of the convex hull of the seen points, shrunk [m]."""
    from scipy.spatial import ConvexHull

    target = setup.target
    points = target.points_board if view.detection is None else view.detection.points(target)
    places = setup.places(points)[:, :2]
    corners = places[ConvexHull(places).vertices]
    centre = (corners.max(0) + corners.min(0)) / 2
    return centre + (1 - 2 * SHRINK) * (corners - centre)


def _inside(xy: Array, corners: Array) -> Mask:
    """Return which places (n, 2) lie inside a convex polygon (k, 2), counter-clockwise."""
    edge = np.roll(corners, -1, axis=0) - corners
    away = xy[:, None] - corners
    return np.all(edge[:, 0] * away[..., 1] - edge[:, 1] * away[..., 0] >= 0, axis=1)


def _board_pixels(
    outline: Array, pose: PosedBoard, setup: DepthSetup
) -> tuple[Array, Array, Array]:
    """Return pixels (p, 2) on the target, their rays (p, 2) and predicted inverse depth (p,)."""
    T_depth_board = se3.invert(setup.T_color_depth) @ pose.T
    corners = np.concatenate([outline, setup.lift(outline)[0][:, None]], -1)
    uv = project(setup.depth, se3.transform(T_depth_board, corners))
    last = np.array([setup.depth.width - 1, setup.depth.height - 1])
    if not np.all(np.isfinite(uv)):
        return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)
    low, high = np.clip(np.floor(uv.min(0)), 0, last), np.clip(np.ceil(uv.max(0)), 0, last)
    stride = max(1, int(np.sqrt(np.prod(high - low + 1) / MAX_PIXELS)))
    u, v = np.meshgrid(*(np.arange(a, b + 1, stride) for a, b in zip(low, high, strict=True)))
    pixels = np.stack([u.ravel(), v.ravel()], -1)
    rays, valid = undistort(setup.depth, pixels)
    w, places = setup.inverse_depth(pose.T, rays)
    keep = valid & np.isfinite(w)
    keep[keep] &= _inside(places[keep], outline)
    return pixels[keep], rays[keep], w[keep]


def _inverse_image(depth: NDArray[np.floating], pixels: Array) -> tuple[Array, float]:
    """Return measured inverse depth (p,) at pixels, NaN = none, and its temporal sd [1/m]."""
    stack = depth[None] if depth.ndim == 2 else depth
    rows, columns = pixels[:, 1].astype(int), pixels[:, 0].astype(int)
    z = stack[:, rows, columns].astype(np.float64)
    known = np.isfinite(z) & (z > 0)
    inverse = np.where(known, 1.0 / np.where(known, z, 1.0), 0.0)
    count = known.sum(0)
    mean = np.where(count > 0, inverse.sum(0) / np.maximum(count, 1), np.nan)
    always = count == len(stack)
    if len(stack) < 2 or not always.any():
        return mean, float("nan")
    return mean, float(np.sqrt(np.median(np.var(inverse[:, always], axis=0, ddof=1))))


def robust_plane(xy: Array, values: Array) -> tuple[Array, float]:
    """Return the weights (n,) of values (n,) about their plane over xy (n, 2), and sigma.

    Starts from least absolute values, then Tukey's biweight with the scale from the median
    absolute deviation.
    """
    A = np.concatenate([np.ones((len(xy), 1)), xy], -1)
    weights: Array = np.ones(len(xy))
    sigma = 0.0
    c = np.array([float(np.median(values)), 0.0, 0.0])
    for step in range(2 * FIT_STEPS):
        r = np.abs(values - A @ c)
        sigma = max(mad_sigma(r), 1e-12)
        if step < FIT_STEPS:
            weights = 1.0 / np.maximum(r, sigma)
        else:
            weights = tukey_weights(np.square(r / (TUKEY_SIGMAS * sigma)))
        root = np.sqrt(weights)
        c = np.linalg.lstsq(root[:, None] * A, root * values, rcond=None)[0]
    return weights, sigma


def _measure(view: DepthBoardView, pose: PosedBoard, setup: DepthSetup) -> BoardDepth:
    """Return measured and predicted inverse depth for one pose of the target."""
    outline = _outline(view, setup)
    pixels, rays, w = _board_pixels(outline, pose, setup)
    if len(pixels) < MIN_PIXELS:
        return _unused(view, f"the target covers only {len(pixels)} pixels of the depth image")
    m, temporal = _inverse_image(view.depth_m, pixels)
    known = np.isfinite(m)
    share = float(known.mean())
    if known.sum() < MIN_PIXELS or share < MIN_VALID_SHARE:
        return _unused(
            view, f"only {int(known.sum())} of {len(m)} depth pixels on the target have a value"
        )
    pixels, rays, w, m = pixels[known], rays[known], w[known], m[known]
    # The ratio, not the difference: a wrong unit must not look like a steep plane.
    ratio = float(np.median(w) / np.median(m))
    weights, sigma = robust_plane(rays - rays.mean(0), w / ratio - m)
    inliers = float(np.mean(weights > 0))
    if inliers < MIN_INLIER_SHARE:
        return _unused(
            view, f"only {inliers:.0%} of the depth pixels on the target lie on one surface"
        )
    weights = weights / weights.sum()
    mean_ray = weights @ rays
    A = np.concatenate([np.ones((len(rays), 1)), rays - mean_ray], -1)
    normal = np.linalg.inv(A.T @ (weights[:, None] * A))
    slope = (normal @ A.T @ (weights * w))[1:]
    error = slope - (normal @ A.T @ (weights * m))[1:] * ratio
    partial = _partials(pose, setup, rays, weights, normal @ A.T * weights)
    noise = np.diag(normal)[1:] * (sigma * ratio) ** 2 * float(np.sum(weights**2)) * WINDOW_PX
    noise = noise / min(_pixel_step(pixels) ** 2, WINDOW_PX)
    spread = np.einsum("ij,jk,ik->i", partial[1:], pose.covariance, partial[1:])
    return BoardDepth(
        index=view.index, label=view.label, reason="", T_cam_board=pose.T, points=pose.points,
        corner_sd_px=pose.sd_px, pose_covariance=pose.covariance, rays=rays, weights=weights,
        measured=float(weights @ m), predicted=float(weights @ w), by_pose=partial[0],
        predicted_slope=slope, slope_error=error, slope_sd=np.sqrt(noise + spread),
        mean_ray=mean_ray, bowl=_bowl(w, w - ratio * m, rays, A, normal, weights),
        noise_per_m=sigma, temporal_per_m=temporal, valid_share=share, inlier_share=inliers,
    )  # fmt: skip


def _pixel_step(pixels: Array) -> float:
    """Return the step of the pixel grid that was sampled [px]."""
    columns = np.unique(pixels[:, 0])
    return float(np.diff(columns).min()) if len(columns) > 1 else 1.0


def _partials(
    pose: PosedBoard, setup: DepthSetup, rays: Array, weights: Array, fit: Array
) -> Array:
    """Return d (mean, slope x, slope y of the predicted inverse depth) / d pose (3, 6)."""
    columns: list[Array] = []
    for k in range(6):
        step = np.zeros(6)
        step[k] = POSE_STEP
        ahead, _ = setup.inverse_depth(pose.T @ se3.exp(step), rays)
        behind, _ = setup.inverse_depth(pose.T @ se3.exp(-step), rays)
        change = (ahead - behind) / (2 * POSE_STEP)
        columns.append(np.array([weights @ change, *(fit[1:] @ change)]))
    return np.stack(columns, -1)


def _bowl(
    w: Array, r: Array, rays: Array, A: Array, normal: Array, weights: Array
) -> tuple[float, float]:
    """Return the curvature of the residual r in units of a range image's, and its strength.

    A camera that reports the distance along the ray measures w / |ray|, so that its residual is
    w (1 - 1 / |ray|): 1 unit. Planes are taken out of both, so that the pose does not matter.
    """
    length = np.linalg.norm(np.concatenate([rays, np.ones((len(rays), 1))], -1), axis=-1)
    pattern = w * (1 - 1 / length)
    pattern = pattern - A @ (normal @ A.T @ (weights * pattern))
    strength = float(weights @ pattern**2)
    return float(weights @ (pattern * r)) / max(strength, 1e-30), strength
