"""What the views are worth: distances and depth noise, field of view, dexterity, spacing."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim_capture_plans.pictures.curves import PlanCurves
from realsim_capture_plans.pictures.drawing import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    new_figure,
    plain,
)
from realsim_capture_plans.planning.view_quality import (
    board_views,
    parallax_deg,
    scene_box,
    spacing_deg,
)

Array = NDArray[np.float64]
BINS = 24
GOOD_IN_VIEW = 0.9
"""Share of the scene in the image from which on a view misses nothing that matters."""


def quality_chart(curves: PlanCurves) -> Any:
    """Return the figure: histograms of what the views are worth."""
    plan, config = curves.plan, curves.plan.config
    figure = new_figure(11.5, 7.0)
    axes = figure.subplots(2, 3).ravel()
    noise_mm = 1000 * curves.depth_noise_m
    _histogram(axes[0], curves.radius_m, BLUE, "camera to the scene's centre [m]")
    _histogram(axes[1], noise_mm, ORANGE, f"depth noise at the centre [mm], {curves.sensor.name}")
    _histogram(axes[2], 100 * curves.in_view, GREEN, "share of the scene in the image [%]",
               line=(100 * GOOD_IN_VIEW, "good"))  # fmt: skip
    _histogram(axes[3], curves.sigma, PURPLE, "least singular value of the Jacobian",
               line=(config.sigma_min, "required"))  # fmt: skip
    if len(plan) > 1:
        spacing = spacing_deg(plan.directions())
        _histogram(axes[4], spacing, SKY, "angle to the nearest other view [deg]")
        _histogram(axes[5], parallax_deg(plan), RED, "angle between consecutive views [deg]")
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
    gap = m.get("roll_gap_deg", board_views(curves.plan).roll_gap_deg)
    figure.suptitle(
        f"{len(curves.plan)} calibration views: widest gap between rolls {gap:.0f}° "
        f"(should be below {720 / len(curves.plan):.0f}°)",
        fontsize=12,
    )
    return figure


def draw_rolls(figure: Any, axes: Any, curves: PlanCurves) -> None:
    """Draw every view by its roll (angle) and tilt (radius), coloured by its distance."""
    board = board_views(curves.plan)
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
    box = scene_box(plan)
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
