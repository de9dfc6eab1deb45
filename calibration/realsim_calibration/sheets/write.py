"""Write a target's sheet: the PDF, the target file beside it, and a picture for the screen."""

import math
import re
from dataclasses import dataclass, fields, replace
from decimal import Decimal
from itertools import product
from pathlib import Path
from typing import Any

from realsim.errors import InputError
from realsim.records import CharucoBoard, Target
from realsim.store import atomic
from realsim_calibration.sheets.artwork import Artwork, artwork_of
from realsim_calibration.sheets.drawing import pdf_bytes, png_bytes
from realsim_calibration.sheets.layout import (
    LEAST_RULER_MM,
    PREVIEW_PX,
    Layout,
    Place,
    lay_out,
    needed_page,
    page_of,
)
from realsim_calibration.targets.target_file import read_target, target_to_json
from realsim_calibration.targets.target_text import (
    describe,
    format_target,
    parse_length,
    parse_target,
)

PAPERS_MM: dict[str, tuple[float, float]] = {
    "A5": (148.0, 210.0),
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
    "A0": (841.0, 1189.0),
    "letter": (215.9, 279.4),
    "legal": (215.9, 355.6),
    "tabloid": (279.4, 431.8),
}
"""Papers by name, upright, width by height [mm]."""
AUTO_PAPERS = ("A4", "A3", "A2", "A1", "A0")
"""What `auto` tries, before it makes a page to measure."""
LARGEST_PAGE_MM = 5080.0
"""Longest side that the PDF format allows (14400 points)."""
STEP_M = Decimal("0.0001")
"""Lengths that are proposed are whole multiples of this [m]."""

Paper = str | tuple[float, float]


@dataclass(frozen=True, kw_only=True, slots=True)
class SheetReport:
    """What was written, and where things are on the page (mm from its top left corner, y down)."""

    pdf: Path
    target_file: Path
    """The target as JSON, for `read_target`."""
    preview: Path | None
    """Picture of the page for the screen; None where it was not wanted."""
    name: str
    """The line that is printed on the sheet and that `parse_target` reads."""
    paper: str
    layout: Layout

    @property
    def paths(self) -> list[Path]:
        """The files."""
        return [p for p in (self.pdf, self.target_file, self.preview) if p is not None]


def paper_size(paper: Paper) -> tuple[str, tuple[float, float]]:
    """Return the name and the size of a paper [mm].

    Args:
        paper: a name such as "A4", a text such as "300x400mm", or width and height [mm].

    Raises:
        InputError: the name is not known, or the size cannot be a page.
    """
    if isinstance(paper, str):
        by_name = {name.lower(): name for name in PAPERS_MM}
        name = by_name.get(paper.strip().lower())
        if name is not None:
            return name, PAPERS_MM[name]
        found = re.fullmatch(r"\s*([0-9.]+)\s*[xX×]\s*([0-9.]+\s*[a-z]+)\s*", paper)
        if found is None:
            raise InputError(
                f"the paper '{paper[:80]}' is not known; accepted: {', '.join(PAPERS_MM)}, auto, "
                "or width x height such as 300x400mm."
            )
        unit = re.sub(r"[0-9.\s]", "", found[2])
        size = tuple(1000 * parse_length(text, "paper") for text in (found[1] + unit, found[2]))
    else:
        size = tuple(float(v) for v in paper)
    if len(size) != 2 or not all(math.isfinite(v) and 0 < v <= LARGEST_PAGE_MM for v in size):
        raise InputError(
            f"a paper has a width and a height in mm, each at most {LARGEST_PAGE_MM:g}; got "
            f"{paper}."
        )
    return f"{size[0]:g}x{size[1]:g}mm", (size[0], size[1])


def write_sheet(
    target: Target,
    path: Path | str,
    *,
    paper: Paper = "A4",
    preview: bool = False,
    overwrite: bool = False,
    cut_marks: bool = False,
) -> SheetReport:
    """Write the target as a PDF at exact scale, and its target file beside it.

    The page is turned upright or sideways, whichever the target fits. Black parts are vector areas;
    viewers are asked not to fit the page to the paper.

    Args:
        target: any target.
        path: the PDF; the target file has the same name with .json, the picture with .png.
        paper: a paper's name, "300x400mm", width and height [mm], or "auto" for the smallest of
            A4 to A0 that fits, and beyond them a page made to measure.
        preview: whether a picture for the screen is written too.
        overwrite: whether files of another target or a changed target file may be replaced.
        cut_marks: whether marks show where the quiet zone may be cut off.

    Raises:
        InputError: the target does not fit (the message says which size or paper does), the path
            is no PDF, or a target file with another content is already there.
    """
    path = Path(path)
    if path.suffix.lower() != ".pdf":
        raise InputError(f"{path}: a sheet is a PDF; its name must end in .pdf.")
    target_path, picture_path = path.with_suffix(".json"), path.with_suffix(".png")
    values = target_to_json(target)
    artwork = artwork_of(target)
    if not overwrite:
        _refuse_other(path, target_path, values)
    name, layout = _choose(target, artwork, paper, cut_marks)
    page = page_of(artwork, layout, cut_marks)
    line = format_target(target)
    picture = png_bytes(page, PREVIEW_PX) if preview else None
    try:
        atomic.write_bytes(path, pdf_bytes(page, describe(target), line))
        atomic.write_json(target_path, values)
        if picture is not None:
            atomic.write_bytes(picture_path, picture)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}).") from None
    return SheetReport(
        pdf=path,
        target_file=target_path,
        preview=picture_path if preview else None,
        name=line,
        paper=name,
        layout=layout,
    )


def _refuse_other(pdf: Path, path: Path, values: dict[str, Any]) -> None:
    """Raise if files of another content are there: a target file may hold measured lengths."""
    if not path.exists():
        if pdf.exists():
            raise InputError(
                f"{pdf} is already there without {path.name}, so that it is not known to be a "
                "sheet. Write to another name, or allow it to be overwritten."
            )
        return
    try:
        same = target_to_json(read_target(path)) == values
    except InputError:
        same = False
    if not same:
        raise InputError(
            f"{path} is already there and describes something else, perhaps the lengths that were "
            "measured on a print. Write to another name, or allow it to be overwritten."
        )


# --- fitting ----------------------------------------------------------------------------------


def _fit(
    target: Target, artwork: Artwork, size: tuple[float, float], cut_marks: bool
) -> Layout | None:
    """Return the layout on a paper, turned as the target is; text at the bottom where it can be."""
    x0, y0, x1, y1 = artwork.bounds_m
    upright, sideways = (min(size), max(size)), (max(size), min(size))
    pages = (sideways, upright) if x1 - x0 > y1 - y0 else (upright, sideways)
    places: tuple[Place, ...] = ("bottom", "side")
    tried = (lay_out(target, artwork, p, place, cut_marks) for place, p in product(places, pages))
    return next((layout for layout in tried if layout is not None), None)


def _choose(target: Target, artwork: Artwork, paper: Paper, cut_marks: bool) -> tuple[str, Layout]:
    """Return the paper's name and the layout.

    Raises:
        InputError: the target does not fit.
    """
    if isinstance(paper, str) and paper.strip().lower() == "auto":
        return _automatic(target, artwork, cut_marks)
    name, size = paper_size(paper)
    layout = _fit(target, artwork, size, cut_marks)
    if layout is None:
        raise InputError(_does_not_fit(target, artwork, name, size, cut_marks))
    return name, layout


def _automatic(target: Target, artwork: Artwork, cut_marks: bool) -> tuple[str, Layout]:
    """Return the smallest paper of the A series that fits, else a page made to measure."""
    for name in AUTO_PAPERS:
        layout = _fit(target, artwork, PAPERS_MM[name], cut_marks)
        if layout is not None:
            return name, layout
    extent = 1000 * max(artwork.bounds_m[2] - artwork.bounds_m[0],
                        artwork.bounds_m[3] - artwork.bounds_m[1])  # fmt: skip
    page = needed_page(target, artwork, cut_marks) if extent < LARGEST_PAGE_MM else (extent, extent)
    layout = lay_out(target, artwork, page, "bottom", cut_marks)
    if layout is None or max(page) > LARGEST_PAGE_MM:
        raise InputError(
            f"the target is {extent:.0f} mm long; a page of at most {LARGEST_PAGE_MM:.0f} mm is "
            "possible. Print it in parts, or choose a smaller target."
        )
    return f"{page[0]:g}x{page[1]:g}mm", layout


def _does_not_fit(
    target: Target, artwork: Artwork, name: str, size: tuple[float, float], cut_marks: bool
) -> str:
    """Return the message: what is too large, what would fit, and the commands for it."""
    x0, y0, x1, y1 = (1000 * v for v in artwork.bounds_m)
    message = (
        f"the target ({describe(target)}) is {x1 - x0:.1f} x {y1 - y0:.1f} mm and does not fit "
        f"{name} ({size[0]:g} x {size[1]:g} mm) with its white border, rulers and text."
    )
    smaller = largest_fit(target, size, cut_marks)
    if smaller is None:
        message += f" Nothing fits there: the rulers need {LEAST_RULER_MM:g} mm."
    else:
        message += (
            f" The largest of its kind that fits: {describe(smaller)}; command: "
            f"realsim board '{format_target(smaller)}' --paper {name}."
        )
    other, _ = _automatic(target, artwork, cut_marks)
    return f"{message} At the size that was asked for: --paper {other}."


def largest_fit(target: Target, size: tuple[float, float], cut_marks: bool) -> Target | None:
    """Return the target with all lengths shrunk just so far that it fits a paper, or None.

    Lengths are rounded down to tenths of a millimetre, those of a ratio (a marker in its field)
    after the largest one.
    """
    low, high = 0.0, 1.0
    best: Target | None = None
    for _ in range(24):
        middle = (low + high) / 2
        candidate = _scaled(target, middle)
        if candidate is not None and _fit(candidate, artwork_of(candidate), size, cut_marks):
            low, best = middle, candidate
        else:
            high = middle
    return best


def _scaled(target: Target, scale: float) -> Target | None:
    """Return the target with its lengths scaled and rounded down, None where none is left."""
    names = [f.name for f in fields(target) if f.name.endswith("_m")]
    lengths: dict[str, Any] = {}
    for name in names:
        steps = math.floor(getattr(target, name) / float(STEP_M) * scale + 1e-9)
        lengths[name] = float(steps * STEP_M)
    try:
        smaller = replace(target, **lengths)
    except InputError:
        return None
    if isinstance(smaller, CharucoBoard) and smaller.marker_m >= smaller.square_m:
        return None
    return smaller


# --- command ----------------------------------------------------------------------------------


def make_board(
    what: str,
    out: Path | str,
    paper: Paper = "A4",
    *,
    preview: bool = False,
    cut_marks: bool = False,
    overwrite: bool = False,
) -> list[Path]:
    """Write the sheet of a target that is named by a line or by a file.

    Args:
        what: a line such as 'chessboard:8x6,square=25mm', or the path of a target file.
        out: the PDF, or a folder in which it gets the name of the line.
        paper: see `write_sheet`.
        preview: whether a picture for the screen is written too.
        cut_marks: whether marks show where the quiet zone may be cut off.
        overwrite: whether a target file with other contents may be replaced.

    Returns:
        The files written: the PDF, the target file, and the picture where it was wanted.

    Raises:
        InputError: the target is not understood or does not fit, or a file is in the way.
    """
    is_file = Path(what).suffix.lower() in (".json", ".yaml", ".yml") or (
        ":" not in what and Path(what).exists()
    )
    target = read_target(what) if is_file else parse_target(what)
    path = Path(out)
    if path.suffix.lower() != ".pdf":
        if path.suffix and not path.is_dir():
            raise InputError(f"{path}: give a name that ends in .pdf, or a folder.")
        path = path / f"{file_name(format_target(target) if is_file else what)}.pdf"
    report = write_sheet(
        target, path, paper=paper, preview=preview, overwrite=overwrite, cut_marks=cut_marks
    )
    return report.paths


def file_name(line: str) -> str:
    """Return a target's line, as it was typed, as a file name without an ending."""
    return re.sub(r"[^A-Za-z0-9.\-]+", "_", line.strip().replace("=", ""))[:200]
