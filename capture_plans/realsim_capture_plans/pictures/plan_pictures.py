"""All pictures of a plan: a handful of PNGs that say at a glance whether to drive it."""

from pathlib import Path
from typing import Any

from realsim_capture_plans.pictures.arm_chart import arm_chart
from realsim_capture_plans.pictures.drawing import PlanCurves, save_png
from realsim_capture_plans.pictures.motion_charts import clearance_chart, joints_chart
from realsim_capture_plans.pictures.view_charts import board_chart, coverage_chart, quality_chart
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
