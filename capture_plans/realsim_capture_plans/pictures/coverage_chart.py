"""Where the views are: directions seen from above, with the holes between them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim_capture_plans.pictures.curves import PlanCurves
from realsim_capture_plans.pictures.drawing import BLACK, RED, new_figure
from realsim_capture_plans.planning.view_quality import hole_deg, nearest_deg

Array = NDArray[np.float64]
AZIMUTHS, TILTS = 361, 91
"""Cells of the map of holes: one degree each."""
HOLE_COLOR_DEG = 12.0
"""Holes from here on have the darkest colour; the goal for 256 views is 6 to 8 degrees."""
SPARE_COLOR = 1.2
"""Fewer views have greater holes: the scale goes on to this many times the greatest."""
MANY_VIEWS = 100
"""From here on dots are small."""


def coverage_chart(curves: PlanCurves) -> Any:
    """Return the figure: the hemisphere from above, coloured by the angle to the nearest view."""
    figure = new_figure(8.6, 8.4)
    draw_coverage(figure, figure.add_subplot(projection="polar"), curves)
    m, plan = curves.metrics, curves.plan
    low, high = plan.config.elevation_deg
    figure.suptitle(
        f"Coverage of {len(plan)} {plan.kind} views, {plan.robot}\n"
        f"greatest hole {_hole(curves):.1f}° over elevations {low:g}° to {high:g}°"
        + (f", {m['hole_cap_deg']:.1f}° from 15° up" if "hole_cap_deg" in m else ""),
        fontsize=13,
    )
    return figure


def draw_coverage(figure: Any, axes: Any, curves: PlanCurves) -> None:
    """Draw the map of holes, the views, the tour, its vias and the reference view."""
    plan = curves.plan
    directions = plan.directions()
    azimuth = np.radians(np.linspace(-180.0, 180.0, AZIMUTHS))
    tilt = np.linspace(0.0, 90.0, TILTS)
    grid = np.stack(np.meshgrid(azimuth, np.radians(tilt), indexing="xy"), -1)
    target = _unit(grid[..., 0], grid[..., 1])
    hole = nearest_deg(directions, target.reshape(-1, 3)).reshape(target.shape[:2])
    mesh = axes.pcolormesh(
        azimuth, tilt, hole, cmap="Blues", shading="gouraud", rasterized=True, vmin=0.0,
        vmax=max(HOLE_COLOR_DEG, SPARE_COLOR * _hole(curves)),
    )  # fmt: skip
    axes.grid(color="0.6", linewidth=0.4)

    at, from_top = _polar(directions)
    _draw_tour(axes, curves)
    size = 12 if len(plan) >= MANY_VIEWS else 30
    axes.scatter(at, from_top, s=size, color=BLACK, zorder=5, label="view")
    k = plan.reference_view
    axes.scatter(at[k], from_top[k], s=150, facecolors="none", edgecolors=BLACK, linewidths=1.8,
                 zorder=6, label="reference view")  # fmt: skip
    low, high = plan.config.elevation_deg
    inside = (tilt >= 90.0 - high) & (tilt <= 90.0 - low)
    if np.any(inside):
        row, column = np.unravel_index(np.argmax(np.where(inside[:, None], hole, -1)), hole.shape)
        axes.scatter(azimuth[column], tilt[row], s=130, marker="X", color=RED, edgecolors="white",
                     zorder=7, label=f"greatest hole, {_hole(curves):.1f}°")  # fmt: skip
    ring = np.radians(np.linspace(0.0, 360.0, 181))
    axes.plot(ring, np.full_like(ring, 90.0 - low), color=RED, linewidth=1.2, linestyle=":",
              zorder=3, label=f"least elevation asked for, {low:g}°")  # fmt: skip
    axes.set_rlim(0.0, 90.0)
    on_white = {"fc": "white", "ec": "none", "alpha": 0.8, "pad": 1}
    axes.set_rgrids(
        [30.0, 60.0, 90.0], ["60° up", "30° up", ""], angle=100.0, fontsize=8, bbox=on_white,
        zorder=8,
    )  # fmt: skip
    axes.set_thetagrids(
        [0, 45, 90, 135, 180, 225, 270, 315],
        ["+x,\naway\nfrom\nbase", "", "+y", "", "−x,\nto the\nbase", "", "−y", ""],
        fontsize=9,
    )
    axes.tick_params(axis="x", pad=9)
    bar = figure.colorbar(mesh, ax=axes, shrink=0.6, pad=0.07, extend="max")
    bar.set_label("angle to the nearest view [deg]")
    axes.legend(
        loc="upper center", bbox_to_anchor=(0.55, -0.07), ncols=3, fontsize=9, frameon=False
    )


def _draw_tour(axes: Any, curves: PlanCurves) -> None:
    """Draw the tour from view to view; moves over vias follow the camera's real way."""
    plan = curves.plan
    at, from_top = _polar(plan.directions())
    with_vias = {k for k, via in plan.vias if len(via)}
    label = "tour"
    for k in range(1, len(plan)):
        if k not in with_vias:
            ends = np.stack([plan.directions()[k - 1], plan.directions()[k]])
            a, r = _polar(_great_circle(ends[0], ends[1]))
            axes.plot(np.unwrap(a), r, color="0.35", linewidth=0.7, zorder=4, label=label)
            label = None
    label = "move over via points"
    for k in sorted(with_vias):
        q = curves.samples.joints[curves.samples.move == k]
        camera = (plan.chain.forward(q) @ plan.mount.T_ee_cam)[:, :3, 3] - plan.center_world
        a, r = _polar(camera / np.linalg.norm(camera, axis=-1, keepdims=True))
        axes.plot(np.unwrap(a), r, color=RED, linewidth=1.6, zorder=4, label=label)
        label = None
    axes.scatter(at[0], from_top[0], s=60, marker=">", color=RED, zorder=6, label="first view")


def _hole(curves: PlanCurves) -> float:
    """Return the greatest hole [deg], measured here where the metrics do not have it."""
    if "hole_deg" in curves.metrics:
        return curves.metrics["hole_deg"]
    return hole_deg(curves.plan.directions(), curves.plan.config.elevation_deg)


def _unit(azimuth: Array, from_top: Array) -> Array:
    """Return unit vectors (..., 3) of azimuths and angles from straight above [rad]."""
    s = np.sin(from_top)
    return np.stack([s * np.cos(azimuth), s * np.sin(azimuth), np.cos(from_top)], -1)


def _polar(directions: Array) -> tuple[Array, Array]:
    """Return azimuths [rad] and angles from straight above [deg] (N,) of unit vectors (N, 3)."""
    d = np.asarray(directions)
    return np.arctan2(d[:, 1], d[:, 0]), np.degrees(np.arccos(np.clip(d[:, 2], -1.0, 1.0)))


def _great_circle(start: Array, end: Array) -> Array:
    """Return unit vectors (12, 3) from one to another the short way."""
    part = np.linspace(0.0, 1.0, 12)[:, None]
    line = (1 - part) * start + part * end
    length = np.linalg.norm(line, axis=1, keepdims=True)
    return line / np.where(length > 1e-9, length, 1.0)
