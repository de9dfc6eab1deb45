"""Targets as text and as files: what is written comes back, and what is wrong is named."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from realsim.errors import InputError
from realsim.records import CharucoBoard, Chessboard, CircleGrid, TagBoard, Target
from realsim.untrusted.own_json import to_json
from realsim_calibration.targets.marker_sets import dictionary_names, dictionary_size
from realsim_calibration.targets.target_file import (
    LARGEST_BYTES,
    read_target,
    target_from_json,
    target_to_json,
)
from realsim_calibration.targets.target_text import (
    FORMS,
    describe,
    format_target,
    parse_length,
    parse_target,
)
from refusals import refused


def fields_of(target: Target) -> dict[str, Any]:
    return {"record": type(target).__name__, **dataclasses.asdict(target)}


lengths = st.floats(0.002, 0.9, allow_nan=False)
counts = st.integers(3, 12)


@st.composite
def targets(draw: st.DrawFn) -> Target:
    kind = draw(st.sampled_from(["tags", "single", "charuco", "chessboard", "circles"]))
    if kind in ("tags", "single"):
        family = draw(st.sampled_from(["tag16h5", "tag25h9", "tag36h10", "tag36h11"]))
        single = kind == "single"
        rows, columns = (1, 1) if single else (draw(st.integers(1, 5)), draw(st.integers(1, 6)))
        most = dictionary_size("DICT_APRILTAG_" + family[3:]) - rows * columns
        return TagBoard(
            rows=rows,
            columns=columns,
            tag_size_m=draw(lengths),
            gap_m=draw(lengths),
            family=family,
            first_id=draw(st.integers(0, most)),
            ids_from=draw(st.sampled_from(["top", "bottom"])),
            corner_squares=draw(st.booleans()),
        )
    if kind == "charuco":
        square = draw(lengths)
        large = [n for n in dictionary_names() if dictionary_size(n) >= 40]
        return CharucoBoard(
            rows=draw(st.integers(3, 9)),
            columns=draw(st.integers(3, 9)),
            square_m=square,
            marker_m=square * draw(st.floats(0.3, 0.95)),
            dictionary=draw(st.sampled_from(large)),
            legacy=draw(st.booleans()),
        )
    if kind == "chessboard":
        return Chessboard(rows=draw(counts), columns=draw(counts), square_m=draw(lengths))
    kinds = {"asymmetric": st.booleans(), "large_origin": st.booleans()}
    return draw(st.builds(CircleGrid, rows=counts, columns=counts, pitch_m=lengths, **kinds))


@given(target=targets())
@settings(max_examples=40, deadline=None)
def test_every_target_comes_back_from_json_and_from_its_line(target: Target) -> None:
    through_file = target_from_json(json.loads(json.dumps(target_to_json(target))))
    assert fields_of(through_file) == fields_of(target)
    line = format_target(target)
    assert fields_of(parse_target(line)) == fields_of(target)
    assert format_target(parse_target(line)) == line
    assert "\n" not in describe(target) and "\n" not in line


@given(tenths=st.integers(5, 9999))
def test_millimetres_are_scaled_as_decimal_numbers(tenths: int) -> None:
    mm, metres = f"{tenths // 10}.{tenths % 10}", float(f"{tenths}e-4")
    assert parse_length(f"{mm}mm", "square") == metres
    told = {"kind": "chessboard", "rows": 6, "columns": 8, "square_mm": float(mm)}
    board = target_from_json(told)
    assert isinstance(board, Chessboard) and board.square_m == metres


def test_the_documented_lines() -> None:
    documented = {
        "charuco:5x7,square=33mm,marker=20mm,dict=6X6_100":
        CharucoBoard(rows=7, columns=5, square_m=0.033, marker_m=0.02, dictionary="DICT_6X6_100"),
        "chessboard:8x6,square=21.9mm": Chessboard(rows=6, columns=8, square_m=0.0219),
        "circles:10x10,pitch=1in,large-origin":
        CircleGrid(rows=10, columns=10, pitch_m=0.0254, large_origin=True),
        "aprilgrid:6x4,tag=40mm,gap=10mm,family=25h9,first=3,from-bottom":
        TagBoard(rows=4, columns=6, tag_size_m=0.04, gap_m=0.01, family="tag25h9", first_id=3,
                 ids_from="bottom"),
        "tag:7,size=80mm": TagBoard(rows=1, columns=1, tag_size_m=0.08, gap_m=0.01, first_id=7),
    }  # fmt: skip
    for line, target in documented.items():
        assert fields_of(parse_target(line)) == fields_of(target)
    assert parse_target("ChArUco: 5 x 7 , square = 33 mm, marker=2cm, dict=dict_6x6_100, legacy")


def test_every_form_accepts_its_own_usage_line() -> None:
    for form in FORMS.values():
        plain = form.usage.split("[", maxsplit=1)[0]
        everything = form.usage.replace("[", "").replace("]", "")
        assert parse_target(plain)
        assert parse_target(everything)


@pytest.mark.parametrize(
    ("line", "names"),
    [
        ("", ["no kind of target", "charuco:", "chessboard:", "circles:", "aprilgrid:", "tag:"]),
        ("chessboard:8,square=2mm", ["'8'", "INNER CORNERS"]),
        ("chessboard:8x6,square=21.9", ["'square=21.9'", "no unit", "mm", "square=21.9mm"]),
        ("chessboard:8x6,square=21.9ft", ["'ft'", "mm, cm, m, in"]),
        ("chessboard:8x6,square=5mm,square=6mm", ["'square'", "twice"]),
        ("charuco:5x7,square=33mm,marker=20mm,dict=6X6_99", ["'6X6_99'", "6X6_100"]),
        ("charuco:15x17,square=20mm,marker=13mm,dict=6X6_100", ["127", "100"]),
        ("aprilgrid:6x4,tag=40mm,gap=10mm,first=570", ["570 to 593", "0 to 586"]),
        ("tag:7," + "size=80mm," * 60, ["400 characters"]),
    ],
)
def test_a_wrong_line_names_the_word_and_what_is_accepted(line: str, names: list[str]) -> None:
    said = refused(".", parse_target, line)
    assert all(name in said for name in names), said


nonsense = st.text("0123456789xmc=,.squaretipdg", max_size=40)
kinds = st.sampled_from(sorted(FORMS))


@given(line=st.text(max_size=60) | st.builds("{}:{}".format, kinds, nonsense))
@settings(max_examples=60, deadline=None)
def test_no_line_gives_anything_but_a_target_or_an_input_error(line: str) -> None:
    try:
        assert parse_target(line).points_board.shape[1] == 3
    except InputError as error:
        assert str(error)


# --- objects and files ------------------------------------------------------------------------

CHESS = {"kind": "chessboard", "rows": 6, "columns": 8, "square_m": 0.025}
TAGS = {"kind": "tag_board", "rows": 4, "columns": 6, "tag_size_m": 0.04, "gap_m": 0.01}
CHARUCO = {"kind": "charuco", "rows": 7, "columns": 5, "square_mm": 33, "marker_mm": 20}


def test_a_tag_board_of_the_store_is_read_without_kind() -> None:
    board = TagBoard(rows=4, columns=6, tag_size_m=0.04, gap_m=0.01, first_id=5)
    assert fields_of(target_from_json(to_json(board))) == fields_of(board)


@pytest.mark.parametrize(
    ("values", "names"),
    [
        ([1, 2], ["a list", "kind"]),
        ({"kind": "chess"}, ["'chess'", "tag_board, charuco, chessboard, circle_grid"]),
        (CHESS | {"square_mm": 25}, ["'square_m'", "'square_mm'", "once"]),
        ({k: v for k, v in CHESS.items() if k != "square_m"}, ["'square_m' or 'square_mm'"]),
        (CHESS | {"sqare_mm": 25, "x": 1}, ["sqare_mm, x", "square_mm"]),
        (CHESS | {"square_m": 25}, ["millimetres"]),
        (TAGS | {"corner_squares": "yes"}, ["'corner_squares'", "true or false"]),
        (CHARUCO | {"dictionary": "5X5"}, ["'5X5'", "5X5_100"]),
        ({"target_type": "aprilgrid", "tagCols": 6, "tagRows": 6, "tagSize": 0.088,
          "tagSpacing": 0.0264}, ["0.0264", "share of tagSize", "in metres"]),
        ({"target_type": "checkerboard", "targetCols": 6, "targetRows": 7,
          "rowSpacingMeters": 0.05, "colSpacingMeters": 0.06}, ["0.05", "0.06", "square"]),
    ],
)  # fmt: skip
def test_a_wrong_object_names_the_key_and_what_is_accepted(values: Any, names: list[str]) -> None:
    said = refused(".", target_from_json, values)
    assert all(name in said for name in names) and len(said) < 2000, said


def write(folder: Path, name: str, text: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_kalibr_files(tmp_path: Path) -> None:
    april = TagBoard(rows=5, columns=6, tag_size_m=0.088, gap_m=0.0264, ids_from="bottom",
                     corner_squares=True)  # fmt: skip
    for name, target, text in (
        ("april.yaml", april,
         "target_type: 'aprilgrid' #gridtype\ntagCols: 6\ntagRows: 5  # rows\n"
         "tagSize: 0.088  #edge to edge [m]\ntagSpacing: 0.3  #ratio\n"),
        ("chess.yml", Chessboard(rows=7, columns=6, square_m=0.06),
         "target_type: 'checkerboard'\ntargetCols: 6\ntargetRows: 7\n"
         "rowSpacingMeters: 0.06\ncolSpacingMeters: 0.06\n"),
        ("circles.yaml", CircleGrid(rows=11, columns=4, pitch_m=0.02, asymmetric=True),
         "target_type: circlegrid\ntargetCols: 4\ntargetRows: 11\n"
         "spacingMeters: 0.02\nasymmetricGrid: True\n"),
    ):  # fmt: skip
        assert fields_of(read_target(write(tmp_path, name, text))) == fields_of(target)
    assert april.ids[0] == 24 and april.ids[-6] == 0


@pytest.mark.parametrize(
    ("name", "content", "names"),
    [
        ("a.txt", "kind: chessboard", [".json, .yaml, .yml", "'.txt'"]),
        ("a.json", "{", ["not valid JSON"]),
        ("a.json", b"{" + b" " * LARGEST_BYTES + b"}", ["at most 0.065536 MB"]),
        ("a.yaml", "kind: [chessboard", ["not valid YAML", "line"]),
    ],
)
def test_wrong_files_are_named(
    tmp_path: Path, name: str, content: str | bytes, names: list[str]
) -> None:
    said = refused(".", read_target, write(tmp_path, name, content))
    assert all(part in said for part in (name, *names)), said


def test_yaml_runs_no_code_and_aliases_do_not_grow(tmp_path: Path) -> None:
    marker = tmp_path / "ran"
    code = f"kind: !!python/object/apply:os.system ['touch {marker}']\n"
    refused("has the tag", read_target, write(tmp_path, "code.yaml", code))
    assert not marker.exists()
    nested = "a0: &a0 [x, x]\n" + "".join(
        f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}, *a{k - 1}, *a{k - 1}]\n" for k in range(1, 40)
    )
    assert len(refused(".", read_target, write(tmp_path, "bomb.yaml", nested))) < 500


def test_descriptions_are_readable() -> None:
    lines = {
        "chessboard:8x6,square=20mm": (
            "Chessboard, 8 x 6 inner corners, squares of 20 mm; looks the same turned by 180 deg"
        ),
        "aprilgrid:6x4,tag=25mm,gap=8mm,first=4": (
            "AprilGrid, 6 x 4 tags of 25 mm, gaps of 8 mm, tag36h11, ids 4 to 27 from the top"
        ),
    }
    for line, text in lines.items():
        assert describe(parse_target(line)) == text
