"""Coverage: which parts of the image and which viewpoints the calibration has seen."""

from typing import Any

import numpy as np

from realsim_calibration.report import style
from realsim_calibration.report.residual_plots import CELLS_ACROSS
from realsim_calibration.report.summary import amount, viewpoint
from realsim_calibration.results import HandEyeReport

ROLL_BIN_DEG = 15
FULL_TILT_DEG = 60.0
"""Tilt that the polar plot shows at least [deg]."""


def plot_coverage(report: HandEyeReport) -> Any:
    """Plot where in the image points lay, from where the target was seen, and the camera's roll."""
    figure = style.new_figure(3.1)
    grid = figure.add_gridspec(1, 3, width_ratios=(1.45, 1.1, 0.9))
    _image_coverage(figure, figure.add_subplot(grid[0]), report)
    _directions(figure, figure.add_subplot(grid[1], projection="polar"), report)
    _rolls(figure.add_subplot(grid[2], projection="polar"), report)
    return figure


def _image_coverage(figure: Any, ax: Any, report: HandEyeReport) -> None:
    """Draw the number of points per cell of the image; cells without any are hatched."""
    w, h = report.intrinsics.width, report.intrinsics.height
    style.image_axes(ax, w, h)
    uv = np.concatenate([v.uv for v in report.used] or [np.zeros((0, 2))])
    rows = max(1, round(CELLS_ACROSS * h / w))
    counts, x, y = np.histogram2d(
        uv[:, 0], uv[:, 1], bins=(CELLS_ACROSS, rows), range=((-0.5, w - 0.5), (-0.5, h - 0.5))
    )
    ax.patch.set(hatch="////", edgecolor=style.FAINT, facecolor="white")
    shown = np.ma.masked_equal(counts.T, 0)
    mesh = ax.pcolormesh(x, y, shown, cmap="YlGnBu", vmin=0)
    style.color_bar(figure, mesh, ax, "points per cell")
    covered = 100 * float(np.mean(counts > 0))
    ax.set_title(f"Image: {covered:.0f} % of the cells hold points")


def _directions(figure: Any, ax: Any, report: HandEyeReport) -> None:
    """Draw from where the target was seen, coloured by the error of the view."""
    used = [(viewpoint(report, v), v.unseen_px) for v in report.used]
    dropped = [viewpoint(report, v) for v in report.views if not v.used]
    tilts = [p.tilt_deg for p, _ in used] + [p.tilt_deg for p in dropped]
    most = max([FULL_TILT_DEG, *[15 * np.ceil(t / 15) for t in tilts if t <= 90]])
    if dropped:
        ax.scatter(
            np.radians([p.azimuth_deg for p in dropped]), [p.tilt_deg for p in dropped],
            marker="x", s=22, lw=1.2, color=style.BAD, label="dropped",
        )  # fmt: skip
        ax.legend(loc="lower right", bbox_to_anchor=(1.18, -0.1), handletextpad=0.1)
    if used:
        points = ax.scatter(
            np.radians([p.azimuth_deg for p, _ in used]), [p.tilt_deg for p, _ in used],
            c=[e for _, e in used], cmap=style.ERROR_MAP, s=26, edgecolor="white", lw=0.5, vmin=0,
        )  # fmt: skip
        style.color_bar(figure, points, ax, "unseen error [px]")
    ax.set_ylim(0, most)
    ax.set_yticks(np.arange(15, most + 1, 15), [f"{t:.0f}°" for t in np.arange(15, most + 1, 15)])
    ax.set_rlabel_position(67)
    _polar_looks(ax)
    ax.set_title("Viewpoints: tilt and azimuth", pad=14, loc="center")


def _rolls(ax: Any, report: HandEyeReport) -> None:
    """Draw how often the camera was rolled by how much about its optical axis."""
    rolls = np.radians([viewpoint(report, v).roll_deg for v in report.used])
    edges = np.radians(np.arange(-180, 181, ROLL_BIN_DEG))
    counts, _ = np.histogram(rolls, edges)
    ax.bar(edges[:-1], counts, width=np.radians(ROLL_BIN_DEG) * 0.92, align="edge",
           color=style.BLUE)  # fmt: skip
    most = max(2, int(counts.max(initial=0)))
    steps = np.arange(1, most + 1, max(1, int(np.ceil(most / 3))))
    ax.set_yticks(steps, [str(s) for s in steps])
    ax.set_ylim(0, most * 1.05)
    # The numbers of the rings stand where the circle is emptiest.
    middles = (edges[:-1] + edges[1:]) / 2
    apart = np.abs((middles[:, None] - rolls + np.pi) % (2 * np.pi) - np.pi)
    nearest = apart.min(1) if len(rolls) else np.ones(len(middles))
    ax.set_rlabel_position(float(np.degrees(middles[int(np.argmax(nearest))])))
    _polar_looks(ax)
    ax.set_title(
        f"Camera roll: {amount(report.roll_range_deg, 0, '°')} (views)", pad=14, loc="center"
    )


def _polar_looks(ax: Any) -> None:
    """Thin a polar plot's rings and spokes."""
    ax.grid(color=style.FAINT, lw=0.7)
    ax.spines["polar"].set_color(style.FAINT)
    ax.tick_params(labelsize=7, pad=-1)
    ax.set_axisbelow(True)
    ax.set_thetagrids(range(0, 360, 45))
