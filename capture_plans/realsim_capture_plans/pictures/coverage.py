"""A capture plan as pictures."""

from pathlib import Path
from typing import Any

import numpy as np

from realsim_capture_plans.planning.record import CapturePlan


def plan_picture(plan: CapturePlan, path: Path | str) -> None:
    """Draw the views' directions seen from above, in tour order, as a PNG.

    The radius of the polar plot is the angle from straight above; colour is the distance.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    directions = plan.directions()
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    from_top = 90.0 - np.degrees(np.arcsin(np.clip(directions[:, 2], -1.0, 1.0)))
    distance = np.linalg.norm(plan.Ts_base_cam[:, :3, 3] - plan.center_world, axis=-1)
    figure = Figure(figsize=(7.0, 7.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes: Any = figure.add_subplot(projection="polar")
    axes.plot(azimuth, from_top, color="0.75", linewidth=0.8, zorder=1)
    for k, _ in plan.vias:
        axes.plot(azimuth[max(k - 1, 0) : k + 1], from_top[max(k - 1, 0) : k + 1], "r--", zorder=2)
    dots = axes.scatter(azimuth, from_top, c=distance, cmap="viridis", s=36, zorder=3)
    top = plan.reference_view
    axes.scatter(azimuth[top], from_top[top], s=160, facecolors="none", edgecolors="k", zorder=4)
    axes.set_rlim(0.0, 90.0)
    axes.set_rlabel_position(22.5)
    figure.colorbar(dots, ax=axes, label="distance to the scene centre [m]", shrink=0.7)
    m = plan.metrics
    hole = f", greatest hole {m['hole_deg']:.1f} deg" if "hole_deg" in m else ""
    axes.set_title(
        f"{len(plan)} {plan.kind} views, {plan.robot}{hole}\n"
        f"{m['seconds']:.0f} s of motion, dashed: over via points, ring: reference view\n"
        "radius: angle from straight above [deg]; the base is towards 180 deg"
    )
    figure.savefig(str(path), dpi=120)
