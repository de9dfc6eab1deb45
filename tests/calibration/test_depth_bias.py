"""The bias of a depth camera from board views: laws, statistics, refusals."""

from dataclasses import replace

import numpy as np
import pytest

from board_depth import (
    BASELINE,
    BOARD,
    CAMERA,
    EXACT,
    exact_depth,
    run,
    sensed,
    sensed_views,
    views_of,
)
from realsim.errors import InputError, UnitError
from realsim.geometry import se3
from realsim.geometry.camera import pixel_grid, undistort
from realsim.records import CameraIntrinsics
from realsim.records.calibration import DepthBias
from realsim_calibration.depth.bias import estimate_depth_bias
from realsim_calibration.depth.board import DepthBoardView
from realsim_calibration.results import BoardShape
from refusals import refused, undetermined

# ---- laws of the record


def test_corrected_inverts_measured() -> None:
    rng = np.random.default_rng(1)
    bias = DepthBias(scale=1 + rng.normal(scale=0.02), offset_per_m=rng.normal(scale=0.02))
    z = rng.uniform(0.1, 1.5, (20, 30))
    np.testing.assert_allclose(bias.corrected(bias.measured(z)), z, rtol=1e-12)
    np.testing.assert_allclose(1 / bias.corrected(z), bias.scale / z + bias.offset_per_m)


def test_none_changes_nothing_and_holes_stay_holes() -> None:
    depth = np.array([[0.0, np.nan, 0.3, 1.0]], np.float32)
    same = DepthBias.none().corrected(depth)
    assert same.dtype == np.float32
    np.testing.assert_array_equal(same, depth)
    out = DepthBias(scale=1.01, offset_per_m=-0.9).corrected(np.array([0.0, np.nan, 0.3, 5.0]))
    assert out[0] == 0 and np.isnan(out[1]) and out[2] > 0 and out[3] == 0
    assert DepthBias.unmeasured().sigma_m(0.4) > 0 == DepthBias.none().sigma_m(0.4)


def test_sigma_is_that_of_drawn_corrections() -> None:
    C = np.array([[4e-6, -1.5e-5], [-1.5e-5, 9e-5]])
    bias = DepthBias(scale=1.01, offset_per_m=0.01, covariance=C)
    draws = np.random.default_rng(0).multivariate_normal([1.01, 0.01], C, 20000)
    for z in (0.2, 0.5, 1.0):
        spread = np.std(z / (draws[:, 0] + draws[:, 1] * z))
        assert bias.sigma_m(z) == pytest.approx(spread, rel=0.03)


# ---- laws of the estimator


def test_exact_data_give_the_exact_bias() -> None:
    truth = DepthBias(scale=1.012, offset_per_m=-0.015)
    report = run(views_of(truth, noise_px=0.0, corner_px=0.0))
    # counts of 0.1 mm and the weak prior are all that is left
    assert report.bias.scale == pytest.approx(truth.scale, abs=3e-4)
    assert report.bias.offset_per_m == pytest.approx(truth.offset_per_m, abs=1e-3)
    assert report.held_out_m < 5e-5 < report.uncorrected_m
    assert report.bias.separable
    assert report.disparity_px == pytest.approx(0.015 / 1.012 * CAMERA.fx * BASELINE, abs=3e-3)


def test_correcting_the_input_leaves_no_bias_and_order_does_not_matter() -> None:
    views = views_of(DepthBias(scale=0.99, offset_per_m=0.02), seed=3)
    report = run(views)
    again = run([replace(v, depth_m=report.bias.corrected(v.depth_m)) for v in views])
    assert again.bias.scale == pytest.approx(1.0, abs=0.2 * np.sqrt(report.bias.covariance[0, 0]))
    assert abs(again.bias.offset_per_m) < 0.2 * np.sqrt(report.bias.covariance[1, 1])
    turned = run(views[::-1])
    np.testing.assert_allclose(turned.bias.scale, report.bias.scale, rtol=1e-12)
    np.testing.assert_allclose(turned.bias.covariance, report.bias.covariance, rtol=1e-9)


def test_a_focal_length_error_is_within_its_sigma() -> None:
    views = views_of(DepthBias(scale=1.0, offset_per_m=0.0), noise_px=0.0, corner_px=0.0)
    wrong = replace(CAMERA, fx=CAMERA.fx * 1.003, fy=CAMERA.fy * 1.003)
    C = np.zeros((12, 12))
    C[:2, :2] = np.outer([CAMERA.fx, CAMERA.fy], [CAMERA.fx, CAMERA.fy]) * 0.003**2
    report = estimate_depth_bias(views, BOARD, wrong, EXACT, intrinsics_covariance=C)
    error = np.array([report.bias.scale - 1, report.bias.offset_per_m])
    sd = np.sqrt(np.diag(report.board_covariance))
    assert abs(error[0]) == pytest.approx(sd[0], rel=0.15)  # one sigma was applied
    assert sd[0] > 10 * np.sqrt(report.view_covariance[0, 0])


def test_warp_is_taken_from_the_boards_shape() -> None:
    warp, L = np.array([0.012, 0.004, -0.008]), max(BOARD.size_m) / 2
    shape = BoardShape(scale=1.0, aspect=0.0, warp=warp, sd=np.zeros(5), half_extent_m=L)
    points = BOARD.points_board.copy()
    xy = (points[:, :2] - np.array(BOARD.size_m) / 2) / L
    points[:, 2] = L * (warp[0] * xy[:, 0] ** 2 + warp[1] * xy.prod(1) + warp[2] * xy[:, 1] ** 2)
    truth, rng = DepthBias(scale=1.01, offset_per_m=-0.01), np.random.default_rng(5)
    views = sensed_views(
        rng, lambda T: sensed(exact_depth(T, CAMERA, warp), truth, rng, 0.0), points=points
    )
    bent, flat = run(views, shape=shape), run(views)
    assert bent.bias.scale == pytest.approx(1.01, abs=5e-4)
    assert bent.bias.offset_per_m == pytest.approx(-0.01, abs=2e-3)
    assert bent.scatter_per_m < 0.2 * flat.scatter_per_m


def test_own_depth_camera_beside_the_colour_camera() -> None:
    """Depth from a second camera, 15 mm aside and of another resolution, without alignment."""
    truth, rng = DepthBias(scale=1.008, offset_per_m=-0.01), np.random.default_rng(8)
    depth_camera = CameraIntrinsics(width=240, height=180, fx=140.0, fy=140.0, cx=119.5, cy=92.0)
    beside = se3.from_rt(se3.exp_so3([0.01, -0.02, 0.005]), [0.015, 0.002, -0.001])
    views = sensed_views(
        rng, lambda T: truth.measured(exact_depth(se3.invert(beside) @ T, depth_camera))
    )
    report = run(views, depth_intrinsics=depth_camera, T_color_depth=beside)
    assert report.bias.scale == pytest.approx(1.008, abs=1e-4)
    assert report.bias.offset_per_m == pytest.approx(-0.01, abs=4e-4)


# ---- statistics


def test_sigma_covers_the_truth() -> None:
    """Noise growing with z^2, holes, fliers, corner noise, and an error common to each view."""
    truth = DepthBias(scale=1.008, offset_per_m=-0.012)
    squared: list[float] = []
    for seed in range(14):
        distances = np.linspace(0.2, 0.5, 6)
        report = run(views_of(truth, seed, distances=distances, pose_sd=(2e-3, 0.4e-3)))
        error = [report.bias.scale - truth.scale, report.bias.offset_per_m - truth.offset_per_m]
        squared.append(float(error @ np.linalg.solve(report.bias.covariance, error)))
    # chi^2 of 2 degrees: mean 2, 95 % below 6
    assert 1.0 < np.mean(squared) < 3.3
    assert np.mean(np.array(squared) < 6.0) >= 0.85


def test_noise_is_measured_and_grows_with_the_square_of_distance() -> None:
    report = run(views_of(DepthBias.none(), 1, noise_px=0.16, corner_px=0.05))
    assert report.bias.noise_per_m == pytest.approx(0.16 / (CAMERA.fx * BASELINE), rel=0.15)
    assert report.noise_exponent == pytest.approx(2.0, abs=0.3)


def test_a_bad_view_does_not_bend_the_result() -> None:
    views = views_of(DepthBias(scale=1.01, offset_per_m=-0.01), 2)
    clean = run(views)
    spoiled = replace(views[4], depth_m=views[4].depth_m * np.float32(1.05))
    report = run([*views[:4], spoiled, *views[5:]])
    sd = np.sqrt(np.diag(report.bias.covariance))
    assert abs(report.bias.scale - clean.bias.scale) < 2 * sd[0]
    assert max(report.views, key=lambda v: abs(v.unseen_m / v.distance_m)).index == 4


# ---- refusals


def test_one_distance_gives_only_the_sum() -> None:
    truth = DepthBias(scale=1.01, offset_per_m=-0.012)
    report = run(views_of(truth, 6, distances=np.full(10, 0.35)))
    assert not report.bias.separable
    check = next(c for c in report.checks if c.name == "depth range")
    assert check.verdict == "warn" and "0.2 to 0.5 m" in check.advice
    z = float(truth.measured(0.35))
    assert abs(report.bias.corrected(z) - 0.35) < 3 * report.bias.sigma_m(z)
    assert report.bias.sigma_m(z) < 0.4e-3 < report.bias.sigma_m(0.8)


def test_a_wrong_unit_is_named() -> None:
    tenfold = [replace(v, depth_m=v.depth_m * np.float32(10.0)) for v in views_of(DepthBias.none())]
    refused(r"0\.001.*0\.0001", run, tenfold, error=UnitError)


def test_a_wrong_board_size_is_named() -> None:
    views = views_of(DepthBias.none())
    larger = replace(BOARD, tag_size_m=0.042, gap_m=0.014)
    refused("ruler", estimate_depth_bias, views, larger, CAMERA, EXACT)


def test_shifted_depth_is_refused() -> None:
    views = views_of(DepthBias.none(), 7)
    shifted = [replace(v, depth_m=np.roll(v.depth_m, 9, axis=1)) for v in views]
    said = refused("aligned to the colour image", run, shifted)
    assert "(-9, +0)" in said or "(-9, -0)" in said
    a_little = run([replace(v, depth_m=np.roll(v.depth_m, 1, axis=0)) for v in views])
    check = next(c for c in a_little.checks if c.name == "depth alignment")
    assert check.value == pytest.approx(1.0, abs=0.4)


def test_another_focal_length_under_the_same_size_is_refused() -> None:
    """A depth image that was resized, not aligned: planes come out at other angles."""
    rng, other = np.random.default_rng(9), replace(CAMERA, fx=CAMERA.fx * 1.5, fy=CAMERA.fy * 1.5)
    views = sensed_views(rng, lambda T: sensed(exact_depth(T, other), DepthBias.none(), rng), 0.05)
    refused("turned by", run, views)


def test_another_size_is_refused() -> None:
    views = [replace(v, depth_m=v.depth_m[:150]) for v in views_of(DepthBias.none())]
    refused("resizing the image does not align it", run, views)
    refused("T_color_depth", run, views, depth_intrinsics=CAMERA)


def test_too_little_depth_is_said_per_view() -> None:
    views = views_of(DepthBias.none())
    empty = [replace(v, depth_m=np.zeros_like(v.depth_m)) for v in views]
    undetermined("0 of 12 views", run, empty)
    report = run([*views[:8], *empty[8:]])
    unused = [v for v in report.views if not v.used]
    assert [v.index for v in unused] == [8, 9, 10, 11]
    assert all("have a value" in v.reason for v in unused)
    check = next(c for c in report.checks if c.name == "depth coverage")
    assert check.verdict == "warn" and check.views == (8, 9, 10, 11)


def test_range_images_are_recognised() -> None:
    xy, _ = undistort(CAMERA, pixel_grid(CAMERA.width, CAMERA.height))
    length = np.linalg.norm(np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], -1), axis=-1)
    views = views_of(DepthBias.none(), 11)
    ranges = [replace(v, depth_m=v.depth_m * length) for v in views]
    assert {c.name: c.verdict for c in run(views).checks}["depth kind"] == "good"
    assert {c.name: c.verdict for c in run(ranges).checks}["depth kind"] == "bad"


def test_counts_and_duplicates_are_refused() -> None:
    with pytest.raises(InputError, match="depth unit"):
        DepthBoardView(index=0, depth_m=np.zeros((4, 4), np.uint16), T_cam_board=np.eye(4))
    refused("neither", DepthBoardView, index=0, depth_m=np.zeros((4, 4)))
    v = views_of(DepthBias.none())
    refused("unique", run, [v[0], v[0]])
