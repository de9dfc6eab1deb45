"""The calibration's page, made from a calibration of a simulated arm: what it says."""

import base64
import io
import math
import re
import warnings
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.text import Text

import board_depth
from page_tags import Tags
from realsim.geometry import camera, se3
from realsim.records import ArmErrorMap, Check, HandEye
from realsim.records.calibration import DepthBias
from realsim_calibration.lens.intrinsics import calibrate_intrinsics
from realsim_calibration.report import style
from realsim_calibration.report.model_plots import lens_field
from realsim_calibration.report.page import PAGE_NAME, write_calibration_report
from realsim_calibration.report.scene_3d import frustum
from realsim_calibration.report.summary import (
    camera_in_board,
    check_rows,
    corrected,
    pose_rows,
    rest_of_map,
    summary_rows,
    verdict,
    viewpoint,
)
from realsim_calibration.report.view_plots import plot_views
from realsim_calibration.results import HandEyeReport, Mode
from realsim_calibration.views import detection_of
from refusals import refused
from tests.calibration.conftest import TRUE_LENS, arm_calibration

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
def report() -> HandEyeReport:
    """Return a real calibration, with some checks of every verdict added to its own."""
    found = arm_calibration()
    return replace(found, checks=(*found.checks, *CHECKS))


@pytest.fixture(scope="module")
def paths(report: HandEyeReport, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return the files of a report of six views with photographs."""
    photo = np.full((360, 640, 3), 200, np.uint8)
    cv2.circle(photo, (320, 180), 100, (40, 90, 160), -1)
    folder = tmp_path_factory.mktemp("page") / "new" / "folder"
    return write_calibration_report(
        replace(report, views=tuple(report.views[k] for k in (0, 3, 5, 7, 12, 15))),
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
    parts = (verdict(report).headline, "Measure the board", "Where the camera")
    assert sorted(parts, key=shown.index) == list(parts)


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
    changed = replace(report, checks=checks)
    judged = verdict(changed)
    assert judged.verdict == expected and says in judged.headline + judged.sentence
    order = [row[0] for row in check_rows(changed)]
    assert order == sorted(order, key=["bad", "warn", "unknown", "good"].index)


def test_verdict_and_table_count_the_checks_of_the_lens(report: HandEyeReport) -> None:
    good = Check(name="c", verdict="good", sentence="S.")
    lens = (good, Check(name="border", verdict="warn", sentence="90 px.", views=(0,)))
    changed = replace(report, checks=(good,))
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
        replace(v, used=False, reason="no", residuals=np.zeros((0, 2)), uv=v.uv[:0],
                            point_ids=v.point_ids[:0], label=ODD_NAME,
                            seen_px=nan, unseen_px=nan, robot_error=e) for v in report.views[:4]
    )  # fmt: skip
    unknown = dict.fromkeys(("seen_px", "held_out_px", "held_out_mm", "held_out_deg"), nan)
    bare = replace(report, views=dropped, **unknown)
    paths = write_calibration_report(bare, tmp_path, images=lambda index: None)
    shown = " ".join(outline(paths[0]).words)
    assert not re.search(r"\bnan\b", shown)
    assert "Where the camera is" in shown and all(p.stat().st_size > 1000 for p in paths)


@pytest.mark.slow
def test_a_camera_beside_the_robot_with_lens_and_depth(tmp_path: Path) -> None:
    report = arm_calibration(16, "eye_to_hand", with_map=False)
    detections = [detection_of(report.target, v.uv, (1280, 720), v.point_ids) for v in report.used]
    lens = calibrate_intrinsics(detections, report.target)
    warned = Check(name="depth", verdict="warn", sentence="3 of the views <lie>.")
    depth = board_depth.run(board_depth.views_of(DepthBias(scale=1.004, offset_per_m=0.01)))
    depth = replace(depth, checks=(warned,))
    paths = write_calibration_report(report, tmp_path, intrinsics_report=lens,
                                     depth_report=depth)  # fmt: skip
    shown = " ".join(outline(paths[0]).words)
    assert "camera in the base for this arm [mm]" in shown and "lens alone" in shown
    assert "exported, with X_alone" in shown and lens.checks[0].sentence in shown
    assert {"lens_alone.png", "depth_bias.png"} <= {p.name for p in paths}
    assert "3 of the views <lie>" in shown


# --- The pictures of a calibration's page: what they are drawn from, and what stands in them.


@pytest.mark.parametrize(
    ("mode", "tilt", "azimuth", "roll"),
    [("eye_in_hand", 0, 0, 30), ("eye_in_hand", 25, 60, -40), ("eye_to_hand", 50, -120, 170)],
)
def test_viewpoint_of_a_known_camera(
    report: HandEyeReport, mode: Mode, tilt: float, azimuth: float, roll: float
) -> None:
    t, a, r = np.radians([tilt, azimuth, roll])
    middle = np.array([*report.target.size_m, 0]) / 2
    # A camera that looks straight down on the page, tilted about the target's middle, then rolled.
    R = se3.exp_so3(t * np.array([-np.sin(a), np.cos(a), 0])).T @ se3.exp_so3([0, 0, -r])
    T_board_cam = se3.from_rt(R, middle - 0.4 * R[:, 2])
    A = report.Z @ T_board_cam @ se3.invert(report.X)
    if mode == "eye_to_hand":
        A = report.X @ se3.invert(T_board_cam) @ se3.invert(report.Z)
    changed = replace(report, mode=mode, robot_map=None)
    view = replace(report.views[0], T_base_ee=A)
    np.testing.assert_allclose(camera_in_board(changed, view), T_board_cam, atol=1e-9)
    p = viewpoint(changed, view)
    assert p.distance_m == pytest.approx(0.4, abs=1e-9)
    assert p.tilt_deg == pytest.approx(tilt, abs=1e-5)
    if tilt == 0:
        assert p.roll_deg == pytest.approx(roll, abs=1e-9)
    else:
        assert np.cos(np.radians(p.azimuth_deg) - a) == pytest.approx(1, abs=1e-9)


def test_the_arms_map_explains_most_of_the_error() -> None:
    """Errors of a milliradian per joint: what the solver's map leaves is a fraction of them."""
    report = arm_calibration(with_joints=True)
    assert isinstance(report.robot_map, ArmErrorMap) and report.map_name == "arm"
    rests = [rest_of_map(report, v) for v in report.used]
    left = np.array([r for r in rests if r is not None])
    whole = np.array([v.robot_error for v in report.used])
    assert len(left) == len(whole)
    for part in (slice(0, 3), slice(3, 6)):
        assert np.linalg.norm(left[:, part]) < 0.4 * np.linalg.norm(whole[:, part])
    unknown = replace(report.used[0], joints=None)
    assert rest_of_map(report, unknown) is None
    assert np.array_equal(corrected(report, unknown), unknown.T_base_ee)


def test_camera_poses_of_an_arm_s_calibration_need_joints() -> None:
    report = arm_calibration(with_joints=True)
    hand_eye = report.hand_eye
    assert isinstance(hand_eye, HandEye)
    view = report.used[0]
    refused("joint angles are needed", hand_eye.camera_poses, view.T_base_ee)
    T = hand_eye.camera_poses(view.T_base_ee, view.joints)
    moved = se3.log(se3.invert(view.T_base_ee @ hand_eye.T_ee_cam) @ T)
    assert 0 < np.linalg.norm(moved[3:]) < 5e-3


def test_names_that_the_font_lacks() -> None:
    assert style.view_label("图像_0007.png", 7) == "view 7"
    assert style.view_label("ｖｉｅｗ１.png", 7) == "view1.png"
    assert style.view_label("Übersicht_é.png", 7) == "Übersicht_é.png"


def test_pictures_have_no_letters_that_the_font_lacks(report: HandEyeReport) -> None:
    odd = tuple(
        replace(v, label=f"图像_{v.index}.png", reason="没有" if v.reason else "")
        for v in report.views
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with style.paper_style():  # a letter that the font lacks would be a warning, here an error
            figure = plot_views(replace(report, views=odd))
            figure.savefig(out := io.BytesIO(), format="png")
    assert out.getvalue().startswith(b"\x89PNG")
    shown = "".join(text.get_text() for text in figure.findobj(Text))
    assert "view " in shown and "图" not in shown


def test_sigma_is_given_along_the_axes_of_the_carrier(report: HandEyeReport) -> None:
    """A camera turned by 90 deg about z: its x is the tool's y, so is its uncertainty."""
    X = se3.from_rt(se3.exp_so3([0, 0, np.pi / 2]), [0.01, 0.02, 0.03])
    C = np.diag([1e-8, 1e-8, 1e-8, 9e-6, 1e-6, 4e-6])
    row = pose_rows(replace(report, X_here=X, X_here_covariance=C))[0]
    assert row[1] == "x 10.000 ± 1.000, y 20.000 ± 3.000, z 30.000 ± 2.000"


def test_frustum_meets_the_corners_of_the_image() -> None:
    ideal = replace(TRUE_LENS, distortion=np.zeros(8))
    uv = camera.project(ideal, frustum(ideal, 0.3)[1:])
    np.testing.assert_allclose(uv, [[-0.5, -0.5], [1279.5, -0.5], [1279.5, 719.5], [-0.5, 719.5]])


def test_lens_field_undoes_the_lens() -> None:
    uv, shift = lens_field(TRUE_LENS)
    ideal = (uv - shift - [TRUE_LENS.cx, TRUE_LENS.cy]) / [TRUE_LENS.fx, TRUE_LENS.fy]
    rays = np.concatenate([ideal, np.ones((*ideal.shape[:-1], 1))], -1)
    np.testing.assert_allclose(camera.project(TRUE_LENS, rays), uv, atol=1e-6)
    _, none = lens_field(replace(TRUE_LENS, distortion=np.zeros(8)))
    assert np.abs(none).max() < 1e-9
