"""The Robot School's picture sheet: what became of all grasps of a scene, and object by object.

Above, how many candidates are left after each stage, and how p_hold (else the score) and margins
are distributed; below, every object with its grasps as small hands, red to green by the same label,
dashed where it is of few draws.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from realsim.arrays import Array, Int64
from realsim.errors import InputError
from realsim.models.model_picture_views import INK, MUTED, PAPER
from realsim.pages.plots import png
from realsim.records import GraspSet, ObjectModel
from realsim.records.grasps import label_words
from realsim.rendering.overlay import score_hex, score_rgb
from realsim_sim_bridge.school import sheet_object
from realsim_sim_bridge.school.measure_statistics import LABEL_BINS, joined, label_chart, mean_label

WIDTH_PX = 1600
DPI = 100
MARGIN_PX = 28
TITLE_PX = 64
CHARTS_PX = 270
LEGEND_PX = 46
OBJECT_PX = 372
"""Height of one object [px]."""
FEW = 6
"""Up to so many objects stand three in a row, more four."""
MOST_OBJECTS = 60
"""Objects on one sheet: 15 rows, and a picture of 6,000 pixels."""
BAR = 0.94 / LABEL_BINS
"""Width of a histogram's bar."""
LEFT_AFTER = ("candidates", "trajectory", "close", "lift", "oscillate", "pendulum")
BAR_COLOR = "#5b7f95"
ROOM, PAD = 0.35, 0.015
"""Share of a chart's width that a number takes, and that is left beside it."""


def school_sheet(
    sets: Sequence[GraspSet],
    models: Mapping[int, ObjectModel],
    *,
    title: str = "Robot School",
    Ts_up_obj: Mapping[int, Array] | None = None,
) -> bytes:
    """Return the sheet as the content of a PNG file, 1600 px wide; the same sets, the same bytes.

    Args:
        sets: the grasps of a scene, one set per object instance.
        models: the objects by id.
        title: of the sheet.
        Ts_up_obj: (4, 4) pose of an object in a frame whose z axis is up [m], by instance, such as
            the table's; of others the object's own z axis is drawn upwards.

    Raises:
        InputError: an object has no model, or there are more than 60.
    """
    return png(sheet_figure(sets, models, title, Ts_up_obj or {}), paper=PAPER)


def sheet_figure(
    sets: Sequence[GraspSet],
    models: Mapping[int, ObjectModel],
    title: str,
    Ts_up_obj: Mapping[int, Array],
) -> Any:
    """Return the sheet as a figure of Matplotlib; arguments as of `school_sheet`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    _require_models(sets, models)
    columns = 3 if len(sets) <= FEW else 4
    rows = -(-len(sets) // columns)
    top = TITLE_PX + CHARTS_PX + LEGEND_PX
    height = top + rows * OBJECT_PX + MARGIN_PX
    figure = Figure(figsize=(WIDTH_PX / DPI, height / DPI), dpi=DPI, facecolor=PAPER)
    FigureCanvasAgg(figure)
    _title(figure, sets, title)
    _charts(figure, sets)
    _legend(figure, TITLE_PX + CHARTS_PX, sets)
    names = sheet_object.names_of_sets(sets, {i: m.name for i, m in models.items()})
    width = (WIDTH_PX - 2 * MARGIN_PX) / columns
    for k, (s, name) in enumerate(zip(sets, names, strict=True)):
        row, column = divmod(k, columns)
        box = (
            MARGIN_PX + column * width + 8, top + row * OBJECT_PX, width - 16, OBJECT_PX - 22,
        )  # fmt: skip
        T_up_obj = Ts_up_obj.get(s.instance, np.eye(4))
        sheet_object.draw_object(figure, box, s, models[s.obj_id].mesh, name, T_up_obj)
    return figure


def _require_models(sets: Sequence[GraspSet], models: Mapping[int, ObjectModel]) -> None:
    """Check that every object can be drawn."""
    without = sorted({s.obj_id for s in sets} - set(models))
    if without:
        raise InputError(
            f"object {without[0]} has grasps but no model; there are: "
            f"{', '.join(map(str, sorted(models))) or 'none'}."
        )
    if len(sets) > MOST_OBJECTS:
        raise InputError(
            f"{len(sets)} objects; one sheet shows {MOST_OBJECTS}. Give a scene at a time."
        )


def _title(figure: Any, sets: Sequence[GraspSet], title: str) -> None:
    """Write the title and the figures of the scene."""
    sheet_object.text_at(figure, MARGIN_PX, 34, title[:70], 19, INK, bold=True)
    scores = joined([s.scores for s in sets])
    known = scores[~np.isnan(scores)]
    plural = "" if len(sets) == 1 else "s"
    said = f"{len(sets)} object{plural}, {len(scores):,} candidates"
    if len(known):
        said += f", {100 * np.mean(known >= 0.5):.1f} % good, mean {mean_label(sets)}"
    sheet_object.text_at(figure, WIDTH_PX - MARGIN_PX, 34, said, 13, MUTED, align="right")


def _charts(figure: Any, sets: Sequence[GraspSet]) -> None:
    """Draw the stages' attrition, and the distributions of scores and margins."""
    margins = joined([s.measures["margin"] for s in sets if "margin" in s.measures])
    margins = margins[~np.isnan(margins)]
    charts: list[Any] = [_attrition, _label_histogram]
    if len(margins):
        charts.append(_margin_histogram)
    width = (WIDTH_PX - 2 * MARGIN_PX) / len(charts)
    for k, chart in enumerate(charts):
        left = MARGIN_PX + k * width + (98 if k == 0 else 62)
        right = MARGIN_PX + (k + 1) * width - 30
        chart(_chart_axes(figure, (left, TITLE_PX + 34, right - left, CHARTS_PX - 96)), sets)


def _chart_axes(figure: Any, box: sheet_object.Box) -> Any:
    ax = sheet_object.axes_at(figure, box)
    ax.set_facecolor(PAPER)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        ax.spines[side].set_color(MUTED)
    ax.tick_params(labelsize=9.5, colors=MUTED, length=3)
    return ax


def _named(ax: Any, title: str, below: str, beside: str = "") -> None:
    """Write the title of a chart and of its axes."""
    ax.set_title(title, fontsize=12, color=INK, loc="left", pad=10)
    ax.set_xlabel(below, fontsize=10, color=MUTED)
    ax.set_ylabel(beside, fontsize=10, color=MUTED)


def left_after(sets: Sequence[GraspSet]) -> Int64:
    """Return how many candidates are left: all, with a trajectory, and after each stage."""
    stops = joined([sheet_object.stops_of(s) for s in sets])
    return np.array(
        [len(stops), *(int(np.sum(stops > k)) for k in range(1, len(sheet_object.STOPS) - 1))]
    )


def _attrition(ax: Any, sets: Sequence[GraspSet]) -> None:
    """Draw how many candidates are left after each stage, and what the stage took."""
    counts = left_after(sets)
    lost = -np.diff(counts, prepend=counts[0])
    places = np.arange(len(counts))[::-1]
    ax.barh(places, counts, height=0.72, color=BAR_COLOR)
    untried = int(np.sum(joined([sheet_object.stops_of(s) for s in sets]) == 0))
    taken = [0, lost[1] - untried, *lost[2:]]
    colors = [color for _, color in sheet_object.STOPS[:-1]]
    ax.barh(places, taken, left=counts, height=0.72, color=colors)
    ax.barh(places[1], untried, left=counts[0] - untried, height=0.72, color=colors[0])
    most = max(1, counts[0])
    for place, count, loss, color in zip(places, counts, taken, colors, strict=True):
        said = f"{count:,}  ({100 * count / most:.0f} %)"
        # In the bar, in what the stage took, or beside both: wherever there is room.
        at, align, ink = count, "right", sheet_object.ink_on(BAR_COLOR)
        if count < ROOM * most:
            at, ink = count + loss, sheet_object.ink_on(color)
            if loss < ROOM * most:
                align, ink = "left", INK
        pad = PAD * most if align == "left" else -PAD * most
        ax.text(at + pad, place - 0.03, said, fontsize=10, color=ink, ha=align, va="center")
    ax.set_yticks(places, LEFT_AFTER, fontsize=10.5, color=INK)
    ax.set_xlim(0, most)
    ax.xaxis.get_major_locator().set_params(integer=True)
    _named(ax, "Left after each stage, and what it took", "grasps")


def _label_histogram(ax: Any, sets: Sequence[GraspSet]) -> None:
    """Draw how many of the tried grasps have which p_hold or score in ten bins."""
    counts, title, name = label_chart(sets)
    colors = [score_hex(x) for x in np.linspace(0, 1, LABEL_BINS)]
    _ten_bars(ax, counts, colors, title, name)


def _margin_histogram(ax: Any, sets: Sequence[GraspSet]) -> None:
    """Draw how many grasps have which margin: 1 = held at every friction and force tried."""
    margins = joined([s.measures["margin"] for s in sets if "margin" in s.measures])
    counts = np.histogram(margins[~np.isnan(margins)], LABEL_BINS, (0.0, 1.0))[0]
    _ten_bars(ax, counts, BAR_COLOR, "Margins over friction and force", "margin")


def _ten_bars(ax: Any, counts: Int64, colors: str | list[str], title: str, name: str) -> None:
    """Draw counts of ten equal bins from 0 to 1."""
    ax.bar(np.arange(LABEL_BINS) / LABEL_BINS, counts, BAR, align="edge", color=colors)
    ax.set_xlim(-0.02, 1.02)
    ax.set_xticks([0, 0.25, 0.5, 0.75, 1])
    ax.set_ylim(0, 1.18 * max(1, int(counts.max())))
    ax.yaxis.get_major_locator().set_params(integer=True)
    _named(ax, title, name, "grasps")


def _legend(figure: Any, top: float, sets: Sequence[GraspSet]) -> None:
    """Explain the colours of the bars and of the hands, in one line."""
    width = WIDTH_PX - 2 * MARGIN_PX
    ax = sheet_object.axes_at(figure, (MARGIN_PX, top, width, LEGEND_PX))
    middle = LEGEND_PX / 2 + 2
    at = _written(ax, 12.0, middle, "stopped at:", MUTED) + 14
    for label, color in sheet_object.STOPS:
        ax.add_patch(_swatch(at, middle, color))
        at = _written(ax, at + 20, middle, label, INK) + 18
    # From the right the hands, whose colours run with the label.
    few = "   dashed: few draws" if any(s.unsure.any() for s in sets) else ""
    at = _written(ax, width - 12, middle, f"1{few}", MUTED, "right") - 8
    ramp = score_rgb(np.linspace(0, 1, 64))[None]
    ax.imshow(ramp, extent=(at - 120, at, middle + 6, middle - 6), aspect="auto")
    _written(ax, at - 128, middle, f"hands by {label_words(sets)}:  0", MUTED, "right")
    ax.set_axis_off()
    ax.axhline(2, color="#d3d8de", linewidth=1)
    ax.set_xlim(0, width)
    ax.set_ylim(LEGEND_PX, 0)


def _written(
    ax: Any, at: float, middle: float, text: str, color: str, align: str = "left"
) -> float:
    """Write into axes whose unit is a pixel, and return the end of the text away from `at`."""
    written = ax.text(at, middle, text, fontsize=10.5, color=color, va="center", ha=align)
    width = float(written.get_window_extent(ax.figure.canvas.get_renderer()).width)
    return at + width if align == "left" else at - width


def _swatch(left: float, middle: float, color: str) -> Any:
    from matplotlib.patches import Rectangle

    return Rectangle((left, middle - 7), 14, 14, fc=color, ec="none")
