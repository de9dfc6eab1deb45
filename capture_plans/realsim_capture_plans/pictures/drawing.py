"""What all pictures share: colours, figures without a screen, files that are whole or not there."""

import io
from pathlib import Path
from typing import Any

from realsim.store.atomic import write_bytes

BLUE, ORANGE, GREEN, RED = "#0072B2", "#E69F00", "#009E73", "#D55E00"
SKY, PURPLE, BLACK, GREY = "#56B4E9", "#CC79A7", "#000000", "#8C8C8C"
"""Okabe and Ito's colours, told apart by the colour-blind; RED is their vermillion."""
JOINT_COLORS = (BLUE, ORANGE, GREEN, RED, SKY, PURPLE)
GROUP_COLORS = {"self": BLUE, "tool": PURPLE, "table": GREEN, "scene": ORANGE}
DPI = 110
"""A picture 11 inches wide fills a laptop's screen and is some 100 kB."""


def new_figure(width_in: float, height_in: float) -> Any:
    """Return a matplotlib figure of its own canvas; nothing global is touched."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_png(figure: Any, path: Path | str) -> Path:
    """Write the figure as a PNG, whole or not at all, and return where."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    write_bytes(path, buffer.getvalue())
    return Path(path)


def plain(axes: Any) -> None:
    """Take away the frame's upper and right side and draw a faint grid."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
