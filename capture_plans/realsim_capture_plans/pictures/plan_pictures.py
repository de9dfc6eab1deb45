"""All pictures of a plan: a handful of PNGs that say at a glance whether to drive it."""

from pathlib import Path
from typing import Any

from realsim_capture_plans.pictures.arm_chart import arm_chart, draw_arm
from realsim_capture_plans.pictures.drawing import PlanCurves, new_figure, save_png
from realsim_capture_plans.pictures.motion_charts import (
    clearance_chart,
    draw_clearance,
    joints_chart,
)
from realsim_capture_plans.pictures.view_charts import (
    board_chart,
    coverage_chart,
    draw_coverage,
    draw_rolls,
    quality_chart,
)
from realsim_capture_plans.planning.record import CapturePlan


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


def plan_picture(plan: CapturePlan, path: Path | str) -> None:
    """Write one picture with the essence: the views, the arm, the clearance that is least.

    Raises:
        InputError: the mount's camera is not known.
    """
    curves = PlanCurves.of(plan)
    figure = new_figure(13.5, 9.5)
    grid = figure.add_gridspec(2, 2, width_ratios=[1.15, 1], height_ratios=[2.6, 1])
    views: Any = figure.add_subplot(grid[0, 0], projection="polar")
    if plan.kind == "calibration":
        draw_rolls(figure, views, curves)
    else:
        draw_coverage(figure, views, curves)
    draw_arm(figure.add_subplot(grid[0, 1], projection="3d"), curves)
    least = min(curves.clearance, key=lambda group: float(curves.clearance[group].min()))
    bottom = figure.add_subplot(grid[1, :])
    draw_clearance(bottom, curves, least)
    bottom.set_xlabel("time of the tour [s]")
    m = curves.metrics
    how_far = f"greatest hole {m['hole_deg']:.1f}°" if "hole_deg" in m else (
        f"widest roll gap {m['roll_gap_deg']:.0f}°" if "roll_gap_deg" in m else ""
    )  # fmt: skip
    figure.suptitle(
        f"{len(plan)} {plan.kind} views, {plan.robot}: {how_far}, {m['seconds']:.0f} s of motion, "
        f"colliding legs: {m['colliding_legs']:.0f}, moves over vias: {m['moves_with_vias']:.0f}\n",
        fontsize=13,
    )
    save_png(figure, path)
