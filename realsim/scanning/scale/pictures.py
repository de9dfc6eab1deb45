"""Pictures of a scale fit, as PNG: where the model misses the surface, which views disagree.

Every picture carries the verdict: a scale is not shown without it.
"""

from typing import Any

import numpy as np

from realsim.arrays import Array, Mask
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.pages.plots import png
from realsim.records import Mesh
from realsim.scanning.scale.result import ScaleFit
from realsim.scanning.shading import DIVERGING, UNSEEN, ShadingConfig, shaded_views, value_paint

INK, MUTED, GOOD, WARN, BAD = "#22303c", "#8a99a8", "#1f8a7d", "#b26a00", "#c03f26"
VERDICT_COLORS = {"accepted": GOOD, "doubtful": WARN, "rejected": BAD, "unchecked": MUTED}
DPI = 110
RANGE_PERCENTILE = 98.0
"""The colours end where all but so many percent of the residuals lie: outliers must not pale the
rest."""
LEAST_RANGE_MM = 0.3
"""They do not end below the noise of a depth camera, which would look like a shape error [mm]."""
ROUND_MM = (0.1, 0.2, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0, 50.0, 100.0)
"""Ends of the colour bar [mm]."""
PERCENTS = (10, 20, 33, 50, 70, 80, 90, 95, 98, 100, 102, 105, 110, 125, 150, 200, 300, 500,
            1000)  # fmt: skip
"""Where an axis of scales may have ticks."""
SAME_SCALE = 0.02
"""Candidates whose scale is within this share of the result's are the same solution."""


def headline(fit: ScaleFit) -> str:
    """Return scale, sigma and verdict in one line."""
    low, high = fit.interval
    size = " x ".join(f"{e:.1f}" for e in fit.extent_mm)
    return (
        f"{fit.verdict.upper()}   scale {fit.scale:.6g} m per unit "
        f"± {fit.sigma_percent:.2f} %  (95 %: {low:.6g} to {high:.6g})   {size} mm"
    )


def residual_range_mm(fit: ScaleFit) -> float:
    """Return the end of the colour bar [mm], the same on both sides of zero."""
    seen = np.abs(fit.residual_mm[np.isfinite(fit.residual_mm)])
    wanted = float(np.percentile(seen, RANGE_PERCENTILE)) if len(seen) else 0.0
    wanted = max(wanted, LEAST_RANGE_MM)
    return next((r for r in ROUND_MM if r >= wanted), ROUND_MM[-1])


def diverging_map() -> Any:
    """Return matplotlib's form of the diverging colours."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("diverging", DIVERGING / 255)


def new_figure(width: float, height: float, fit: ScaleFit) -> Any:
    """Return a figure whose title is the fit's headline in the colour of its verdict."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained")
    figure.suptitle(
        headline(fit), fontsize=10, color=VERDICT_COLORS[fit.verdict], x=0.01, ha="left",
        fontweight="bold",
    )  # fmt: skip
    return figure


def residuals_png(mesh: Mesh, fit: ScaleFit, config: ShadingConfig | None = None) -> bytes:
    """Return the mesh from four sides, coloured by where the real surface lies.

    Args:
        mesh: the mesh, in its own unit.
        fit: its fit; one residual per vertex.
        config: how the mesh is drawn.

    Raises:
        InputError: the residuals are not of this mesh.
    """
    config = config or ShadingConfig()
    if fit.residual_mm.shape != (len(mesh.vertices),):
        raise InputError(
            f"the fit has {len(fit.residual_mm)} residuals and the mesh "
            f"{len(mesh.vertices)} vertices: they are not of each other."
        )
    T_table_obj = se3.invert(fit.plane.T_world_table) @ fit.T_world_obj
    standing = Mesh(
        vertices=se3.transform(T_table_obj, fit.scale * mesh.vertices), faces=mesh.faces
    )
    limit = residual_range_mm(fit)
    pictures = shaded_views(standing, value_paint(fit.residual_mm, limit), config)
    figure = new_figure(11.0, 3.7, fit)
    axes = figure.subplots(1, len(pictures))
    for ax, picture, side in zip(np.atleast_1d(axes), pictures, config.sides_deg, strict=True):
        ax.imshow(picture, interpolation="antialiased")
        ax.set_title(f"from {side[0]:.0f}°", fontsize=8, color=MUTED)
        ax.axis("off")
    _residual_bar(figure, axes, limit)
    seen = fit.residual_mm[np.isfinite(fit.residual_mm)]
    share = 100 * len(seen) / len(fit.residual_mm)
    about = (
        f"{share:.0f} % of the vertices were measured; half of them within "
        f"{np.median(np.abs(seen)):.2f} mm, RMS {np.sqrt(np.mean(seen**2)):.2f} mm"
        if len(seen)
        else "no vertex was measured"
    )
    figure.supxlabel(about, fontsize=9, color=INK)
    return png(figure)


def _residual_bar(figure: Any, axes: Any, limit: float) -> None:
    """Add the colour bar, and below it what grey means."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.patches import Patch

    mappable = ScalarMappable(Normalize(-limit, limit), diverging_map())
    bar = figure.colorbar(mappable, ax=axes, shrink=0.78, aspect=18, extend="both", pad=0.01)
    bar.set_label("real surface − model [mm]", fontsize=8, color=INK)
    bar.ax.tick_params(labelsize=8, colors=INK)
    bar.ax.set_title("outside", fontsize=8, color=INK, pad=12)
    grey = Patch(facecolor="#{:02x}{:02x}{:02x}".format(*UNSEEN), label="not measured")
    figure.legend(handles=[grey], loc="lower right", fontsize=8, frameon=False)


def views_png(fit: ScaleFit) -> bytes:
    """Return bars of how every view agrees; those left out are hatched.

    Raises:
        InputError: the fit has no views.
    """
    if not fit.views:
        raise InputError("the fit has no views: there is nothing to draw.")
    x = np.arange(len(fit.views))
    rows: list[tuple[str, str, tuple[float, float] | None]] = [
        ("agree", "depth agrees\n[share of pixels]", (0.0, 1.0)),
        ("iou", "outlines overlap\n[IoU]", (0.0, 1.0)),
        ("rms_mm", "points to model\n[RMS, mm]", None),
        ("shift_mm", "camera moved\n[mm]", None),
        ("turn_deg", "camera turned\n[deg]", None),
    ]
    figure = new_figure(10.0, 7.2, fit)
    axes = figure.subplots(len(rows), 1, sharex=True)
    for ax, (name, label, limits) in zip(axes, rows, strict=True):
        _view_bars(ax, fit, name)
        ax.set_ylabel(label, fontsize=8, color=INK)
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(labelsize=8, colors=INK)
        shown = limits if limits is not None else (0.0, ax.get_ylim()[1] or 1.0)
        greatest = float(np.nanmax([0.0, *(getattr(v, name) for v in fit.views)]))
        ax.set_ylim(*(shown if greatest > 0 else (0.0, 1.0)))
    step = max(1, len(x) // 32)
    axes[-1].set_xticks(x[::step], [str(v.index) for v in fit.views[::step]], fontsize=8)
    axes[-1].set_xlabel("view", fontsize=8, color=INK)
    axes[0].set_xlim(-0.7, len(x) - 0.3)
    _view_legend(figure, fit)
    return png(figure)


def _view_bars(ax: Any, fit: ScaleFit, name: str) -> None:
    """Draw one bar a view, and a line at the median of those that were used."""
    values = np.array([getattr(v, name) for v in fit.views], dtype=np.float64)
    used = np.array([v.used for v in fit.views])
    x = np.arange(len(values))
    ax.bar(x[used], np.nan_to_num(values[used]), color=GOOD, width=0.75)
    ax.bar(
        x[~used], np.nan_to_num(values[~used]), color="white", edgecolor=BAD, hatch="////",
        width=0.75, linewidth=1,
    )  # fmt: skip
    for k in np.flatnonzero(~np.isfinite(values)):
        ax.annotate("–", (x[k], 0), ha="center", va="bottom", fontsize=8, color=MUTED)
    kept = values[used & np.isfinite(values)]
    if len(kept):
        median = float(np.median(kept))
        ax.axhline(median, color=INK, lw=0.8, ls=(0, (4, 3)))
        ax.annotate(
            f"median {median:.3g}", (1.0, median), xycoords=("axes fraction", "data"),
            xytext=(3, 0), textcoords="offset points", va="center", fontsize=8, color=INK,
            annotation_clip=False,
        )  # fmt: skip


def _view_legend(figure: Any, fit: ScaleFit) -> None:
    """Name the colours of the bars."""
    from matplotlib.patches import Patch

    out = sum(not v.used for v in fit.views)
    handles = [Patch(color=GOOD, label=f"used ({len(fit.views) - out})")]
    if out:
        label = f"left out: speaks against the others ({out})"
        handles.append(Patch(facecolor="white", edgecolor=BAD, hatch="////", label=label))
    figure.legend(
        handles=handles, loc="outside lower left", ncols=2, fontsize=8, frameon=False,
        bbox_to_anchor=(0.05, 0.0),
    )  # fmt: skip


def candidates_png(fit: ScaleFit) -> bytes:
    """Return the score of every other scale that was looked at: is there a rival?

    Raises:
        InputError: the fit has no candidates.
    """
    scored = [c for c in fit.candidates if np.isfinite(c.score)]
    if not scored:
        raise InputError("the fit has no candidates with a score: there is nothing to draw.")
    scale = np.array([c.scale for c in scored])
    score = np.array([c.score for c in scored])
    same = np.abs(np.log(scale / fit.scale)) < np.log1p(SAME_SCALE)
    figure = new_figure(9.0, 3.8, fit)
    ax = figure.subplots()
    low, high = fit.interval
    ax.axvspan(100 * low / fit.scale, 100 * high / fit.scale, color=GOOD, alpha=0.18, lw=0)
    ax.axvline(100, color=GOOD, lw=1.2)
    kinds = [(same, GOOD, "the same scale"), (~same, BAD, "another scale")]
    for kind, color, label in kinds:
        if kind.any():
            ax.scatter(
                100 * scale[kind] / fit.scale, score[kind], s=34, color=color, label=label,
                edgecolor="white", linewidth=0.6, zorder=3,
            )  # fmt: skip
    _name_rivals(ax, fit, scale, score, same, [c.source for c in scored])
    ax.set_xscale("log")
    _percent_ticks(ax, 100 * scale / fit.scale)
    ax.set_xlabel("scale [% of the result]", fontsize=8, color=INK)
    ax.set_ylabel("score (greater is better)", fontsize=8, color=INK)
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(labelsize=8, colors=INK)
    ax.legend(fontsize=8, frameon=False, loc="best")
    return png(figure)


def _name_rivals(
    ax: Any, fit: ScaleFit, scale: Array, score: Array, same: Mask, names: list[str]
) -> None:
    """Write beside the best three of the other scales where they come from."""
    rivals = [k for k in np.argsort(-score) if not same[k]][:3]
    for k in rivals:
        is_right = scale[k] > fit.scale
        ax.annotate(
            names[k], (100 * scale[k] / fit.scale, score[k]), fontsize=7, color=MUTED,
            xytext=(-6 if is_right else 6, 6), textcoords="offset points",
            ha="right" if is_right else "left",
        )  # fmt: skip


def _percent_ticks(ax: Any, percent: Array) -> None:
    """Put a few plain percentages on a logarithmic axis."""
    from matplotlib.ticker import FixedLocator, NullFormatter, NullLocator, StrMethodFormatter

    span = max(float(np.abs(np.log(np.append(percent, 100) / 100)).max()), np.log(1.05))
    ax.set_xlim(100 * np.exp(-1.15 * span), 100 * np.exp(1.15 * span))
    inside = [c for c in PERCENTS if abs(np.log(c / 100)) <= 1.15 * span]
    if span > np.log(1.4):
        inside = [c for c in inside if c not in (95, 98, 102, 105)]
    if span > np.log(2.5):
        inside = [c for c in inside if c not in (80, 90, 110, 125)]
    ax.xaxis.set_major_locator(FixedLocator(inside))
    ax.xaxis.set_major_formatter(StrMethodFormatter("{x:.0f}"))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_minor_formatter(NullFormatter())
