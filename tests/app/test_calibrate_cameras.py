"""`realsim calibrate --cameras`: pictures of a lab with a camera in the hand and two fixed ones."""

import json
import re
import shutil
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import Result

from begun_sessions import begun
from photographed_boards import photograph
from realsim.app.calibrate.folder import MADE_OF, made_of
from realsim.app.register.config import load_depth_bias
from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from realsim.records import CameraIntrinsics, TagBoard, View
from realsim.records.calibration import DepthBias
from realsim.store import SessionStore
from realsim.store.atomic import write_json
from realsim.store.cameras import camera_folder
from realsim_calibration.cameras.files import read_cameras
from realsim_calibration.exports.calibration_file import read_calibration
from realsim_calibration.inputs.image_files import load_image
from realsim_calibration.targets.target_file import target_to_json
from typed_commands import invoked, refused

CAMERA = CameraIntrinsics(width=640, height=480, fx=520.0, fy=520.0, cx=319.5, cy=239.5)
TABLE = TagBoard(rows=3, columns=4, tag_size_m=0.04, gap_m=0.01)
HELD = TagBoard(rows=3, columns=4, tag_size_m=0.04, gap_m=0.01, first_id=100)
X_WRIST = se3.from_rt(se3.exp_so3([0.02, -0.03, 0.9]), [0.01, -0.065, 0.035])
Z_TABLE = se3.from_rt(np.diag([1.0, -1.0, -1.0]), [0.32, 0.08, 0.0])
Z_HELD = se3.from_rt(np.eye(3), [0.05, 0.04, 0.0])
FIXED = {
    "left": se3.look_at([0.75, 0.5, 0.85], [0.42, 0.05, 0.35], 0.0),
    "right": se3.look_at([0.75, -0.45, 0.85], [0.42, 0.05, 0.35], 0.0),
}
BIAS = DepthBias(offset_per_m=0.02)
"""Bias of a fixed camera's depth."""
VIEWS = 8
MISPLACED = (
    ("wrist=hand,left=fixed", "--held-board", "table", "board 'held' is on the table (give it"),
    ("left=fixed,right=fixed", "--board", "held", "board 'table' is in the hand (give it"),
)


def hands(rng: np.random.Generator) -> Array:
    """Return poses of the hand (VIEWS, 4, 4) above the table, tilted and rolled."""
    found: list[Array] = []
    for k in range(VIEWS):
        turn = se3.exp_so3([np.pi, 0, 0]) @ se3.exp_so3(
            [*rng.uniform(-0.35, 0.35, 2), -0.9 + 0.5 * np.sin(k)]
        )
        at = np.array([0.40, 0.0, 0.42]) + rng.uniform(-0.04, 0.04, 3)
        found.append(se3.from_rt(turn, at))
    return np.array(found)


def write_poses(path: Path, columns: str, *values: Array) -> None:
    """Write a table of the pictures' poses."""
    rows = [",".join(f"{v:.9f}" for v in row) for row in np.hstack(values)]
    lines = [f"name,{columns}", *(f"{k:03d}.png,{row}" for k, row in enumerate(rows))]
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of every camera, a file of poses, and both targets."""
    folder = tmp_path_factory.mktemp("lab") / "pictures"
    rng = np.random.default_rng(3)
    for name in ("wrist", *FIXED):
        (folder / name).mkdir(parents=True)
    Ts = hands(rng)
    q = np.array([se3.quaternion_wxyz(T[:3, :3]) for T in Ts])
    write_poses(folder / "arm.csv", "x,y,z,qx,qy,qz,qw", Ts[:, :3, 3], q[:, [1, 2, 3, 0]])
    for k, hand in enumerate(Ts):
        for name, eye in {"wrist": hand @ X_WRIST, **FIXED}.items():
            to_cam = se3.invert(eye)
            seen = [(TABLE, to_cam @ Z_TABLE)]
            if name != "wrist":
                seen.append((HELD, to_cam @ hand @ Z_HELD))
            cv2.imwrite(str(folder / name / f"{k:03d}.png"), photograph(CAMERA, seen, rng))
    for name, board in (("table", TABLE), ("held", HELD)):
        write_json(folder.parent / f"{name}.json", target_to_json(board))
    return folder


@pytest.fixture
def lab(photos: Path, tmp_path: Path) -> Path:
    """The same to be changed."""
    return Path(shutil.copytree(photos.parent, tmp_path / "all")) / photos.name


def words_for(lab: Path, cameras: str = "wrist=hand,left=fixed,right=fixed") -> list[object]:
    """Return the command that calibrates cameras of a lab."""
    boards = ("--board", lab.parent / "table.json", "--held-board", lab.parent / "held.json")
    return ["calibrate", lab, "--cameras", cameras, *boards, "--out", lab.parent / "out"]


def keep_first(lab: Path, names: Iterable[str], count: int) -> None:
    """Take out all but the first pictures of cameras."""
    for name in names:
        for path in sorted((lab / name).glob("*.png"))[count:]:
            path.unlink()


def test_cameras_without_an_arm_get_all_their_files(photos: Path, tmp_path: Path) -> None:
    held = ["--moved-board", str(photos.parent / "held.json")]
    fixed = ["--cameras", "left=fixed,right=fixed", "--out", str(tmp_path / "out")]
    (tmp_path / "out/wrist/exports").mkdir(parents=True)
    (tmp_path / "out" / MADE_OF).write_text(made_of(photos))
    result = invoked("calibrate", photos, *fixed, *held)
    assert result.exit_code in {0, 1}, result.output
    page = (tmp_path / "out/cameras_report.html").read_text()
    assert re.search("in camera .{,5}left.{,5} its place is known to", page)
    assert "arm error" not in page and " metres the board is" not in page and "-0.00" not in page
    assert "for this arm" not in page
    assert "is of an earlier run: camera 'wrist' is not in this one." in result.output
    urdf = (tmp_path / "out/right/exports/camera.urdf").read_text()
    assert 'parent link="base"' in urdf and 'child link="right_optical_frame"' in urdf
    (pair,) = read_cameras(tmp_path / "out/cameras.json").pairs
    off = se3.invert(se3.invert(FIXED["left"]) @ FIXED["right"]) @ pair.T_a_b
    assert np.linalg.norm(off[:3, 3]) < 0.01


@pytest.fixture(scope="module")
def calibrated(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, Path]:
    out = tmp_path_factory.mktemp("out") / "calibration"
    return invoked(*words_for(photos)[:-1], out, "--json"), out


def test_pictures_give_every_camera(calibrated: tuple[Result, Path]) -> None:
    result, out = calibrated
    assert result.exit_code in {0, 1}, result.output
    found = read_cameras(out / "cameras.json")
    for name, truth in {"wrist": X_WRIST, **FIXED}.items():
        off = se3.invert(truth) @ found.camera(name).T
        assert np.linalg.norm(off[:3, 3]) < 4e-3, name
        assert se3.angle(off) < np.radians(0.4), name
    page = (out / "cameras_report.html").read_text()
    assert "1 sigma for this arm as it moves here" in page and "1 sigma absolute" in page
    # What is amiss says of which camera.
    assert all(f"{c}: " in page.split('key="cameras"')[0] for c in ("left", "right"))
    assert {p.names for p in found.pairs} == {("wrist", "left"), ("wrist", "right"),
                                              ("left", "right")}  # fmt: skip


def test_every_camera_has_the_files_of_a_camera_alone(calibrated: tuple[Result, Path]) -> None:
    _, out = calibrated
    cameras = read_cameras(out / "cameras.json")
    for name, mode in (("wrist", "eye_in_hand"), ("left", "eye_to_hand")):
        one = read_calibration(out / name / "exports/calibration.json")
        assert one.mode == mode
        assert np.array_equal(one.X, cameras.camera(name).T)
    page = (out / "cameras_report.html").stat().st_mtime_ns
    assert all(p.stat().st_mtime_ns <= page for p in out.rglob("*")), "the page is written last"
    assert "left_optical_frame" in (out / "left/exports/camera.urdf").read_text()


def test_json_says_what_the_file_says(calibrated: tuple[Result, Path]) -> None:
    result, out = calibrated
    said, file = json.loads(result.stdout), json.loads((out / "cameras.json").read_text())
    assert said["cameras"] == file["cameras"]
    assert said["passed"] == (result.exit_code == 0)


@pytest.mark.parametrize(
    ("gone", "copied", "cameras", "words"),
    [
        ("", "", "", "--cameras has ''; NAME=hand or NAME=fixed"),
        ("", "", "wrist=hand,left", "NAME=hand or NAME=fixed"),
        ("", "", "wrist=hand,top=fixed", "no folder"),
        ("", "", "wrist=hand,wrist=fixed", "twice"),
        ("arm.csv", "", "wrist=hand,left=fixed", "no poses of the arm"),
        ("", "again.csv", "wrist=hand,left=fixed", "Give --poses"),
    ],
)
def test_what_is_missing_is_named(
    lab: Path, gone: str, copied: str, cameras: str, words: str
) -> None:
    keep_first(lab, ("wrist", *FIXED), 3)
    if copied:
        shutil.copy(lab / "arm.csv", lab / copied)
    if gone:
        (lab / gone).unlink()
    assert words in refused(*words_for(lab, cameras))


@pytest.mark.parametrize(
    ("gray", "words"), [(90, "shows nothing that looks like a target"), (12, "is too dark")]
)
def test_a_camera_that_sees_no_board_is_named_with_what_it_shows(
    lab: Path, gray: int, words: str
) -> None:
    for path in (lab / "right").glob("*.png"):
        cv2.imwrite(str(path), np.full((480, 640, 3), gray, np.uint8))
    keep_first(lab, ("wrist", "left"), 2)
    said = refused(*words_for(lab))
    assert "camera 'right' never sees a board" in said and words in said
    assert "leave the camera out" in said


@pytest.mark.parametrize(
    ("cameras", "option", "file", "words", "stated"),
    [
        pytest.param(*case, k == by, marks=[pytest.mark.slow] * by)
        for k, case in enumerate(MISPLACED)
        for by in (0, 1)
    ],
)
def test_a_board_that_is_said_to_be_elsewhere_is_named(
    photos: Path, tmp_path: Path, cameras: str, option: str, file: str, words: str, stated: bool
) -> None:
    """Whether the poses' reading is stated or must be proven, and whatever lens cannot be told."""
    poses = photos / "arm.csv"
    if not stated:
        poses, Ts = tmp_path / "arm.csv", hands(np.random.default_rng(3))
        write_poses(poses, "x,y,z,rx,ry,rz", Ts[:, :3, 3], se3.log_so3(Ts[:, :3, :3]))
    board = (option, photos.parent / f"{file}.json")
    out = photos.parent / "refused"  # the points found are noted there
    given = ("--cameras", cameras, *board, "--out", out, "--poses", poses)
    said = refused("calibrate", photos, *given)
    assert "contradict the robot" in said and words in said


def test_images_without_partners_are_left_out(lab: Path) -> None:
    from realsim.app.calibrate.camera_frames import cameras_of, frames_of
    from realsim_calibration.inputs.pose_file import read_pose_file

    (lab / "left/004.png").unlink()
    shutil.copy(lab / "right/000.png", lab / "right/099.png")
    arm = lab / "arm.csv"
    cameras = cameras_of("wrist=hand,left=fixed,right=fixed")
    frames = frames_of(lab, cameras, read_pose_file(arm))
    stranger = f"camera 'right': images without a pose are left out: 1 of {VIEWS + 1} (099.png)."
    assert frames.left_out == (stranger,)
    assert [len(frames.images[c.name]) for c in cameras] == [VIEWS, VIEWS - 1, VIEWS]
    names = {c.name: {i: p.name for i, p in frames.images[c.name].items()} for c in cameras}
    assert all(names["right"][i] == name for i, name in names["wrist"].items())
    assert all(names["wrist"][i] == name for i, name in names["left"].items())
    rows = arm.read_text().splitlines()
    rows[3] = rows[3].replace("002.png,", "002.png,nan,").rsplit(",", 1)[0]
    arm.write_text("\n".join(rows[:-1]) + "\n")
    said = frames_of(lab, cameras, read_pose_file(arm)).left_out
    assert f"left out: 1 of {VIEWS} ({VIEWS - 1:03d}.png)." in said[0]
    of = f"1 of {VIEWS} (002.png (line 4))."
    assert said[1].endswith(f"with a NaN or infinite pose are left out: {of}")


def test_an_image_of_another_size_is_named_though_it_shows_no_board(lab: Path) -> None:
    cv2.imwrite(str(lab / "left/004.png"), np.full((240, 320, 3), 90, np.uint8))
    said = refused(*words_for(lab))
    assert "camera 'left' has images of several sizes" in said and "004.png (320x240)" in said


def plane_depth(T_cam_board: Array) -> Array:
    """Return the depth (H, W) of a board's plane, as if it filled the image [m]."""
    normal = T_cam_board[:3, 2]
    along = ray_table(CAMERA) @ normal
    z = (normal @ T_cam_board[:3, 3]) / np.where(np.abs(along) > 0.05, along, np.inf)
    return np.where((z > 0.1) & (z < 3.0), z, 0.0)


def test_board_views_of_a_session(photos: Path, tmp_path: Path) -> None:
    """Fixed cameras are sessions in cameras/NAME, or just images in rgb_NAME/."""
    Ts = hands(np.random.default_rng(3))
    capture = tmp_path / "session/calibration/capture"
    store = begun(capture, CAMERA, unit_m=0.001)
    depth = np.zeros((CAMERA.height, CAMERA.width), np.uint16)
    for k, hand in enumerate(Ts):
        view = View(index=k, T_base_ee=hand)
        store.add_view(view, load_image(photos / f"wrist/{k:03d}.png"), depth)
    store.close()
    (capture / "rgb_right").mkdir()
    left = begun(camera_folder(capture, "left"), CAMERA, unit_m=0.001)
    for k, hand in enumerate(Ts):
        held = se3.invert(FIXED["left"]) @ hand @ Z_HELD
        seen = BIAS.measured(plane_depth(held)).astype(np.float32)
        left.add_view(View(index=k), load_image(photos / f"left/{k:03d}.png"), seen)
        shutil.copy(photos / f"right/{k:03d}.png", capture / f"rgb_right/{k:06d}.png")
    # The session's own camera, which looks at the objects: not yet placed.
    own = begun(camera_folder(tmp_path / "session", "left"), CAMERA, unit_m=0.001)
    for k in range(2):
        own.add_view(View(index=k), load_image(photos / "left/000.png"), depth)
    write_json(tmp_path / "session/calibration/board.json", target_to_json(TABLE))
    held = str(photos.parent / "held.json")
    words = ("calibrate", tmp_path / "session", "--held-board", held, "--cameras")
    assert "'up': neither the session" in str(invoked(*words, "wrist=hand,up=fixed").exception)
    result = invoked(*words, "wrist=hand,left=fixed,right=fixed")
    assert result.exit_code in {0, 1}, result.output
    found = read_cameras(tmp_path / "session/calibration/cameras/cameras.json")
    off = se3.invert(FIXED["left"]) @ found.camera("left").T
    assert np.linalg.norm(off[:3, 3]) < 4e-3
    bias = load_depth_bias(own.folder / "calibration/depth_bias.json")
    assert abs(bias.offset_per_m - BIAS.offset_per_m) < 0.5 * BIAS.offset_per_m
    placed = SessionStore.open(own.folder).session
    assert placed.intrinsics.fx == found.camera("left").intrinsics.fx != CAMERA.fx
    for view in placed.views:
        assert view.T_world_cam is not None
        np.testing.assert_allclose(view.T_world_cam, found.camera("left").T, atol=1e-9)
