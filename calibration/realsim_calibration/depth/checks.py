"""What a depth bias run refuses, and what it says of itself."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError, UnitError
from realsim.records import Check
from realsim_calibration.depth.area import BoardDepth
from realsim_calibration.depth.fit import ViewFit
from realsim_calibration.results import BoardShape

if TYPE_CHECKING:
    from realsim_calibration.depth.bias import DepthBiasReport

UNIT_FACTORS = (1e-4, 1e-3, 1e-2, 0.1, 0.25, 0.4, 2.5, 4.0, 10.0, 100.0, 1e3, 1e4)
"""Ratios of the usual depth units: 1, 0.01, 0.001 (most), 0.00025 (L515), 0.0001 (D405) m."""
UNIT_TOLERANCE = 0.1
"""Relative distance from such a ratio: biases and board sizes are off by less."""
LARGEST_RATIO = 1.2
"""Measured over predicted depth beyond which no camera's bias is the cause."""
DOUBTFUL_RATIO = 1.03
"""Ratio beyond which the board's size or the resolution of the intrinsics is doubted: depth
cameras are specified to 2 %."""
RANGE_BOWL = 0.5
"""Curvature in units of a range image's from which depth is taken for a range."""
BOWL_STRENGTH = 1e-5
"""Least mean square of a range image's curvature over the target [1/m^2]: 0.003 1/m."""
SURE = 2.0
"""Sigmas from which a bias counts as found."""
LOW_COVERAGE = 0.7
"""Share of the target with depth below which a warning is given: glare, or too near."""
MIN_RANGE_RATIO = 1.3
"""Least ratio of the farthest to the nearest view that tells scale from offset."""
MAX_SHIFT_PX = 4.0
"""Shift between depth and colour beyond which depth is not aligned [px]; warned of at half."""
MAX_TILT_DEG = 3.0
"""Median angle between measured and predicted plane beyond which depth is not aligned [deg]; good
poses and D405 depth agree to 1 deg."""
SURE_SIGMAS = 5.0
"""Sigmas by which a shift or an angle must stand out before it refuses the run."""


def refuse_unit(used: Sequence[BoardDepth]) -> None:
    """Raise where measured depth is a power of ten, or far, from what the target predicts."""
    ratio = float(np.median([d.predicted / d.measured for d in used]))
    z = float(np.median([1 / d.predicted for d in used]))
    for factor in UNIT_FACTORS:
        if abs(ratio / factor - 1) < UNIT_TOLERANCE:
            raise UnitError(
                f"depth is {ratio:.4g} times what the target's pose predicts ({z * ratio:.4g} m "
                f"instead of {z:.3g} m): the depth unit is wrong by {factor:g}. Is it 0.001 "
                "(millimetres), 0.00025 (an L515) or 0.0001 (a D405) metres per count? Ask the "
                "camera's driver for its depth scale. If depth is right, check the board's size."
            )
    if not 1 / LARGEST_RATIO < ratio < LARGEST_RATIO:
        raise InputError(
            f"depth is {ratio:.3g} times what the target's pose predicts ({z * ratio:.3g} m "
            f"instead of {z:.3g} m); within {LARGEST_RATIO:g} times is accepted. Check the board's "
            "square or tag size with a ruler, and that the intrinsics belong to this resolution."
        )


def refuse_misaligned(used: Sequence[BoardDepth], loose: ViewFit, focal: Array) -> None:
    """Raise where the depth image does not show what the colour image shows at the same pixel."""
    shift, sd = loose.theta[2:] * focal, np.sqrt(np.diag(loose.covariance)[2:]) * focal
    far = (np.abs(shift) > MAX_SHIFT_PX) & (np.abs(shift) > SURE_SIGMAS * sd)
    angles = np.degrees([d.tilt_error_rad for d in used])
    noise = np.degrees([d.tilt_noise_rad for d in used])
    angle, usual = float(np.median(angles)), float(np.median(noise))
    tilted = angle > MAX_TILT_DEG and angle > SURE_SIGMAS * usual
    if not (far.any() or tilted):
        return
    found: list[str] = []
    if tilted:
        found.append(
            f"the measured planes are turned by {angle:.1f} deg against the target's poses "
            f"(at most {MAX_TILT_DEG:g}; {usual:.1f} is noise)"
        )
    if far.any():
        found.append(
            f"depth is shifted by ({shift[0]:+.0f}, {shift[1]:+.0f}) px against colour "
            f"(+-{sd.max():.1f}; at most {MAX_SHIFT_PX:g})"
        )
    raise InputError(
        f"{' and '.join(found)}: is the depth aligned to the colour image? Align it with the "
        "camera's driver (rs.align(rs.stream.color)), or give depth_intrinsics and T_color_depth. "
        "If it is aligned, check that colour and depth were taken at the same moment and that the "
        "intrinsics are those of the colour image."
    )


def depth_checks(
    report: "DepthBiasReport",
    used: Sequence[BoardDepth],
    loose: ViewFit,
    focal: Array,
    shape: BoardShape | None,
) -> tuple[Check, ...]:
    """Return everything that was looked at."""
    return (
        _range_check(report),
        _bias_check(report),
        _size_check(report, shape),
        _unseen_check(report),
        _alignment_check(used, loose, focal),
        _kind_check(used),
        _coverage_check(report),
        _noise_check(report),
    )


def _range_check(report: "DepthBiasReport") -> Check:
    near, far = report.bias.range_m
    there = f"The views stand {near:.2f} to {far:.2f} m from the target"
    if report.bias.separable:
        return Check(
            name="depth range", verdict="good", value=far / near,
            sentence=f"{there}: scale and offset are told apart.",
        )  # fmt: skip
    return Check(
        name="depth range", verdict="warn", value=far / near,
        sentence=f"{there}: too little to tell scale from offset. Only their sum at "
        f"{report.middle_m:.2f} m is known: {1e3 * report.middle_bias_m:+.2f} mm "
        f"+- {1e3 * report.middle_sd_m:.2f}.",
        advice=f"Use it near that distance only, or add views so that the farthest is at least "
        f"{max(MIN_RANGE_RATIO, 2.0):g} times as far as the nearest (0.2 to 0.5 m).",
    )  # fmt: skip


def _bias_check(report: "DepthBiasReport") -> Check:
    bias, sigmas = report.bias, abs(report.middle_bias_m) / max(report.middle_sd_m, 1e-12)
    at = f"{1e3 * report.middle_bias_m:+.2f} mm +- {1e3 * report.middle_sd_m:.2f}"
    offset = bias.offset_per_m
    mahalanobis = np.array([bias.scale - 1.0, offset])
    sigmas = max(
        sigmas, float(np.sqrt(mahalanobis @ np.linalg.pinv(bias.covariance) @ mahalanobis / 2))
    )
    text = (
        f"At {report.middle_m:.2f} m the camera measures {at}; scale {bias.scale:.4f}, offset "
        f"{offset:+.4f} 1/m ({report.disparity_px:+.3f} px +- {report.disparity_sd_px:.3f} of "
        "disparity)."
    )
    found = sigmas > SURE
    return Check(
        name="depth bias", verdict="warn" if found else "good", sentence=text,
        advice="Correct the depth with DepthBias.corrected before registration." if found else "",
        value=1e3 * report.middle_bias_m, unit="mm",
    )  # fmt: skip


def _size_check(report: "DepthBiasReport", shape: BoardShape | None) -> Check:
    share = 100 * float(np.sqrt(report.board_covariance[0, 0]))
    ratio = report.bias.scale
    if not 1 / DOUBTFUL_RATIO < ratio < DOUBTFUL_RATIO and report.bias.separable:
        return Check(
            name="depth scale", verdict="warn", value=ratio,
            sentence=f"The depth scale is {ratio:.3f}; depth cameras keep within 2 %.",
            advice="Measure the board over its whole length and check the intrinsics' resolution.",
        )  # fmt: skip
    known = "its fitted size" if shape is not None else "its nominal size"
    return Check(
        name="depth scale", verdict="good" if shape is not None else "unknown", value=share,
        unit="%",
        sentence=f"Depth is known relative to the board ({known}) and the lens: {share:.2f} % of "
        "the distance is common to all views and does not average out.",
        advice="" if shape is not None else "Give the fitted shape, or measure the board.",
    )  # fmt: skip


def _unseen_check(report: "DepthBiasReport") -> Check:
    with_it, without = 1e3 * report.held_out_m, 1e3 * report.uncorrected_m
    worse = with_it > without
    return Check(
        name="depth on unseen views", verdict="warn" if worse else "good", value=with_it,
        unit="mm",
        sentence=f"Views corrected by the others are off by {with_it:.2f} mm, as measured by "
        f"{without:.2f} mm.",
        advice="The correction does not help on unseen views: do not use it." if worse else "",
    )  # fmt: skip


def _alignment_check(used: Sequence[BoardDepth], loose: ViewFit, focal: Array) -> Check:
    shift, sd = loose.theta[2:] * focal, np.sqrt(np.diag(loose.covariance)[2:]) * focal
    angle = float(np.median(np.degrees([d.tilt_error_rad for d in used])))
    text = (
        f"Depth lies ({shift[0]:+.1f}, {shift[1]:+.1f}) px from colour (+- {sd.max():.1f}); planes "
        f"agree to {angle:.1f} deg."
    )
    if sd.max() > MAX_SHIFT_PX:
        return Check(
            name="depth alignment", verdict="unknown", value=float(sd.max()), unit="px",
            sentence=f"{text} The views are too square-on to see a shift.",
            advice="Tilt the camera by 20 to 40 deg about two axes in some views.",
        )  # fmt: skip
    off = np.abs(shift) > np.maximum(MAX_SHIFT_PX / 2, SURE_SIGMAS * sd)
    warn = bool(off.any()) or angle > MAX_TILT_DEG
    return Check(
        name="depth alignment", verdict="warn" if warn else "good", sentence=text,
        advice="Check the driver's alignment of depth to colour." if warn else "",
        value=float(np.linalg.norm(shift)), unit="px",
    )  # fmt: skip


def _kind_check(used: Sequence[BoardDepth]) -> Check:
    bowls = np.array([d.bowl for d in used])
    strength = float(bowls[:, 1].mean())
    if strength < BOWL_STRENGTH:
        return Check(
            name="depth kind", verdict="unknown",
            sentence="The target fills too little of the image to tell depth from range.",
        )  # fmt: skip
    bowl = float(np.sum(bowls[:, 0] * bowls[:, 1]) / np.sum(bowls[:, 1]))
    if bowl < RANGE_BOWL:
        return Check(
            name="depth kind", verdict="good", value=bowl,
            sentence=f"Depth is along the optical axis (curvature {bowl:+.2f} of a range image's).",
        )  # fmt: skip
    return Check(
        name="depth kind", verdict="bad", value=bowl,
        sentence=f"Flat targets look curved as in a range image ({bowl:.2f} of it): these are "
        "distances along the ray, or the board is bent.",
        advice="Divide by |ray| (z = distance / sqrt(1 + x^2 + y^2)), or give the board's shape.",
    )  # fmt: skip


def _coverage_check(report: "DepthBiasReport") -> Check:
    poor = [v for v in report.views if not v.used or v.valid_share < LOW_COVERAGE]
    if not poor:
        return Check(name="depth coverage", verdict="good",
                     sentence="Every view has depth on the target.")  # fmt: skip
    why = "; ".join(
        f"{v.label}: {v.reason or f'{v.valid_share:.0%} of the target has depth'}" for v in poor[:6]
    )
    return Check(
        name="depth coverage", verdict="warn", value=float(len(poor)), unit="views",
        views=tuple(v.index for v in poor),
        sentence=f"{len(poor)} of {len(report.views)} views lack depth on the target ({why}).",
        advice="Use a matt print, avoid glare, and stay beyond the camera's least distance.",
    )  # fmt: skip


def _noise_check(report: "DepthBiasReport") -> Check:
    k, p = report.bias.noise_per_m, report.noise_exponent
    grows = f", growing with distance to the power {p:.1f}" if np.isfinite(p) else ""
    temporal = [v.temporal_noise_m for v in report.views if np.isfinite(v.temporal_noise_m)]
    still = f" Over time it is {1e3 * float(np.median(temporal)):.2f} mm." if temporal else ""
    return Check(
        name="depth noise", verdict="good", value=k, unit="1/m",
        sentence=f"A pixel's noise is {k:.4f} z^2 ({1e3 * k * 0.16:.2f} mm at 0.4 m){grows}."
        f"{still}",
    )  # fmt: skip
