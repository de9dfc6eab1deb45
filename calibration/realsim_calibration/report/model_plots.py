"""What was estimated: X, the target's shape, the robot's errors, the lens, the depth's bias."""

from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.geometry.camera import undistort
from realsim.records import CameraIntrinsics
from realsim_calibration.depth.bias import DepthBiasReport
from realsim_calibration.lens.covariance import projection_sd
from realsim_calibration.report import style
from realsim_calibration.report.summary import amount, rest_of_map
from realsim_calibration.results import HandEyeReport

CAMERA_AXES = ("x (right)", "y (down)", "z (forward)")
PAIRS = ((0, 1), (0, 2), (1, 2))
MOST_CANDIDATES = 12
DRAWN_BEND = 0.06
"""Share of the target's size to which its largest displacement is enlarged in the drawing."""
FIELD_ACROSS = 49
"""Points of the field along the image's width."""
MOST_BANDS = 9
"""Bands of a field that colours still tell apart, the largest values first."""
ARROW_STEP = 4
"""Every how many points of the field an arrow is drawn."""


def plot_uncertainty(report: HandEyeReport) -> Any:
    """Plot the 1 and 2 sigma ellipses of X along the camera's axes: translation and rotation."""
    figure = style.new_figure(5.4, grid=(2, 3))
    axes = figure.subplots(2, 3)
    C = report.place_covariance
    rows = (
        ("translation", "mm", 1e6 * C[3:, 3:], style.BLUE),
        ("rotation about", "deg", np.degrees(np.degrees(C[:3, :3])), style.GOOD),
    )
    for row, (what, unit, cov, color) in zip(axes, rows, strict=True):
        limit = 2.35 * float(np.sqrt(np.diag(cov).max())) or 1.0
        for ax, (i, j) in zip(row, PAIRS, strict=True):
            _ellipses(ax, cov[np.ix_((i, j), (i, j))], color)
            ax.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect="equal")
            x, y = (f"{what} {CAMERA_AXES[k]} [{unit}]" for k in (i, j))
            ax.set(xlabel=x, ylabel=y)
            ax.locator_params(nbins=5)
            style.grid(ax)
        sd = np.sqrt(np.diag(cov))
        row[0].set_title(
            f"1 sigma x, y, z: {sd[0]:.3g}, {sd[1]:.3g}, {sd[2]:.3g} {unit}", fontsize=9
        )
    axes[0, 2].legend(loc="lower right", bbox_to_anchor=(1.02, 1.0), ncols=2, borderaxespad=0.2)
    return figure


def _ellipses(ax: Any, cov: Array, color: str) -> None:
    """Draw the ellipses of 1 and 2 sigma of a (2, 2) covariance about the origin."""
    values, vectors = np.linalg.eigh(cov)
    t = np.linspace(0, 2 * np.pi, 181)
    circle = np.stack([np.cos(t), np.sin(t)])
    ellipse = vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * circle)
    ax.fill(*(2 * ellipse), color=color, alpha=0.16, lw=0)
    ax.plot(*(2 * ellipse), color=color, lw=0.9, label="2 sigma (86 %)")
    ax.fill(*ellipse, color=color, alpha=0.30, lw=0)
    ax.plot(*ellipse, color=color, lw=1.6, label="1 sigma (39 %)")
    ax.plot(0, 0, "+", color=style.INK, ms=6)


def plot_board(report: HandEyeReport) -> Any:
    """Plot the target's bend as a height map, and its shape against the drawing, enlarged."""
    from matplotlib.ticker import MaxNLocator

    figure = style.new_figure(3.6, grid=(1, 2), room=(0.7, 0.15, 0.7, 0.45, 0.8, 0))
    left, right = figure.subplots(1, 2, width_ratios=(1.15, 1))
    board, points = report.board, report.target.points_board[:, :2]
    middle = (points.min(0) + points.max(0)) / 2
    sides = board.half_sides_m or (board.half_extent_m, board.half_extent_m)
    x, y = np.meshgrid(*(np.linspace(-half, half, 61) for half in sides))
    lift = 1e3 * _lift(report, x, y)
    most = max(0.01, float(np.abs(lift).max()))
    mm = 1e3 * (points - middle)
    levels = MaxNLocator(nbins=14, symmetric=True).tick_values(-most, most)
    surface = left.contourf(1e3 * x, 1e3 * y, lift, levels=levels, cmap="RdBu_r")
    left.plot(mm[:, 0], mm[:, 1], ".", ms=2, color=style.INK, alpha=0.55)
    style.color_bar(figure, surface, left, "out of the plane, into the paper [mm]")
    bent = np.any(board.sd[2:] != 0) or np.any(board.warp != 0)
    left.set_title(f"Bend: up to {board.warp_mm:.2f} mm" if bent else "Bend: taken for flat")
    _outline(right, report, 2 * np.array(sides))
    for ax in (left, right):
        ax.set(aspect="equal", xlabel="x [mm]", ylabel="y, down the page [mm]")
        ax.invert_yaxis()
    return figure


def _lift(report: HandEyeReport, x: Array, y: Array) -> Array:
    """Return how far the target's points lie out of its plane [m], x, y from its middle [m]."""
    b = report.board
    u, v = x / b.half_extent_m, y / b.half_extent_m
    return b.scale * b.half_extent_m * (b.warp[0] * u**2 + b.warp[1] * u * v + b.warp[2] * v**2)


def _outline(ax: Any, report: HandEyeReport, size: Array) -> None:
    """Draw the target's outline as drawn and as it is, the difference enlarged."""
    b = report.board
    corners = 0.5e3 * size * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    real = corners * [b.scale, b.scale * (1 + b.aspect)]
    off = float(np.abs(real - corners).max())
    factor = style.round_number(DRAWN_BEND * 1e3 * float(size.max()) / max(off, 1e-9))
    factor = max(1.0, min(factor, 1000.0))
    drawn = corners + factor * (real - corners)
    ax.plot(*corners.T, color=style.MUTED, lw=1.2, ls=(0, (4, 3)), label="as drawn")
    ax.plot(*drawn.T, color=style.BLUE, lw=1.8, label=f"as it is, difference times {factor:g}")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2)
    held = " (held)" if b.sd[0] == 0 else f" ± {100 * b.sd[0]:.2f}"
    tall = " (held)" if b.sd[1] == 0 else f" ± {100 * b.sd[1]:.2f}"
    ax.set_title(
        f"Size {100 * (b.scale - 1):+.2f}{held} %\nheight / width {100 * b.aspect:+.2f}{tall} %"
    )
    ax.margins(0.12)


def _rms_text(values: Array, unit: str) -> str:
    """Return the RMS of some numbers in words."""
    mean = float(np.mean(values**2)) if len(values) else float("nan")
    return amount(float(np.sqrt(mean)), 2, unit)


def plot_robot(report: HandEyeReport) -> Any:
    """Plot the robot's error of every used view, as it is and after the map."""
    figure = style.new_figure(3.2, grid=(1, 2), room=(0.65, 0.1, 0.6, 0.5, 0.8, 0))
    axes = figure.subplots(1, 2)
    used = report.used
    before = np.array([v.robot_error for v in used]).reshape(-1, 6)
    rests = {n: rest for n, v in enumerate(used) if (rest := rest_of_map(report, v)) is not None}
    known = list(rests)
    k = np.arange(len(used))
    for ax, part, factor, unit, name in (
        (axes[0], slice(3, 6), 1e3, "mm", "Position error of the hand"),
        (axes[1], slice(0, 3), 1e3, "mrad", "Orientation error of the hand"),
    ):
        total = factor * np.linalg.norm(before[:, part], axis=-1)
        whole = f"whole, RMS {_rms_text(total, unit)}"
        if len(known) == 0:
            ax.bar(k, total, width=0.7, color=style.BLUE, label=whole)
        else:
            rest = factor * np.linalg.norm(np.array([rests[n] for n in known])[:, part], axis=-1)
            some = "" if len(known) == len(used) else f" in {len(known)} views"
            ax.bar(k, total, width=0.8, color=style.PALE, label=whole)
            ax.bar(known, rest, width=0.4, color=style.BLUE,
                   label=f"left by the map{some}, RMS {_rms_text(rest, unit)}")  # fmt: skip
        ax.set_title(name, pad=20)
        ax.set(xlabel="view", ylabel=f"[{unit}]")
        step = max(1, int(np.ceil(len(used) / 24)))
        ax.set_xticks(k[::step], [str(v.index) for v in used[::step]], rotation=90, fontsize=6.5)
        ax.legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=2, borderaxespad=0.2)
        style.grid(ax, "y")
    return figure


def _shown_maps(report: HandEyeReport) -> tuple[tuple[str, float], ...]:
    """Return the maps' scores that there is room for, the chosen one among them."""
    shown = report.map_scores[:MOST_CANDIDATES]
    chosen = tuple(s for s in report.map_scores[MOST_CANDIDATES:] if s[0] == report.map_name)
    return (*shown[: len(shown) - len(chosen)], *chosen)


def plot_choices(report: HandEyeReport) -> Any:
    """Plot how well every error map predicts unseen views, and where every closed form started."""
    maps, starts = _shown_maps(report), report.starts[:MOST_CANDIDATES]
    side = style.room_for(style.short_label(n) for n, _ in (*maps, *starts))
    height_in, room = 1.2 + 0.2 * max(4, len(maps), len(starts)), (side, 0.1, 0.5, 0.3, side, 0)
    figure = style.new_figure(height_in, grid=(1, 2), room=room)
    left, right = figure.subplots(1, 2)
    least = min((px for _, px in starts if np.isfinite(px)), default=float("nan"))
    first = next((name for name, px in starts if px == least), "")
    for ax, pairs, dark, title in (
        (left, maps, report.map_name, "Error maps: unseen views, geometric mean"),
        (right, starts, first, "Closed forms that the fit could start from"),
    ):
        values = [v for _, v in pairs]
        if not len(style.finite(values)):
            style.empty_axes(ax, "none was tried")
            continue
        most = float(style.finite(values).max())
        for k, (name, value) in enumerate(pairs):
            color = style.BLUE if name == dark else style.PALE
            ax.barh(k, value if np.isfinite(value) else 0.0, height=0.7, color=color)
            words = f"{value:.3g}" if np.isfinite(value) else "failed"
            words += ", chosen" if name == dark and ax is left else ""
            ax.text((value if np.isfinite(value) else 0.0) + most * 0.01, k, words, va="center",
                    fontsize=7.5, color=style.INK)  # fmt: skip
        ax.set_yticks(range(len(pairs)), [style.short_label(n) for n, _ in pairs])
        ax.set(ylim=(len(pairs) - 0.4, -0.6), xlim=(0, most * 1.12))
        ax.set(title=title, xlabel="reprojection RMS [px]")
    return figure


# --- lens and depth ---------------------------------------------------------------------------


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
    height_in, room = 0.75 + 0.43 * style.PAGE_WIDTH_IN * h / w, (0.65, 0.75, 0.5, 0.3, 1.35, 0)
    figure = style.new_figure(height_in, grid=(1, 2), room=room)
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
    figure = style.new_figure(3.3, grid=(1, 2), room=(0.7, 0.15, 0.5, 0.5, 0.8, 0))
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
    left.set(xlabel="distance [mm]", ylabel="[mm]")
    left.legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=4, borderaxespad=0.2,
                columnspacing=1.0)  # fmt: skip
    right.plot(1e3 * z, 1e3 * np.array([v.unseen_m for v in used]), "o", ms=4, color=style.BLUE)
    right.axhline(0, color=style.MUTED, lw=0.7)
    right.set_title(
        f"Unseen views: {amount(1e3 * report.held_out_m, 2, 'mm')} RMS, "
        f"{amount(1e3 * report.uncorrected_m, 2, 'mm')} uncorrected", pad=20,
    )  # fmt: skip
    right.set(xlabel="distance [mm]", ylabel="error after correction [mm]")
    style.grid(left)
    style.grid(right)
    return figure
