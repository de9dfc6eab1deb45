"""The lens: its distortion, and how well every pixel's direction is known; the depth's bias."""

from typing import Any

import numpy as np

from realsim.geometry.camera import undistort
from realsim.records import CameraIntrinsics
from realsim_calibration.depth.bias import DepthBiasReport
from realsim_calibration.lens.covariance import projection_sd
from realsim_calibration.report import style
from realsim_calibration.report.summary import Array, amount

FIELD_ACROSS = 49
"""Points of the field along the image's width."""
MOST_BANDS = 9
"""Bands of a field that colours still tell apart, the largest values first."""
ARROW_STEP = 4
"""Every how many points of the field an arrow is drawn."""


def lens_field(intrinsics: CameraIntrinsics) -> tuple[Array, Array]:
    """Return pixels (rows, columns, 2) and how far the lens moved them (rows, columns, 2) [px].

    The shift is that from an ideal pinhole camera of the same focal lengths and principal point.
    """
    i = intrinsics
    across = FIELD_ACROSS
    down = max(2, round(across * i.height / i.width))
    u, v = np.meshgrid(np.linspace(0, i.width - 1, across), np.linspace(0, i.height - 1, down))
    uv = np.stack([u, v], -1)
    xy, _ = undistort(i, uv)
    return uv, uv - (xy * [i.fx, i.fy] + [i.cx, i.cy])


def round_levels(values: Array) -> list[float]:
    """Return contour levels 1, 2, 5 times powers of ten that enclose positive values."""
    known = values[np.isfinite(values) & (values > 0)]
    if len(known) == 0:
        return [0.0, 1.0]
    levels = [style.round_number(float(known.min()))]
    while levels[-1] < float(known.max()) or len(levels) < 2:
        levels.append(style.round_number(2.5 * levels[-1]))
    return levels


def plot_lens(intrinsics: CameraIntrinsics, covariance: Array, seen_uv: Array) -> Any:
    """Plot the distortion field and the 1-sigma of every pixel, the camera's best turn taken out.

    Args:
        intrinsics: the camera.
        covariance: (12, 12) of its terms.
        seen_uv: (n, 2) points that it was calibrated with [px]: their hull is drawn.
    """
    w, h = intrinsics.width, intrinsics.height
    figure = style.new_figure(0.75 + 0.43 * style.PAGE_WIDTH_IN * h / w)
    left, right = figure.subplots(1, 2)
    i = intrinsics
    for ax in (left, right):
        style.image_axes(ax, i.width, i.height)
        ax.plot(i.cx, i.cy, "+", ms=9, color=style.BAD)
    uv, shift = lens_field(i)
    lengths = np.linalg.norm(shift, axis=-1)
    if i.is_distorted and np.any(np.isfinite(lengths)):
        _bands(figure, left, uv, lengths, "Blues", "shift by the lens [px]")
        pick = (slice(ARROW_STEP // 2, None, ARROW_STEP),) * 2
        known = np.isfinite(lengths[pick])
        _, factor = style.draw_arrows(
            left, uv[pick][known], shift[pick][known], i.width, color=style.INK, width=0.0022
        )
        left.set_title(f"Distortion, arrows {factor:g} times")
    else:
        left.set_title("Distortion: none")
    if np.any(covariance != 0):
        sd = projection_sd(i, covariance, uv.reshape(-1, 2)).reshape(uv.shape[:2])
        _bands(figure, right, uv, sd, "YlOrBr", "1 sigma of a coordinate [px]")
        _draw_hull(right, seen_uv)
        right.set_title("How well the lens is known")
    else:
        right.set_title("The lens was held as given")
    return figure


def _bands(figure: Any, ax: Any, uv: Array, values: Array, colors: str, label: str) -> None:
    """Draw a field in bands of 1, 2, 5; where it is not known the image is hatched."""
    from matplotlib.colors import BoundaryNorm

    ax.patch.set(hatch="////", edgecolor=style.FAINT, facecolor="white")
    levels = round_levels(values)[-MOST_BANDS - 1 :]
    surface = ax.contourf(
        uv[..., 0], uv[..., 1], np.maximum(values, levels[0]), levels=levels, cmap=colors,
        norm=BoundaryNorm(levels, 256),
    )  # fmt: skip
    bar = style.color_bar(figure, surface, ax, label)
    bar.set_ticks(levels, labels=[f"{v:g}" for v in levels])


def _draw_hull(ax: Any, uv: Array) -> None:
    """Draw the outline of the points that were seen."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = uv[ConvexHull(uv).vertices]
    except (QhullError, ValueError):
        return
    loop = np.concatenate([hull, hull[:1]])
    ax.plot(loop[:, 0], loop[:, 1], color=style.INK, lw=1, ls=(0, (4, 3)))


def bias_curve(report: DepthBiasReport, distance_m: Array) -> tuple[Array, Array]:
    """Return measured minus true depth [m] at true distances (n,) [m], and its 1-sigma [m]."""
    measured = report.bias.measured(distance_m)
    return measured - distance_m, report.bias.sigma_m(measured)


def plot_depth_bias(report: DepthBiasReport) -> Any:
    """Plot the depth's error over distance: every view, the fitted curve with 2 sigma, the rest."""
    figure = style.new_figure(3.3)
    left, right = figure.subplots(1, 2)
    used = [v for v in report.views if v.used]
    z = np.array([v.distance_m for v in used])
    if len(z):
        span = np.linspace(0.9 * z.min(), 1.1 * z.max(), 101)
        model, sd = bias_curve(report, span)
        left.fill_between(1e3 * span, 1e3 * (model - 2 * sd), 1e3 * (model + 2 * sd), lw=0,
                          color=style.BLUE, alpha=0.18, label="± 2 sigma")  # fmt: skip
        left.plot(1e3 * span, 1e3 * model, color=style.BLUE, lw=1.6, label="fitted")
    left.errorbar(
        1e3 * z, 1e3 * np.array([v.bias_m for v in used]), fmt="o", ms=4, color=style.INK,
        yerr=1e3 * np.array([v.noise_m for v in used]), ecolor=style.MUTED, elinewidth=0.7,
        label="view, ± 1 sigma of a pixel",
    )  # fmt: skip
    dropped = [v for v in report.views if not v.used and np.isfinite(v.bias_m)]
    if dropped:
        left.plot([1e3 * v.distance_m for v in dropped], [1e3 * v.bias_m for v in dropped], "x",
                  color=style.BAD, label="dropped")  # fmt: skip
    left.axhline(0, color=style.MUTED, lw=0.7)
    left.set_title("Measured minus true depth", pad=20)
    left.set_xlabel("distance [mm]")
    left.set_ylabel("[mm]")
    left.legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=4, borderaxespad=0.2,
                columnspacing=1.0)  # fmt: skip
    right.plot(1e3 * z, 1e3 * np.array([v.unseen_m for v in used]), "o", ms=4, color=style.BLUE)
    right.axhline(0, color=style.MUTED, lw=0.7)
    right.set_title(
        f"Views corrected by the others: {amount(1e3 * report.held_out_m, 2, 'mm')} RMS, "
        f"{amount(1e3 * report.uncorrected_m, 2, 'mm')} before", pad=20,
    )  # fmt: skip
    right.set_xlabel("distance [mm]")
    right.set_ylabel("error after correction [mm]")
    for ax in (left, right):
        ax.grid()
        ax.set_axisbelow(True)
    return figure
