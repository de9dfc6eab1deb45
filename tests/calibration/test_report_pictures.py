"""The pictures of a calibration's page: what they are drawn from, and what stands in them."""

import dataclasses
import io
import math
import warnings
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from realsim.geometry import camera, se3
from realsim.records import ArmErrorMap, CameraIntrinsics, RobotErrorMap
from realsim_calibration.report import style, summary_rows, verdict
from realsim_calibration.report.model_plots import (
    lens_field,
)
from realsim_calibration.report.scene_3d import frustum, plot_camera_in_hand
from realsim_calibration.report.summary import (
    camera_in_board,
    corrected,
    pose_rows,
    rest_of_map,
    viewpoint,
)
from realsim_calibration.report.view_plots import (
    plot_coverage,
    plot_views,
)
from realsim_calibration.results import HandEyeReport, Mode

Array = NDArray[np.float64]
Maker = Callable[..., HandEyeReport]
LENS = CameraIntrinsics(
    width=1280, height=720, fx=644.0, fy=643.0, cx=643.0, cy=356.0,
    distortion=np.array([-0.05, 0.04, 6e-4, -4e-4, 0, 0, 0, 0]),
)  # fmt: skip


@pytest.fixture(scope="module")
def report(calibrated_arm: Maker) -> HandEyeReport:
    return calibrated_arm()


def test_viewpoints_do_not_depend_on_where_the_base_is(report: HandEyeReport) -> None:
    G = se3.exp([0.3, -0.4, 1.1, 0.5, -0.2, 0.9])
    alone = dataclasses.replace(report, robot_map=None)
    moved = dataclasses.replace(
        alone, Z=G @ alone.Z,
        views=tuple(dataclasses.replace(v, T_base_ee=G @ v.T_base_ee) for v in alone.views),
    )  # fmt: skip
    for v, w in zip(alone.views, moved.views, strict=True):
        p, q = viewpoint(alone, v), viewpoint(moved, w)
        for name in ("tilt_deg", "azimuth_deg", "roll_deg", "distance_m"):
            assert getattr(p, name) == pytest.approx(getattr(q, name), abs=1e-6)


@pytest.mark.parametrize("mode", ["eye_in_hand", "eye_to_hand"])
@pytest.mark.parametrize(("tilt", "azimuth", "roll"), [(0, 0, 30), (25, 60, -40), (50, -120, 170)])
def test_viewpoint_of_a_known_camera(
    report: HandEyeReport, mode: Mode, tilt: float, azimuth: float, roll: float
) -> None:
    t, a, r = np.radians([tilt, azimuth, roll])
    w, h = report.target.size_m
    middle = np.array([w / 2, h / 2, 0])
    # A camera that looks straight down on the page, tilted about the target's middle, then rolled.
    lean = se3.exp_so3(t * np.array([-np.sin(a), np.cos(a), 0]))
    R = lean.T @ se3.exp_so3([0, 0, -r])
    T_board_cam = se3.from_rt(R, middle - 0.4 * R[:, 2])
    A = report.Z @ T_board_cam @ se3.invert(report.X)
    if mode == "eye_to_hand":
        A = report.X @ se3.invert(T_board_cam) @ se3.invert(report.Z)
    changed = dataclasses.replace(report, mode=mode, robot_map=None)
    view = dataclasses.replace(report.views[0], T_base_ee=A)
    np.testing.assert_allclose(camera_in_board(changed, view), T_board_cam, atol=1e-9)
    p = viewpoint(changed, view)
    assert p.distance_m == pytest.approx(0.4, abs=1e-9)
    assert p.tilt_deg == pytest.approx(tilt, abs=1e-5)
    if tilt == 0:
        assert p.roll_deg == pytest.approx(roll, abs=1e-9)
    else:
        assert np.cos(np.radians(p.azimuth_deg) - a) == pytest.approx(1, abs=1e-9)


def test_a_map_of_poses_that_knows_everything_leaves_nothing(report: HandEyeReport) -> None:
    rng = np.random.default_rng(2)
    poses = np.stack([v.T_base_ee for v in report.used])
    mean = np.concatenate([poses[:, :3, 3], poses[:, :3, :3].reshape(-1, 9)], -1).mean(0)
    bare = RobotErrorMap(
        frame="base", mean=mean, sd_m=0.1, weights=rng.normal(size=(6, 12)) * 1e-3,
        reach=np.zeros((len(poses), 12)),
    )  # fmt: skip
    view = dataclasses.replace(report.used[0], robot_error=bare.twist(poses[0]))
    rest = rest_of_map(dataclasses.replace(report, robot_map=bare), view)
    assert rest is not None and np.abs(rest).max() < 1e-12


def test_the_arms_map_explains_most_of_the_error(calibrated_arm: Maker) -> None:
    """Errors of a milliradian per joint: what the solver's map leaves is a fraction of them."""
    report = calibrated_arm(with_joints=True)
    assert isinstance(report.robot_map, ArmErrorMap) and report.map_name == "arm"
    rests = [rest_of_map(report, v) for v in report.used]
    left = np.array([r for r in rests if r is not None])
    whole = np.array([v.robot_error for v in report.used])
    assert len(left) == len(whole)
    for part in (slice(0, 3), slice(3, 6)):
        assert np.linalg.norm(left[:, part]) < 0.4 * np.linalg.norm(whole[:, part])
    unknown = dataclasses.replace(report.used[0], joints=None)
    assert rest_of_map(report, unknown) is None
    assert np.array_equal(corrected(report, unknown), unknown.T_base_ee)


@pytest.mark.parametrize(
    ("label", "shown"),
    [
        ("图像_0007.png", "view 7"),
        ("写真.png", "view 7"),
        ("ｖｉｅｗ１.png", "view1.png"),
        ("Übersicht_é.png", "Übersicht_é.png"),
        ("what?.png", "what?.png"),
    ],
)
def test_names_that_the_font_lacks(label: str, shown: str) -> None:
    assert style.view_label(label, 7) == shown


def test_pictures_have_no_letters_that_the_font_lacks(report: HandEyeReport) -> None:
    odd = tuple(
        dataclasses.replace(v, label=f"图像_{v.index}.png", reason="没有" if v.reason else "")
        for v in report.views
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with style.paper_style():  # a letter that the font lacks would be a warning, here an error
            plot_views(dataclasses.replace(report, views=odd)).savefig(io.BytesIO(), format="png")


def test_what_is_not_known_is_said_so(report: HandEyeReport) -> None:
    nan = math.nan
    bare = dataclasses.replace(
        report, seen_px=nan, held_out_px=nan, held_out_mm=nan, held_out_deg=nan, sigma_px=nan,
        roll_range_deg=nan,
    )  # fmt: skip
    rows = summary_rows(bare)
    words = " ".join(cell for row in rows for cell in row) + verdict(bare).sentence
    assert "not known" in words and "nan" not in words


def test_sigma_is_given_along_the_axes_of_the_carrier(report: HandEyeReport) -> None:
    """A camera turned by 90 deg about z: its x is the tool's y, so is its uncertainty."""
    X = se3.from_rt(se3.exp_so3([0, 0, np.pi / 2]), [0.01, 0.02, 0.03])
    C = np.diag([1e-8, 1e-8, 1e-8, 9e-6, 1e-6, 4e-6])
    row = pose_rows(dataclasses.replace(report, X=X, X_covariance=C))[0]
    assert row[1] == "x 10.000 ± 1.000, y 20.000 ± 3.000, z 30.000 ± 2.000"


def test_frustum_meets_the_corners_of_the_image() -> None:
    ideal = dataclasses.replace(LENS, distortion=np.zeros(8))
    uv = camera.project(ideal, frustum(ideal, 0.3)[1:])
    np.testing.assert_allclose(uv, [[-0.5, -0.5], [1279.5, -0.5], [1279.5, 719.5], [-0.5, 719.5]])


def test_lens_field_undoes_the_lens() -> None:
    uv, shift = lens_field(LENS)
    ideal = (uv - shift - [LENS.cx, LENS.cy]) / [LENS.fx, LENS.fy]
    rays = np.concatenate([ideal, np.ones((*ideal.shape[:-1], 1))], -1)
    np.testing.assert_allclose(camera.project(LENS, rays), uv, atol=1e-6)
    _, none = lens_field(dataclasses.replace(LENS, distortion=np.zeros(8)))
    assert np.abs(none).max() < 1e-9


@pytest.mark.slow
def test_labels_do_not_overlap(report: HandEyeReport) -> None:
    """Texts of the drawings that people read first keep clear of one another."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    for draw in (plot_camera_in_hand, plot_coverage):
        with style.paper_style():
            figure = draw(report)
            canvas = FigureCanvasAgg(figure)
            canvas.draw()
        renderer = canvas.get_renderer()
        titles = [ax.title for ax in figure.axes] + [ax._left_title for ax in figure.axes]
        labels = [axis.label for ax in figure.axes if ax.name == "rectilinear"
                  for axis in (ax.xaxis, ax.yaxis)]  # fmt: skip
        boxes = [t.get_window_extent(renderer) for t in titles + labels if t.get_text()]
        for k, a in enumerate(boxes):
            for b in boxes[k + 1 :]:
                assert not a.overlaps(b)
        width, height = figure.bbox.size
        for box in boxes:
            assert box.x0 > -1 and box.y0 > -1 and box.x1 < width + 1 and box.y1 < height + 1
