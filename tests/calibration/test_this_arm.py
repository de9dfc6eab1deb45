"""Two answers: X for this arm as it moves here, X absolute; and X for programs without a map."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from realsim.app.calibrate.show import warn_of_far_views
from realsim.app.console import Console
from realsim.geometry import se3
from realsim.records import TagBoard, View
from realsim_calibration import BoardView, HandEyeConfig, HandEyeReport, calibrate_hand_eye_report
from realsim_calibration.checks import hand_eye_checks
from realsim_calibration.exports import (
    FrameNames,
    calibration_text,
    note_lines,
    read_calibration,
    write_calibration,
)
from realsim_calibration.fit.closed_forms import CLOSED_FORMS
from realsim_calibration.fit.effective import places_of
from realsim_calibration.fit.linear_model import LinearModel
from realsim_calibration.fit.robot_error import pose_features
from realsim_calibration.fit.robust_fit import Solution, at_least, solve
from realsim_calibration.hand_eye import setup_of
from realsim_calibration.plain import choose_plain
from realsim_calibration.report.summary import places_rows
from realsim_calibration.screening import Screened, screen, stacks
from tests.calibration.conftest import FACTORY, arm_views

BOARD = TagBoard(rows=4, columns=6, tag_size_m=0.03, gap_m=0.01)


@cache
def shots() -> tuple[BoardView, ...]:
    """Return views of an arm whose poses are off by errors that are linear in the pose."""
    views = [v for v in arm_views(BOARD, 34, "eye_in_hand", False) if v.index not in (7, 15)]
    Ts = np.array([v.T_base_ee for v in views])
    weights = np.random.default_rng(3).normal(size=(6, 12)) * 6e-4
    errors = pose_features(Ts)[0] @ weights.T
    told = Ts @ se3.exp(errors)
    return tuple(replace(v, T_base_ee=T) for v, T in zip(views, told, strict=True))


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
    rng = np.random.default_rng(6)
    A, H = (M @ M.T for M in rng.normal(size=(2, 6, 6)))
    whole = np.eye(9)
    whole[:6, :6] = A
    lifted = at_least(whole, share * A)
    assert np.allclose(lifted[:6, :6], max(share, 1.0) * A) and np.array_equal(
        lifted[6:], whole[6:]
    )
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
    path = write_calibration(report, tmp_path / "calibration.json", frames=FrameNames())
    back = read_calibration(path)
    assert back.plain_name == report.plain_name and back.stretch == report.stretch
    for name in ("X_here", "X_here_covariance", "X_alone_here_covariance"):
        assert np.array_equal(getattr(back, name), getattr(report, name))


def test_a_closed_form_that_predicts_better_is_taken() -> None:
    """Where the joint fits fail on unseen views, the best closed form is exported."""
    solution, screened = solved()
    worse = [replace(fit, held_out_px=1e3) for fit in solution.plain]
    solution = replace(solution, plain=tuple(worse))
    plain = choose_plain(solution, screened, FACTORY)
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
