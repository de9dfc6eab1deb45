"""All pictures of a plan: a handful of PNGs that say at a glance whether to drive it.

The views: where they are, with the holes between them, and what they are worth.
"""

from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim_capture_plans.pictures.arm_chart import arm_chart
from realsim_capture_plans.pictures.drawing import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    PlanCurves,
    new_figure,
    plain,
    save_png,
)
from realsim_capture_plans.pictures.motion_charts import clearance_chart, joints_chart
from realsim_capture_plans.planning import view_quality
from realsim_capture_plans.planning.record import CapturePlan

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
    hole = view_quality.nearest_deg(directions, target.reshape(-1, 3)).reshape(target.shape[:2])
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
    return view_quality.hole_deg(curves.plan.directions(), curves.plan.config.elevation_deg)


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


BINS = 24
GOOD_IN_VIEW = 0.9
"""Share of the scene in the image from which on a view misses nothing that matters."""


def quality_chart(curves: PlanCurves) -> Any:
    """Return the figure: histograms of what the views are worth."""
    plan, sensor = curves.plan, curves.sensor
    figure = new_figure(11.5, 7.0)
    axes = figure.subplots(2, 3).ravel()
    radius = np.linalg.norm(plan.Ts_base_cam[:, :3, 3] - plan.center_world, axis=-1)
    noise_mm = 1000 * sensor.depth_noise(view_quality.centre_depth(plan))
    in_view = view_quality.seen(plan, view_quality.scene_points(plan), sensor).mean(axis=1)
    _histogram(axes[0], radius, BLUE, "camera to the scene's centre [m]")
    _histogram(axes[1], noise_mm, ORANGE, f"depth noise at the centre [mm], {sensor.name}")
    _histogram(axes[2], 100 * in_view, GREEN, "share of the scene in the image [%]",
               line=(100 * GOOD_IN_VIEW, "good"))  # fmt: skip
    sigma = plan.chain.sigma_min(plan.joints)
    _histogram(axes[3], sigma, PURPLE, "least singular value of the Jacobian",
               line=(plan.config.sigma_min, "required"))  # fmt: skip
    if len(plan) > 1:
        spacing = view_quality.spacing_deg(plan.directions())
        _histogram(axes[4], spacing, SKY, "angle to the nearest other view [deg]")
        _histogram(
            axes[5], view_quality.parallax_deg(plan), RED, "angle between consecutive views [deg]"
        )
    else:
        axes[4].set_axis_off()
        axes[5].set_axis_off()
    figure.suptitle(
        f"What the {len(plan)} views are worth (solid line: median, dashed: required or good)",
        fontsize=12,
    )
    return figure


def _histogram(
    axes: Any, values: Array, color: str, label: str, line: tuple[float, str] | None = None
) -> None:
    """Draw how many views have which value, the median, and a limit."""
    axes.hist(values, bins=BINS, color=color, alpha=0.75)
    middle = float(np.median(values))
    axes.axvline(middle, color=BLACK, linewidth=1.5, label=f"median {middle:.3g}")
    if line is not None:
        axes.axvline(line[0], color=RED, linestyle="--", linewidth=1.5,
                     label=f"{line[1]} {line[0]:g}")  # fmt: skip
    axes.set_xlabel(label)
    axes.set_ylabel("views")
    axes.set_title(f"from {values.min():.3g} to {values.max():.3g}", fontsize=9, color="0.3")
    axes.legend(fontsize=8)
    axes.yaxis.get_major_locator().set_params(integer=True)
    plain(axes)


def board_chart(curves: PlanCurves) -> Any:
    """Return the figure of a calibration plan: roll, tilt, distance, places in the image."""
    figure = new_figure(12.5, 5.4)
    grid = figure.add_gridspec(1, 2, width_ratios=[1, 1.45])
    draw_rolls(figure, figure.add_subplot(grid[0], projection="polar"), curves)
    _draw_outlines(figure.add_subplot(grid[1]), curves)
    m = curves.metrics
    gap = m.get("roll_gap_deg", view_quality.board_views(curves.plan).roll_gap_deg)
    figure.suptitle(
        f"{len(curves.plan)} calibration views: widest gap between rolls {gap:.0f}° "
        f"(should be below {720 / len(curves.plan):.0f}°)",
        fontsize=12,
    )
    return figure


def draw_rolls(figure: Any, axes: Any, curves: PlanCurves) -> None:
    """Draw every view by its roll (angle) and tilt (radius), coloured by its distance."""
    board = view_quality.board_views(curves.plan)
    dots = axes.scatter(
        np.radians(board.roll_deg), board.tilt_deg, c=1000 * board.distance_m, cmap="viridis",
        s=46, edgecolors="white", linewidths=0.5, zorder=3,
    )  # fmt: skip
    axes.set_rlim(0.0, max(50.0, 1.1 * float(board.tilt_deg.max())))
    axes.set_rlabel_position(100.0)
    axes.set_title("angle: roll of the board in the image\nradius: tilt [deg]", fontsize=10)
    figure.colorbar(dots, ax=axes, shrink=0.75, pad=0.1, label="distance to the board [mm]")


def _draw_outlines(axes: Any, curves: PlanCurves) -> None:
    """Draw where the board's area lies in every image."""
    plan, camera = curves.plan, curves.sensor.intrinsics
    box = view_quality.scene_box(plan)
    (x0, y0, _), (x1, y1, _), z = box.lower, box.upper, float(plan.center_world[2])
    corners = np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z], [x0, y0, z]])
    to_cam = se3.invert(plan.Ts_base_cam)
    uv = project(camera, se3.transform(to_cam, corners))
    centre = project(camera, se3.transform(to_cam, plan.center_world[None]))[:, 0]
    for k, outline in enumerate(uv):
        axes.plot(*outline.T, color=BLUE, alpha=0.35, linewidth=0.9,
                  label="keep-out box's footprint" if k == 0 else None)  # fmt: skip
    axes.scatter(*centre.T, s=26, color=RED, zorder=4, label="board's centre")
    w, h = camera.width, camera.height
    axes.plot([0, w, w, 0, 0], [0, 0, h, h, 0], color=BLACK, linewidth=2.0, label="image")
    axes.set_xlim(-0.35 * w, 1.35 * w)
    axes.set_ylim(1.45 * h, -0.45 * h)
    axes.set_aspect("equal")
    axes.set_xlabel("u [px]")
    axes.set_ylabel("v [px]")
    axes.set_title(f"the board's area in every image ({curves.sensor.name})", fontsize=10)
    axes.legend(fontsize=8, loc="upper right")
    plain(axes)


def plan_pictures(
    plan: CapturePlan, folder: Path | str, metrics: dict[str, float] | None = None
) -> list[Path]:
    """Write a plan's pictures into a folder and return their paths.

    `coverage.png` (of a calibration plan `board.png`), `arm.png`, `joints.png`, `clearance.png`,
    `views.png`.

    Args:
        plan: the plan.
        folder: where to; made as needed.
        metrics: those of `plan_metrics`; computed where not given.

    Raises:
        InputError: the mount's camera is not known.
    """
    curves = PlanCurves.of(plan, metrics)
    first = ("board", board_chart) if plan.kind == "calibration" else ("coverage", coverage_chart)
    charts: dict[str, Any] = {
        first[0]: first[1],
        "arm": arm_chart,
        "joints": joints_chart,
        "clearance": clearance_chart,
        "views": quality_chart,
    }
    return [save_png(draw(curves), Path(folder) / f"{name}.png") for name, draw in charts.items()]
