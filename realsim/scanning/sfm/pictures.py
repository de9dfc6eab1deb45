"""What a person looks at: cameras and points from above and from the side, residuals, matches."""

from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array, Mask
from realsim.scanning.sfm.result import SfmResult

INK, MUTED, GOOD, BAD = "#22303c", "#8a99a8", "#2a9d8f", "#c8553d"
MOST_POINTS = 20_000
"""Points drawn; more only make the file larger."""
SHOWN_PERCENTILES = (1.0, 99.0)
"""Percentiles of the points that set the picture's frame: stray ones would shrink the rest."""
AXIS_SHARE = 0.06
"""Length of a drawn optical axis over the width of the scene."""
MOST_LABELS = 40
"""Up to so many views are named on an axis."""


def write_pictures(result: SfmResult, folder: Path) -> list[Path]:
    """Write scene.png, views.png and matches.png and return their paths."""
    paths = [folder / name for name in ("scene.png", "views.png", "matches.png")]
    for draw, path in zip((_scene, _views, _matches), paths, strict=True):
        figure = draw(result)
        draft = path.with_name(f".{path.name}.draft.png")
        figure.savefig(draft)
        draft.replace(path)
    return paths


def _figure(width: float, height: float, rows: int, columns: int) -> tuple[Any, list[Any]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=110, layout="constrained")
    axes = [figure.add_subplot(rows, columns, k + 1) for k in range(rows * columns)]
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(colors=INK, labelsize=8)
    return figure, axes


def _upright(result: SfmResult) -> tuple[Array, Array, Array]:
    """Return points, camera centres and optical axes with z up.

    A metric world is the robot's, whose z is up. Else the cameras' mean viewing direction is down.
    """
    g = result.geometry
    points, T = g.points, g.Ts_world_cam
    centres, axes = T[:, :3, 3], T[:, :3, 2]
    if result.is_metric:
        return points, centres, axes
    down = axes.mean(0) / max(float(np.linalg.norm(axes.mean(0))), 1e-9)
    x = np.cross([0.0, 1.0, 0.0] if abs(down[1]) < 0.9 else [1.0, 0.0, 0.0], down)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(-down, x), -down])
    return points @ R.T, centres @ R.T, axes @ R.T


def _scene(result: SfmResult) -> Any:
    """Draw cameras and points from above and from the side."""
    figure, axes = _figure(11.0, 5.0, 1, 2)
    points, centres, looks = _upright(result)
    step = max(1, len(points) // MOST_POINTS)
    wrong = np.isin(result.geometry.names, result.outliers)
    low, high = np.percentile(points, SHOWN_PERCENTILES, axis=0)
    both = np.vstack([centres, low, high])
    low, high = both.min(0), both.max(0)
    margin = 0.08 * float((high - low).max())
    length = AXIS_SHARE * float((high - low).max())
    unit = "m" if result.is_metric else "COLMAP's unit"
    for ax, (i, j), title in zip(
        axes, ((0, 1), (0, 2)), ("from above", "from the side"), strict=True
    ):
        ax.scatter(
            points[::step, i], points[::step, j], s=3, c=result.geometry.colors[::step] / 255,
            edgecolors="none",
        )  # fmt: skip
        for centre, look, bad in zip(centres, looks, wrong, strict=True):
            tip = centre + length * look
            ax.plot([centre[i], tip[i]], [centre[j], tip[j]], color=BAD if bad else INK, lw=1)
        ax.scatter(centres[~wrong, i], centres[~wrong, j], s=16, color=GOOD, zorder=3)
        ax.scatter(centres[wrong, i], centres[wrong, j], s=24, color=BAD, marker="x", zorder=3)
        ax.set_xlim(low[i] - margin, high[i] + margin)
        ax.set_ylim(low[j] - margin, high[j] + margin)
        ax.set_aspect("equal")
        ax.set_xlabel(f"{'xyz'[i]} [{unit}]", fontsize=8)
        ax.set_ylabel(f"{'xyz'[j]} [{unit}]", fontsize=8)
        ax.set_title(title, fontsize=9, loc="left")
    told = f"{len(points)} points, {len(centres)} of {len(result.matching.names)} views"
    told += f", {int(wrong.sum())} speak against the robot (red)" if wrong.any() else ""
    figure.suptitle(f"Structure from motion: {told}", fontsize=10, x=0.01, ha="left")
    return figure


def _short(names: tuple[str, ...]) -> list[str]:
    """Return names without folder and ending."""
    return [Path(n).stem.lstrip("0") or "0" for n in names]


def _bars(ax: Any, names: tuple[str, ...], values: Array, wrong: Mask, label: str) -> None:
    place = np.arange(len(names))
    ax.bar(place, values, color=np.where(wrong, BAD, GOOD))
    ax.set_ylabel(label, fontsize=8)
    step = max(1, -(-len(names) // MOST_LABELS))
    ax.set_xticks(place[::step], _short(names)[::step], fontsize=6, rotation=90)
    ax.margins(x=0.01)
    # One view that is metres away would leave nothing of the others.
    usual = values[~wrong]
    top = 1.15 * float(usual.max(initial=0.0))
    if top and values.max() > 3 * top:
        ax.set_ylim(0, 2 * top)
        for k in np.flatnonzero(values > 2 * top):
            ax.annotate(
                f"{values[k]:.0f}", (place[k], 2 * top), ha="center", va="top", fontsize=6,
                color="white", rotation=90,
            )  # fmt: skip


def _views(result: SfmResult) -> Any:
    """Draw every view's distance from the robot and its reprojection error."""
    views = () if result.alignment is None else result.alignment.views
    figure, axes = _figure(9.0, 2.0 * (3 if views else 1), 3 if views else 1, 1)
    if views:
        names = tuple(v.name for v in views)
        wrong = np.array([v.outlier for v in views])
        mm = np.array([v.offset_mm for v in views])
        deg = np.array([v.turn_deg for v in views])
        _bars(axes[0], names, mm, wrong, "from the robot [mm]")
        _bars(axes[1], names, deg, wrong, "from the robot [deg]")
        axes[0].set_title("Camera poses against the robot's", fontsize=9, loc="left")
    g = result.geometry
    # The same place for a view in every row; one that was dropped has no bar.
    names = tuple(v.name for v in views) or g.names
    px = dict(zip(g.names, result.view_reprojection_px.tolist(), strict=True))
    values = np.array([px.get(n, 0.0) for n in names])
    _bars(axes[-1], names, values, np.isin(names, result.outliers), "reprojection [px]")
    axes[-1].set_title("Median reprojection error", fontsize=9, loc="left")
    axes[-1].set_xlabel("view", fontsize=8)
    return figure


def _matches(result: SfmResult) -> Any:
    """Draw how many matches of each pair of views passed the geometric verification."""
    from matplotlib.colors import LogNorm

    count = len(result.matching.names)
    verified = np.full((count, count), np.nan)
    for i, j, _, n in result.matching.pairs:
        verified[i, j] = verified[j, i] = n if n > 0 else np.nan
    figure, (ax,) = _figure(6.0, 5.2, 1, 1)
    most = float(np.nanmax(verified, initial=20.0))
    shown = ax.imshow(verified, cmap="viridis", norm=LogNorm(10, max(most, 20.0)))
    ax.set_facecolor("#eef1f4")
    step = max(1, -(-count // MOST_LABELS))
    labels = _short(result.matching.names)
    ax.set_xticks(range(0, count, step), labels[::step], fontsize=6, rotation=90)
    ax.set_yticks(range(0, count, step), labels[::step], fontsize=6)
    bar = figure.colorbar(shown, ax=ax, shrink=0.9)
    bar.set_label("verified matches (grey: none)", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    ax.set_title("Which views share features", fontsize=9, loc="left")
    return figure
