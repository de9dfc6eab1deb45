"""What all pictures share: colours, figures without a screen, arrays that are drawn."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.pages.plots import png
from realsim.store.atomic import write_bytes
from realsim_capture_plans.planning.metrics import plan_metrics
from realsim_capture_plans.planning.record import CapturePlan
from realsim_capture_plans.planning.tour_time import TourSamples, TourTime
from realsim_capture_plans.planning.view_quality import Sensor, sensor_of

BLUE, ORANGE, GREEN, RED = "#0072B2", "#E69F00", "#009E73", "#D55E00"
SKY, PURPLE, BLACK, GREY = "#56B4E9", "#CC79A7", "#000000", "#8C8C8C"
"""Okabe and Ito's colours, told apart by the colour-blind; RED is their vermillion."""
JOINT_COLORS = (BLUE, ORANGE, GREEN, RED, SKY, PURPLE, BLACK)
GROUP_COLORS = {"self": BLUE, "tool": PURPLE, "table": GREEN, "scene": ORANGE}
DPI = 110
"""A picture 11 inches wide fills a laptop's screen and is some 100 kB."""


def new_figure(width_in: float, height_in: float) -> Any:
    """Return a matplotlib figure of its own canvas; nothing global is touched."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_png(figure: Any, path: Path | str) -> Path:
    """Write the figure as a PNG, whole or not at all, and return where."""
    write_bytes(path, png(figure))
    return Path(path)


def plain(axes: Any) -> None:
    """Take away the frame's upper and right side and draw a faint grid."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PlanCurves:
    """A plan with what is drawn of it."""

    plan: CapturePlan
    metrics: dict[str, float]
    sensor: Sensor
    tour: TourTime
    samples: TourSamples
    """Configurations along the tour, as moves are checked."""
    clearance: dict[str, Array]
    """Per group (M,) [m] at the samples."""

    @classmethod
    def of(cls, plan: CapturePlan, metrics: dict[str, float] | None = None) -> "PlanCurves":
        """Return the arrays of a plan; metrics that are not given are computed."""
        model = plan.collision_model()
        sensor = sensor_of(plan)
        tour = TourTime.of(plan)
        samples = tour.samples(plan.config.edge_step_rad)
        found = model.clearance(samples.joints)
        return cls(
            plan=plan,
            metrics=plan_metrics(plan, model, sensor=sensor) if metrics is None else metrics,
            sensor=sensor,
            tour=tour,
            samples=samples,
            clearance={g: d for g, d in found.items() if np.any(np.isfinite(d))},
        )
