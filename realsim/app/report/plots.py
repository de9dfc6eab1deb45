"""The style of all plots: colours that colour-blind people tell apart, axes with units."""

import io
import warnings
from typing import Any

INK, MUTED, GOOD, WARN, BAD = "#22303c", "#8a99a8", "#1b9e8a", "#e69f00", "#c8502f"
VERDICT_COLORS = {"accepted": GOOD, "doubtful": WARN, "rejected": BAD, "unchecked": MUTED}
SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
"""Of several sessions in one plot (Okabe and Ito, Color Universal Design, 2008)."""
STYLES = ("-", "--", "-.", ":", "-", "--")
"""Their lines: colour is never the only difference."""
MARKERS = ("o", "s", "^", "D", "v", "P")
WIDTH_PX = 530
"""Width of a plot on the page: two stand side by side."""
PIXELS_A_POINT = 2
"""Pixels of the picture for one of the page: plots are sharp on fine screens, too."""
DPI = 100


def axes(height_px: int = 300, width_px: int = WIDTH_PX) -> tuple[Any, Any]:
    """Return a figure and its axes without the frame that nobody reads."""
    from matplotlib.figure import Figure

    size = (width_px / DPI, height_px / DPI)
    figure = Figure(figsize=size, dpi=PIXELS_A_POINT * DPI, layout="constrained")
    ax = figure.add_subplot(1, 1, 1)
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_color(MUTED)
    ax.tick_params(colors=INK, labelsize=9)
    return figure, ax


def titled(ax: Any, title: str, x: str, y: str) -> None:
    """Write what the plot says, and what its axes are."""
    ax.set_title(title, fontsize=10, loc="left", color=INK)
    ax.set_xlabel(x, fontsize=9, color=INK)
    ax.set_ylabel(y, fontsize=9, color=INK)


def legend(ax: Any, **where: Any) -> None:
    """Add a legend without a frame."""
    ax.legend(fontsize=8, frameon=False, labelcolor=INK, **where)


def whole_numbers(*axis: Any) -> None:
    """Number axes of counts by whole numbers."""
    from matplotlib.ticker import MaxNLocator

    for a in axis:
        a.set_major_locator(MaxNLocator(integer=True, nbins=8))


def png(figure: Any) -> bytes:
    """Return the figure as PNG; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # A name in a script that the font has not got is drawn as boxes; the tables spell it.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        figure.savefig(buffer, format="png", facecolor="white", metadata={"Software": None})
    return buffer.getvalue()
