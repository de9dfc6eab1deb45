"""The Franka driver through the real franky, against franky-sim's arm in a process of its own."""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from franka_server import FrankaServer
from given_plans import stopped
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.robots.arm import find_arm
from realsim_capture_plans.devices.franka import FrankaArm, FrankaConfig
from realsim_capture_plans.devices.interfaces import ArmStoppedError, Stop
from refusals import refused

FR3 = find_arm("FR3")
CONFIG = FrankaConfig(connect_s=1.5, call_s=2.0)
TOOL = np.array([0.02, -0.01, 0.05])
SLOW = pytest.mark.slow


def connect(host: str, **options: Any) -> FrankaArm:
    return FrankaArm(host, **{"chain": FR3.chain, "config": CONFIG} | options)


@pytest.fixture(scope="module")
def server() -> Iterator[FrankaServer]:
    server = FrankaServer()
    yield server
    server.close()


@pytest.fixture
def arm(server: FrankaServer) -> Iterator[FrankaArm]:
    server.tell("clear")
    with connect(server.host) as arm:
        yield arm


def test_the_flange_agrees_with_the_chain_whatever_the_tool_and_moves_arrive(
    server: FrankaServer, arm: FrankaArm
) -> None:
    rng, home, times = np.random.default_rng(0), server.joints(), [0.0]
    for tool in (np.zeros(3), TOOL):
        server.tell("tool " + " ".join(map(str, tool)))
        goal = home + rng.uniform(-0.3, 0.3, 7)
        arm.move(goal, speed=1.5, acceleration=4.0)
        state = arm.state()
        np.testing.assert_allclose(state.joints, goal, atol=CONFIG.arrival_rad)
        np.testing.assert_allclose(server.joints(), state.joints, atol=1e-3)  # it stands
        # Single precision on the wire, one packet after the other while it settles.
        np.testing.assert_allclose(state.T_base_ee, FR3.chain.forward(state.joints), atol=1e-4)
        # franky-sim's hand: 103.4 mm out, turned by -45 deg; the tool comes behind it.
        turn = se3.exp_so3([0, 0, -np.pi / 4])
        offset = [0, 0, 0.1034] + turn @ tool
        np.testing.assert_allclose(state.T_ee_tcp, se3.from_rt(turn, offset), atol=1e-6)
        times.append(state.time_s)
    server.tell("tool 0 0 0")
    assert np.all(np.diff(times) > 0)
    assert arm.name == "FR3" and arm.description["robot_model"] == "fr3"
    assert arm.description["controller_gap_mm"] < 0.1


def when_moving(
    server: FrankaServer, home: np.ndarray, do: Callable[[], object]
) -> threading.Thread:
    """Do something once the arm has left home: on a busy machine that takes its time."""

    def watch() -> None:
        for _ in range(400):
            if np.abs(server.joints() - home).max() > 0.02:
                break
            time.sleep(0.02)
        do()

    thread = threading.Thread(target=watch)
    thread.start()
    return thread


@pytest.mark.slow
def test_a_move_is_straight_in_joint_space(server: FrankaServer, arm: FrankaArm) -> None:
    way = np.array([0.5, -0.25, 0.1, 0.02, 0.0, -0.3, 0.4])
    off: list[float] = []
    while len(off) < 4 and min(off, default=1.0) > 0.005:  # a busy machine misses set-points
        start, way, seen = np.array(arm._look().q_d), -way, list[np.ndarray]()
        mover = threading.Thread(target=arm.move, args=(start + way, 1.0, 3.0))
        mover.start()
        while mover.is_alive():
            seen.append(arm._look().q_d - start)
            time.sleep(0.005)
        mover.join()
        along = np.array(seen) @ way / (way @ way)
        assert len(seen) > 50 and along[-1] > 0.9
        off.append(float(np.abs(np.array(seen) - np.outer(along, way)).max()))
    assert min(off) <= 0.005, off


def test_what_cannot_be_driven_is_refused_before_anything_moves(
    server: FrankaServer, arm: FrankaArm
) -> None:
    home = server.joints()
    for goal, said in (
        (home + 9.0 * np.eye(7)[0], "outside the limits"),
        (np.degrees(home), "degrees"),
        (home[:6], "7 finite"),
        (home * np.nan, "finite"),
    ):
        refused(said, arm.move, goal)
    for speed, acceleration in ((9.0, 1.4), (0.0, 1.4), (np.nan, 1.4), (1.0, 5.0), (1.0, -1.0)):
        refused("at most", arm.move, home + 0.1, speed=speed, acceleration=acceleration)
    np.testing.assert_allclose(server.joints(), home, atol=1e-4)


@pytest.mark.parametrize(
    ("what", "stop", "said"),
    [
        ("reflex joint_reflex", "protective stop", r"reflex \(joint_reflex\).*what it touched"),
        pytest.param(
            "reflex communication_constraints_violation",
            "protective stop",
            "real-time kernel",
            marks=SLOW,
        ),
        pytest.param("user_stop", "not ready", "external activation device", marks=SLOW),
        pytest.param("locked", "emergency stop", "unlock the joints in Desk", marks=SLOW),
    ],
)
def test_a_stop_in_mid_move_is_named_and_gone_after_recovery(
    what: str, stop: Stop, said: str, server: FrankaServer, arm: FrankaArm
) -> None:
    home = server.joints()
    goal = home + np.where(home > 0, -0.3, 0.3)
    timer = when_moving(server, home, lambda: server.tell(what))
    for way in (goal, home):  # it stays so until somebody recovers it
        assert "What to do" in stopped(stop, said, arm.move, way)
    timer.join()
    arm.state()  # it can still be read
    if not what.startswith("reflex"):
        refused(said, arm.recover, error=ArmStoppedError)
        server.tell("clear")
    arm.recover()
    assert 0.005 < np.abs(server.joints() - home).max() < 0.29
    arm.move(home, acceleration=4.0)
    np.testing.assert_allclose(arm.state().joints, home, atol=CONFIG.arrival_rad)


def test_another_robot_than_expected_is_named(server: FrankaServer) -> None:
    with pytest.raises(InputError, match=r"a Panda is expected.* says that it is: fr3"):
        connect(server.host, chain=find_arm("Panda").chain)
    d = FR3.chain.d.copy()
    d[0] += 0.01
    refused(r"10\.0 mm and 0\.00 deg from", connect, server.host, chain=replace(FR3.chain, d=d))


@pytest.mark.slow
def test_ctrl_c_stops_the_arm(server: FrankaServer, arm: FrankaArm) -> None:
    home = server.joints()
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    timer = when_moving(server, home, lambda: os.kill(os.getpid(), signal.SIGINT))
    try:
        with pytest.raises(KeyboardInterrupt):
            arm.move(home - 0.3, speed=0.2)
    finally:
        timer.join()
        signal.signal(signal.SIGINT, before)
    arm.move(arm.state().joints)  # stands where it was, and goes on
    assert 0.005 < np.abs(server.joints() - home).max() < 0.25
    arm.move(home, acceleration=4.0)


@pytest.mark.slow
def test_a_second_driver_is_refused_and_the_first_one_goes_on(
    server: FrankaServer, arm: FrankaArm
) -> None:
    stopped("connection lost", "no other program is connected", connect, server.host)
    arm.move(server.joints() + 0.05, acceleration=4.0)


def test_wrong_addresses_are_told_apart() -> None:
    stopped("not ready", "activate FCI in Desk", connect, "127.77.7.7")
    refused("Host not found", connect, "no-such-robot.invalid", error=ArmStoppedError)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_controller_that_dies_or_falls_silent_is_noticed_at_once(number: int) -> None:
    server = FrankaServer()
    arm = connect(server.host)
    try:
        timer = threading.Timer(0.3, server.signal, [number])
        timer.start()
        began = time.monotonic()
        stopped("connection lost", ".", arm.move, arm.state().joints + 0.5, speed=0.2)
        assert time.monotonic() - began < 4.0
        timer.join()
        refused("connection lost", arm.state, error=ArmStoppedError)
        with pytest.raises(ArmStoppedError):
            arm.recover()
        if number == signal.SIGSTOP:
            server.signal(signal.SIGCONT)
            arm.recover()
            arm.move(arm.state().joints + 0.05, acceleration=4.0)
    finally:
        arm.close()
        server.close()
