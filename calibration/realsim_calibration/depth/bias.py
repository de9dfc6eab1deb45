"""The scale and offset error of a depth camera, from the target that the calibration has anyway.

With w the inverse depth that the target's pose predicts and m the measured one, averaged over the
target's area of view i:

    w_i = a m_i + b - s_i . d + e_i,        var e_i = pose_i + tau^2

a, b are the bias (`DepthBias`), d a shift of the depth image against the colour image [x/z, y/z],
seen through the target's slopes s_i. tau is what poses and noise do not explain (Paule & Mandel
1982). Views are weighted by Huber. The covariance is the hand-eye's:

    Cov = (n - 1) / (n - 3) (J + max(kappa, 1) H^-1) / 2 + G S G^T

J is the jackknife over views, H the information, G S G^T what the board's size and the lens, which
are common to all views, may be wrong by. Depth is known relative to the board's size, not better.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from realsim.arrays import Array
from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, Check, Target
from realsim.records.calibration import DepthBias
from realsim_calibration.depth.area import BoardDepth, measure_board
from realsim_calibration.depth.board import DepthBoardView, DepthSetup
from realsim_calibration.depth.checks import (
    MAX_SHIFT_PX,
    MIN_RANGE_RATIO,
    depth_checks,
    refuse_misaligned,
    refuse_unit,
)
from realsim_calibration.depth.fit import DepthBiasConfig, ViewFit, common_errors, fit_views
from realsim_calibration.results import BoardShape

MIN_VIEWS = 4
"""Fewest usable views: two parameters, and something left to judge them by."""
MAX_SCALE_SD = 0.01
"""Largest 1-sigma of the scale, board and lens set aside, at which it is told apart from the
offset."""
SHIFT_PRIOR_PX = 0.7
"""Prior of the shift between depth and colour [px]: aligned images agree to a pixel."""


@dataclass(frozen=True, kw_only=True, slots=True)
class DepthViewReport:
    """One view's part."""

    index: int
    label: str
    used: bool
    reason: str
    """Why it was not used; empty where it was."""
    distance_m: float
    """Predicted depth of the target's area, harmonic mean [m]."""
    bias_m: float
    """Measured minus predicted depth there [m]."""
    unseen_m: float
    """The same after a correction by all other views [m]."""
    noise_m: float
    """1-sigma of a pixel over the target's area [m]."""
    temporal_noise_m: float
    """1-sigma of a pixel over the frames [m]; NaN for a single frame."""
    valid_share: float
    """Share of the target's area that has depth."""
    inlier_share: float
    """Share of the valid pixels that lie on one surface."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class DepthBiasReport:
    """A depth camera's bias with its diagnosis."""

    bias: DepthBias
    """Scale, offset and their whole covariance."""
    view_covariance: Array
    """(2, 2) the part that more views would shrink."""
    board_covariance: Array
    """(2, 2) the part that comes from the board's size and the lens: common to all distances."""
    disparity_px: float
    """The offset as an error of the disparity [px]."""
    disparity_sd_px: float
    focal_px: float
    """Focal length of that disparity [px]."""
    baseline_m: float
    """Baseline of that disparity [m]."""
    middle_m: float
    """Distance at which the bias is known best [m]."""
    middle_bias_m: float
    """Measured minus true depth there [m]."""
    middle_sd_m: float
    """1-sigma of that, board and lens included [m]."""
    scatter_per_m: float
    """tau: 1-sigma between views that poses and noise do not explain [1/m]."""
    noise_exponent: float
    """p of sigma_z ~ z^p over the views; 2 for a stereo camera, NaN = one distance."""
    held_out_m: float
    """RMS error of views corrected by the other views [m]."""
    uncorrected_m: float
    """RMS error of the same views as measured [m]."""
    views: tuple[DepthViewReport, ...]
    """Every view that was given, in the order of their numbers."""
    checks: tuple[Check, ...]


def estimate_depth_bias(
    views: Sequence[DepthBoardView],
    target: Target,
    intrinsics: CameraIntrinsics,
    config: DepthBiasConfig | None = None,
    *,
    shape: BoardShape | None = None,
    intrinsics_covariance: Array | None = None,
    depth_intrinsics: CameraIntrinsics | None = None,
    T_color_depth: Array | None = None,
) -> DepthBiasReport:
    """Return scale and offset of a depth camera from views of a target at several distances.

    Args:
        views: depth images of the target, with its points in the colour image or its pose.
        target: the target as drawn.
        intrinsics: the calibrated colour camera.
        config: what is known of the camera and the board.
        shape: how the printed target differs from its drawing (of a `HandEyeReport`).
        intrinsics_covariance: (12, 12) of the colour camera; None = `focal_sd`.
        depth_intrinsics: the depth image's own camera; None = depth is aligned to colour.
        T_color_depth: (4, 4) depth camera in the colour camera [m], with `depth_intrinsics`.

    Raises:
        InputError: the depth images are not the camera's size, or not aligned to colour.
        UnitError: depth is 10, 100 or 1000 times too large or small.
        DegenerateError: too few views show the target in depth.
    """
    config = config or DepthBiasConfig()
    setup = _setup(target, shape, intrinsics, depth_intrinsics, T_color_depth)
    ordered = sorted(views, key=lambda v: v.index)
    _check_sizes(ordered, setup, depth_intrinsics is None)
    measured = [measure_board(v, setup) for v in ordered]
    used = [d for d in measured if not d.reason]
    if used:
        refuse_unit(used)
    if len(used) < MIN_VIEWS:
        reasons = "; ".join(f"view {d.label}: {d.reason}" for d in measured if d.reason)
        raise DegenerateError(
            f"depth bias: {len(used)} of {len(measured)} views show the target in depth; at least "
            f"{MIN_VIEWS} are needed, at 0.2 to 0.5 m. {reasons[:400]} "
            "Is the depth aligned to the colour image, and is the board matt and well lit?".strip()
        )
    focal = np.array([setup.depth.fx, setup.depth.fy])
    loose = fit_views(used, MAX_SHIFT_PX * 25 / focal)
    refuse_misaligned(used, loose, focal)
    fit = fit_views(used, SHIFT_PRIOR_PX / focal)
    common = common_errors(used, setup, config, intrinsics_covariance, depth_intrinsics is None)
    report = _report(measured, used, fit, fit.gain @ common, setup, config)
    return replace(report, checks=depth_checks(report, used, loose, focal, shape))


def _setup(
    target: Target,
    shape: BoardShape | None,
    color: CameraIntrinsics,
    depth: CameraIntrinsics | None,
    T_color_depth: Array | None,
) -> DepthSetup:
    """Return what all views share, the depth camera's place checked."""
    if (depth is None) != (T_color_depth is None):
        raise InputError(
            "depth with a camera of its own needs both its intrinsics and T_color_depth (the "
            "depth camera in the colour camera, from the camera's driver); one was given."
        )
    T = np.eye(4) if T_color_depth is None else se3.check_rigid(T_color_depth, "T_color_depth")
    return DepthSetup(
        target=target, shape=shape, color=color, depth=depth or color, T_color_depth=T
    )


def _check_sizes(views: Sequence[DepthBoardView], setup: DepthSetup, aligned: bool) -> None:
    """Raise unless there are views, of unique numbers, whose images are the camera's size."""
    if len({v.index for v in views}) != len(views):
        raise InputError("two depth views have the same number; view numbers must be unique.")
    camera = setup.depth
    for v in views:
        height, width = v.depth_m.shape[-2:]
        if (width, height) == (camera.width, camera.height):
            continue
        whose = "the colour camera" if aligned else "the depth camera"
        raise InputError(
            f"the depth image of view {v.label} is {width}x{height}, {whose} "
            f"{camera.width}x{camera.height}: this depth is not aligned to the colour image. Align "
            "it with the camera's driver (rs.align(rs.stream.color)), or give depth_intrinsics and "
            "T_color_depth; resizing the image does not align it."
        )


def _report(
    measured: Sequence[BoardDepth],
    used: Sequence[BoardDepth],
    fit: ViewFit,
    common: Array,
    setup: DepthSetup,
    config: DepthBiasConfig,
) -> DepthBiasReport:
    """Return the report without its checks; common is (4, q), one sigma of each common error."""
    seen, board = fit.covariance[:2, :2], (common @ common.T)[:2, :2]
    m = np.array([d.measured for d in used])
    separable = bool(m.max() / m.min() >= MIN_RANGE_RATIO and np.sqrt(seen[0, 0]) <= MAX_SCALE_SD)
    bias = DepthBias(
        scale=float(fit.theta[0]),
        offset_per_m=float(fit.theta[1]),
        covariance=seen + board,
        noise_per_m=float(np.median([d.noise_per_m for d in used])),
        range_m=(float(1 / m.max()) * (1 - 1e-9), float(1 / m.min())),
        separable=separable,
    )
    # [m, 1] C [m, 1]^T is least here: where the line is known best.
    best = float(np.clip(-seen[0, 1] / seen[0, 0], m.min(), m.max()))
    middle = 1.0 / best
    focal = config.focal_px or setup.depth.fx
    rows = tuple(_view_report(d, fit, list(used)) for d in measured)
    there = [r for r in rows if r.used]
    return DepthBiasReport(
        bias=bias, view_covariance=seen, board_covariance=board,
        disparity_px=bias.disparity_px(focal, config.baseline_m),
        disparity_sd_px=float(np.sqrt(bias.covariance[1, 1])) * focal * config.baseline_m,
        focal_px=focal, baseline_m=config.baseline_m, middle_m=middle,
        middle_bias_m=float(bias.bias_m(middle)), middle_sd_m=float(bias.sigma_m(middle)),
        scatter_per_m=fit.scatter, noise_exponent=_noise_exponent(there),
        held_out_m=float(np.sqrt(np.mean([r.unseen_m**2 for r in there]))),
        uncorrected_m=float(np.sqrt(np.mean([r.bias_m**2 for r in there]))),
        views=rows, checks=(),
    )  # fmt: skip


def _view_report(d: BoardDepth, fit: ViewFit, used: list[BoardDepth]) -> DepthViewReport:
    """Return one view's part; errors in depth are z^2 times those in inverse depth."""
    nan = float("nan")
    if d.reason:
        return DepthViewReport(
            index=d.index, label=d.label, used=False, reason=d.reason, distance_m=nan, bias_m=nan,
            unseen_m=nan, noise_m=nan, temporal_noise_m=nan, valid_share=d.valid_share,
            inlier_share=d.inlier_share,
        )  # fmt: skip
    z, k = 1 / d.predicted, next(i for i, other in enumerate(used) if other is d)
    scale, offset = fit.without[k][:2]
    return DepthViewReport(
        index=d.index, label=d.label, used=True, reason="", distance_m=z,
        bias_m=1 / d.measured - z, unseen_m=1 / (scale * d.measured + offset) - z,
        noise_m=d.noise_per_m * z**2, temporal_noise_m=d.temporal_per_m * z**2,
        valid_share=d.valid_share, inlier_share=d.inlier_share,
    )  # fmt: skip


def _noise_exponent(views: Sequence[DepthViewReport]) -> float:
    """Return p of sigma_z ~ z^p over the views; NaN where they stand at one distance."""
    z = np.log([v.distance_m for v in views])
    noise = np.log([max(v.noise_m, 1e-9) for v in views])
    if np.ptp(z) < np.log(MIN_RANGE_RATIO):
        return float("nan")
    return float(np.polyfit(z, noise, 1)[0])
