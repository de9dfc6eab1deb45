"""The calibration's page, made from a calibration of a simulated arm: what it says."""

import base64
import dataclasses
import math
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

import board_depth
from page_tags import Tags
from realsim.records import Check
from realsim.records.depth_bias import DepthBias
from realsim_calibration.lens.intrinsics import calibrate_intrinsics
from realsim_calibration.report import check_rows, summary_rows, verdict
from realsim_calibration.report.page import PAGE_NAME, write_calibration_report
from realsim_calibration.results import HandEyeReport
from realsim_calibration.views import detection_of

Maker = Callable[..., HandEyeReport]
HOSTILE = "<script>alert('$x^2$ & _y_')</script>.png"
ODD_NAME = "图像 \u202e\n\t$" + "x" * 200
CHECKS = (
    Check(name="views", verdict="good", sentence="22 of 24 views were used.", value=22),
    Check(name="roll", verdict="good", sentence="The camera rolls through 330 deg.", value=330.0,
          unit="deg"),
    Check(name="board scale", verdict="warn", value=0.9958,
          sentence="The print is 0.42 % smaller than its drawing.",
          advice="Measure the board over several tags and give the size that you found."),
    Check(name="screw axes", verdict="unknown", sentence="The hand hardly slides along its axes."),
    Check(name="dropped views", verdict="warn", sentence="Two views were dropped.",
          advice="Look at the photographs: was the arm still moving?", views=(7, 15)),
)  # fmt: skip


# --- the page -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def report(calibrated_arm: Maker) -> HandEyeReport:
    """Return a real calibration, with some checks of every verdict added to its own."""
    found = calibrated_arm()
    return dataclasses.replace(found, checks=(*found.checks, *CHECKS))


@pytest.fixture(scope="module")
def paths(report: HandEyeReport, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return the files of a report of six views with photographs."""
    photo = np.full((360, 640, 3), 200, np.uint8)
    cv2.circle(photo, (320, 180), 100, (40, 90, 160), -1)
    folder = tmp_path_factory.mktemp("page") / "new" / "folder"
    return write_calibration_report(
        dataclasses.replace(report, views=tuple(report.views[k] for k in (0, 3, 5, 7, 12, 15))),
        folder, images=lambda index: photo, title=f"Cell 4 {HOSTILE}",
    )  # fmt: skip


def outline(path: Path) -> Tags:
    return Tags(path.read_text(encoding="utf-8"))


@pytest.mark.slow
def test_the_page_is_one_file(paths: list[Path]) -> None:
    assert paths[0].name == PAGE_NAME
    for tag, attributes in outline(paths[0]).seen:
        assert tag not in ("iframe", "object", "embed")
        assert tag != "link" or attributes["href"] == "data:,"  # no icon is asked for
        assert (attributes.get("src") or "data:").startswith("data:")
    assert "url(" not in paths[0].read_text() and "@import" not in paths[0].read_text()


@pytest.mark.slow
def test_the_pictures_in_the_page_are_those_beside_it(paths: list[Path]) -> None:
    shown = [a["src"] or "" for tag, a in outline(paths[0]).seen if tag == "img" and "src" in a]
    beside = [p.read_bytes() for p in paths[1:]]
    assert [base64.b64decode(s.partition(",")[2]) for s in shown] == beside
    assert {p for p in paths[0].parent.iterdir()} == set(paths)  # nothing half-written
    for data in beside:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None and image.std() > 5 and image.shape[1] < 1700


@pytest.mark.slow
def test_hostile_names_are_text(report: HandEyeReport, paths: list[Path]) -> None:
    text, shown = paths[0].read_text(), "".join(outline(paths[0]).words)
    assert "<script>alert" not in text and "<b>$bold$" not in text
    assert report.views[3].label == HOSTILE and HOSTILE in shown and "<b>$bold$</b>" in shown


@pytest.mark.slow
def test_the_page_says_the_figures(report: HandEyeReport, paths: list[Path]) -> None:
    shown = " ".join(outline(paths[0]).words)
    for text in (
        f"{report.held_out_px:.2f} px",
        f"{report.held_out_mm:.2f} mm",
        verdict(report).headline,
        "Measure the board over several tags",
        report.views[7].reason,
        report.checks[0].sentence,
    ):
        assert text in shown
    # The verdict comes before the checks, these before the pictures.
    order = [
        shown.index(t) for t in (verdict(report).headline, "Measure the board", "Where the camera")
    ]
    assert order == sorted(order)


@pytest.mark.parametrize(
    ("verdicts", "expected", "says"),
    [
        (("good", "bad", "warn"), "bad", "Do not use"),
        (("good", "warn", "unknown"), "warn", "with care"),
        (("good", "unknown"), "good", "1 checks passed, 1 could not be made"),
        (("unknown",), "unknown", "Nothing was checked"),
        ((), "unknown", "Nothing was checked"),
    ],
)
def test_the_verdict_is_that_of_the_worst_check(
    report: HandEyeReport, verdicts: tuple[str, ...], expected: str, says: str
) -> None:
    checks = tuple(Check(name=f"c{k}", verdict=v, sentence=f"S{k}.")  # type: ignore[arg-type]
                   for k, v in enumerate(verdicts))  # fmt: skip
    changed = dataclasses.replace(report, checks=checks)
    judged = verdict(changed)
    assert judged.verdict == expected and says in judged.headline + judged.sentence
    order = [row[0] for row in check_rows(changed)]
    assert order == sorted(order, key=["bad", "warn", "unknown", "good"].index)


def test_verdict_and_table_count_the_checks_of_the_lens(report: HandEyeReport) -> None:
    good = Check(name="c", verdict="good", sentence="S.")
    lens = (good, Check(name="border", verdict="warn", sentence="90 px.", views=(0,)))
    changed = dataclasses.replace(report, checks=(good,))
    judged = verdict(changed, lens)
    assert judged.verdict == "warn" and "1 of 3 checks gave a warning" in judged.sentence
    assert check_rows(changed, lens)[0][:4] == ["warn", "border", "", "90 px."]


def test_checks_name_views_by_their_files(report: HandEyeReport) -> None:
    row = next(r for r in check_rows(report) if r[1] == "dropped views")
    assert "view_007.png, view_015.png" in row[3] and row[4].startswith("Look at")
    rows = summary_rows(report)
    assert all(len(r) == 2 for r in rows)
    assert "ros2_static_transform.sh" in dict(rows)["camera pose for ROS and URDF"]


# --- reports at the edge ------------------------------------------------------------------------


@pytest.mark.slow
def test_a_report_of_dropped_views_is_written(report: HandEyeReport, tmp_path: Path) -> None:
    nan, e = math.nan, np.zeros(6)
    dropped = tuple(
        dataclasses.replace(v, used=False, reason="no", residuals=np.zeros((0, 2)), uv=v.uv[:0],
                            point_ids=v.point_ids[:0], label=ODD_NAME,
                            seen_px=nan, unseen_px=nan, robot_error=e) for v in report.views[:4]
    )  # fmt: skip
    bare = dataclasses.replace(
        report, seen_px=nan, held_out_px=nan, held_out_mm=nan, held_out_deg=nan, views=dropped
    )
    paths = write_calibration_report(bare, tmp_path, images=lambda index: None)
    shown = " ".join(outline(paths[0]).words)
    assert not re.search(r"\bnan\b", shown)
    assert "Where the camera is" in shown and all(p.stat().st_size > 1000 for p in paths)


@pytest.mark.slow
def test_a_camera_beside_the_robot_with_lens_and_depth(
    calibrated_arm: Maker, tmp_path: Path
) -> None:
    report = calibrated_arm(16, "eye_to_hand", with_map=False)
    detections = [detection_of(report.target, v.uv, (1280, 720), v.point_ids) for v in report.used]
    lens = calibrate_intrinsics(detections, report.target)
    warned = Check(name="depth", verdict="warn", sentence="3 of the views <lie>.")
    depth = board_depth.run(board_depth.views_of(DepthBias(scale=1.004, offset_per_m=0.01)))
    depth = dataclasses.replace(depth, checks=(warned,))
    paths = write_calibration_report(report, tmp_path, intrinsics_report=lens,
                                     depth_report=depth)  # fmt: skip
    shown = " ".join(outline(paths[0]).words)
    assert "camera in the base for this arm [mm]" in shown and "lens alone" in shown
    assert "exported, with X_alone" in shown and lens.checks[0].sentence in shown
    assert {"lens_alone.png", "depth_bias.png"} <= {p.name for p in paths}
    assert "3 of the views <lie>" in shown
