"""The views: residuals over the image, on the worst photographs and per view; their coverage."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from realsim.arrays import Array, UInt8
from realsim_calibration.report import style
from realsim_calibration.report.summary import amount, viewpoint
from realsim_calibration.results import HandEyeReport, ViewReport

Images = Callable[[int], UInt8 | None]
"""Gives the photograph (height, width, 3) of a view, None where there is none."""
MOST_ARROWS = 4000
"""Arrows that are still told apart on one picture."""
CELLS_ACROSS = 16
"""Cells of the mean residual along the image's width."""
LEAST_IN_CELL = 4
"""Points from which a cell's mean says something."""
WORST_VIEWS = 3
MOST_BARS = 48
"""Views in the bar plot: the worst ones; the page's table has all."""
MARGIN = 1.5
"""Size of the part of a photograph that is shown, relative to that of the points in it."""
PHOTO_WIDTH_PX = 1600
"""Photographs are drawn at this width: more cannot be seen on the page."""
PALER = 0.45
"""How far a photograph is mixed with white so that arrows stand out."""
ROLL_BIN_DEG = 15
FULL_TILT_DEG = 60.0
"""Tilt that the polar plot shows at least [deg]."""


def plot_residuals(report: HandEyeReport) -> Any:
    """Plot every residual over the image plane, and their mean per cell."""
    w, h = report.intrinsics.width, report.intrinsics.height
    height_in, room = 0.75 + 0.43 * style.PAGE_WIDTH_IN * h / w, (0.65, 0.1, 0.5, 0.3, 1.35, 0)
    figure = style.new_figure(height_in, grid=(1, 2), room=room)
    axes = figure.subplots(1, 2)
    uv = style.joined(v.uv for v in report.used)
    r = style.joined(v.residuals for v in report.used)
    for ax in axes:
        style.image_axes(ax, w, h)
    if len(r) == 0:
        return figure
    keep = np.random.default_rng(0).permutation(len(r))[:MOST_ARROWS]
    limit = float(np.percentile(np.linalg.norm(r, axis=-1), 99))
    quiver, factor = style.draw_arrows(
        axes[0], uv[keep], r[keep], w, cmap=style.ERROR_MAP, clim=(0, limit), width=0.0018
    )
    style.color_bar(figure, quiver, axes[0], "residual [px]")
    axes[0].set_title(f"Every residual, {factor:g} times enlarged")
    centers, means = cell_means(uv, r, w, h)
    axes[1].set_title("Mean per cell: too few points")
    if len(means):
        _, factor = style.draw_arrows(
            axes[1], centers, means, w, color=style.BLUE, width=0.003
        )  # fmt: skip
        axes[1].set_title(f"Mean per cell, {factor:g} times enlarged")
    return figure


def cell_means(uv: Array, r: Array, width: int, height: int) -> tuple[Array, Array]:
    """Return centres (m, 2) [px] and mean residuals (m, 2) [px] of the cells with enough points."""
    size = width / CELLS_ACROSS
    cell = np.floor(np.clip(uv, 0, [width - 1, height - 1]) / size).astype(int)
    key = cell[:, 1] * CELLS_ACROSS + cell[:, 0]
    keys, inverse, counts = np.unique(key, return_inverse=True, return_counts=True)
    sums = np.zeros((len(keys), 2))
    np.add.at(sums, inverse, r)
    enough = counts >= LEAST_IN_CELL
    row, column = np.divmod(keys[enough], CELLS_ACROSS)
    centers = (np.stack([column, row], -1) + 0.5) * size
    return centers, sums[enough] / counts[enough, None]


def worst_views(report: HandEyeReport, count: int = WORST_VIEWS) -> list[ViewReport]:
    """Return the used views that the rest of the calibration predicts worst."""
    known = [v for v in report.used if np.isfinite(v.unseen_px) and len(v.residuals)]
    return sorted(known, key=lambda v: -v.unseen_px)[:count]


def plot_worst_views(
    report: HandEyeReport, views: Sequence[ViewReport], images: Images | None
) -> Any:
    """Plot the residuals of some views on top of their photographs."""
    i = report.intrinsics
    columns = max(1, len(views))
    width_in = style.PAGE_WIDTH_IN * min(1.0, 0.42 * columns)
    height_in = 0.55 + width_in / columns * i.height / i.width
    room = (0.05, 0.05, 0.27, 0.28, 0.08, 0)
    figure = style.new_figure(height_in, width_in, (1, columns), room)
    for k, view in enumerate(views):
        ax = figure.add_subplot(1, columns, k + 1)
        note = _draw_photo(ax, images(view.index) if images else None, i.width, i.height)
        style.image_axes(ax, i.width, i.height)
        low, width_px = _window(view.uv, i.width, i.height)
        height_px = width_px * i.height / i.width
        ax.set(xlim=(low[0], low[0] + width_px), ylim=(low[1] + height_px, low[1]))
        ax.set(xticks=[], yticks=[], ylabel="")
        _, factor = style.draw_arrows(
            ax, view.uv, view.residuals, width_px, color=style.BAD, width=0.005
        )
        ax.plot(view.uv[:, 0], view.uv[:, 1], ".", ms=2, color=style.INK)
        ax.set_title(style.view_label(view.label, view.index), fontsize=8.5)
        ax.set_xlabel(
            f"unseen {amount(view.unseen_px, 2, 'px')}; arrows {factor:g} times{note}", fontsize=8
        )
    return figure


def _window(uv: Array, width: int, height: int) -> tuple[Array, float]:
    """Return upper left corner (2,) and width [px] of the part of an image that holds points.

    It has the image's shape and lies inside of it.
    """
    low, high = uv.min(0), uv.max(0)
    size = np.array([width, height], dtype=np.float64)
    share = float(min(1.0, MARGIN * np.max((high - low) / size)))
    corner = np.clip((low + high) / 2 - share * size / 2, 0.0, (1 - share) * size)
    return corner - 0.5, share * width


def _draw_photo(ax: Any, rgb: UInt8 | None, width: int, height: int) -> str:
    """Draw a photograph, paler than it is; return what must be said of it."""
    import cv2

    if rgb is None:
        return ""
    if rgb.shape[:2] != (height, width):
        return f"; photo left out, it is {rgb.shape[1]}x{rgb.shape[0]}"
    shrink = min(1.0, PHOTO_WIDTH_PX / width)
    size = (round(width * shrink), max(1, round(height * shrink)))
    small = cv2.resize(np.ascontiguousarray(rgb), size, interpolation=cv2.INTER_AREA)
    pale = cv2.convertScaleAbs(small, alpha=1 - PALER, beta=255 * PALER)
    ax.imshow(
        pale, cmap="gray", vmin=0, vmax=255, extent=(-0.5, width - 0.5, height - 0.5, -0.5),
        interpolation="bilinear",
    )  # fmt: skip
    return ""


def plot_views(report: HandEyeReport) -> Any:
    """Plot seen and unseen error of every view, worst first, and the dropped ones with a reason."""
    from matplotlib.patches import Patch

    used = sorted(report.used, key=lambda v: -np.nan_to_num(v.unseen_px, nan=-1.0))
    dropped = [v for v in report.views if not v.used]
    shown = [*used[: max(0, MOST_BARS - len(dropped))], *dropped[:MOST_BARS]]
    names = [style.view_label(v.label, v.index) for v in shown]
    room = (style.room_for(names), 0.1, 0.5, 0.5, 0, 0)
    figure = style.new_figure(0.9 + 0.165 * max(4, len(shown)), room=room)
    ax = figure.add_subplot()
    largest = float(np.max(style.finite([v.unseen_px for v in used]), initial=0.1))
    for k, v in enumerate(shown):
        if v.used:
            ax.barh(k, v.unseen_px, height=0.72, color=style.PALE)
            ax.barh(k, v.seen_px, height=0.34, color=style.BLUE)
        else:
            ax.barh(k, largest, height=0.72, color=style.BAD, alpha=0.13)
            reason = style.short_label(f"dropped: {v.reason}", 120)
            ax.text(largest * 0.008, k, reason, va="center", fontsize=7, color=style.BAD)
    ax.set_yticks(range(len(shown)), names)
    for tick, v in zip(ax.get_yticklabels(), shown, strict=True):
        tick.set_color(style.INK if v.used else style.BAD)
    ax.set(ylim=(len(shown) - 0.4, -0.6), xlim=(0, largest * 1.06))
    line = ax.axvline(report.held_out_px, color=style.INK, lw=1, ls=(0, (4, 3)))
    handles = {
        "predicted without this view": Patch(color=style.PALE),
        "fitted with it": Patch(color=style.BLUE),
        f"RMS of all unseen, {amount(report.held_out_px, 2, 'px')}": line,
    }
    left_out = len(report.views) - len(shown)
    more = f", {left_out} better ones are in the table below" if left_out else ""
    ax.set_title(f"Reprojection error of each view, worst first{more}", pad=22)
    ax.set_xlabel("RMS through the robot's pose [px]")
    ax.legend(handles.values(), handles.keys(), loc="lower left", bbox_to_anchor=(0, 1.0), ncols=3,
              borderaxespad=0.2)  # fmt: skip
    style.grid(ax, "x")
    return figure


# --- coverage ---------------------------------------------------------------------------------


def plot_coverage(report: HandEyeReport) -> Any:
    """Plot where in the image points lay, from where the target was seen, and the camera's roll."""
    figure = style.new_figure(3.1, grid=(1, 3), room=(0.6, 0.3, 0.3, 0.5, 1.2, 0))
    grid = figure.add_gridspec(1, 3, width_ratios=(1.4, 1.4, 1))
    _image_coverage(figure, figure.add_subplot(grid[0]), report)
    _directions(figure, figure.add_subplot(grid[1], projection="polar"), report)
    _rolls(figure.add_subplot(grid[2], projection="polar"), report)
    return figure


def _image_coverage(figure: Any, ax: Any, report: HandEyeReport) -> None:
    """Draw the number of points per cell of the image; cells without any are hatched."""
    if report.nominal_lens:
        ax.set_axis_off()
        ax.set_title("No images")
        return
    w, h = report.intrinsics.width, report.intrinsics.height
    style.image_axes(ax, w, h)
    uv = style.joined(v.uv for v in report.used)
    rows = max(1, round(CELLS_ACROSS * h / w))
    counts, x, y = np.histogram2d(
        uv[:, 0], uv[:, 1], bins=(CELLS_ACROSS, rows), range=((-0.5, w - 0.5), (-0.5, h - 0.5))
    )
    ax.patch.set(hatch="////", edgecolor=style.FAINT, facecolor="white")
    shown = np.ma.masked_equal(counts.T, 0)
    mesh = ax.pcolormesh(x, y, shown, cmap="YlGnBu", vmin=0)
    style.color_bar(figure, mesh, ax, "points per cell")
    ax.set_title("Image: where points were")


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
    ax.set_title("Viewpoints: tilt and azimuth", pad=20, loc="center")


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
        f"Camera roll: {amount(report.roll_range_deg, 0, '°')} (views)", pad=20, loc="center"
    )


def _polar_looks(ax: Any) -> None:
    """Thin a polar plot's rings and spokes."""
    ax.grid(color=style.FAINT, lw=0.7)
    ax.spines["polar"].set_color(style.FAINT)
    ax.tick_params(labelsize=7, pad=-1)
    ax.set_axisbelow(True)
    ax.set_thetagrids(range(0, 360, 45))
