"""Pose logs and recordings by two clocks through `realsim calibrate`."""

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import refusals
from realsim.app.calibrate.clock import arm_at, clock_option, is_stream, mend_views, pair_pose_logs
from realsim.app.console import Console
from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.records import CameraIntrinsics, Chessboard
from realsim_calibration import BoardView, detection_of, solve_pose_pairs
from realsim_calibration.exports.calibration_file import read_calibration
from realsim_calibration.inputs.pose_file import read_pose_file
from realsim_calibration.results import Clock
from typed_commands import invoked, refused

X_TRUE = se3.exp([0.1, -0.2, 0.7, 0.03, -0.05, 0.08])
Z_TRUE = se3.from_rt(np.diag([1.0, -1, -1]), [0.4, 0.05, 0.0])
CAMERA = CameraIntrinsics(width=640, height=480, fx=420.0, fy=420.0, cx=319.5, cy=239.5)
GIVEN = ("--poses", "robot.csv", "--board-poses", "board.csv")
BOARD = Chessboard(rows=5, columns=7, square_m=0.03)


def hand(t: Array) -> Array:
    """Return T_base_ee (n, 4, 4) of a motion above the board that does not repeat."""
    rng = np.random.default_rng(0)
    f, phase = rng.uniform(0.1, 0.5, (3, 6)), rng.uniform(0, 2 * np.pi, (3, 6))
    size = np.array([0.2, 0.2, 0.4, 0.05, 0.05, 0.05]) / np.sqrt(3)
    x = np.sin(2 * np.pi * f * t[:, None, None] + phase).sum(1) * size
    return se3.from_rt(se3.exp_so3(x[:, :3]) @ np.diag([1.0, -1, -1]), x[:, 3:] + [0.4, 0, 0.5])


def log(path: Path, t: Array, Ts: Array) -> Path:
    """Write a pose log with time stamps."""
    q = np.array([se3.quaternion_wxyz(T[:3, :3]) for T in Ts])
    rows = np.column_stack([t, Ts[:, :3, 3], q[:, [1, 2, 3, 0]]])
    np.savetxt(path, rows, "%.9f", ",", header="t,x,y,z,qx,qy,qz,qw", comments="")
    return path


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs at 50 and 10 Hz; the camera's clock is 80 ms ahead."""
    folder, rng = tmp_path_factory.mktemp("logs"), np.random.default_rng(1)
    tr, t = np.arange(0, 8, 0.02), np.arange(0.5, 7.5, 0.1)
    C = se3.invert(hand(t) @ X_TRUE) @ Z_TRUE @ se3.exp(rng.normal(scale=5e-4, size=(len(t), 6)))
    log(folder / "robot.csv", tr, hand(tr) @ se3.exp(rng.normal(scale=1e-4, size=(len(tr), 6))))
    log(folder / "board.csv", t + 0.08, C)
    return folder


def joined(folder: Path, offset: str, console: Console) -> tuple[Any, ...]:
    """Return the pairs of both logs, and the clock."""
    robot = read_pose_file(folder / "robot.csv")
    board = read_pose_file(folder / "board.csv", board=True)
    assert robot.stated is not None and board.stated is not None
    stated = robot.stated, board.stated
    found = pair_pose_logs(robot, board, stated, "eye_in_hand", offset, console)
    assert found is not None and found[4] is not None
    return found


def refuses(folder: Path, out: Path, offset: str, words: str) -> None:
    """Hold that logs cannot be paired by an offset, and with which words."""
    said = refused("calibrate", folder, *GIVEN, "--out", out, "--clock-offset", offset)
    assert re.search(words, said), said


def test_two_logs_are_joined_by_their_offset(logs: Path) -> None:
    """400 robot poses and 70 board poses give 70 pairs that fit one place of the camera."""
    pairs, told = (joined(logs, offset, Console(quiet=True)) for offset in ("auto", "0.08"))
    assert len(pairs[0]) == len(pairs[1]) == len(pairs[3]) == 70
    found = solve_pose_pairs(pairs[0], pairs[1])
    assert np.linalg.norm(found.X[:3, 3] - X_TRUE[:3, 3]) < 1e-3
    assert told[4].offset_s == 0.08
    np.testing.assert_allclose(told[0], pairs[0], atol=5e-4)


def test_files_hold_the_offset(logs: Path, tmp_path: Path) -> None:
    """The offset found, its sigma and that the poses follow it are in every export."""
    done = invoked("calibrate", logs, *GIVEN, "--out", tmp_path / "c")
    assert done.exit_code in (0, 1), done.output
    clock = read_calibration(tmp_path / "c/exports/calibration.json").clock
    assert clock is not None and clock.applied and clock.sigma_s > 0
    assert clock.offset_s == pytest.approx(0.08, abs=3e-3)
    for name in ("camera.urdf", "easy_handeye/hand_eye.yaml", "ros2_static_transform.sh"):
        assert clock.sentence in (tmp_path / "c/exports" / name).read_text()
    page = (tmp_path / "c/calibration_report.html").read_text()
    offset = f"{1e3 * clock.offset_s:+.2f} ± {1e3 * clock.sigma_s:.2f} ms, applied"
    assert "clock offset arm to camera" in page and offset in page


def test_a_given_offset_is_taken_and_off_pairs_rows(logs: Path, tmp_path: Path) -> None:
    """A wrong given offset is taken at its word; without one 400 and 70 rows do not pair."""
    for offset, words in (("100", "no time in common"), ("off", "belong together")):
        refuses(logs, tmp_path / "c", offset, words)


def recorded(d: float) -> tuple[list[BoardView], Array]:
    """Return board views of a moving camera whose stamps are d late, and the stamps."""
    t = np.arange(0, 8, 1 / 15)
    rng = np.random.default_rng(2)
    views: list[BoardView] = []
    Ts, points = hand(t), BOARD.points_board
    centred = Z_TRUE @ se3.from_translation(-points.mean(0))
    for k, T in enumerate(hand(t - d)):
        uv = project(CAMERA, se3.transform(se3.invert(T @ X_TRUE) @ centred, points))
        uv = uv + rng.normal(scale=0.1, size=uv.shape)
        found = detection_of(BOARD, uv, (CAMERA.width, CAMERA.height))
        views.append(BoardView(index=k, T_base_ee=Ts[k], detection=found))
    return views, t


def test_a_recording_follows_its_clock() -> None:
    """Views 60 ms late get the arm's pose of 60 ms before; views by one clock stay as they are."""
    views, t = recorded(0.06)
    mended, clock = mend_views(views, t, BOARD, CAMERA, "auto", Console(quiet=True))
    assert clock is not None and clock.applied and clock.offset_s == pytest.approx(0.06, abs=1e-3)
    truth = hand(t - 0.06)
    error = [np.linalg.norm(v.T_base_ee[:3, 3] - truth[v.index, :3, 3]) for v in mended]
    before = [np.linalg.norm(v.T_base_ee[:3, 3] - truth[v.index, :3, 3]) for v in views]
    assert np.median(error) < 0.05 * np.median(before)
    same, t = recorded(0.0)
    kept, clock = mend_views(same, t, BOARD, CAMERA, "auto", Console(quiet=True))
    assert clock is not None and not clock.applied
    assert all(a is b for a, b in zip(kept, same, strict=True))


def test_joints_follow_across_a_full_turn() -> None:
    """Joint angles are interpolated the short way."""
    t = np.array([0.0, 1.0, 2.0])
    joints = np.array([[3.1], [-3.1], [-3.0]])
    at = arm_at(t, np.tile(np.eye(4), (3, 1, 1)), joints, np.array([1.5]), 1.0).joints
    assert at is not None
    assert np.cos(at[0, 0]) == pytest.approx(-1.0, abs=1e-6)


def test_views_at_stops_are_no_stream() -> None:
    assert not is_stream(np.arange(0.0, 320.0, 8.0))
    assert not is_stream(None)
    assert is_stream(np.arange(0.0, 4.0, 0.1))


def test_what_is_no_offset_is_named() -> None:
    refusals.refused("auto, off, or seconds", clock_option, "soon")


Change = Callable[[Array], Array]


def same(a: Array) -> Array:
    return a


def changed(logs: Path, folder: Path, robot: Change, board: Change = same) -> Path:
    """Return a folder with both logs, their rows of numbers changed."""
    folder.mkdir()
    for name, how in (("robot.csv", robot), ("board.csv", board)):
        a = how(np.loadtxt(logs / name, delimiter=",", skiprows=1))
        np.savetxt(folder / name, a, "%.9f", ",", header="t,x,y,z,qx,qy,qz,qw", comments="")
    return folder


def times(factor: float, a: Array) -> Array:
    """Return a log whose stamps are multiplied."""
    return a * [factor, 1, 1, 1, 1, 1, 1, 1]


def unknown(column: int, a: Array) -> Array:
    """Return a log of which one number is NaN."""
    b = a.copy()
    b[100, column] = np.nan
    return b


ms: Change = partial(times, 1e3)
no_pose: Change = partial(unknown, 1)


def reset(a: Array) -> Array:
    """Return a log whose clock began anew half-way."""
    return a - np.outer(np.arange(len(a)) >= len(a) // 2, 3.993 * np.eye(8)[0])


def stuck(a: Array) -> Array:
    """Return a log whose clock stood for two seconds."""
    b = a.copy()
    b[151:250, 0] = b[151, 0]
    return b


def few(a: Array) -> Array:
    return a[:10]


@pytest.mark.parametrize(
    ("robot", "board", "option", "words"),
    [
        (ms, ms, "auto", "robot.csv: the time stamps are 20 apart .*milliseconds.*by 1000"),
        (same, ms, "auto", "board.csv: the time stamps are 100 apart .*milliseconds"),
        (ms, ms, "0.08", "robot.csv: the time stamps are 20 apart .*milliseconds"),
        (same, ms, "0.08", "no time in common. Are both in seconds"),
        (partial(times, 0.0), same, "auto", "robot.csv: all time stamps are equal"),
        (same, few, "auto", "board.csv: 10 poses .* 30 are needed"),
        (same, same, "off", "400 robot poses and 70 board poses.*--clock-offset off"),
        (no_pose, same, "auto", r"line 102 \(1 of 400\): NaN .* images if there are any"),
        (reset, same, "auto", "robot.csv: line 202: the time goes back by 3.973 s: two record"),
        (reset, same, "0.08", "robot.csv: line 202: the time goes back by 3.973 s"),
    ],
)
def test_stamps_that_cannot_pair_are_named(
    logs: Path, tmp_path: Path, robot: Change, board: Change, option: str, words: str
) -> None:
    refuses(changed(logs, tmp_path / "s", robot, board), tmp_path / "c", option, words)


def test_what_a_log_does_not_know_is_left_out_and_named(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One stamp that is NaN, and two seconds in which the clock stood: their frames are not used.

    Lines that are not in the order of time are still one stream.
    """

    def pairs(name: str, how: Change) -> tuple[int, str]:
        found = joined(changed(logs, tmp_path / name, how), "auto", Console())
        assert found[4].offset_s == pytest.approx(0.08, abs=3e-3)
        said = capsys.readouterr()
        return len(found[0]), " ".join((said.out + said.err).split())

    n, said = pairs("nan", partial(unknown, 0))
    assert n == 70 and "1 of 400 poses are left out: without a time stamp" in said
    assert "line 102" in said
    n, said = pairs("stuck", stuck)
    assert 48 <= n <= 52 and "98 of 400 poses are left out: with the time stamp of" in said
    assert "line 154" in said and f"{70 - n} poses of" in said and "lie in gaps of" in said
    for name, how in (("b", np.flipud), ("m", np.random.default_rng(0).permutation)):
        assert pairs(name, how)[0] == 70


def test_the_table_tells_years_in_seconds() -> None:
    """Clocks may start at different times; an offset that was given has no sigma."""
    from realsim_calibration.report.summary import clock_in_words

    words = [
        clock_in_words(Clock(offset_s=d, sigma_s=s, applied=d > 0.01))
        for d, s in ((1.7e9, 4e-5), (1.7e9, np.nan), (0.135, np.nan), (0.001, 4e-5))
    ]
    assert words == [
        "+1700000000.000000 s ± 0.04 ms, applied",
        "+1700000000.000000 s as given, applied",
        "+135.00 ms, as given, applied",
        "+1.00 ± 0.04 ms, too small to matter, left out",
    ]
