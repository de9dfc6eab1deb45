"""How the arm moves: joints and speeds over the time of the tour, and what it keeps away from."""

from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim_capture_plans.pictures import drawing
from realsim_capture_plans.planning.metrics import joint_names
from realsim_capture_plans.planning.record import CapturePlan

GROUP_LABELS = {
    "self": "arm to itself",
    "tool": "arm to camera",
    "table": "to the table",
    "scene": "to keep-out box\nand obstacles",
}
FINE_TIMES = 4000
"""Times at which a curve over the whole tour is drawn: more than the picture has pixels."""
CLEARANCE_TOP_MM = 100.0
"""Greater clearances are off the picture: nobody worries about them."""
LABEL_HEIGHTS = (0.62, 0.84)
"""Where the labels of the worst and the next spot stand, as shares of the axes' height: each at a
height of its own, so that they never lie on each other."""
LABEL_SHIFT = 0.012
"""How far beside its spot a label begins, as a share of the tour."""
APART = 0.08
"""Named spots are at least this share of the tour apart; nearer ones are the same trouble."""
VIAS_NAMED = 12
"""Moves over via points that are named."""
ZOOM_BEFORE_S, ZOOM_AFTER_S = 3.0, 5.0
"""Shown before and after the slowest move [s]."""


def joints_chart(curves: drawing.PlanCurves) -> Any:
    """Return the figure: every joint between its limits over the tour, and the speeds."""
    tour, plan = curves.tour, curves.plan
    n, labels = plan.chain.joints, _labels(plan)
    figure = drawing.new_figure(11.0, 2.5 + 1.4 * n)
    grid = figure.add_gridspec(n + 1, 2, height_ratios=[1] * n + [1.7])
    t = np.linspace(0.0, tour.total_s, FINE_TIMES)
    q = np.degrees(tour.joints_at(t))
    lower, upper = np.degrees(plan.chain.limits.lower), np.degrees(plan.chain.limits.upper)
    via_moves = sorted({k for k, via in plan.vias if len(via)})
    shared: Any = None
    for j in range(n):
        axes = figure.add_subplot(grid[j, :], sharex=shared)
        shared = shared or axes
        axes.plot(t, q[:, j], color=_color(j), linewidth=1.1)
        for limit in (lower[j], upper[j]):
            axes.axhline(limit, color=drawing.RED, linewidth=1.2, linestyle="--")
        axes.axhline(np.degrees(plan.home[j]), color=drawing.GREY, linewidth=0.8, linestyle=":")
        for k in via_moves:
            own = np.flatnonzero(tour.move == k)
            axes.axvspan(
                tour.begin_s[own[0]], tour.end_s[own[-1]], color=drawing.RED, alpha=0.18, lw=0
            )
        span = upper[j] - lower[j]
        axes.set_ylim(lower[j] - 0.06 * span, upper[j] + 0.06 * span)
        axes.set_yticks([round(lower[j]), 0, round(upper[j])])
        margin = min(q[:, j].min() - lower[j], upper[j] - q[:, j].max())
        axes.set_ylabel(f"{labels[j]}\n[deg]", fontsize=9)
        axes.text(1.005, 0.5, f"margin\n{margin:.0f}°", transform=axes.transAxes, fontsize=9,
                  va="center", color=_color(j))  # fmt: skip
        axes.tick_params(labelbottom=j == n - 1)
        drawing.plain(axes)
    shared.set_xlim(0.0, tour.total_s)
    named = ", ".join(str(k) for k in via_moves[:VIAS_NAMED]) or "none"
    if len(via_moves) > VIAS_NAMED:
        named += f" and {len(via_moves) - VIAS_NAMED} more"
    figure.axes[n - 1].set_xlabel("time of the tour [s]")
    _draw_speeds(figure.add_subplot(grid[n, 0]), curves)
    _draw_slowest(figure.add_subplot(grid[n, 1]), curves)
    figure.suptitle(
        f"Joints over the tour: {len(plan)} views, {tour.total_s:.0f} s with "
        f"{plan.config.settle_s:g} s of settling at each\n"
        f"red dashes: limits; grey dots: home; red bands: moves over via points ({named})",
        fontsize=12,
    )
    return figure


def _labels(plan: CapturePlan) -> list[str]:
    """Return what the joints are called in pictures."""
    return [name.replace("_", " ") for name in joint_names(plan.chain)]


def _color(joint: int) -> str:
    return drawing.JOINT_COLORS[joint % len(drawing.JOINT_COLORS)]


def _draw_speeds(axes: Any, curves: drawing.PlanCurves) -> None:
    """Draw how long each move takes, in tour order."""
    tour = curves.tour
    seconds = np.bincount(tour.move, weights=tour.end_s - tour.begin_s)
    axes.bar(np.arange(len(seconds)), seconds, width=1.0, color=drawing.JOINT_COLORS[0])
    axes.set_xlabel("move to view number")
    axes.set_ylabel("seconds")
    axes.set_title(f"time of each move, {seconds.sum():.0f} s in all", fontsize=10)
    drawing.plain(axes)


def _draw_slowest(axes: Any, curves: drawing.PlanCurves) -> None:
    """Draw the joints' speeds about the slowest move: trapezoids, stop to stop."""
    tour, config = curves.tour, curves.plan.config
    seconds = np.bincount(tour.move, weights=tour.end_s - tour.begin_s)
    slowest = int(np.argmax(seconds))
    legs = np.flatnonzero(tour.move == slowest)
    first = max(0.0, tour.begin_s[legs[0]] - ZOOM_BEFORE_S)
    t = np.linspace(first, min(tour.total_s, tour.end_s[legs[-1]] + ZOOM_AFTER_S), FINE_TIMES // 4)
    speed = tour.speeds_at(t)
    for j, label in enumerate(_labels(curves.plan)):
        axes.plot(t, speed[:, j], color=_color(j), linewidth=1.2, label=label)
    for sign in (-1, 1):
        axes.axhline(sign * config.speed, color=drawing.RED, linewidth=1.0, linestyle="--")
    axes.set_xlim(t[0], t[-1])
    axes.set_xlabel("time of the tour [s]")
    axes.set_ylabel("speed [rad/s]")
    axes.set_title(f"about the slowest move, to view {slowest}", fontsize=10)
    axes.legend(fontsize=7, ncols=3, loc="lower center", framealpha=0.9)
    axes.set_ylim(-1.75 * config.speed, 1.15 * config.speed)
    drawing.plain(axes)


def clearance_chart(curves: drawing.PlanCurves) -> Any:
    """Return the figure: the least distance per group along the tour."""
    groups = list(curves.clearance)
    figure = drawing.new_figure(11.0, 1.6 + 2.2 * len(groups))
    axes = figure.subplots(len(groups), 1, sharex=True, squeeze=False)[:, 0]
    for group, one in zip(groups, axes, strict=True):
        draw_clearance(one, curves, group)
    axes[-1].set_xlabel("time of the tour [s]")
    need = 1000 * curves.plan.config.clearance_m
    worst = min((d.min() for d in curves.clearance.values()), default=np.nan)
    broken = curves.metrics.get("colliding_legs", 0.0)
    verdict = (
        "kept everywhere" if worst >= need / 1000 and not broken else "NOT KEPT: do not drive this"
    )
    figure.suptitle(
        f"Clearance along the tour of {len(curves.plan)} views: "
        f"least {1000 * worst:.1f} mm, {need:g} mm required, {verdict}\n"
        "red dashes: required; dots: worst spots; distances above "
        f"{CLEARANCE_TOP_MM:g} mm are off the picture",
        fontsize=12,
    )
    return figure


def draw_clearance(axes: Any, curves: drawing.PlanCurves, group: str) -> None:
    """Draw one group's clearance over time, with its worst spots named."""
    t, distance = curves.samples.time_s, 1000 * curves.clearance[group]
    need = 1000 * curves.plan.config.clearance_m
    color = drawing.GROUP_COLORS.get(group, drawing.GREY)
    axes.plot(t, distance, color=color, linewidth=0.9)
    bad = distance < need
    if np.any(bad):
        axes.scatter(t[bad], distance[bad], s=9, color=drawing.RED, zorder=4)
    axes.axhline(need, color=drawing.RED, linewidth=1.4, linestyle="--")
    axes.axhspan(min(distance.min(), 0.0) - 20, need, color=drawing.RED, alpha=0.10, lw=0)
    bottom = min(distance.min() - 5.0, -2.0)
    axes.set_ylim(bottom, CLEARANCE_TOP_MM)
    axes.set_xlim(0.0, curves.tour.total_s)
    for rank, i in enumerate(_worst(t, distance, curves.tour.total_s)):
        if distance[i] > CLEARANCE_TOP_MM:
            continue
        move, right = int(curves.samples.move[i]), t[i] > 0.8 * curves.tour.total_s
        shift = (-LABEL_SHIFT if right else LABEL_SHIFT) * curves.tour.total_s
        axes.scatter(t[i], distance[i], s=45, color=drawing.BLACK, zorder=5)
        axes.annotate(
            f"{distance[i]:.1f} mm on the move to view {move}",
            (t[i], distance[i]), xytext=(t[i] + shift, LABEL_HEIGHTS[rank]),
            textcoords=axes.get_xaxis_transform(), ha="right" if right else "left", fontsize=9,
            bbox={"boxstyle": "round,pad=0.2", "fc": "white", "ec": "0.6", "alpha": 0.92},
            arrowprops={"arrowstyle": "-", "color": "0.3"}, zorder=6,
        )  # fmt: skip
    name = GROUP_LABELS.get(group, group)
    if distance.min() > CLEARANCE_TOP_MM:
        axes.text(0.5, 0.5, f"never nearer than {distance.min():.0f} mm", ha="center",
                  transform=axes.transAxes, fontsize=11, color=color)  # fmt: skip
    axes.set_ylabel(f"{name}\n[mm]", fontsize=10)
    drawing.plain(axes)


def _worst(time_s: Array, distance: Array, total_s: float) -> list[int]:
    """Return the samples with the least distances that are apart in time."""
    found: list[int] = []
    left = np.ones(len(time_s), dtype=bool)
    while len(found) < len(LABEL_HEIGHTS) and np.any(left):
        i = int(np.argmin(np.where(left, distance, np.inf)))
        found.append(i)
        left &= np.abs(time_s - time_s[i]) > APART * total_s
    return found
