"""`realsim capture`: sessions begun and gone on with, board views in place, clear refusals."""

import json
import shutil
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from begun_sessions import begun
from franka_server import FrankaServer
from given_plans import plan_through
from realsim.app.doctor.run import robot_findings
from realsim.arrays import Array
from realsim.geometry import se3
from realsim.interop import import_pyrealsense2
from realsim.robots.arm import UR5, UR5E, find_arm
from realsim.store import SessionStore
from realsim_capture_plans.capturing import contact_sheet as sheets
from realsim_capture_plans.collision.mount import d405_mount
from realsim_capture_plans.devices.ur_loopback import LoopbackController
from realsim_capture_plans.plan_files.plan_json import save_plan
from realsim_capture_plans.planning.record import CapturePlan
from typed_commands import complained, finished, realsim

VIEWS = 2


def made_plan(kind: str, n: int, chain=UR5) -> CapturePlan:
    """Views round the middle of the lab's table, tilted and turned."""
    center = np.array([0.45, 0.0, 0.01])
    home = find_arm("ur5").home + np.pi * np.eye(6)[0]
    joints: list[Array] = []
    for k, turn in enumerate(np.linspace(0.0, 2 * np.pi, n, endpoint=False)):
        tilt = 0.35 if k % 3 else 0.1
        eye = center + 0.34 * np.array([tilt * np.cos(turn), tilt * np.sin(turn), 1.0])
        T = se3.look_at(eye, center, 1.2 * np.sin(2.4 * k))
        q = chain.inverse(T @ se3.invert(d405_mount().T_ee_cam))
        joints.append(q[np.argmin(np.abs(q - (joints[-1] if joints else home)).max(-1))])
    return plan_through(np.stack(joints), home, center, kind, chain=chain)


@pytest.fixture(scope="module")
def plans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("plans")
    save_plan(made_plan("hemisphere", VIEWS), folder / "plan.json")
    save_plan(made_plan("hemisphere", VIEWS + 1), folder / "other.json")
    save_plan(made_plan("calibration", 3), folder / "board_plan.json")
    save_plan(made_plan("hemisphere", VIEWS, UR5E), folder / "ur5e.json")
    return folder


@lru_cache(maxsize=1)
def scene_session(plans: Path) -> Path:
    out = plans / "session"
    words = ("--plan", plans / "plan.json", "--simulated", "--only-views", "0")
    assert "contact sheet" in finished("capture", out, *words).stdout
    return out


def test_a_session_has_plan_devices_log_and_sheet(plans: Path) -> None:
    store = SessionStore.open(scene_session(plans))
    assert store.completed == {0} and store.verify() == []
    assert store.extra["arm_description"]["simulated"] is True
    assert store.extra["camera_description"]["name"] == store.extra["camera"]
    assert store.extra["gravity_up_world"] == [0.0, 0.0, 1.0]
    assert store.has("plan.json") and store.has("models/models_info.json")
    sheet = store.read_image("reports/contact_sheet.png")
    top = sheet.shape[0] - 180  # a head of several lines: nothing of it is cut
    assert sheet.shape[1:] == (2 * 320, 3) and top in (46, 76, 106)
    # Reduced, the session's photograph stands in the cell.
    photo = store.rgb(0)[8::16, 8::16].astype(float)
    cell = sheet[top:, :320][2::4, 2::4].astype(float)
    inner = np.s_[10:-10, 10:-10]
    assert np.corrcoef(photo[inner].ravel(), cell[inner].ravel())[0, 1] > 0.8


def test_what_a_killed_run_did_not_come_to_after_its_last_view_is_done_by_the_next(
    plans: Path, tmp_path: Path
) -> None:
    sheet = shutil.copytree(scene_session(plans), tmp_path / "s") / "reports/contact_sheet.png"
    before, log = sheet.read_bytes(), tmp_path / "s/capture_log.jsonl"
    sheet.unlink()
    *views, end = log.read_text().splitlines(keepends=True)
    log.write_text("".join(views))
    words = ("--plan", plans / "plan.json", "--simulated", "--only-views", "0")
    finished("capture", tmp_path / "s", *words)
    assert len(sheet.read_bytes()) > 0.9 * len(before)
    last = json.loads(log.read_text().splitlines()[-1])
    assert last["event"] == json.loads(end)["event"] == "ended" and last["complete"]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--plan", "plan.json"], "--simulated"),
        (["--plan", "plan.json", "--simulated", "--robot-host", "1.2.3.4"], "--robot-host"),
        (["--plan", "ur5e.json", "--simulated", "--arm", "panda"],
         "--arm panda is a Panda with 7 joints, and the plan was made for a UR5e with 6"),
        (["--plan", "board_plan.json", "--simulated"], "--board does not say which"),
        (["--plan", "plan.json", "--simulated", "--speed", "2"], "at most 1"),
        (["--plan", "plan.json", "--simulated", "--settle", "500"], "0 to 60 s is accepted"),
        (["--plan", "plan.json", "--simulated", "--fixed-cameras", "left=2"], "one camera"),
        (["--plan", "plan.json", "--simulated", "--only-views", "0-1,9-11"], "[9, 10, 11]"),
        (["--plan", "plan.json", "--simulated", "--retake", "1-x"], "such as 1-3,7"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_named(
    plans: Path, tmp_path: Path, options: list[str], says: str
) -> None:
    words = [plans / o if o.endswith(".json") else o for o in options]
    assert says in complained("capture", tmp_path / "s", *words)
    assert not (tmp_path / "s").exists()


def test_another_session_and_a_strangers_folder_are_left_alone(plans: Path, tmp_path: Path) -> None:
    session = tmp_path / "s"
    shutil.copytree(scene_session(plans), session)
    before = sorted((p, p.stat().st_mtime_ns) for p in session.rglob("*"))
    said = complained("capture", session, "--plan", plans / "other.json", "--simulated")
    assert "begun with the plan" in said
    assert f"Choose a new folder, or go on with the plan in {session}/plan.json" in said
    words = ("--plan", plans / "plan.json", "--simulated")
    assert "with --seed 0, --objects 5, not" in complained("capture", session, *words, "--seed", 7)
    assert sorted((p, p.stat().st_mtime_ns) for p in session.rglob("*")) == before
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis/thesis.tex").write_text("precious")
    assert "thesis.tex" in complained("capture", tmp_path / "thesis", *words)
    assert [p.name for p in (tmp_path / "thesis").iterdir()] == ["thesis.tex"]


def test_an_imported_session_is_not_gone_on_with(plans: Path, tmp_path: Path) -> None:
    camera = SessionStore.open(scene_session(plans)).session.intrinsics
    begun(tmp_path / "s", camera, {"import": {"source": "a.bag"}}).close()
    said = complained("capture", tmp_path / "s", "--plan", plans / "plan.json", "--simulated")
    assert "was imported, not captured" in said


def test_a_session_without_its_header_is_sent_to_the_repair(plans: Path, tmp_path: Path) -> None:
    (tmp_path / "s").mkdir()
    (tmp_path / "s/robot.jsonl").write_text("{}\n")
    said = complained("capture", tmp_path / "s", "--plan", plans / "plan.json", "--simulated")
    assert "realsim check" in said and "--repair" in said


# --- a robot, or what answers like one --------------------------------------------------------


def needs_no_camera() -> None:
    """Skip where a RealSense is connected: these tests are of machines without."""
    if list(import_pyrealsense2().context().query_devices()):
        pytest.skip("a RealSense is connected")


def test_a_robot_that_does_not_answer_ends_with_1(plans: Path, tmp_path: Path) -> None:
    needs_no_camera()
    done = realsim("capture", tmp_path / "s", "--plan", plans / "plan.json",
                   "--robot-host", "127.0.0.1", "--no-input")  # fmt: skip
    assert done.returncode == 1 and "127.0.0.1 refuses the robot's port" in done.stderr
    assert "the same command goes on" not in done.stdout + done.stderr
    assert "no RealSense camera is connected" in done.stderr
    assert "Traceback" not in done.stderr and not (tmp_path / "s").exists()


def test_a_robot_of_another_model_is_named_without_a_camera(plans: Path, tmp_path: Path) -> None:
    needs_no_camera()
    with LoopbackController.start(robot="UR5e", speedup=10) as controller:
        words = ("--robot-host", controller.host, "--no-input", "--dry-run")
        done = realsim("capture", tmp_path / "s", "--plan", plans / "plan.json", *words)
    assert done.returncode == 2
    assert "a UR5 is expected" in done.stderr and "UR5e" in done.stderr
    assert "no RealSense camera is connected" not in done.stderr
    assert "goes on from here" not in done.stdout and not (tmp_path / "s").exists()


def test_a_dry_run_drives_the_robot_without_a_camera(plans: Path, tmp_path: Path) -> None:
    needs_no_camera()
    plan = made_plan("hemisphere", 4)
    save_plan(plan, tmp_path / "four.json")
    words = {"joints": ",".join(map(repr, plan.home.tolist()))}
    with LoopbackController.start(robot="UR5", speedup=60, **words) as controller:
        command = ("capture", tmp_path / "s", "--plan", tmp_path / "four.json", "--robot-host",
                   controller.host, "--no-input")  # fmt: skip
        said = finished(*command, "--dry-run", "--views", "0-2").stdout
        assert "nothing is looked at" in said and "nothing was stored" in said
        # The arm really went: it stands at the last view asked for.
        np.testing.assert_allclose(controller.joints(), plan.joints[2], atol=1e-3)
        real = realsim(*command)
        assert real.returncode == 1 and "no RealSense camera" in real.stderr
        assert "nothing was begun" in real.stdout
        np.testing.assert_allclose(controller.joints(), plan.joints[2], atol=1e-3)
        controller.inject("protective_stop", at_progress=0.5)
        stopped = realsim(*command, "--dry-run", "--views", "0")
        assert stopped.returncode == 1 and "protective stop" in stopped.stderr
    assert not (tmp_path / "s").exists()


def seven_joint_plan(arm: str, path: Path) -> CapturePlan:
    """Write a plan of two views near where franky-sim's arm begins."""
    home = np.pi / 4 * np.array([0, 0, 0, -2, 0, 2, 1])
    joints = home + np.array([[0.05], [-0.05]]) * np.eye(7)[0]
    plan = plan_through(joints, home, [0.5, 0.0, 0.01], chain=find_arm(arm).chain)
    save_plan(plan, path)
    return plan


def test_an_arm_without_a_driver_is_told_where_to_write_one(tmp_path: Path) -> None:
    seven_joint_plan("iiwa14", tmp_path / "plan.json")
    words = ("--robot-host", "127.0.0.1", "--no-input", "--dry-run")
    said = complained("capture", tmp_path / "s", "--plan", tmp_path / "plan.json", *words)
    assert "docs/how-to/write-a-device-driver.md" in said


@pytest.mark.slow
def test_the_plan_of_a_franka_drives_a_franka(tmp_path: Path) -> None:
    needs_no_camera()
    plan = seven_joint_plan("FR3", tmp_path / "plan.json")
    server = FrankaServer()
    try:
        (found,) = robot_findings(server.host)
        assert found.kind == "ok" and "FCI" in found.found
        words = ("--plan", tmp_path / "plan.json", "--robot-host", server.host, "--no-input")
        said = finished("capture", tmp_path / "s", *words, "--dry-run").stdout
        assert "nothing is looked at" in said
        np.testing.assert_allclose(server.joints(), plan.joints[1], atol=5e-3)
    finally:
        server.close()


def test_the_head_of_a_contact_sheet_is_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything that is written shows: as much ink as on a sheet wide enough for one line."""
    asked = {}, {}, 4, "single_depth_color_640x480, D405 130322273305", (640, 480)
    monkeypatch.setattr(sheets, "LARGEST_CELL_PX", 80)
    narrow = sheets.contact_sheet(*asked)
    monkeypatch.setattr(sheets, "LEAST_WIDTH_PX", 2000)
    wide = sheets.contact_sheet(*asked)
    cells = 2 * 60
    head, one_line = narrow[:-cells], wide[:-cells]
    assert one_line.shape[0] == 46 < head.shape[0] and head.shape[1] == 480
    assert np.all(head[:, -4:] == head[0, 0]) and np.all(head[-4:] == head[0, 0])
    ink = [float((h != h[0, 0]).any(axis=-1).sum()) for h in (head, one_line)]
    assert 0.6 < ink[0] / ink[1] <= 1.01  # a shrunk title has less


def test_a_replay_file_is_not_replaced_unasked(plans: Path, tmp_path: Path) -> None:
    replay = tmp_path / "replay.html"
    for there, told in (("precious", "no replay that this command wrote"),
                        ("a replay by viser", "--overwrite")):  # fmt: skip
        replay.write_text(there)
        assert told in complained("plan-show", plans / "plan.json", "--replay-file", replay)
        assert replay.read_text() == there
