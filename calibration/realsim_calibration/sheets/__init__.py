"""Printable targets: vector sheets at exact scale, and pictures of them."""

from realsim_calibration.sheets.artwork import Artwork, artwork_of, dot_diameters_m, target_image
from realsim_calibration.sheets.layout import Ruler
from realsim_calibration.sheets.write import (
    PAPERS_MM,
    SheetReport,
    largest_fit,
    make_board,
    paper_size,
    write_sheet,
)

__all__ = [
    "PAPERS_MM",
    "Artwork",
    "Ruler",
    "SheetReport",
    "artwork_of",
    "dot_diameters_m",
    "largest_fit",
    "make_board",
    "paper_size",
    "target_image",
    "write_sheet",
]
