"""How the pictures of a calibration look: one paper, one ink, colours that the colour-blind see."""

import unicodedata
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.pages.plots import AXIS_COLORS, BAD, FAINT, GOOD, INK, MUTED, WARN

__all__ = ["AXIS_COLORS", "BAD", "FAINT", "GOOD", "INK", "MUTED", "WARN"]

BLUE, PALE = "#2b6ca3", "#a9c7e0"
ERROR_MAP = "viridis"
"""Colour map of errors: dark is small, bright is large."""
DPI = 140
PAGE_WIDTH_IN = 10.4
"""Width of a picture that fills the page [inch]."""
LABEL_LENGTH = 26
"""Characters of a file name beside a bar."""
FONT = "DejaVu Sans"
"""matplotlib's own font, the same on every machine; it has no Chinese, Japanese or Korean."""
NOT_DRAWN = "?"
"""Stands for a letter that the font lacks and that has no Latin form."""
SETTINGS: dict[str, Any] = {
    "font.family": FONT,
    "font.size": 8.5,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.titlecolor": INK,
    "axes.titleweight": "bold",
    "axes.titley": 1.0,  # looking for a place beside the ticks is a seventh of all drawing
    "axes.labelcolor": INK,
    "axes.edgecolor": MUTED,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "legend.frameon": False,
    "legend.fontsize": 7.5,
    "figure.facecolor": "white",
    "grid.color": FAINT,
    "grid.linewidth": 0.6,
    # File names may hold dollar signs, which are no formulas.
    "text.parse_math": False,
}


@contextmanager
def paper_style() -> Generator[None]:
    """Draw what is drawn inside in the report's style."""
    from matplotlib import rc_context

    with rc_context(cast(Any, SETTINGS)):
        yield


def new_figure(
    height_in: float, width_in: float = PAGE_WIDTH_IN, grid: tuple[int, int] = (1, 1),
    room: Sequence[float] = (0.7, 0.15, 0.5, 0.3, 0.8, 0.75),
) -> Any:  # fmt: skip
    """Return an empty figure for a grid of (rows, columns) of axes.

    `room` [inch] is left of, right of, below and above all, between columns and between rows: a
    layout that measures every label costs a third of all drawing.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), dpi=DPI)
    left, right, below, above, *gaps = room
    wide, high = width_in - left - right, height_in - below - above
    gaps = [
        g * n / (e - g * (n - 1)) for g, n, e in zip(gaps, grid[::-1], (wide, high), strict=True)
    ]
    edges = (left / width_in, below / height_in, 1 - right / width_in, 1 - above / height_in)
    figure.subplots_adjust(*edges, *gaps)
    return figure


def room_for(names: Iterable[str]) -> float:
    """Return the room that names beside bars need [inch]."""
    return 0.3 + 0.07 * max(map(len, names), default=0)


@cache
def _font_letters() -> frozenset[int]:
    """Return the characters that the font can draw."""
    from matplotlib.font_manager import findfont, get_font

    return frozenset(get_font(findfont(FONT)).get_charmap())


def drawable(text: str) -> str:
    """Return a text with letters that the font lacks in their Latin form, or as "?"."""
    letters = _font_letters()
    drawn: list[str] = []
    for c in text:
        if ord(c) in letters or not c.isprintable():
            drawn.append(c)
            continue
        plain = unicodedata.normalize("NFKD", c).encode("ascii", "ignore").decode()
        drawn.append(plain or NOT_DRAWN)
    return "".join(drawn)


def view_label(label: str, index: int) -> str:
    """Return how a picture names a view: its label, or its index where that cannot be drawn."""
    drawn = drawable(label)
    lost = drawn.count(NOT_DRAWN) > label.count(NOT_DRAWN)
    return f"view {index}" if lost else short_label(drawn)


def short_label(text: str, length: int = LABEL_LENGTH) -> str:
    """Return a name on one line that can be drawn, its middle left out where it is long."""
    line = drawable("".join(c if c.isprintable() else " " for c in " ".join(text.split())))
    if len(line) <= length:
        return line
    tail = (length - 1) // 2
    return f"{line[: length - 1 - tail]}…{line[-tail:]}"


def round_number(value: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is not above a positive value."""
    if not np.isfinite(value) or value <= 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(m * power for m in (1.0, 2.0, 5.0) if m * power <= value * (1 + 1e-9)))


def image_axes(ax: Any, width: int, height: int) -> None:
    """Make axes an image plane: pixels, y down, the image's border drawn."""
    ax.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
    ax.set(xlabel="u [px]", ylabel="v [px]")
    ax.spines[["top", "right"]].set_visible(True)


def grid(ax: Any, axis: str = "both") -> None:
    """Draw the lines of a grid behind what is plotted."""
    ax.grid(axis=axis)
    ax.set_axisbelow(True)


def draw_arrows(
    ax: Any, at: ArrayLike, arrows: ArrayLike, width_px: float, **looks: Any
) -> tuple[Any, float]:
    """Draw arrows (n, 2) [px] enlarged on an image plane, with a key; return quiver and factor.

    The factor is round and makes the 95th percentile about a twentieth of the image's width.
    """
    at, arrows = np.asarray(at, dtype=np.float64), np.asarray(arrows, dtype=np.float64)
    lengths = np.linalg.norm(arrows, axis=-1)
    usual = float(np.percentile(lengths, 95)) if len(lengths) else 0.0
    factor = round_number(width_px / 20 / max(usual, 1e-9))
    moved = factor * arrows
    quiver = ax.quiver(
        at[:, 0], at[:, 1], moved[:, 0], moved[:, 1], *([lengths] if "cmap" in looks else []),
        angles="xy", scale_units="xy", scale=1.0, **looks,
    )  # fmt: skip
    key = round_number(0.99 * width_px / 12 / factor)
    ax.quiverkey(
        quiver, 0.83, 1.045, factor * key, f"{key:g} px", labelpos="E", coordinates="axes",
        color=INK, labelcolor=INK, fontproperties={"size": 7.5},
    )  # fmt: skip
    return quiver, factor


def color_bar(figure: Any, artist: Any, ax: Any, label: str) -> Any:
    """Add a slim colour bar, as tall as the axes."""
    if ax.name == "rectilinear":
        bar = figure.colorbar(artist, cax=ax.inset_axes((1.02, 0.0, 0.025, 1.0)))
    else:
        bar = figure.colorbar(artist, ax=ax, shrink=0.75, aspect=28, pad=0.1)
    bar.set_label(label, color=INK)
    bar.outline.set_visible(False)
    return bar


def empty_axes(ax: Any, text: str) -> None:
    """Say in the place of a plot why there is none."""
    ax.set_axis_off()
    ax.text(0.5, 0.5, text, ha="center", va="center", color=MUTED, transform=ax.transAxes)


def joined(arrays: Iterable[Array]) -> Array:
    """Return pairs of numbers (n, 2) of some views, one after the other."""
    return np.concatenate([np.zeros((0, 2)), *arrays])


def finite(values: Sequence[float] | Array) -> Array:
    """Return the finite ones of some numbers."""
    array = np.asarray(values, dtype=np.float64)
    return array[np.isfinite(array)]
