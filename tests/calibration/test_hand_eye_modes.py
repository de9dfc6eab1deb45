import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from realsim.app.calibrate.show import warn_of_far_views
from realsim.app.console import Console
from realsim.errors import InputError, NotRigidError
from realsim.geometry import se3
from realsim.geometry.camera import project, undistort
from realsim.records import CameraIntrinsics, Chessboard, TagBoard, View
from realsim.robots.arm import find_arm, known_chains
from realsim_calibration import (
    BoardView,
    HandEyeConfig,
    HandEyeReport,
    calibrate,
    calibrate_from_poses,
    calibrate_hand_eye_report,
)
from realsim_calibration.checks import hand_eye_checks
from realsim_calibration.exports.calibration_file import calibration_text, read_calibration
from realsim_calibration.exports.frames import FrameNames, note_lines
from realsim_calibration.exports.write import write_exports
from realsim_calibration.fit.closed_forms import CLOSED_FORMS
from realsim_calibration.fit.linear_model import LinearModel, places_of
from realsim_calibration.fit.robot_error import matching_arm, pose_features
from realsim_calibration.fit.robust_fit import Solution, at_least, solve
from realsim_calibration.hand_eye import choose_plain, setup_of
from realsim_calibration.report.summary import places_rows, viewpoint
from realsim_calibration.results import Clock
from realsim_calibration.screening import Screened, screen, stacks
from realsim_calibration.views import detection_of
from refusals import refused
from tests.calibration.conftest import FACTORY, arm_views, pose_pairs

CLOCK = Clock(offset_s=0.035, sigma_s=0.0004, applied=True)


def test_a_camera_that_stands_still_is_placed_in_the_base(simulate):
    sim = simulate(3, views=14, robot=(0.0, 0.0), pixel=0.0)
    # The same pictures: the hand carries the board, the base carries the camera.
    views = [replace(v, T_base_ee=se3.invert(v.T_base_ee)) for v in sim.views]
    config = HandEyeConfig(mode="eye_to_hand")
    r = calibrate_hand_eye_report(views, sim.board, sim.intrinsics0, config)
    assert np.abs(se3.log(se3.invert(r.X) @ sim.T_ee_cam)).max() < 1e-5
    assert np.abs(se3.log(se3.invert(r.Z) @ sim.T_base_board)).max() < 1e-5
    with pytest.raises(InputError, match="has no place in the hand"):
        _ = r.hand_eye
    refused("inverted", calibrate_hand_eye_report, views, sim.board, sim.intrinsics0)


def test_boards_counted_from_the_wrong_end_are_mended(simulate):
    sim = simulate(4, views=14)
    target = Chessboard(rows=6, columns=8, square_m=0.03)
    assert target.half_turn
    views = []
    for v, ee in zip(sim.views, sim.truth_ee, strict=True):
        T = se3.invert(ee @ sim.T_ee_cam) @ sim.T_base_board
        uv = project(sim.intrinsics, se3.transform(T, target.points_board))
        inside = np.flatnonzero(np.all((uv > 0) & (uv < [1279, 719]), axis=1))
        seen = detection_of(target, uv[inside], (1280, 720), inside)
        views.append(replace(v, detection=seen))
    plain = calibrate_hand_eye_report(views, target, sim.intrinsics0)
    flipped = list(views)
    for k in (2, 5, 9):
        d = views[k].detection
        flipped[k] = replace(views[k], detection=replace(d, point_ids=47 - d.point_ids))
    mended = calibrate_hand_eye_report(flipped, target, sim.intrinsics0)
    assert np.allclose(mended.X, plain.X, atol=1e-9)
    check = next(c for c in mended.checks if c.name == "half turns")
    assert check.views == (2, 5, 9) and "3 of 14" in check.sentence
    assert "half turns" not in {c.name for c in plain.checks}


@pytest.mark.parametrize("factor", [1.2, 0.8])
def test_a_given_camera_of_another_focal_length_is_named_and_not_the_board(simulate, factor):
    """Every board seems too far by as much: the target's size would be blamed."""
    sim = simulate(3, views=12, robot=(0.0, 0.0), pixel=0.1)
    lens = sim.intrinsics
    wrong = replace(lens, fx=factor * lens.fx, fy=factor * lens.fy)
    with pytest.raises(InputError, match=r"given camera has a focal length.*Leave --intrinsics"):
        calibrate(sim.views, sim.board, intrinsics0=wrong)


def test_the_lens_of_pose_pairs_is_the_given_one_or_is_said_to_be_none(tmp_path):
    X, _, A, C = pose_pairs(0, 9)
    lens = CameraIntrinsics(
        width=1280, height=720, fx=910.0, fy=911.0, cx=641.0, cy=357.0, distortion=[0.1, -0.2]
    )
    for camera in (lens, None):
        report = replace(calibrate_from_poses(A, C, camera=camera), clock=CLOCK)
        folder = tmp_path / str(camera is None)
        names = {p.name for p in write_exports(report, folder, frames=FrameNames())}
        known = {"camera_info.yaml", "opencv.yml", "calibration.npz"}
        assert known <= names if camera else not known & names
        written = json.loads((folder / "calibration.json").read_text())
        assert written["nominal_lens"] == (camera is None)
        for key in ("intrinsics", "intrinsics_alone"):
            assert ("do NOT use" in written[key]["use"]) == (camera is None)
            assert camera is None or (written[key]["fx"] == 910.0 and written[key]["width"] == 1280)
        back = read_calibration(folder / "calibration.json")
        assert back.clock == CLOCK and np.array_equal(back.Z_points, report.Z_points)
        assert "+35.00 ms +-0.40 ms" in (folder / "camera.urdf").read_text()
        assert np.abs(se3.log(se3.invert(X) @ back.X)).max() < 1e-6


def test_perfect_poses_alone_give_the_truth():
    X, Z, A, C = pose_pairs(0, 12)
    r = calibrate_from_poses(A, C)
    assert np.abs(se3.log(se3.invert(X) @ r.X)).max() < 1e-6
    assert np.abs(se3.log(se3.invert(Z) @ r.Z)).max() < 1e-6
    assert np.abs(se3.log(se3.invert(Z) @ r.Z_alone)).max() < 1e-6
    outwards = np.diag([1.0, -1.0, -1.0, 1.0])  # a board's frame with z out of the print
    flipped = calibrate_from_poses(A, C @ outwards)
    assert np.abs(se3.log(se3.invert(Z @ outwards) @ flipped.Z)).max() < 1e-6
    flat = next(c for c in r.checks if c.name == "board flatness")
    assert flat.verdict == "unknown" and "held flat" in flat.sentence
    for record in (r, flipped):
        seen = [viewpoint(record, v) for v in record.used]
        distances = np.linalg.norm(C[:, :3, 3], axis=-1)
        assert np.allclose([p.distance_m for p in seen], distances, atol=1e-5)
        assert max(p.tilt_deg for p in seen) < 90
    refused("12 hand poses and 11 camera poses", calibrate_from_poses, A, C[1:])
    with pytest.raises(InputError, match="behind the camera"):
        calibrate_from_poses(A, se3.invert(C) @ np.diag([1.0, -1.0, -1.0, 1.0]))


def test_white_robot_errors_get_no_map(simulate):
    # With many views a map's gain of one percent was beyond chance, and the map tripled the error.
    sim = simulate(0, views=90)
    r = calibrate_hand_eye_report(sim.views, sim.board, sim.intrinsics0)
    assert r.map_name == "none" and r.robot_map is None
    assert np.allclose(r.X, r.X_alone, atol=2e-5)


@pytest.mark.parametrize("name", ["ur5e", "panda"])
def test_the_arm_is_told_by_joints_and_poses(name):
    rng = np.random.default_rng(5)
    arm = find_arm(name).chain
    joints = rng.uniform(arm.limits.lower, arm.limits.upper, (12, arm.joints)) / 3
    tool = se3.from_rt(se3.exp_so3([0.3, 0.1, -0.2]), [0.01, 0.02, 0.15])
    Ts = arm.corrected(rng.normal(size=4 * arm.joints) * 3e-4).forward(joints) @ tool
    # A Panda and an FR3 are one arm by their numbers; those of other joint counts are passed over.
    arms = [arm, *(c for c in known_chains().values() if c is not arm)]
    assert matching_arm(joints, Ts, arms) is arm
    assert matching_arm(joints, se3.random_transform(rng, 12), arms) is None
    assert matching_arm(joints[:3], Ts[:3], arms) is None


def test_a_bent_pandas_errors_are_found_in_its_views(simulate):
    arm = find_arm("panda").chain
    sim = simulate(1, views=60, robot=(0.0, 0.0))
    rng = np.random.default_rng(1)
    bent = arm.corrected(rng.normal(size=28) * np.repeat([1e-3, 3e-4], 14))
    # The pictures stay: the hand is really there, so the bent arm's joints are those that reach it.
    T_base = se3.from_translation([0.0, 0.0, 0.1])
    views, real = [], []
    for k, ee in enumerate(sim.truth_ee):
        q, of = bent.inverse_branches((T_base @ ee)[None])
        if len(of):
            joints = q[int(np.argmin(np.abs(q - find_arm("panda").home).max(-1)))]
            told = arm.forward(joints) @ se3.exp(rng.normal(scale=5e-5, size=6))
            views.append(replace(sim.views[k], T_base_ee=told, joints=joints))
            real.append(T_base @ ee)
    assert len(views) > 30
    plain = calibrate_hand_eye_report(views, sim.board, sim.intrinsics0)
    found = calibrate_hand_eye_report(views, sim.board, sim.intrinsics0, arm=arm.bare())
    assert found.map_name == "arm" and found.joint_offsets.shape == (7, 2)
    Ts = np.array([v.T_base_ee for v in views])
    mended = found.robot_map.corrected(Ts, np.array([v.joints for v in views])) @ found.X

    def apart_mm(cameras):
        # What is left after the best common move: where the base lies is no error of the arm.
        gap = se3.invert(np.array(real) @ sim.T_ee_cam) @ cameras
        return 1e3 * np.linalg.norm(gap[:, :3, 3] - np.median(gap[:, :3, 3], axis=0), axis=1).mean()

    assert apart_mm(mended) < 0.5 * apart_mm(Ts @ plain.X_alone)


def test_terms_that_the_lens_refused_cannot_fold_the_image(simulate):
    # Freed in the hand-eye fit, k2 and k3 of a board seen in the image's middle folded the lens.
    sim = simulate(2, views=12)
    views = []
    for v in sim.views:
        d = v.detection
        near = np.linalg.norm(d.uv - [640.0, 360.0], axis=1) < 260
        views.append(replace(v, detection=replace(d, point_ids=d.point_ids[near], uv=d.uv[near])))
    result = calibrate(views, sim.board)
    assert result.lens is not None and "k3" not in result.lens.terms
    corner = np.array([[0.0, 0.0], [1279.0, 0.0], [0.0, 719.0], [1279.0, 719.0]])
    _, valid = undistort(result.hand_eye.intrinsics, corner)
    assert valid.all()


def test_joints_of_another_arm_are_named(simulate):
    sim = simulate(1, views=12)
    views = [replace(v, joints=np.zeros(6)) for v in sim.views]
    panda = find_arm("panda").chain.bare()
    with pytest.raises(InputError, match="6 joint angles, and a Panda has 7"):
        calibrate_hand_eye_report(views, sim.board, sim.intrinsics0, arm=panda)


def test_matrices_that_a_controller_rounded_are_taken(simulate):
    sim = simulate(4, views=12)
    rng = np.random.default_rng(6)
    C = np.array([se3.invert(v.T_base_ee @ sim.T_ee_cam) @ sim.T_base_board for v in sim.views])
    A = np.array([v.T_base_ee for v in sim.views])
    rounded = np.round(A, 4)  # R^T R is off by up to 1e-4
    R = rounded[:, :3, :3]
    assert np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max() > 2e-5
    exact, close = calibrate_from_poses(A, C), calibrate_from_poses(rounded, np.round(C, 4))
    assert np.abs(se3.log(se3.invert(exact.X) @ close.X)).max() < 2e-4
    view = replace(sim.views[0], T_base_ee=rounded[0])
    assert np.abs(view.T_base_ee[:3, :3] @ view.T_base_ee[:3, :3].T - np.eye(3)).max() < 1e-14
    A[3, :3, :3] *= 1.0 + rng.uniform(0.02, 0.03)
    said = refused(r"view 3.*not a rotation", calibrate_from_poses, A, C, error=NotRigidError)
    assert "mesh" not in said


# --- Two answers: X for this arm as it moves here, X absolute; and X for programs without a map.

BOARD = TagBoard(rows=4, columns=6, tag_size_m=0.03, gap_m=0.01)


@cache
def shots() -> tuple[BoardView, ...]:
    """Return views of an arm whose poses are off by errors that are linear in the pose."""
    views = [v for v in arm_views(BOARD, 34, "eye_in_hand", False) if v.index not in (7, 15)]
    Ts = np.array([v.T_base_ee for v in views])
    weights = np.random.default_rng(3).normal(size=(6, 12)) * 6e-4
    errors = pose_features(Ts)[0] @ weights.T
    return tuple(replace(v, T_base_ee=T) for v, T in zip(views, Ts @ se3.exp(errors), strict=True))


@cache
def calibrated() -> HandEyeReport:
    return calibrate_hand_eye_report(shots(), BOARD, FACTORY)


@cache
def solved() -> tuple[Solution, Screened]:
    """Return the joint fit's solution and what was screened."""
    config = HandEyeConfig()
    screened = screen(shots(), BOARD, FACTORY, config, None)
    return solve(setup_of(screened.candidates, BOARD, FACTORY, config), screened.start, config,
                 None, None), screened  # fmt: skip


def test_what_the_arm_gets_wrong_everywhere_cancels() -> None:
    """Poses off by a constant in the tool: the camera seems elsewhere, as surely as before."""
    off = se3.exp([0.004, -0.003, 0.002, 0.003, -0.002, 0.004])
    told = [replace(v, T_base_ee=v.T_base_ee @ off) for v in shots()]
    moved, before = calibrate_hand_eye_report(told, BOARD, FACTORY), calibrated()
    assert before.X_here is not None and moved.X_here is not None
    apart = se3.log(se3.invert(before.X_here) @ off @ moved.X_here)
    assert np.linalg.norm(apart[3:]) < 2e-4 and np.linalg.norm(apart[:3]) < 5e-4
    assert moved.here_mm == pytest.approx(before.here_mm, rel=0.15)


def test_a_constant_error_of_the_tool_is_another_place_of_the_camera() -> None:
    solution, _ = solved()
    problem, state = solution.problem, solution.state
    model = LinearModel(problem, state, problem.ones())
    K = places_of(model, np.broadcast_to(np.eye(6), (len(shots()), 6, 6)))
    assert np.allclose(K[:6], se3.adjoint(se3.invert(state.X)), atol=0.02)
    assert np.allclose(K[6:], 0, atol=0.02)


def test_sigma_for_this_arm_is_what_halves_show_and_the_absolute_one_is_larger() -> None:
    a, b = (calibrate_hand_eye_report(shots()[k::2], BOARD, FACTORY) for k in (0, 1))
    assert a.X_here is not None and b.X_here is not None
    off = se3.log(se3.invert(a.X_here) @ b.X_here)
    C = a.place_covariance + b.place_covariance
    assert 0.4 < np.sqrt(np.trace(C[3:, 3:])) / np.linalg.norm(off[3:]) < 4
    whole = calibrated()
    assert whole.here_mm < 0.5 * whole.sigma_mm and whole.here_deg < whole.sigma_deg


@pytest.mark.parametrize("share", [0.5, 1.0, 3.0])
def test_the_absolute_sigma_is_nowhere_the_smaller_one(share: float) -> None:
    """A covariance lifted to another's is no smaller than either, and lifted no further."""
    A, H = (M @ M.T for M in np.random.default_rng(6).normal(size=(2, 6, 6)))
    whole = np.eye(9)
    whole[:6, :6] = A
    lifted = at_least(whole, share * A)
    assert np.allclose(lifted[:6, :6], max(share, 1.0) * A)
    assert np.array_equal(lifted[6:], whole[6:])
    lifted = at_least(whole, H)[:6, :6]
    assert min(np.linalg.eigvalsh(lifted - A)[0], np.linalg.eigvalsh(lifted - H)[0]) > -1e-9


def test_verdict_follows_this_arm_and_the_other_sigma_is_told() -> None:
    report = replace(calibrated(), X_covariance=np.eye(6) * 0.05**2)
    checks = {c.name: c for c in hand_eye_checks(report)}
    assert checks["uncertainty"].verdict in ("good", "warn")
    told = checks["uncertainty elsewhere"]
    assert told.verdict == "unknown" and "joint angles" in told.advice
    assert "50.00 mm" in told.sentence
    worse = replace(report, X_here_covariance=np.eye(6) * 0.05**2)
    checks = {c.name: c for c in hand_eye_checks(worse)}
    assert checks["uncertainty"].verdict == "bad"


def test_x_without_a_map_is_the_best_on_unseen_views_and_files_say_so(tmp_path: Path) -> None:
    report = calibrated()
    scores = dict(report.plain_scores)
    assert {"joint", "pixels", "effective", "park", "daniilidis", "shah"} <= set(scores)
    assert scores[report.plain_name] == min(scores.values())
    notes = " ".join(note_lines(report, FrameNames()))
    assert f"'{report.plain_name}'" in notes and "this arm as it moves here" in notes
    use = json.loads(calibration_text(report, FrameNames()))
    assert "covariance: absolute" in use["X"]["use"] and "for this arm" in use["X_here"]["use"]
    assert "here_covariance: for this arm" in use["X_alone"]["use"]
    told = {row[1]: row[3:] for row in places_rows(report)}
    assert told["X_here"][1] == "-" and told["X"][0] == "-" and "-" not in told["X_alone"]
    assert f"{report.here_mm:.3f} mm" in told["X_here"][0]
    assert f"{report.sigma_mm:.3f} mm" in told["X"][1]
    (path := tmp_path / "calibration.json").write_text(calibration_text(report, FrameNames()))
    back = read_calibration(path)
    assert back.plain_name == report.plain_name and back.stretch == report.stretch
    for name in ("X_here", "X_here_covariance", "X_alone_here_covariance"):
        assert np.array_equal(getattr(back, name), getattr(report, name))


def test_a_closed_form_that_predicts_better_is_taken() -> None:
    """Where the joint fits fail on unseen views, the best closed form is exported."""
    solution, screened = solved()
    worse = tuple(replace(fit, held_out_px=1e3) for fit in solution.plain)
    plain = choose_plain(replace(solution, plain=worse), screened, FACTORY)
    scores = dict(plain.scores)
    assert plain.name in CLOSED_FORMS and scores[plain.name] == min(scores.values())
    assert dict(screened.starts)[plain.name] <= scores[plain.name]
    A, C = stacks(screened.candidates)
    assert np.array_equal(plain.X, CLOSED_FORMS[plain.name](A, C)[0])


def test_the_map_beyond_its_poses_is_measured_and_views_outside_are_named(
    capsys: pytest.CaptureFixture[str],
) -> None:
    report = calibrated()
    assert report.robot_map is not None and report.stretch is not None
    s = report.stretch
    assert len(s.views) == len(report.used) // 4 and s.map_px > report.held_out_px
    assert "map beyond its poses" in {c.name for c in report.checks}
    near = np.asarray(report.used[0].T_base_ee)
    far = near @ se3.exp([0, 0, 1.0, 0.5, 0.5, 0.5])
    views = [View(index=k, T_base_ee=T) for k, T in enumerate((near, far))]
    warn_of_far_views(report.hand_eye, views, Console())
    told = capsys.readouterr()
    assert "1 of 2 views" in told.out + told.err
    warn_of_far_views(report.hand_eye, views[:1], Console())
    told = capsys.readouterr()
    assert not told.out + told.err
