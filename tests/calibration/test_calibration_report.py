"""The calibration's page, made from a calibration of a simulated arm: what it says."""

import base64
import dataclasses
import math
import re
import time
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from realsim.geometry.dh import DhArm
from realsim.records import ArmErrorMap, CameraIntrinsics, Check
from realsim.records.depth_bias import DepthBias
from realsim_calibration.depth.bias import DepthBiasReport, DepthViewReport
from realsim_calibration.lens.intrinsics import calibrate_intrinsics
from realsim_calibration.report import check_rows, summary_rows, verdict
from realsim_calibration.report.page import PAGE_NAME, write_calibration_report
from realsim_calibration.results import BoardShape, HandEyeReport
from realsim_calibration.views import detection_of

Maker = Callable[..., HandEyeReport]
HOSTILE = "<script>alert('$x^2$ & _y_')</script>.png"
ODD_NAME = "图像 \u202e\n\t$" + "x" * 200
CPU_LIMIT_S = 15.0
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
def page(
    report: HandEyeReport, tmp_path_factory: pytest.TempPathFactory
) -> tuple[list[Path], float]:
    """Return the files of a report of 16 views with photographs, and the CPU time it took [s]."""
    repeated = tuple(
        dataclasses.replace(report.views[k % len(report.views)], index=k) for k in range(16)
    )
    photo = np.full((720, 1280, 3), 200, np.uint8)
    cv2.circle(photo, (640, 360), 200, (40, 90, 160), -1)
    folder = tmp_path_factory.mktemp("page") / "new" / "folder"
    start = time.process_time()
    paths = write_calibration_report(
        dataclasses.replace(report, views=repeated), folder, images=lambda index: photo,
        title=f"Cell 4 {HOSTILE}",
    )  # fmt: skip
    return paths, time.process_time() - start


class Outline(HTMLParser):
    """Collects tags and checks that they are closed in order."""

    VOID = ("meta", "img", "br", "hr", "link", "input")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def outline(path: Path) -> Outline:
    parser = Outline()
    parser.feed(path.read_text(encoding="utf-8"))
    assert parser.open == []
    return parser


def test_the_simulated_calibration_found_the_truth(report: HandEyeReport) -> None:
    """The pictures are of a fit that works: the board's scale and the lens come back."""
    assert abs(report.board.scale - 0.9958) < 0.003
    assert abs(report.intrinsics.fx - 644.0) < 4
    assert report.seen_px < report.held_out_px < 4.0
    assert [index for index, _ in report.rejected] == [7, 15]


def test_the_page_is_one_file(page: tuple[list[Path], float]) -> None:
    paths, _ = page
    assert paths[0].name == PAGE_NAME
    for tag, attributes in outline(paths[0]).tags:
        assert tag not in ("link", "iframe", "object", "embed")
        assert (attributes.get("src") or "data:").startswith("data:")
    assert "url(" not in paths[0].read_text() and "@import" not in paths[0].read_text()


def test_the_pictures_in_the_page_are_those_beside_it(page: tuple[list[Path], float]) -> None:
    paths, _ = page
    shown = [a["src"] or "" for tag, a in outline(paths[0]).tags if tag == "img" and "src" in a]
    beside = [p.read_bytes() for p in paths[1:]]
    assert [base64.b64decode(s.partition(",")[2]) for s in shown] == beside
    assert {p for p in paths[0].parent.iterdir()} == set(paths)  # nothing half-written
    for data in beside:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None and image.std() > 5 and image.shape[1] < 1700


def test_hostile_names_are_text(report: HandEyeReport, page: tuple[list[Path], float]) -> None:
    text = page[0][0].read_text()
    assert "<script>alert" not in text and "<b>$bold$" not in text
    shown = "".join(outline(page[0][0]).words)
    assert report.views[3].label == HOSTILE and HOSTILE in shown and "<b>$bold$</b>" in shown


def test_the_page_says_the_figures(report: HandEyeReport, page: tuple[list[Path], float]) -> None:
    shown = " ".join(outline(page[0][0]).words)
    for text in (
        f"{report.held_out_px:.2f} px",
        f"{report.held_out_mm:.2f} mm",
        verdict(report).headline,
        "Measure the board over several tags",
        "view_007.png",
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


def test_checks_name_views_by_their_files(report: HandEyeReport) -> None:
    row = next(r for r in check_rows(report) if r[1] == "dropped views")
    assert "view_007.png, view_015.png" in row[3] and row[4].startswith("Look at")
    assert all(len(r) == 2 for r in summary_rows(report))


# --- reports at the edge ------------------------------------------------------------------------


def without_views(r: HandEyeReport) -> HandEyeReport:
    return dataclasses.replace(r, views=(), checks=(), map_scores=(), starts=(), robot_map=None)


def all_dropped(r: HandEyeReport) -> HandEyeReport:
    nan, e = math.nan, np.zeros(6)
    return dataclasses.replace(
        r, seen_px=nan, held_out_px=nan, held_out_mm=nan, held_out_deg=nan,
        views=tuple(
            dataclasses.replace(v, used=False, reason="no", residuals=np.zeros((0, 2)), uv=v.uv[:0],
                                point_ids=v.point_ids[:0],
                                seen_px=nan, unseen_px=nan, robot_error=e) for v in r.views
        ),
    )  # fmt: skip


def everything_held(r: HandEyeReport) -> HandEyeReport:
    flat = BoardShape(scale=1.0, aspect=0.0, warp=np.zeros(3), sd=np.zeros(5), half_extent_m=0.115,
                      half_sides_m=(0.115, 0.075))  # fmt: skip
    ideal = CameraIntrinsics(width=1280, height=720, fx=640.0, fy=640.0, cx=639.5, cy=359.5)
    return dataclasses.replace(
        r, board=flat, intrinsics=ideal, intrinsics_covariance=np.zeros((12, 12)), robot_map=None,
        X_covariance=np.zeros((6, 6)), starts=(("park", math.inf), ("shah", math.nan)),
        map_scores=(("none", 0.5),), X=np.eye(4), X_alone=np.eye(4), views=r.views[:1],
    )  # fmt: skip


def of_an_arm(r: HandEyeReport) -> HandEyeReport:
    arm = DhArm(name="arm", a=np.ones(6), d=np.ones(6), alpha=np.zeros(6))
    found = ArmErrorMap(arm=arm, errors=np.zeros(24), T_flange_tool=np.eye(4))
    return dataclasses.replace(
        r, robot_map=found, map_name="arm", joint_offsets=np.full((6, 2), 1e-3),
        views=tuple(dataclasses.replace(v, label=ODD_NAME) for v in r.views[:5]),
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("change", [without_views, all_dropped, everything_held, of_an_arm])
def test_reports_at_the_edge_are_written(
    report: HandEyeReport, change: Callable[[HandEyeReport], HandEyeReport], tmp_path: Path
) -> None:
    paths = write_calibration_report(change(report), tmp_path, images=lambda index: None)
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
    paths = write_calibration_report(report, tmp_path, intrinsics_report=lens,
                                     depth_report=depth_report())  # fmt: skip
    shown = " ".join(outline(paths[0]).words)
    assert "camera in the base [mm]" in shown and "lens alone" in shown
    assert {"lens_alone.png", "depth_bias.png"} <= {p.name for p in paths}
    assert "3 of the views <lie>" in shown


def depth_report() -> DepthBiasReport:
    """Return a depth camera that reads 0.4 % too far and 0.05 / m off, with noise."""
    rng = np.random.default_rng(1)
    bias = DepthBias(scale=1.004, offset_per_m=0.01, covariance=np.diag([1e-6, 1e-6]),
                     noise_per_m=2e-3, range_m=(0.25, 0.6))  # fmt: skip
    z = np.linspace(0.25, 0.6, 14)
    measured = bias.measured(z) + rng.normal(scale=2e-4, size=14)
    views = tuple(
        DepthViewReport(
            index=k, label=f"{k}.png", used=k != 5, reason="tilted" if k == 5 else "",
            distance_m=float(d), bias_m=float(m - d), residual_m=float(bias.corrected(m) - d),
            unseen_m=float(1.1 * (bias.corrected(m) - d)), noise_m=2e-3 * float(d) ** 2,
            temporal_noise_m=math.nan, tilt_error_deg=0.1, valid_share=0.99, inlier_share=0.98,
        )
        for k, (d, m) in enumerate(zip(z, measured, strict=True))
    )  # fmt: skip
    return DepthBiasReport(
        bias=bias, view_covariance=np.eye(2), board_covariance=np.eye(2), disparity_px=0.1,
        disparity_sd_px=0.01, focal_px=640.0, baseline_m=0.018, middle_m=0.4, middle_bias_m=1e-3,
        middle_sd_m=1e-4, scatter_per_m=1e-3, shift_px=np.zeros(2), shift_sd_px=np.ones(2),
        noise_exponent=2.0, held_out_m=3e-4, uncorrected_m=2e-3, views=views,
        checks=(Check(name="depth", verdict="warn", sentence="3 of the views <lie>."),),
    )  # fmt: skip
