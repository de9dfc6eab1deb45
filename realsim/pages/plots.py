"""The one style of all plots: colours that colour-blind people tell apart, axes with units."""

import io
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from realsim.arrays import Int64

INK, MUTED, FAINT = "#22303c", "#8a99a8", "#dfe5ea"
GOOD, WARN, BAD = "#1b9e8a", "#e69f00", "#c8502f"
VERDICT_COLORS = {"accepted": GOOD, "doubtful": WARN, "rejected": BAD, "unchecked": MUTED}
SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
"""Colours of several series in one plot (Okabe and Ito, Color Universal Design, 2008)."""
AXIS_COLORS = ("#c8553d", "#4c9a3f", "#2b6ca3")
"""x, y, z of a frame."""
STYLES = ("-", "--", "-.", ":", "-", "--")
"""Lines of several series: colour is never the only difference."""
MARKERS = ("o", "s", "^", "D", "v", "P")
WIDTH_PX, HEIGHT_PX = 530, 300
"""Size of a plot on the page: two stand side by side."""
WIDE_PX = 1060
"""Width of a plot that takes the whole page."""
BAR_PX = 26
"""Height of a bar with a name."""
PIXELS_A_POINT = 2
"""Pixels of the picture for one of the page: plots are sharp on fine screens, too."""
DPI = 100


def figure(width_px: float = WIDTH_PX, height_px: float = HEIGHT_PX) -> Any:
    """Return an empty figure whose axes will not overlap; nothing global is touched."""
    from matplotlib.figure import Figure

    size = (width_px / DPI, height_px / DPI)
    return Figure(figsize=size, dpi=PIXELS_A_POINT * DPI, layout="constrained")


def axes(
    title: str = "", x: str = "", y: str = "", *,
    height_px: float = HEIGHT_PX, width_px: float = WIDTH_PX,
) -> tuple[Any, Any]:  # fmt: skip
    """Return a figure and its axes, titled, without the frame that nobody reads."""
    drawn = figure(width_px, height_px)
    ax = plain(drawn.add_subplot(1, 1, 1))
    titled(ax, title, x, y)
    return drawn, ax


def columns(count: int, height_px: float = HEIGHT_PX) -> tuple[Any, list[Any]]:
    """Return a figure as wide as the page and `count` axes side by side."""
    drawn = figure(WIDE_PX, height_px)
    return drawn, [plain(drawn.add_subplot(1, count, k + 1)) for k in range(count)]


def plain(ax: Any) -> Any:
    """Return axes without the upper and the right side of their frame."""
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_color(MUTED)
    ax.tick_params(colors=INK, labelsize=9)
    return ax


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


def share_bars(ax: Any, counts: Int64, title: str, x: str, y: str) -> None:
    """Draw how many values lie in each of equal bins from 0 to 1, those below 0.5 red."""
    width = 1 / len(counts)
    left = width * np.arange(len(counts))
    colors = [GOOD if edge >= 0.5 - 1e-9 else BAD for edge in left]
    ax.bar(left, counts, 0.94 * width, align="edge", color=colors)
    ax.set_xlim(-0.02, 1.02)
    whole_numbers(ax.yaxis)
    titled(ax, title, x, y)


def bars(
    names: Sequence[str], values: Sequence[float], colors: str | Sequence[str], title: str, x: str
) -> tuple[Any, Any]:
    """Return a figure and its axes with a named horizontal bar a row, the first one on top."""
    drawn, ax = axes(title, x, height_px=90 + BAR_PX * max(3, len(names)))
    ax.barh(range(len(names)), values, 0.7, color=colors)
    ax.set_yticks(range(len(names)), names)
    ax.invert_yaxis()
    return drawn, ax


def png(drawn: Any, software: str | None = None, paper: str = "white") -> bytes:
    """Return the figure as PNG, which names its maker; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    engine = drawn.get_layout_engine()
    with warnings.catch_warnings():
        # A name in a script that the font has not got is drawn as boxes; the tables spell it.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        if engine is not None:  # once: savefig would draw all of it in vain before
            engine.execute(drawn)
            drawn.set_layout_engine(None)
        drawn.savefig(buffer, format="png", facecolor=paper, metadata={"Software": software})
    return buffer.getvalue()
