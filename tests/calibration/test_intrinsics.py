from dataclasses import replace

import numpy as np
import pytest

from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.records import CameraIntrinsics, Chessboard
from realsim_calibration.fit.view_system import camera_vector
from realsim_calibration.lens.bundle import (
    Observations,
    State,
    _normal,  # pyright: ignore[reportPrivateUsage]
    shaped_points,
)
from realsim_calibration.lens.fit import IntrinsicsConfig
from realsim_calibration.lens.intrinsics import calibrate_intrinsics
from realsim_calibration.lens.report import measure_coverage
from realsim_calibration.views import TargetDetection
from refusals import refused, undetermined

LENS = CameraIntrinsics(
    width=1280, height=720, fx=902.0, fy=900.0, cx=650.0, cy=352.0,
    distortion=np.array([-0.12, 0.08, 0.0008, -0.0005, 0, 0, 0, 0]),
)  # fmt: skip
BOARD = Chessboard(rows=6, columns=8, square_m=0.025)
FOUR = IntrinsicsConfig(models=("k1 k2 p1 p2",))
TRUTH = camera_vector(LENS)


def half_extent(board):
    return float(np.ptp(board.points_board, axis=0).max() / 2)


def print_shape(board, shape):
    """Points (N, 3) of a print that is stretched and bent, from the board's middle."""
    drawing = board.points_board[:, :2]
    flat = drawing - (drawing.min(0) + drawing.max(0)) / 2
    return shaped_points(flat, np.asarray(shape, dtype=float), half_extent(board))


def board_pose(rng, lens, tilt_deg, spread, distances):
    tilt = np.radians(tilt_deg) * np.sqrt(rng.uniform())
    azimuth, roll = rng.uniform(0, 2 * np.pi), rng.uniform(-np.pi, np.pi)
    R = se3.exp_so3(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0]))
    R = R @ se3.exp_so3([0, 0, roll])
    at = rng.uniform(0.5 - spread / 2, 0.5 + spread / 2, size=2) * [lens.width, lens.height]
    xy = (at - [lens.cx, lens.cy]) / [lens.fx, lens.fy]
    return se3.from_rt(R, rng.uniform(*distances) * np.append(xy, 1.0))


def see(
    seed, views=20, lens=LENS, noise=0.1, tilt=45.0, shape=(0, 0, 0, 0), spread=0.8, board=BOARD,
    distances=(0.3, 0.6),
):  # fmt: skip
    """Detections of a board at random poses; corners outside the image are not found."""
    rng = np.random.default_rng(seed)
    points = print_shape(board, shape)
    found = []
    while len(found) < views:
        uv = project(lens, se3.transform(board_pose(rng, lens, tilt, spread, distances), points))
        uv = uv + rng.normal(scale=noise, size=uv.shape) if noise else uv
        inside = np.all((uv > 0) & (uv < [lens.width - 1, lens.height - 1]), axis=-1)
        if inside.sum() >= 12:
            found.append(detection(np.flatnonzero(inside), uv[inside], lens))
    return found


def detection(ids, uv, lens=LENS):
    return TargetDetection(point_ids=ids, uv=uv, image_size=(lens.width, lens.height))


def vector(report):
    return camera_vector(report.intrinsics)


# --- laws -------------------------------------------------------------------------------------


def test_derivatives_are_those_of_the_cost():
    lens = replace(LENS, distortion=np.array([-0.12, 0.08, 8e-4, -5e-4, 0.02, 0.01, 0.02, 0.01]))
    seen = see(0, views=3, lens=lens, noise=0.5)
    drawing = BOARD.points_board[:, :2]
    flat = drawing - (drawing.min(0) + drawing.max(0)) / 2
    obs = Observations(
        flat=np.concatenate([flat[d.point_ids] for d in seen]),
        uv=np.concatenate([d.uv for d in seen]),
        weight=np.linspace(0.5, 2.0, sum(len(d) for d in seen)),
        offsets=np.cumsum([0, *(len(d) for d in seen)]).astype(np.int64),
        half_extent_m=half_extent(BOARD),
        image_size=(1280, 720),
    )
    rng = np.random.default_rng(0)
    poses = np.stack([board_pose(rng, lens, 45.0, 0.8, (0.3, 0.6)) for _ in seen])
    board = np.array([0.002, 0.01, -0.02, 0.005])
    state = State(camera=camera_vector(lens), board=board, poses=poses)

    def costs(at):
        return _normal(at, obs, 1.0, 1e9).costs

    g = _normal(state, obs, 1.0, 1e9).g
    for k in range(16):
        step = np.zeros(16)
        step[k] = 1e-6 * max(abs(state.theta[k]), 1.0)
        slope = (costs(state.moved(step)) - costs(state.moved(-step))) / (4 * step[k])
        assert np.allclose(slope, g[:, k], rtol=2e-4, atol=1e-3 * np.abs(g[:, k]).max()), k
    for k in range(6):
        twist = np.eye(6)[k] * 1e-6
        there, back = (replace(state, poses=poses @ se3.exp(s * twist)) for s in (1, -1))
        slope = (costs(there) - costs(back)) / 4e-6
        assert np.allclose(slope, g[:, 16 + k], rtol=2e-4), k


def test_perfect_corners_give_back_lens_and_print():
    shape = (0.002, 0.008, -0.004, 0.01)
    report = calibrate_intrinsics(see(3, noise=0, shape=shape), BOARD, config=FOUR)
    assert np.allclose(vector(report)[:4] / TRUTH[:4], 1, atol=1e-6)
    assert np.allclose(vector(report)[4:], TRUTH[4:], atol=1e-6)
    assert report.board.aspect == pytest.approx(shape[0], abs=1e-6)
    assert np.allclose(report.board.warp, shape[1:], atol=1e-6)
    assert report.rms_px < 1e-4
    short = calibrate_intrinsics(see(3, noise=0, shape=(-0.006, 0, 0, 0)), BOARD, config=FOUR)
    said = next(c.sentence for c in short.checks if c.name == "board shape")
    assert "0.60% (+- 0.00%) too short" in said


def test_the_order_of_the_views_does_not_matter():
    seen = see(4, views=14)
    order = np.random.default_rng(0).permutation(len(seen))
    a = calibrate_intrinsics(seen, BOARD, config=FOUR)
    b = calibrate_intrinsics([seen[i] for i in order], BOARD, config=FOUR)
    assert a.terms == b.terms
    assert np.allclose(vector(a), vector(b), rtol=1e-6, atol=1e-6)
    assert np.allclose(a.sd, b.sd, rtol=1e-3)
    assert a.held_out_px == pytest.approx(b.held_out_px, rel=1e-6)


# --- statistics -------------------------------------------------------------------------------


def test_the_covariance_says_how_large_errors_are():
    rng = np.random.default_rng(8)
    inside, whole = [], []
    for trial in range(14):
        shape = rng.normal(scale=[0.002, 0.006, 0.006, 0.006])
        report = calibrate_intrinsics(see(100 + trial, shape=shape), BOARD, config=FOUR)
        f = np.flatnonzero(report.sd)
        e = (vector(report) - TRUTH)[f]
        inside.append(np.abs(e) < 1.96 * report.sd[f])
        whole.append(e @ np.linalg.solve(report.covariance[np.ix_(f, f)], e) / len(f))
    # 14 trials of 8 terms that go together: 95 % of them to within 6 %.
    assert 0.87 <= np.mean(np.concatenate(inside)) <= 1.0
    assert 0.5 < np.mean(whole) < 1.5


def test_corner_errors_shared_by_a_view_widen_the_covariance():
    rng = np.random.default_rng(9)
    seen = see(9, views=24)
    # A smooth distortion of every view, like a bent page that moves between the pictures.
    drawing = BOARD.points_board[:, :2] - BOARD.points_board[:, :2].mean(0)
    x, y = (drawing / half_extent(BOARD)).T
    smooth = np.stack([x**2, x * y, y**2, x**3, y**3], -1)
    bent = [
        detection(d.point_ids, np.clip(d.uv + (smooth @ rng.normal(scale=0.2, size=(5, 2)))[
            d.point_ids], 0, [1279, 719]))
        for d in seen
    ]  # fmt: skip
    plain, shared = (calibrate_intrinsics(s, BOARD, config=FOUR) for s in (seen, bent))
    assert plain.inflation < 2.5 < shared.inflation
    # The residuals alone would not explain it.
    assert shared.sd[0] / plain.sd[0] > 1.2 * shared.sigma_px / plain.sigma_px


def test_a_bent_board_taken_for_flat_gives_a_wrong_lens():
    seen = see(10, views=24, shape=(0.004, 0.02, 0, 0.01))
    shaped = calibrate_intrinsics(seen, BOARD, config=FOUR)
    flat = calibrate_intrinsics(seen, BOARD, config=replace(FOUR, board_shape=False))
    assert abs(vector(shaped)[0] - TRUTH[0]) < 4 * shaped.sd[0]
    assert abs(vector(flat)[0] - TRUTH[0]) > 3 * abs(vector(shaped)[0] - TRUTH[0])
    assert np.abs(shaped.board.aspect - 0.004) < 4 * shaped.board.sd[1]
    assert {c.name: c.verdict for c in shaped.checks}["board shape"] == "warn"


def test_the_lens_is_known_best_where_the_corners_were():
    report = calibrate_intrinsics(see(11, spread=0.3, distances=(0.5, 0.8)), BOARD, config=FOUR)
    middle, corner = report.projection_sd_px([[639.5, 359.5], [0.0, 0.0]])
    assert 0 < 4 * middle < corner
    more = calibrate_intrinsics(see(12, views=40, spread=1.0), BOARD, config=FOUR)
    assert more.projection_sd_px([[0.0, 0.0]])[0] < 0.3 * corner


# --- choice and refusal -----------------------------------------------------------------------


def test_the_model_is_chosen_on_unseen_views():
    pinhole = replace(LENS, distortion=np.zeros(8))
    assert calibrate_intrinsics(see(13, lens=pinhole), BOARD).model == "pinhole"
    report = calibrate_intrinsics(see(13, views=30), BOARD)
    table = {s.model: s for s in report.held_out}
    assert list(table) == ["pinhole", "k1", "k1 k2", "k1 k2 p1 p2", "Brown 5", "rational 8"]
    assert table["pinhole"].held_out_px > 3 * table[report.model].held_out_px
    assert {"k1", "k2"} <= set(report.terms)
    assert sum(s.chosen for s in report.held_out) == 1
    assert report.rms_px < report.held_out_px < 1.5 * report.rms_px


def test_terms_that_the_views_do_not_determine_are_held_and_named():
    seen = see(15, views=10, spread=0.2, tilt=35.0, distances=(0.6, 0.9))
    report = calibrate_intrinsics(seen, BOARD, config=IntrinsicsConfig(models=("Brown 5",)))
    held = dict(report.refused)
    assert "k3" in held and "held at 0" in held["k3"]
    assert report.intrinsics.distortion[4] == 0 and report.sd[8] == 0
    assert "k3" not in report.terms
    check = {c.name: c for c in report.checks}["refused terms"]
    assert check.verdict == "warn" and "k3" in check.sentence and check.advice


def test_views_from_the_front_do_not_give_a_focal_length():
    with pytest.raises(DegenerateError, match="tilt the board by 30 deg about two axes"):
        calibrate_intrinsics(see(16, tilt=0.0), BOARD)
    with pytest.raises(DegenerateError, match="tilt the board by 30 deg"):
        calibrate_intrinsics(see(16, views=8, tilt=3.0, noise=0.3), BOARD)


def test_one_view_or_the_same_view_again_does_not_give_a_lens():
    seen = see(17, views=2)
    undetermined("one view", calibrate_intrinsics, seen[:1], BOARD)
    undetermined(r"under the same angle|squarely", calibrate_intrinsics, seen[:1] * 6, BOARD)


# --- outliers and input -----------------------------------------------------------------------


def test_wrong_corners_and_views_are_named_and_left_out():
    seen = see(20, views=16)
    clean = calibrate_intrinsics(seen, BOARD, config=FOUR)
    uv = seen[3].uv.copy()
    uv[5] += [0, -9.0] if uv[5, 1] > 20 else [0, 9.0]
    spoilt = list(seen)
    spoilt[3] = detection(seen[3].point_ids, uv)
    mixed = np.random.default_rng(0).permutation(len(seen[7]))
    spoilt[7] = detection(seen[7].point_ids, seen[7].uv[mixed])
    report = calibrate_intrinsics(spoilt, BOARD, names=[f"{i}.png" for i in range(16)], config=FOUR)
    assert [v.name for v in report.views if not v.used] == ["7.png"]
    assert "wrongly found" in report.views[7].reason
    assert [p for p, _ in report.views[3].outliers] == [int(seen[3].point_ids[5])]
    assert report.views[3].outliers[0][1] == pytest.approx(9, abs=1)
    assert "7.png" in " ".join(report.warnings)
    assert np.all(np.abs(vector(report) - vector(clean))[:8] < 1.5 * clean.sd[:8])


def test_small_and_straight_views_are_left_out_with_the_reason():
    seen = see(21, views=12, noise=0.05, spread=0.3, distances=(0.5, 0.7))
    few = detection(seen[0].point_ids[:4], seen[0].uv[:4])
    row = np.flatnonzero(seen[1].point_ids < 8)
    line = detection(seen[1].point_ids[row], seen[1].uv[row])
    none = detection([], np.zeros((0, 2)))
    report = calibrate_intrinsics([*seen, few, line, none], BOARD, config=FOUR)
    assert [v.reason for v in report.views[-3:]] == [
        "4 corners, 6 are needed", "its corners lie on one line", "0 corners, 6 are needed",
    ]  # fmt: skip
    assert len(report.used) == 12


def test_what_cannot_be_is_refused_with_names():
    seen = see(22, views=5)
    odd = TargetDetection(point_ids=seen[2].point_ids, uv=seen[2].uv / 2, image_size=(640, 360))
    mixed, names = [*seen[:2], odd, *seen[3:]], [f"{c}.png" for c in "abcde"]
    refused(r"not c\.png \(640x360\)", calibrate_intrinsics, mixed, BOARD, names=names)
    half = replace(LENS, width=640, height=360, cx=320, cy=180)
    refused("scale the intrinsics", calibrate_intrinsics, seen, BOARD, start=half)
    refused("no views", calibrate_intrinsics, [], BOARD)
    refused("3 names for 5 views", calibrate_intrinsics, seen, BOARD, names=["a", "b", "c"])
    with pytest.raises(InputError, match="not on the target"):
        calibrate_intrinsics(seen, Chessboard(rows=3, columns=3, square_m=0.025))
    outside = detection(seen[0].point_ids, seen[0].uv + 2000)
    refused("outside its image", calibrate_intrinsics, [*seen, outside], BOARD)
    blind = replace(seen[0], sd_px=np.full(len(seen[0]), np.nan))
    refused("predicted sigmas", calibrate_intrinsics, [*seen, blind], BOARD)
    refused("lens model 'fisheye' is not known", IntrinsicsConfig, models=("fisheye",))


def test_predicted_sigmas_weigh_the_corners():
    rng = np.random.default_rng(23)
    good, blurred = see(23, views=16, noise=0.03), []
    for i, d in enumerate(good):
        sd = np.full(len(d), 0.03 if i % 2 else 0.3)
        uv = np.clip(d.uv + rng.normal(size=d.uv.shape) * (sd[:, None] - 0.03), 0, [1279, 719])
        blurred.append(replace(d, uv=uv, sd_px=sd))
    blind = [replace(d, sd_px=None) for d in blurred]
    weighed, same = (calibrate_intrinsics(s, BOARD, config=FOUR) for s in (blurred, blind))
    assert np.median(weighed.sd[:8] / same.sd[:8]) < 0.8
    assert np.all(np.abs(vector(weighed) - TRUTH)[:8] < 4 * weighed.sd[:8])


# --- Where the corners were: what the views cover, and what is missing.


def test_coverage_names_what_is_missing():
    poses = np.stack([se3.from_rt(se3.exp_so3([0.5 * s, 0.4, 0]), [0, 0, 0.5]) for s in (-1, 1)])
    u, v = np.meshgrid(np.linspace(0, 639, 30), np.linspace(0, 479, 30))
    everywhere = np.stack([u.ravel(), v.ravel()], -1)
    full = measure_coverage(everywhere, (640, 480), poses)
    assert full.share == 1 and full.reach > 0.9 and full.advice == ""
    assert full.counts.sum() == len(everywhere)
    missing = everywhere[(everywhere[:, 0] < 320) | (everywhere[:, 1] < 240)]
    part = measure_coverage(missing, (640, 480), poses)
    assert "no corners in the lower right quarter" in part.advice
    straight = np.stack([se3.from_translation([0, 0, z]) for z in (0.4, 0.8)])
    flat = measure_coverage(everywhere, (640, 480), straight)
    assert "tilt it by 30 deg" in flat.advice
    assert flat.distance_m.max() / flat.distance_m.min() == pytest.approx(2)


def test_nothing_seen_is_refused():
    refused("no corners", measure_coverage, np.zeros((0, 2)), (640, 480), np.eye(4)[None])
