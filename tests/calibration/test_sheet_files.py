"""Sheets as files: papers, what does not fit, names, and what is never overwritten."""

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from realsim.errors import InputError
from realsim.records import CharucoBoard
from realsim_calibration.sheets.write import largest_fit, make_board, paper_size, write_sheet
from realsim_calibration.targets.target_text import parse_target
from refusals import refused

pdfium = pytest.importorskip("pypdfium2", reason="rasterising a PDF needs pypdfium2")


def test_what_does_not_fit_is_told_with_what_does(tmp_path: Path) -> None:
    target = parse_target("charuco:5x7,square=45mm,marker=30mm,dict=6X6_100")
    message = refused("225.0 x 315.0 mm", write_sheet, target, tmp_path / "a.pdf", paper="A4")
    assert "--paper A3" in message
    proposed = re.search(r"realsim board '([^']+)' --paper A4", message)
    assert proposed is not None
    assert list(tmp_path.iterdir()) == []
    smaller = parse_target(proposed[1])
    assert isinstance(smaller, CharucoBoard)
    write_sheet(smaller, tmp_path / "a.pdf", paper="A4")
    assert smaller.marker_m / smaller.square_m == pytest.approx(30 / 45, abs=0.005)
    # It is the largest: a tenth of a millimetre more no longer fits.
    with pytest.raises(InputError, match="does not fit"):
        write_sheet(replace(smaller, square_m=smaller.square_m + 1e-4), tmp_path / "b.pdf")


def test_auto_takes_the_smallest_paper_and_makes_larger_ones_to_measure(tmp_path: Path) -> None:
    papers: list[str] = []
    for tag in ("25mm", "150mm"):
        target = parse_target(f"aprilgrid:6x6,tag={tag},gap=8mm")
        report = write_sheet(target, tmp_path / f"{tag}.pdf", paper="auto")
        raster_mm = np.array(pdfium.PdfDocument(report.pdf)[0].get_size()) * 25.4 / 72
        assert raster_mm == pytest.approx(report.layout.page_mm, abs=1e-3)
        papers.append(report.paper)
    assert papers[0] == "A3" and papers[1] not in ("A4", "A3")
    with pytest.raises(InputError, match="--paper A3"):
        write_sheet(parse_target("aprilgrid:6x6,tag=25mm,gap=8mm"), tmp_path / "x.pdf")
    with pytest.raises(InputError, match="5080"):
        write_sheet(parse_target("aprilgrid:6x6,tag=999mm,gap=500mm"), tmp_path / "x.pdf",
                    paper="auto")  # fmt: skip


def test_papers() -> None:
    assert paper_size("a4") == ("A4", (210.0, 297.0))
    assert paper_size("300x40.5cm")[1] == pytest.approx((3000, 405))
    assert paper_size((200, 300))[1] == (200.0, 300.0)
    for bad in ("A17", "300x400", "x", (1.0, -2.0), (np.nan, 3.0), "9000x9000mm"):
        refused(r"paper|unit", paper_size, bad)
    with pytest.raises(InputError, match="Nothing fits there: the rulers need 100 mm"):
        write_sheet(parse_target("tag:7,size=20mm"), Path("x.pdf"), paper=(80, 80))
    assert largest_fit(parse_target("tag:7,size=20mm"), (80, 80), cut_marks=False) is None


def test_make_board_writes_sheet_target_and_picture(tmp_path: Path) -> None:
    line = "chessboard:9x6,square=23mm"
    paths = make_board(line, tmp_path / "new", "A4", preview=True, cut_marks=True)
    assert [p.name for p in paths] == [
        f"chessboard_9x6_square23mm.{end}" for end in ("pdf", "json", "png")
    ]
    picture = cv2.imread(str(paths[2]), cv2.IMREAD_GRAYSCALE)
    assert picture is not None and max(picture.shape) == 1600
    page = pdfium.PdfDocument(paths[0])[0].render(scale=150 / 72, grayscale=True).to_numpy()
    page = page.reshape(page.shape[:2])
    page = cv2.resize(page, picture.shape[::-1], interpolation=cv2.INTER_AREA)
    assert np.mean(np.abs(page.astype(float) - picture)) < 2.5
    # The target file makes the same sheet, byte for byte.
    again = make_board(str(paths[1]), tmp_path / "again.pdf", "A4", cut_marks=True)
    assert again[0].read_bytes() == paths[0].read_bytes()
    assert make_board(line, tmp_path / "new") == paths[:2]
    typed = make_board("charuco:5x7,square=33mm,marker=2cm,dict=DICT_6X6_100", tmp_path)[0]
    assert typed.name == "charuco_5x7_square33mm_marker2cm_dictDICT_6X6_100.pdf"


def test_a_target_file_that_was_edited_is_not_lost(tmp_path: Path) -> None:
    line = "chessboard:9x6,square=23mm"
    _, target_file = make_board(line, tmp_path / "a.pdf")
    values = json.loads(target_file.read_text())
    values["square_m"] = 0.02291
    target_file.write_text(json.dumps(values))
    refused("measured", make_board, line, tmp_path / "a.pdf")
    assert json.loads(target_file.read_text()) == values
    make_board(line, tmp_path / "a.pdf", overwrite=True)
    assert json.loads(target_file.read_text())["square_m"] == 0.023


def test_bad_names_are_refused(tmp_path: Path) -> None:
    refused(r"\.pdf", write_sheet, parse_target("tag:7,size=80mm"), tmp_path / "a.svg")
    refused(r"\.pdf", make_board, "tag:7,size=80mm", tmp_path / "a.svg")
    refused("no kind of target", make_board, "cheesboard", tmp_path / "a.pdf")
    (tmp_path / "letter.pdf").write_bytes(b"%PDF")
    refused("already there", make_board, "tag:7,size=80mm", tmp_path / "letter.pdf")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        write_sheet(parse_target("tag:7,size=80mm"), tmp_path / "file" / "a.pdf")
