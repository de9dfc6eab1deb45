"""Where everything goes on a sheet: target, quiet zone, rulers, axes and text.

From the page's edge inwards: what printers leave white, a ruler along the left and the bottom edge,
the text (at the bottom, or up the right side where that makes room), the arrows of the axes, the
quiet zone, the target. All in millimetres from the top left corner of the page, y down.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from realsim.records import CharucoBoard, Chessboard, CircleGrid, TagBoard, Target
from realsim_calibration.sheets.artwork import Artwork, dot_diameters_m, quiet_zone_m
from realsim_calibration.sheets.drawing import (
    POINT_MM,
    Area,
    Font,
    Label,
    Line,
    Page,
    text_width_mm,
    wrap,
)
from realsim_calibration.targets.target_text import describe, format_target

Place = Literal["bottom", "side"]
Mark = Line | Area | Label

EDGE_MM = 6.0
"""White that is left at the page's edge: office printers cannot print on the outer 4 to 5."""
RULER_MM = 7.0
"""Depth of a ruler with its numbers."""
LEAST_RULER_MM = 100.0
"""Shortest ruler: a reading error of 0.2 mm is then 0.2 % of scale."""
AXIS_MM = 5.0
"""Depth of the strip in which an axis's arrow lies."""
LEAST_QUIET_MM = 5.0
"""Least white around the target, whatever its kind: thinner borders vanish under blur."""
ARROW_MM = 14.0
"""Length of an axis's arrow."""
LINE_MM = 0.18
"""Width of thin lines: the thinnest that office printers draw without gaps."""
TITLE_PT = 9.0
"""Size of the first line of text."""
TEXT_PT = 7.5
"""Size of the other lines: the smallest that is read without effort."""
NUMBER_PT = 6.5
"""Size of a ruler's numbers."""
TEXT_GAP_MM = 2.0
"""White between the text and what is beside it."""
CUT_GAP_MM = 1.0
"""White between a cut mark and the corner that it marks: a cut there leaves no black."""
PREVIEW_PX = 1600
"""Longer side of the picture for the screen [px]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Ruler:
    """A ruler along an edge of the page."""

    zero_mm: tuple[float, float]
    """Where its zero is, on its base line."""
    length_mm: float
    upward: bool
    """Whether it runs up the page; else to the right."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Layout:
    """A target that fits its page."""

    page_mm: tuple[float, float]
    origin_mm: tuple[float, float]
    """Origin of the board frame."""
    quiet_mm: tuple[float, float, float, float]
    """Left, top, right and bottom of the target with its quiet zone."""
    rulers: tuple[Ruler, Ruler]
    """Along the bottom and along the left edge."""
    text: list[tuple[str, Font, float]]
    """Lines with their fonts and sizes [pt]."""
    place: Place


def sheet_text(target: Target, rulers: tuple[Ruler, Ruler]) -> list[str]:
    """Return the paragraphs of the sheet; the second one is the line that names the target."""
    x, y = target.size_m
    origin = {
        TagBoard: "the top left corner of the top left tag",
        CharucoBoard: "the outer corner of the first field",
        Chessboard: "the first inner corner",
        CircleGrid: "the centre of the first dot",
    }[type(target)]
    extent = {
        TagBoard: "outer edges of the tags",
        CharucoBoard: "outer edges of the fields",
        Chessboard: "outermost inner corners",
        CircleGrid: "centres of the outermost dots",
    }[type(target)]
    facts = f"Check the target too: {extent} are {1000 * x:.6g} mm (x) by {1000 * y:.6g} mm (y)"
    facts += " apart."
    if isinstance(target, CircleGrid):
        usual, first = dot_diameters_m(target)
        facts += f" Dots are {1000 * usual:.4g} mm wide"
        facts += f", the first {1000 * first:.4g} mm." if target.large_origin else "."
    bottom, left = (f"{ruler.length_mm:g} mm" for ruler in rulers)
    return [
        describe(target),
        format_target(target),
        f"Print at 100 %, never fitted to the page. Measure the rulers: {bottom} along the "
        f"bottom, {left} up the left edge. If a print is off, multiply the target's lengths by "
        "measured / nominal, or print again.",
        f"{facts} Frame: origin at {origin} (at the marks 0), x along the columns, y along "
        "the rows, z into the paper. Glue the sheet to a flat, stiff plate.",
    ]


def lay_out(
    target: Target, artwork: Artwork, page_mm: tuple[float, float], place: Place, cut_marks: bool
) -> Layout | None:
    """Return where everything goes on a page, None if it does not fit."""
    width, height = page_mm
    corner = (EDGE_MM + RULER_MM, height - EDGE_MM - RULER_MM)
    lengths = [math.floor(v / 10 + 1e-9) * 10.0 for v in (width - EDGE_MM - corner[0] - 2,
                                                          corner[1] - EDGE_MM - 2)]  # fmt: skip
    if min(lengths) < LEAST_RULER_MM:
        return None
    rulers = (
        Ruler(zero_mm=(corner[0], height - EDGE_MM), length_mm=lengths[0], upward=False),
        Ruler(zero_mm=(EDGE_MM, corner[1]), length_mm=lengths[1], upward=True),
    )
    along = lengths[0] if place == "bottom" else lengths[1]
    text = _set_text(target, rulers, along)
    depth = _text_depth(text) + TEXT_GAP_MM
    cut = AXIS_MM if cut_marks else 0.0
    free = [
        corner[0] + AXIS_MM,
        EDGE_MM + AXIS_MM,
        width - EDGE_MM - (depth if place == "side" else 0.0) - cut,
        corner[1] - (depth if place == "bottom" else 0.0) - cut,
    ]
    x0, y0, x1, y1 = (1000 * v for v in artwork.bounds_m)
    quiet = max(1000 * quiet_zone_m(target), LEAST_QUIET_MM)
    spare_x = free[2] - free[0] - (x1 - x0) - 2 * quiet
    spare_y = free[3] - free[1] - (y1 - y0) - 2 * quiet
    if spare_x < -1e-6 or spare_y < -1e-6:
        return None
    left, top = free[0] + spare_x / 2, free[1] + spare_y / 2
    return Layout(
        page_mm=page_mm,
        origin_mm=(left + quiet - x0, top + quiet - y0),
        quiet_mm=(left, top, left + x1 - x0 + 2 * quiet, top + y1 - y0 + 2 * quiet),
        rulers=rulers,
        text=text,
        place=place,
    )


def needed_page(target: Target, artwork: Artwork, cut_marks: bool) -> tuple[float, float]:
    """Return the smallest page on which the target fits with the text at the bottom [mm]."""
    x0, y0, x1, y1 = (1000 * v for v in artwork.bounds_m)
    quiet = max(1000 * quiet_zone_m(target), LEAST_QUIET_MM)
    around = 2 * EDGE_MM + RULER_MM
    least = around + LEAST_RULER_MM + 2
    width = max(least, math.ceil(around + AXIS_MM + x1 - x0 + 2 * quiet))
    height = max(least, math.ceil(around + AXIS_MM + y1 - y0 + 2 * quiet))
    while lay_out(target, artwork, (width, height), "bottom", cut_marks) is None:
        height += 1.0
    return width, height


def _set_text(
    target: Target, rulers: tuple[Ruler, Ruler], measure: float
) -> list[tuple[str, Font, float]]:
    """Return the lines of text, broken to a width [mm]."""
    lines: list[tuple[str, Font, float]] = []
    font: Font
    for k, paragraph in enumerate(sheet_text(target, rulers)):
        font = ("Helvetica-Bold", "Courier-Bold", "Helvetica")[min(k, 2)]
        size = TITLE_PT if k == 0 else TEXT_PT
        if k == 1:
            # The name must stay on one line to be copied; the smallest print is still legible.
            size = max(4.5, min(size, size * measure / text_width_mm(paragraph, font, size)))
        for line in wrap(paragraph, font, size, measure):
            lines.append((line, font, size))
    return lines


def _text_depth(text: list[tuple[str, Font, float]]) -> float:
    """Return how deep the lines of text are together [mm]."""
    return sum(_line_pitch(size) for _, _, size in text)


def _line_pitch(size_pt: float) -> float:
    """Return the distance of base lines [mm]."""
    return 1.3 * size_pt * POINT_MM


# --- marks ------------------------------------------------------------------------------------


def page_of(artwork: Artwork, layout: Layout, cut_marks: bool) -> Page:
    """Return everything that is printed."""
    marks: list[Mark] = []
    for ruler in layout.rulers:
        marks += _ruler_marks(ruler)
    marks += _axis_marks(layout)
    marks += _text_marks(layout)
    if cut_marks:
        marks += _cut_marks(layout)
    return Page(size_mm=layout.page_mm, artwork=artwork, origin_mm=layout.origin_mm, marks=marks)


def _ruler_marks(ruler: Ruler) -> Iterator[Mark]:
    """Return a ruler: a mark each millimetre at its exact place, a number each centimetre."""
    x0, y0 = ruler.zero_mm

    def at(along: float, across: float) -> tuple[float, float]:
        return (x0 + across, y0 - along) if ruler.upward else (x0 + along, y0 - across)

    half = LINE_MM / 2
    length = ruler.length_mm
    yield Line(start=at(-half, 0), end=at(length + half, 0), width=LINE_MM)
    for k in range(round(length) + 1):
        tall = 3.6 if k % 10 == 0 else 2.6 if k % 5 == 0 else 1.6
        yield Line(start=at(k, 0), end=at(k, tall), width=LINE_MM)
        if k % 10 == 0:
            # Numbers of the upright ruler are turned with it, their feet towards the marks.
            across = 6.0 if ruler.upward else 4.2
            yield Label(
                at=at(k, across), text=f"{k}", size_pt=NUMBER_PT, centred=True, upward=ruler.upward
            )
    yield Label(
        at=at(length + 3.2, 6.0 if ruler.upward else 4.2), text="mm", size_pt=NUMBER_PT,
        upward=ruler.upward,
    )  # fmt: skip


def _axis_marks(layout: Layout) -> Iterator[Mark]:
    """Return the arrows of x and y beside the quiet zone, each with a mark at the origin."""
    left, top = layout.quiet_mm[:2]
    x0, y0 = layout.origin_mm
    for name, upright in (("x", False), ("y", True)):
        start, line = (y0, left - 1.2) if upright else (x0, top - 1.2)

        def at(along: float, out: float, upright: bool = upright, start: float = start,
               line: float = line) -> tuple[float, float]:  # fmt: skip
            return (line - out, start + along) if upright else (start + along, line - out)

        tip = ARROW_MM
        yield from (
            Line(start=at(0, -1.0), end=at(0, 1.0), width=LINE_MM),
            Line(start=at(0, 0), end=at(tip - 1.5, 0), width=LINE_MM),
            Area(corners=(at(tip, 0), at(tip - 2.4, 0.7), at(tip - 2.4, -0.7))),
            Label(at=(line - 2.6, start + 0.8) if upright else (start, line - 1.6), text="0",
                  size_pt=NUMBER_PT, centred=True),
            Label(at=(line, start + tip + 2.9) if upright else (start + tip + 1.4, line + 0.7),
                  text=name, size_pt=TITLE_PT, font="Helvetica-Bold", centred=upright),
        )  # fmt: skip


def _text_marks(layout: Layout) -> Iterator[Mark]:
    """Return the lines of text at the bottom or up the right side."""
    width, height = layout.page_mm
    depth = _text_depth(layout.text)
    bottom = height - EDGE_MM - RULER_MM
    done = 0.0
    for text, font, size in layout.text:
        done += _line_pitch(size)
        inset = depth - done + 0.3 * size * POINT_MM
        at = (EDGE_MM + RULER_MM + TEXT_GAP_MM, bottom - inset - 0.5)
        if layout.place == "side":
            at = (width - EDGE_MM - inset, bottom - TEXT_GAP_MM)
        yield Label(at=at, text=text, size_pt=size, font=font, upward=layout.place == "side")


def _cut_marks(layout: Layout) -> Iterator[Mark]:
    """Return marks outside the four corners of the quiet zone, in line with its edges."""
    left, top, right, bottom = layout.quiet_mm
    for x, outward_x in ((left, -1.0), (right, 1.0)):
        for y, outward_y in ((top, -1.0), (bottom, 1.0)):
            x0, x1 = (x + outward_x * v for v in (CUT_GAP_MM, AXIS_MM))
            y0, y1 = (y + outward_y * v for v in (CUT_GAP_MM, AXIS_MM))
            yield Line(start=(x0, y), end=(x1, y), width=LINE_MM)
            yield Line(start=(x, y0), end=(x, y1), width=LINE_MM)
