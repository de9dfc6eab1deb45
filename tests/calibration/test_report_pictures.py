"""The pictures of a calibration's page: what they are drawn from, and what stands in them."""

import dataclasses
import io
import warnings
from collections.abc import Callable

import numpy as np
import pytest
from matplotlib.text import Text

from realsim.errors import InputError
from realsim.geometry import camera, se3
from realsim.records import ArmErrorMap, CameraIntrinsics, HandEye
from realsim_calibration.report import style
from realsim_calibration.report.model_plots import lens_field
from realsim_calibration.report.scene_3d import frustum
from realsim_calibration.report.summary import (
    camera_in_board,
    corrected,
    pose_rows,
    rest_of_map,
    viewpoint,
)
from realsim_calibration.report.view_plots import plot_views
from realsim_calibration.results import HandEyeReport, Mode

Maker = Callable[..., HandEyeReport]
LENS = CameraIntrinsics(
    width=1280, height=720, fx=644.0, fy=643.0, cx=643.0, cy=356.0,
    distortion=np.array([-0.05, 0.04, 6e-4, -4e-4, 0, 0, 0, 0]),
)  # fmt: skip


@pytest.fixture(scope="module")
def report(calibrated_arm: Maker) -> HandEyeReport:
    return calibrated_arm()


@pytest.mark.parametrize(
    ("mode", "tilt", "azimuth", "roll"),
    [("eye_in_hand", 0, 0, 30), ("eye_in_hand", 25, 60, -40), ("eye_to_hand", 50, -120, 170)],
)
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


def test_camera_poses_of_an_arm_s_calibration_need_joints(calibrated_arm: Maker) -> None:
    report = calibrated_arm(with_joints=True)
    hand_eye = report.hand_eye
    assert isinstance(hand_eye, HandEye)
    view = report.used[0]
    with pytest.raises(InputError, match="joint angles are needed"):
        hand_eye.camera_poses(view.T_base_ee)
    T = hand_eye.camera_poses(view.T_base_ee, view.joints)
    moved = se3.log(se3.invert(view.T_base_ee @ hand_eye.T_ee_cam) @ T)
    assert 0 < np.linalg.norm(moved[3:]) < 5e-3


def test_names_that_the_font_lacks() -> None:
    assert style.view_label("图像_0007.png", 7) == "view 7"
    assert style.view_label("ｖｉｅｗ１.png", 7) == "view1.png"
    assert style.view_label("Übersicht_é.png", 7) == "Übersicht_é.png"


def test_pictures_have_no_letters_that_the_font_lacks(report: HandEyeReport) -> None:
    odd = tuple(
        dataclasses.replace(v, label=f"图像_{v.index}.png", reason="没有" if v.reason else "")
        for v in report.views
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with style.paper_style():  # a letter that the font lacks would be a warning, here an error
            figure = plot_views(dataclasses.replace(report, views=odd))
            figure.savefig(out := io.BytesIO(), format="png")
    assert out.getvalue().startswith(b"\x89PNG")
    shown = "".join(text.get_text() for text in figure.findobj(Text))
    assert "view " in shown and "图" not in shown


def test_sigma_is_given_along_the_axes_of_the_carrier(report: HandEyeReport) -> None:
    """A camera turned by 90 deg about z: its x is the tool's y, so is its uncertainty."""
    X = se3.from_rt(se3.exp_so3([0, 0, np.pi / 2]), [0.01, 0.02, 0.03])
    C = np.diag([1e-8, 1e-8, 1e-8, 9e-6, 1e-6, 4e-6])
    row = pose_rows(dataclasses.replace(report, X_here=X, X_here_covariance=C))[0]
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
