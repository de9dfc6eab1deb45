"""A hand-eye is known before there is a view of objects, and is checked when there are some."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result

import refusals
import typed_commands
from begun_sessions import begun
from file_trees import bytes_of
from photographed_boards import photograph
from pictured_targets import pose
from realsim.app.calibrate.run import require_no_bag
from realsim.app.calibrate.session import keep_board
from realsim.app.register.files import write_result
from realsim.arrays import Array
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, HandEye, TagBoard, View
from realsim.store import SessionStore, load_hand_eye, save_hand_eye
from realsim.store.atomic import json_bytes
from realsim_calibration.targets.target_file import target_to_json
from registered_sessions import models_of, registered_by_hand, table_session
from shared_sessions import copy_of
from stored_sessions import flip
from typed_commands import finished, invoked

CAMERA = CameraIntrinsics(width=640, height=400, fx=440.0, fy=440.0, cx=319.5, cy=199.5)
BOARD = TagBoard(rows=3, columns=4, tag_size_m=0.04, gap_m=0.01)
T_EE_CAM = se3.from_rt(se3.exp_so3([0.02, -0.03, 0.9]), [0.01, -0.065, 0.035])
VIEWS = 12


def hand_poses(rng: np.random.Generator) -> tuple[Array, Array]:
    """Return T_base_ee and T_cam_board (n, 4, 4) of tilted, rolled views of the board."""
    T_base_board = se3.from_rt(np.diag([1.0, -1.0, -1.0]), [0.35, 0.1, 0.0])
    seen = [
        pose(BOARD, rng.uniform(10, 40), 222.5 * k, 360 * k / VIEWS - 180, rng.uniform(0.28, 0.38))
        for k in range(VIEWS)
    ]
    return T_base_board @ se3.invert(T_EE_CAM @ np.array(seen)), np.array(seen)


def board_views(folder: Path, **header: str) -> Path:
    """Write what `realsim capture --board` leaves in a new session's folder; return that."""
    rng = np.random.default_rng(0)
    store = begun(folder / "calibration/capture", CAMERA, header)
    depth = np.zeros((CAMERA.height, CAMERA.width), np.uint16)
    for k, (hand, T_cam_board) in enumerate(zip(*hand_poses(rng), strict=True)):
        view = View(index=k, T_base_ee=hand, time_s=float(k))
        store.add_view(view, photograph(CAMERA, [(BOARD, T_cam_board)], rng), depth_counts=depth)
    store.close()
    (folder / "calibration/board.json").write_bytes(json_bytes(target_to_json(BOARD)))
    return folder


def calibrate(folder: Path, *options: str) -> Result:
    return invoked("calibrate", folder, *options)


@pytest.fixture(scope="module")
def captured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return board_views(tmp_path_factory.mktemp("captured") / "lab")


@pytest.fixture(scope="module")
def calibrated(captured: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    lab = tmp_path_factory.mktemp("calibrated") / "lab"
    shutil.copytree(captured, lab)
    return lab, calibrate(lab, "--json")


@pytest.fixture
def lab(captured: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(captured, tmp_path / "lab"))


@pytest.mark.slow
def test_the_hand_eye_is_known_before_there_is_a_view_of_objects(
    calibrated: tuple[Path, Result], captured: Path
) -> None:
    folder, done = calibrated
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert told["passed"] and len(told["view_indices"]) == VIEWS
    off = se3.invert(T_EE_CAM) @ np.array(told["T_ee_cam"])
    assert np.linalg.norm(off[:3, 3]) < 0.5e-3
    assert np.degrees(np.linalg.norm(se3.log_so3(off[:3, :3]))) < 0.05
    assert (folder / "calibration/report/calibration_report.html").is_file()
    assert "same command" in done.stderr
    # No session is begun by it.
    assert [p.name for p in folder.iterdir()] == ["calibration"]
    assert bytes_of(folder / "calibration/capture") == bytes_of(captured / "calibration/capture")


@pytest.mark.slow
def test_with_objects_the_same_command_says_the_same_and_places_their_cameras(
    calibrated: tuple[Path, Result], tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(calibrated[0], tmp_path / "lab"))
    before = (folder / "calibration/hand_eye.json").read_bytes()
    rng = np.random.default_rng(1)
    store = begun(folder, CAMERA)
    hand = hand_poses(rng)[0][3]
    grey = np.full((CAMERA.height, CAMERA.width, 3), 120, np.uint8)
    store.add_view(View(index=0, T_base_ee=hand, time_s=0.0), grey)
    store.close()

    done = calibrate(folder, "--quiet")
    assert done.exit_code == 0, done.output
    assert "same command" not in done.stderr
    assert (folder / "calibration/hand_eye.json").read_bytes() == before
    after = SessionStore.open(folder)
    placed = after.session.Ts_world_cam[0]
    np.testing.assert_allclose(placed, load_hand_eye(after).camera_poses(hand, None), atol=1e-12)
    np.testing.assert_allclose(placed, hand @ T_EE_CAM, atol=1e-3)
    assert '"calibration/hand_eye.json"' in (folder / "manifest.jsonl").read_text()
    assert after.verify() == []


def refused(folder: Path, *options: str) -> str:
    """Calibrate what cannot be, and return why; nothing may be written."""
    before = bytes_of(folder)
    said = typed_commands.refused("calibrate", folder, *options)
    assert bytes_of(folder) == before
    return said


def test_the_target_of_imported_board_views_is_given_once(lab: Path) -> None:
    """Board views of a recording come without their target; the command notes it."""
    known = lab / "calibration/board.json"
    before = known.read_bytes()
    known.unlink()
    assert "--poses" in refused(lab, "--board", "aprilgrid:4x3,tag=40mm,gap=10mm", "--poses", "x")
    keep_board(lab, "aprilgrid:4x3,tag=40mm,gap=10mm")
    assert json.loads(known.read_bytes()) == json.loads(before)


@pytest.mark.parametrize("name", ["run.bag", "run.mcap", "run/run_0.db3"])
def test_a_recording_is_told_the_two_commands(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"#ROSBAG V2.0")
    if path.parent != tmp_path:
        (path.parent / "metadata.yaml").write_text("rosbag2_bagfile_information: {}")
        path = path.parent
    said = refusals.refused(".", require_no_bag, path, "tag:7,size=80mm")
    _, first, second = said.splitlines()
    assert first == f"  realsim import {path} run/calibration/capture"
    assert second == "  realsim calibrate run --board tag:7,size=80mm"
    assert "is a recording" in typed_commands.refused("calibrate", path)


def test_what_is_damaged_missing_or_said_twice_is_refused(lab: Path, tmp_path: Path) -> None:
    # What the board views say themselves is not said twice.
    assert "--board" in refused(lab, "--board", "aprilgrid:4x3,tag=40mm,gap=10mm")
    assert "needs joint angles" in refused(lab, "--arm", "ur5")
    lost = Path(shutil.copytree(lab, tmp_path / "lost"))
    (lost / "manifest.jsonl").write_text("")
    assert "session.json" in refused(lost), "a session that lost its header is not one of a board"
    torn = Path(shutil.copytree(lab, tmp_path / "torn"))
    flip(torn / "calibration/capture/rgb/000003.png", 900)
    assert "rgb/000003.png" in refused(torn)
    other = board_views(tmp_path / "other", arm="Panda")
    text = refused(other, "--arm", "ur5e")
    assert "captured with a Panda" in text and "is a UR5e" in text and "--arm Panda" in text
    (lab / "calibration/board.json").unlink()
    assert "realsim board" in refused(lab)


# --- `realsim calibrate SESSION --check`: 0 where the camera sits as calibrated, 1 where not -----

SLIP = np.array([0.004, -0.006, 0.002, 0.003, -0.001, 0.002])


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of ten views whose cameras are off by the arm's noise."""
    folder = tmp_path_factory.mktemp("check") / "s"
    return table_session(folder, views=10, sigma=(5e-4, 2e-4)).folder


def check(folder: Path, *options: str) -> Result:
    return invoked("calibrate", folder, "--check", *options)


def register(pristine: Path, folder: Path, slip: Array) -> Path:
    """Return a copy that is registered, its calibration wrong by a slip."""
    store = SessionStore.open(copy_of(pristine, folder))
    result = registered_by_hand(store)
    claimed = {k: T @ se3.exp(-slip) for k, T in result.cameras.claimed.items()}
    cameras = replace(result.cameras, claimed=claimed)
    write_result(store, replace(result, cameras=cameras), models_of(), {})
    return folder


def test_a_camera_that_sits_as_calibrated_holds(pristine: Path, tmp_path: Path) -> None:
    folder = register(pristine, tmp_path / "s", np.zeros(6))
    done = finished("calibrate", folder, "--check", "--json")
    assert json.loads(done.stdout)["holds"] is True


def test_a_camera_that_slipped_is_told_with_size_and_sigma(pristine: Path, tmp_path: Path) -> None:
    """A slip of 3.7 mm: exit code 1, its size within three sigma, and kept in the session."""
    folder = register(pristine, tmp_path / "s", SLIP)
    done = check(folder)
    assert done.exit_code == 1 and "does NOT hold" in done.output
    kept = json.loads((folder / "calibration/check.json").read_text())
    off = np.array(kept["twist"]) - SLIP
    assert off @ np.linalg.solve(np.array(kept["covariance"]), off) < 25.0
    assert check(folder, "--tolerance", "30").exit_code == 0  # a large one lets it pass


def test_what_cannot_be_checked_is_bad_input(pristine: Path, tmp_path: Path) -> None:
    """A folder that is no session, and one that is not registered, are refused with what to do."""
    for folder, words in ((tmp_path, "not a session"), (pristine, "run `realsim register")):
        assert words in typed_commands.refused("calibrate", folder, "--check")


def test_the_calibration_that_lies_there_now_is_checked(pristine: Path, tmp_path: Path) -> None:
    """A hand-eye that was changed after the registration is the one that does not hold."""
    source, X = SessionStore.open(pristine), se3.exp(10 * SLIP)
    store = SessionStore.create(tmp_path / "s", replace(source.session, views=()))
    for view in source.session.views:
        hand = source.session.Ts_world_cam[view.index] @ se3.invert(X)
        store.add_view(replace(view, T_base_ee=hand), source.rgb(view.index))
    write_result(store, registered_by_hand(store), models_of(), {})
    hand_eye = HandEye(
        T_ee_cam=X, covariance=1e-8 * np.eye(6), T_base_board=np.eye(4),
        intrinsics=source.session.intrinsics, intrinsics_sd=np.zeros(12), view_indices=(0,),
        view_rms_px=np.zeros(1), held_out_px=0.1,
    )  # fmt: skip
    save_hand_eye(store, hand_eye)
    assert check(store.folder, "--tolerance", "2").exit_code == 0
    aside = X @ se3.from_translation([0.005, 0.0, 0.0])
    save_hand_eye(store, replace(hand_eye, T_ee_cam=aside))
    done = check(store.folder, "--tolerance", "2")
    assert done.exit_code == 1 and "another calibration" in done.output
    found = json.loads((store.folder / "calibration/check.json").read_text())
    assert abs(found["moved_mm"] - 5.0) < 1.5


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--check", "--tolerance", "nan"], "above 0"),
        (["--check", "--tolerance", "-1"], "above 0"),
        (["--check", "--live"], "no meaning with --check"),
        (["--check", "--out", "xx"], "--out has no meaning with --check"),
        (["--tolerance", "2"], "belongs to --check"),
        (["--cameras", "a=hand", "--clock-offset", "0.1"], "one camera alone"),
    ],
)
def test_options_that_would_not_be_looked_at_are_refused(
    pristine: Path, tmp_path: Path, options: list[str], words: str
) -> None:
    assert words in typed_commands.refused("calibrate", pristine, *options)
