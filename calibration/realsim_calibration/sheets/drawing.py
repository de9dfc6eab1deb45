"""A page in millimetres, and how it becomes a PDF or a picture.

Coordinates are in mm from the top left corner of the page, y down. The black parts of the target
are vector areas in the PDF; in the picture each pixel is the exact share of them.
"""

import io
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from realsim.arrays import UInt8
from realsim_calibration.sheets.artwork import Artwork, black_share, outlines

POINT_MM = 25.4 / 72
"""A typographic point, the unit of PDF [mm]."""
FINER = 4
"""Pixels across a pixel of the picture when lines and letters are drawn, against jagged edges."""

Font = Literal["Helvetica", "Helvetica-Bold", "Courier-Bold"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Line:
    """A straight black line with its ends cut off square."""

    start: tuple[float, float]
    end: tuple[float, float]
    width: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Area:
    """A filled black polygon."""

    corners: tuple[tuple[float, float], ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class Label:
    """One line of text."""

    at: tuple[float, float]
    """Where its base line starts, or where its middle is."""
    text: str
    size_pt: float
    font: Font = "Helvetica"
    centred: bool = False
    upward: bool = False
    """Whether it runs up the page, turned by a quarter to the left."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Page:
    """Everything that is printed on a sheet."""

    size_mm: tuple[float, float]
    artwork: Artwork
    origin_mm: tuple[float, float]
    """Where the origin of the target's board frame is."""
    marks: list[Line | Area | Label] = field(default_factory=list[Line | Area | Label])


def text_width_mm(text: str, font: Font, size_pt: float) -> float:
    """Return the width of a line of text [mm]."""
    from reportlab.pdfbase.pdfmetrics import stringWidth

    return float(stringWidth(text, font, size_pt)) * POINT_MM


def wrap(text: str, font: Font, size_pt: float, width_mm: float) -> list[str]:
    """Return the text in lines that are no wider than given, broken at spaces and commas."""
    words = text.replace(",", ",\0").replace("\0 ", " ").replace(" ", " \0").split("\0")
    lines = [""]
    for word in words:
        longer = lines[-1] + word
        if lines[-1] and text_width_mm(longer.rstrip(), font, size_pt) > width_mm:
            lines.append(word)
        else:
            lines[-1] = longer
    return [line.strip() for line in lines if line.strip()]


def pdf_bytes(page: Page, title: str, subject: str) -> bytes:
    """Return the page as a PDF of exact scale that asks viewers not to fit it to the paper.

    The same page gives the same bytes: neither dates nor random numbers are in them.
    """
    from reportlab.pdfgen.canvas import Canvas

    width, height = page.size_mm
    buffer = io.BytesIO()
    size = (width / POINT_MM, height / POINT_MM)
    canvas: Any = Canvas(buffer, pagesize=size, invariant=1, pageCompression=1)
    canvas.setTitle(title)
    canvas.setSubject(subject)
    canvas.setCreator("realsim")
    canvas.setViewerPreference("PrintScaling", "None")
    canvas.setFillGray(0.0)
    canvas.setStrokeGray(0.0)
    _draw_target(canvas, page)
    for mark in page.marks:
        _draw_mark(canvas, mark, height)
    canvas.showPage()
    canvas.save()
    return buffer.getvalue()


def _draw_target(canvas: Any, page: Page) -> None:
    """Draw the black areas of the target as one path, and its dots."""
    x0, y0 = page.origin_mm
    height = page.size_mm[1]

    def at(x_m: float, y_m: float) -> tuple[float, float]:
        return (x0 + x_m * 1000) / POINT_MM, (height - y0 - y_m * 1000) / POINT_MM

    path = canvas.beginPath()
    for loop in outlines(page.artwork):
        path.moveTo(*at(*loop[0]))
        for corner in loop[1:]:
            path.lineTo(*at(*corner))
        path.close()
    for x, y, radius in page.artwork.dots:
        path.circle(*at(x, y), radius * 1000 / POINT_MM)
    canvas.drawPath(path, stroke=0, fill=1)


def _draw_mark(canvas: Any, mark: Line | Area | Label, height: float) -> None:
    """Draw a line, an area or a text."""

    def at(point: tuple[float, float]) -> tuple[float, float]:
        return point[0] / POINT_MM, (height - point[1]) / POINT_MM

    if isinstance(mark, Line):
        canvas.setLineWidth(mark.width / POINT_MM)
        canvas.line(*at(mark.start), *at(mark.end))
    elif isinstance(mark, Area):
        path = canvas.beginPath()
        path.moveTo(*at(mark.corners[0]))
        for corner in mark.corners[1:]:
            path.lineTo(*at(corner))
        path.close()
        canvas.drawPath(path, stroke=0, fill=1)
    else:
        canvas.saveState()
        canvas.setFont(mark.font, mark.size_pt)
        canvas.translate(*at(mark.at))
        canvas.rotate(90 if mark.upward else 0)
        (canvas.drawCentredString if mark.centred else canvas.drawString)(0, 0, mark.text)
        canvas.restoreState()


def png_bytes(page: Page, longest_px: int) -> bytes:
    """Return a picture of the page for the screen, its longer side as long as given."""
    from PIL import Image

    per_mm = longest_px / max(page.size_mm)
    width, height = (round(v * per_mm) for v in page.size_mm)
    corner = (-page.origin_mm[0] / 1000, -page.origin_mm[1] / 1000)
    target = black_share(page.artwork, per_mm * 1000, corner, (width, height))
    ink = Image.new("L", (width * FINER, height * FINER), 0)
    for mark in page.marks:
        _paint_mark(ink, mark, per_mm * FINER)
    marks = np.asarray(ink.resize((width, height), Image.Resampling.BOX), np.float32) / 255
    gray: UInt8 = np.rint(255 * (1 - np.maximum(target, marks))).astype(np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(gray).save(buffer, format="PNG", dpi=(per_mm * 25.4, per_mm * 25.4))
    return buffer.getvalue()


def _paint_mark(ink: Any, mark: Line | Area | Label, per_mm: float) -> None:
    """Paint a line, an area or a text into a picture of where ink is."""
    from PIL import Image, ImageDraw, ImageFont

    draw = ImageDraw.Draw(ink)
    if isinstance(mark, Line):
        (x0, y0), (x1, y1), half = mark.start, mark.end, mark.width / 2
        along_x = y0 == y1
        box = (min(x0, x1) - half * (not along_x), min(y0, y1) - half * along_x,
               max(x0, x1) + half * (not along_x), max(y0, y1) + half * along_x)  # fmt: skip
        draw.rectangle([round(v * per_mm) for v in box], fill=255)
    elif isinstance(mark, Area):
        draw.polygon([(x * per_mm, y * per_mm) for x, y in mark.corners], fill=255)
    else:
        font = ImageFont.load_default(mark.size_pt * POINT_MM * per_mm)
        # The picture's own letters are set as wide as those of the PDF.
        width = round(text_width_mm(mark.text, mark.font, mark.size_pt) * per_mm)
        left, top, right, bottom = font.getbbox(mark.text, anchor="ls")
        letters = Image.new("L", (max(1, int(right - left)), max(1, int(bottom - top))), 0)
        ImageDraw.Draw(letters).text((-left, -top), mark.text, font=font, fill=255, anchor="ls")
        letters = letters.resize((max(1, width), letters.height))
        x, y = mark.at[0] * per_mm, mark.at[1] * per_mm
        start = -width / 2 if mark.centred else 0.0
        if mark.upward:
            letters = letters.rotate(90, expand=True)
            place = (round(x + top), round(y - start - letters.height))
        else:
            place = (round(x + start), round(y + top))
        ink.paste(255, place, letters)
