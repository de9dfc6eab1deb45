"""The UR driver through the real ur_rtde, against a loopback controller in a process of its own."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from given_plans import stopped
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.interop import T_from_rotation_vector_pose
from realsim.robots.arm import UR5, UR5E, known_chains
from realsim_capture_plans.devices.interfaces import ArmStoppedError, DeviceError, Stop
from realsim_capture_plans.devices.ur import UrArm
from realsim_capture_plans.devices.ur_connection import UrConfig
from realsim_capture_plans.devices.ur_link import detected_model, trouble
from realsim_capture_plans.devices.ur_loopback import LoopbackController
from realsim_capture_plans.devices.ur_loopback.robot import Motion
from refusals import refused
from waiting import comes_about

HOME = np.radians([0.0, -90.0, 90.0, -90.0, -90.0, 0.0])
TCP = [0.01, -0.02, 0.12, 0.1, 0.4, -1.2]
CONFIG = UrConfig(stall_s=0.5, off_goal_s=0.3, probe_s=0.6)
SPEEDUP = 15


def options(robot: str) -> dict[str, Any]:
    return {"robot": robot, "speedup": SPEEDUP, "tcp": ",".join(map(str, TCP))}


@pytest.fixture(scope="module")
def e_series() -> Iterator[LoopbackController]:
    with LoopbackController.start(**options("UR5e")) as controller:
        yield controller


@pytest.fixture(scope="module")
def cb3() -> Iterator[LoopbackController]:
    with LoopbackController.start(**options("UR5")) as controller:
        yield controller


@pytest.fixture
def controller(e_series: LoopbackController) -> LoopbackController:
    e_series.clear()
    e_series.place(HOME.tolist())
    e_series.set_tcp(TCP)
    return e_series


@pytest.fixture
def arm(controller: LoopbackController) -> Iterator[UrArm]:
    with UrArm(controller.host, config=CONFIG) as arm:
        yield arm


# --- where it is --------------------------------------------------------------------------------


def test_arrives_where_it_is_sent_whatever_the_tool(cb3: LoopbackController) -> None:
    robot, times = "UR5", [0.0]
    with UrArm(cb3.host, model=robot, config=CONFIG) as arm:
        assert arm.name == robot
        assert arm.description["tool_offset_xyz_rotvec"] == pytest.approx(TCP)
        assert arm.description["polyscope"].startswith("3.15")
        assert arm.description["serial_number"] is None
        for goal in HOME + np.random.default_rng(0).uniform(-0.8, 0.8, (3, 6)):
            arm.move(goal, speed=2.0, acceleration=3.0)
            state = arm.state()
            np.testing.assert_allclose(state.joints, goal, atol=1e-12)
            flange = known_chains()[robot].forward(goal)
            np.testing.assert_allclose(state.T_base_ee, flange, atol=1e-12)
            np.testing.assert_allclose(state.T_ee_tcp, T_from_rotation_vector_pose(TCP))
            times.append(state.time_s)
    assert np.all(np.diff(times) > 0)


def test_a_calibrated_controller_is_told_from_the_nominal_arm() -> None:
    delta = np.array([0.0, 0.003, -0.002, 0.0, 0.0, 0.0])
    calibrated = replace(UR5E, delta_a=delta)
    words = ",".join(map(str, delta))
    with LoopbackController.start(robot="UR5e", speedup=SPEEDUP, delta_a=words) as controller:
        with UrArm(controller.host) as arm:
            q = arm.state().joints
            expected = np.linalg.norm((calibrated.forward(q) - UR5E.forward(q))[:3, 3])
            assert arm.description["controller_gap_mm"] == pytest.approx(1e3 * expected, abs=1e-3)
        with UrArm(controller.host, chain=calibrated) as arm:
            assert arm.description["controller_gap_mm"] == 0.0


# --- goals that are refused ---------------------------------------------------------------------


def test_a_goal_or_a_speed_out_of_limits_is_refused_before_anything_moves(
    arm: UrArm, controller: LoopbackController
) -> None:
    for goal, said in (
        (HOME + 7.0 * np.eye(6)[0], "outside the limits"),
        (HOME + 2.0 * np.eye(6)[2], r"joints \[2\]"),
        (np.degrees(HOME), "degrees"),
        ([0.0, 0.0, np.nan, 0.0, 0.0, 0.0], "finite"),
        ([0.0] * 5, "6 finite"),
    ):
        refused(said, arm.move, goal)
    for speed, acceleration in ((3.2, 1.4), (0.0, 1.4), (np.nan, 1.4), (1.0, 5.0), (1.0, -1.0)):
        refused("at most", arm.move, HOME + 0.1, speed=speed, acceleration=acceleration)
    assert controller.joints() == pytest.approx(HOME.tolist(), abs=0)


# --- stops --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("what", "stop", "said"),
    [
        ("protective_stop", "protective stop", "unlock the protective stop at the pendant"),
        ("emergency_stop", "emergency stop", "red button"),
        ("safeguard_stop", "not ready", "safeguard"),
        ("stall", "off goal", "no joint turned"),
    ],
)
def test_a_stop_in_mid_move_is_named_and_gone_after_recovery(
    what: str, stop: Stop, said: str, arm: UrArm, controller: LoopbackController
) -> None:
    goal = HOME + 0.8
    controller.inject(what, at_progress=0.5)
    stopped(stop, said, arm.move, goal)
    time.sleep(0.1)  # it may still have been braking
    stands = np.array(controller.joints())
    assert 0.35 < (stands - HOME).max() < 0.75
    controller.clear()
    time.sleep(0.1)
    np.testing.assert_allclose(controller.joints(), stands)  # clearing moves nothing
    arm.recover()
    np.testing.assert_allclose(controller.joints(), stands)
    arm.move(goal, acceleration=4.0)
    np.testing.assert_allclose(arm.state().joints, goal, atol=1e-12)


def test_recovery_before_the_stop_is_cleared_says_what_to_do(
    arm: UrArm, controller: LoopbackController
) -> None:
    controller.inject("power_off")
    refused(".", arm.move, HOME + 0.1, error=ArmStoppedError)
    for _ in range(2):
        refused(r"What to do: .* pendant", arm.recover, error=ArmStoppedError)
    assert arm.state().joints == pytest.approx(HOME)  # it can still be read
    controller.clear()
    arm.recover()
    arm.move(HOME + 0.1, acceleration=4.0)


def test_ctrl_c_stops_the_arm(arm: UrArm, controller: LoopbackController) -> None:
    # Tests that a shell runs in the background are born deaf to it.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    timer = threading.Timer(0.2, lambda: os.kill(os.getpid(), signal.SIGINT))
    timer.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            arm.move(HOME + 1.5, speed=0.05)
    finally:
        timer.join()
        signal.signal(signal.SIGINT, before)
    first = controller.joints()
    time.sleep(0.1)
    assert controller.joints() == first
    assert 0.01 < first[0] < 1.4
    arm.move(HOME, acceleration=4.0)  # answers that were cut short confuse nothing


# --- connections --------------------------------------------------------------------------------


def test_a_lost_connection_is_noticed_and_recovered(
    arm: UrArm, controller: LoopbackController
) -> None:
    timer = threading.Timer(0.2, controller.inject, ["hang"])
    timer.start()
    stopped("connection lost", ".", arm.move, HOME + 1.5, speed=0.05)
    timer.join()
    refused(r"refuses|switch it off", arm.recover, error=ArmStoppedError)
    refused("connection lost", arm.state, error=ArmStoppedError)
    controller.clear()
    arm.recover()
    arm.move(HOME, acceleration=4.0)


def test_the_end_of_ur_rtdes_process_is_a_lost_connection_not_a_crash(arm: UrArm) -> None:
    (child,) = [int(p) for p in children(os.getpid()) if b"ur_process" in command_line(p)]
    os.kill(child, signal.SIGKILL)
    refused("connection lost", arm.state, error=ArmStoppedError)
    arm.recover()
    assert arm.state().joints == pytest.approx(HOME)


def test_after_a_killed_capture_the_arm_stands_and_the_next_one_goes_on(
    controller: LoopbackController,
) -> None:
    code = (
        "import sys, numpy as np\n"
        "from realsim_capture_plans.devices.ur import UrArm\n"
        "arm = UrArm(sys.argv[1]); print('moving', flush=True)\n"
        "arm.move(arm.state().joints + 1.5, speed=0.05)\n"
    )
    command = [sys.executable, "-c", code, controller.host]
    capture = subprocess.Popen(command, stdout=subprocess.PIPE)
    assert capture.stdout is not None and capture.stdout.readline() == b"moving\n"
    time.sleep(0.3)
    workers = children(capture.pid)
    capture.kill()
    capture.wait()
    gone = comes_about(lambda: not any(command_line(p) for p in workers))
    assert gone, "ur_rtde's process outlives its capture"
    stands = np.array(controller.joints())
    assert 0.0 < (stands - HOME).max() < 1.4
    time.sleep(0.1)
    np.testing.assert_allclose(controller.joints(), stands)
    with UrArm(controller.host, config=CONFIG) as arm:
        arm.move(HOME, acceleration=4.0)


def test_a_second_driver_is_refused_and_the_first_one_goes_on(
    arm: UrArm, controller: LoopbackController
) -> None:
    impatient = replace(CONFIG, release_s=0.2)
    stopped("not ready", "another program holds", UrArm, controller.host, config=impatient)
    arm.move(HOME + 0.1, acceleration=4.0)


def test_a_program_of_somebody_else_is_not_stopped(controller: LoopbackController) -> None:
    controller.inject("foreign_program")
    refused("another program is running", UrArm, controller.host, error=ArmStoppedError)
    dashboard = import_module("dashboard_client").DashboardClient(controller.host)
    dashboard.connect(2000)
    assert dashboard.running()
    dashboard.disconnect()


def test_wrong_addresses_are_told_apart(controller: LoopbackController) -> None:
    stopped("connection lost", r"refuses.*port 30004", UrArm, "127.77.7.7")
    refused("no host", UrArm, "no-such-robot.invalid", error=ArmStoppedError)
    controller.inject("hang")
    with pytest.raises(ArmStoppedError, match=r"says nothing|not as a UR"):
        UrArm(controller.host, config=CONFIG)


# --- which robot --------------------------------------------------------------------------------


def test_another_model_than_expected_is_named_with_the_distance(
    controller: LoopbackController, cb3: LoopbackController
) -> None:
    gap = 1e3 * np.linalg.norm((UR5.forward(HOME) - UR5E.forward(HOME))[:3, 3])
    with pytest.raises(InputError, match=f"a UR5 is expected.*UR5e.*{gap:.1f} mm from a UR5's"):
        UrArm(controller.host, model="UR5")
    refused(f"{gap:.1f} mm from a UR5's", UrArm, controller.host, chain=UR5)
    refused(r"a UR5e is expected.*says that it is a UR5,", UrArm, cb3.host, model="UR5e")
    refused("UR9 is not known", UrArm, controller.host, model="UR9")
    refused("give one", UrArm, controller.host, model="UR5e", chain=UR5)


def test_a_tool_offset_that_changes_is_refused(arm: UrArm, controller: LoopbackController) -> None:
    before = arm.state()
    controller.set_tcp([0.0] * 6)
    refused(r"TCP.*\[10.00, -20.00, 120.00\] mm", arm.state, error=DeviceError)
    refused("TCP", arm.recover, error=DeviceError)
    controller.set_tcp(TCP)
    arm.recover()
    moved = se3.invert(before.T_base_ee) @ arm.state().T_base_ee
    np.testing.assert_allclose(moved, np.eye(4), atol=1e-12)


def test_software_that_cannot_tell_the_tool_offset_is_refused() -> None:
    with LoopbackController.start(robot="UR5", polyscope="3.5.4.10845") as controller:
        refused(r"PolyScope 3\.5, which cannot tell its tool offset", UrArm, controller.host)


def children(pid: int) -> list[int]:
    return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def command_line(pid: int) -> bytes:
    """Return how a process was called; empty once it has ended, waited for or not."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


# --- The loopback controller itself: its motion, its processes, and what it says.

STEP = 2e-3


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    reach=st.floats(1e-3, 3.0),
    speed=st.floats(0.1, 3.0),
    acceleration=st.floats(0.2, 5.0),
)
def test_a_motion_keeps_its_line_and_its_limits(
    seed: int, reach: float, speed: float, acceleration: float
) -> None:
    way = np.random.default_rng(seed).uniform(-1, 1, 6)
    way *= reach / np.abs(way).max()
    motion = Motion(HOME, HOME + way, speed, acceleration)
    cruise = reach >= speed**2 / acceleration
    ideal = reach / speed + speed / acceleration if cruise else 2 * np.sqrt(reach / acceleration)
    joints, speeds = [motion.joints], [motion.speeds]
    while not motion.ended:
        motion.advance(STEP)
        joints.append(motion.joints)
        speeds.append(motion.speeds)
    q, v = np.stack(joints), np.stack(speeds)
    np.testing.assert_allclose(q[-1], HOME + way, atol=1e-12)
    assert (len(q) - 1) * STEP == pytest.approx(ideal, abs=2 * STEP)
    assert np.abs(v).max() <= speed * (1 + 1e-9)
    assert np.abs(np.diff(v, axis=0)).max() <= acceleration * STEP * (1 + 1e-6)
    share = (q - HOME) @ way / (way @ way)
    np.testing.assert_allclose(q, HOME + share[:, None] * way, atol=1e-12)
    # The reported speed is the derivative of the reported place.
    driven = 0.5 * STEP * (v[1:] + v[:-1])
    np.testing.assert_allclose(np.diff(q, axis=0), driven, atol=acceleration * STEP**2)

    # Both wait 0.5 s and more when they are closed: the controller's end is quicker.


def test_ends_with_its_parent() -> None:
    code = (
        "import os\n"
        "from realsim_capture_plans.devices.ur_loopback import LoopbackController\n"
        "print(LoopbackController.start()._process.process.pid, flush=True)\n"
        "os.kill(os.getpid(), 9)\n"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).stdout
    (pid,) = [int(word) for word in said.split()]
    gone = comes_about(lambda: not command_line(pid))
    assert gone, "a loopback controller outlives its parent"


def test_messages_of_modes() -> None:
    assert trouble(7, 1, 1, 2) is None
    assert trouble(7, 2, 2, None) is None
    found = trouble(7, 1, 1 << 2, 2)
    assert found is not None and found.stop == "protective stop"
    found = trouble(3, 7, 1 << 7 | 1 << 6, 1)
    assert found is not None and found.stop == "emergency stop"
    for robot_mode, safety_mode in ((3, 1), (5, 1), (99, 1), (7, 5), (7, 8), (7, 9), (7, 42)):
        found = trouble(robot_mode, safety_mode, 0, 2)
        assert found is not None and found.stop == "not ready" and found.remedy


@pytest.mark.parametrize(
    ("says", "major", "model"),
    [
        ("UR5", 3, "UR5"),
        ("UR5", 5, "UR5e"),
        ("UR5e", 5, "UR5e"),
        ("UR10", 5, "UR10e"),
        ("UR20", 5, "UR20"),
        ("could not understand: 'get robot model'", 3, None),
        (None, 3, None),
    ],
)
def test_the_dashboards_model_name_needs_the_series(
    says: str | None, major: int, model: str | None
) -> None:
    assert detected_model(says, major) == model
