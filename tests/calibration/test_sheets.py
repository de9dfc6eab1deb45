"""The printed sheets, measured as a camera would: the PDF is rasterised and read by OpenCV."""

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from cv2 import aruco

from realsim.arrays import Array, UInt8
from realsim.errors import InputError
from realsim.records import CharucoBoard, Chessboard, CircleGrid, TagBoard, Target
from realsim_calibration.sheets.artwork import artwork_of, dot_diameters_m, target_image
from realsim_calibration.sheets.write import (
    PAPERS_MM,
    SheetReport,
    largest_fit,
    make_board,
    paper_size,
    write_sheet,
)
from realsim_calibration.targets.target_file import read_target, target_to_json
from realsim_calibration.targets.target_text import parse_target
from refusals import refused

pdfium = pytest.importorskip("pypdfium2", reason="rasterising a PDF needs pypdfium2")

DPI = 150
WITHIN_MM = 0.05
SHEETS = {
    "charuco:6x8,square=28mm,marker=21mm,dict=tag36h11": "A4",
    "charuco:6x8,square=25.4mm,marker=0.75in,dict=4X4_50,legacy": "letter",
    "chessboard:9x6,square=21.9mm": "letter",
    "circles:10x10,pitch=15mm,large-origin": "A4",
    "circles:4x11,pitch=20mm,asymmetric": "A4",
    "aprilgrid:3x5,tag=30mm,gap=12mm,family=tag25h9,first=4,from-bottom": "A4",
    "aprilgrid:4x5,tag=32mm,gap=9.6mm,from-bottom,corner-squares": "A4",
    "tag:7,size=80mm": "A4",
}


class Raster:
    """A page as a picture, with the scale between its pixels and millimetres."""

    def __init__(self, path: Path) -> None:
        document = pdfium.PdfDocument(path)
        assert len(document) == 1
        page = document[0]
        self.size_mm = np.array(page.get_size()) * 25.4 / 72
        self.gray = np.asarray(page.render(scale=DPI / 72, grayscale=True).to_numpy())
        self.gray = np.ascontiguousarray(self.gray.reshape(self.gray.shape[:2]))
        # The picture has a whole number of pixels, so its scale is the page's share of them.
        self.mm_per_px = self.size_mm / self.gray.shape[::-1]
        self.text = page.get_textpage().get_text_bounded()
        self.preferences = path.read_bytes()
        document.close()

    def to_mm(self, uv: Array) -> Array:
        """Pixel centres are integers; the page's corner is the outer corner of the first pixel."""
        return (np.asarray(uv, dtype=np.float64) + 0.5) * self.mm_per_px


Printed = tuple[Target, SheetReport, Raster]


@pytest.fixture(scope="module", params=SHEETS)
def printed(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Printed:
    target = parse_target(request.param)
    path = tmp_path_factory.mktemp("sheets") / "sheet.pdf"
    report = write_sheet(target, path, paper=SHEETS[request.param])
    return target, report, Raster(report.pdf)


# --- OpenCV's own detectors -------------------------------------------------------------------


def found_points(target: Target, gray: UInt8) -> Array:
    """(n, 2) all points of the target in the order of its records, NaN where not found."""
    if isinstance(target, TagBoard):
        return found_tags(target, gray)
    size = (target.columns, target.rows)
    if isinstance(target, CharucoBoard):
        dictionary = aruco.getPredefinedDictionary(getattr(aruco, target.dictionary))
        board = aruco.CharucoBoard(size, target.square_m, target.marker_m, dictionary)
        board.setLegacyPattern(target.legacy)
        corners, ids, _, _ = aruco.CharucoDetector(board).detectBoard(gray)
        points = np.full((len(target.points_board), 2), np.nan)
        points[np.ravel(ids)] = np.reshape(corners, (-1, 2))
        # What OpenCV calls corner k is our point k.
        assert np.allclose(board.getChessboardCorners(), target.points_board, atol=1e-6)
        return points
    if isinstance(target, Chessboard):
        ok, corners = cv2.findChessboardCornersSB(gray, size)
    else:
        kind = cv2.CALIB_CB_ASYMMETRIC_GRID if target.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
        # Blobs of the size that the dots have in the picture; the digits of rulers are smaller.
        dot_px = dot_diameters_m(target)[0] * 1000 / 25.4 * DPI
        parameters = cv2.SimpleBlobDetector.Params()
        parameters.minArea, parameters.maxArea = 0.3 * dot_px**2, 3 * dot_px**2
        blobs = cv2.SimpleBlobDetector.create(parameters)
        ok, corners = cv2.findCirclesGrid(gray, size, flags=kind, blobDetector=blobs)
    assert ok
    return np.reshape(corners, (-1, 2)).astype(np.float64)


def found_tags(board: TagBoard, gray: UInt8) -> Array:
    family = f"DICT_APRILTAG_{board.family[3:]}"
    parameters = aruco.DetectorParameters()
    parameters.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
    parameters.cornerRefinementWinSize = 5
    dictionary = aruco.getPredefinedDictionary(getattr(aruco, family))
    quads, ids, _ = aruco.ArucoDetector(dictionary, parameters).detectMarkers(gray)
    by_id = {int(i): np.reshape(q, (4, 2)) for i, q in zip(np.ravel(ids), quads, strict=True)}
    return np.concatenate([by_id.get(int(i), np.full((4, 2), np.nan)) for i in board.ids])


def up_to_turns(target: Target, found: Array, expected: Array):
    """OpenCV's order of a grid that has no first point is any of its turns: take the nearest."""
    if isinstance(target, (TagBoard, CharucoBoard)):
        return found
    grid = found.reshape(target.rows, target.columns, 2)
    turns = [grid, grid[::-1, ::-1]]
    if target.rows == target.columns:
        turns += [np.rot90(grid), np.rot90(grid, 3), np.swapaxes(grid, 0, 1)]
        turns += [np.swapaxes(grid[::-1, ::-1], 0, 1)]
    turns += [g[::-1] for g in turns]
    flat = [g.reshape(-1, 2) for g in turns]
    return min(flat, key=lambda uv: float(np.nanmax(np.abs(uv - expected))))


def test_every_point_is_printed_at_its_place(printed: Printed) -> None:
    target, report, raster = printed
    expected = np.array(report.layout.origin_mm) + 1000 * target.points_board[:, :2]
    found = up_to_turns(target, raster.to_mm(found_points(target, raster.gray)), expected)
    error = np.linalg.norm(found - expected, axis=-1)
    assert not np.isnan(error).any(), f"{np.isnan(error).sum()} points were not found"
    assert error.max() < WITHIN_MM


def test_rulers_and_page_have_their_length(printed: Printed) -> None:
    _, report, raster = printed
    assert raster.size_mm == pytest.approx(report.layout.page_mm, abs=1e-3)
    assert sorted(report.layout.page_mm) == pytest.approx(sorted(PAPERS_MM[report.paper]))
    for ruler in report.layout.rulers:
        assert ruler.length_mm >= 100
        ticks = ruler_ticks_mm(ruler, raster)
        assert len(ticks) == round(ruler.length_mm) + 1
        assert abs(ticks[-1] - ticks[0] - ruler.length_mm) < WITHIN_MM
        assert np.abs(np.diff(ticks) - 1.0).max() < WITHIN_MM


def ruler_ticks_mm(ruler, raster: Raster) -> Array:
    """Centres of the dark marks along a line that crosses the ruler a millimetre off its base."""
    x, y = ruler.zero_mm
    if ruler.upward:
        profile = raster.gray[::-1, round((x + 1.0) / raster.mm_per_px[0])]
        start, pitch = raster.size_mm[1] - y, raster.mm_per_px[1]
    else:
        profile = raster.gray[round((y - 1.0) / raster.mm_per_px[1])]
        start, pitch = x, raster.mm_per_px[0]
    low, high = (round(v / pitch) for v in (start - 0.5, start + ruler.length_mm + 0.5))
    dark = 255.0 - profile[low:high]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (dark > 20).astype(int), [0]])))
    ends = zip(edges[::2], edges[1::2], strict=True)
    centres = [np.average(np.arange(a, b), weights=dark[a:b]) for a, b in ends]
    return (np.array(centres) + low + 0.5) * pitch


def test_the_sheet_says_its_own_name(printed: Printed) -> None:
    target, report, raster = printed
    assert report.name in raster.text
    assert target_to_json(parse_target(report.name)) == target_to_json(target)
    assert "Print at 100 %" in raster.text
    assert f"{report.layout.rulers[0].length_mm:g} mm along the" in raster.text
    assert b"/PrintScaling /None" in raster.preferences
    assert target_to_json(read_target(report.target_file)) == target_to_json(target)


def test_nothing_is_printed_in_the_quiet_zone(printed: Printed) -> None:
    target, report, raster = printed
    x0, y0, x1, y1 = (v * 1000 for v in artwork_of(target).bounds_m)
    inner = np.array([x0, y0, x1, y1]) + np.tile(report.layout.origin_mm, 2)
    quiet = np.array(report.layout.quiet_mm)
    assert np.all((inner - quiet) * [1, 1, -1, -1] >= 5.0 - 1e-6)
    scale = np.tile(raster.mm_per_px, 2)
    a, b = np.round(quiet / scale).astype(int), np.round(inner / scale).astype(int)
    picture = raster.gray[a[1] + 1 : a[3] - 1, a[0] + 1 : a[2] - 1].copy()
    picture[b[1] - a[1] - 3 : b[3] - a[1] + 2, b[0] - a[0] - 3 : b[2] - a[0] + 2] = 255
    assert picture.min() == 255


def test_page_and_picture_show_the_same_without_seams(printed: Printed) -> None:
    target, report, raster = printed
    picture, origin = target_image(target, 1000 / float(raster.mm_per_px.mean()), 0.001)
    u, v = origin - (np.array(report.layout.origin_mm) / raster.mm_per_px - 0.5)
    move = np.array([[1, 0, u], [0, 1, v]])
    seen = cv2.warpAffine(raster.gray, move, picture.shape[::-1], borderValue=255)
    # Inside of what is black nothing is lighter: neighbouring modules are one area.
    black = cv2.erode((picture == 0).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    white = cv2.erode((picture == 255).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert black.sum() > 0.1 * picture.size and white.sum() > 0.1 * picture.size
    assert seen[black].max() == 0
    assert seen[white].min() == 255


# --- pictures ---------------------------------------------------------------------------------


@pytest.mark.parametrize("line", [
    *(line for line in SHEETS if "asymmetric" not in line),
    "chessboard:7x5,square=20mm", "chessboard:8x5,square=20mm", "circles:4x5,pitch=20mm",
    "circles:4x10,pitch=20mm,asymmetric", "circles:3x5,pitch=20mm,asymmetric",
    "circles:4x10,pitch=20mm,asymmetric,large-origin",
])  # fmt: skip
def test_a_target_looks_the_same_turned_if_it_says_so(line: str) -> None:
    target = parse_target(line)
    artwork = artwork_of(target)
    dots = artwork.dots
    same = np.array_equal(artwork.black, artwork.black[::-1, ::-1])
    if len(dots):
        at = dots[:, :2]
        turned = np.column_stack([at.min(0) + at.max(0) - at, dots[:, 2]])
        same = bool(np.all(np.abs(turned[:, None] - dots[None]).max(-1).min(axis=1) < 1e-9))
    assert same == target.half_turn


def test_a_dot_has_its_centre_and_its_area() -> None:
    grid = CircleGrid(rows=3, columns=4, pitch_m=0.0173, large_origin=True)
    per_m = 1771.3
    picture, origin = target_image(grid, per_m, 0.004)
    ink = 1 - picture / 255.0
    v, u = np.mgrid[: picture.shape[0], : picture.shape[1]]
    usual, first = dot_diameters_m(grid)
    assert usual < first < grid.pitch_m
    for k, point in enumerate(grid.points_board[:, :2]):
        centre = np.array(origin) + per_m * point
        own = np.where(np.hypot(u - centre[0], v - centre[1]) < 0.49 * grid.pitch_m * per_m, ink, 0)
        mean = np.array([np.sum(own * u), np.sum(own * v)]) / own.sum()
        assert mean == pytest.approx(centre, abs=2e-3)
        width = first if k == 0 else usual
        assert own.sum() == pytest.approx(np.pi / 4 * (width * per_m) ** 2, rel=1e-3)


# --- Sheets as files: papers, what does not fit, names, and what is never overwritten.


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
    huge = parse_target("aprilgrid:6x6,tag=999mm,gap=500mm")
    refused("5080", write_sheet, huge, tmp_path / "x.pdf", paper="auto")


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
    names = [f"chessboard_9x6_square23mm.{end}" for end in ("pdf", "json", "png")]
    assert [p.name for p in paths] == names
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
