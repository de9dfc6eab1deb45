"""The loopback controller itself: its motion, its processes, and ur_rtde on it alone."""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from realsim_capture_plans.devices.ur_loopback.robot import Motion
from realsim_capture_plans.devices.ur_messages import detected_model, trouble

HOME = np.radians([0.0, -90.0, 90.0, -90.0, -90.0, 0.0])
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
    rng = np.random.default_rng(seed)
    way = rng.uniform(-1, 1, 6)
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
    np.testing.assert_allclose(
        np.diff(q, axis=0), 0.5 * STEP * (v[1:] + v[:-1]), atol=acceleration * STEP**2
    )

    # Both wait 0.5 s and more when they are closed: the controller's end is quicker.


def test_ends_with_its_parent() -> None:
    code = (
        "import os\n"
        "from realsim_capture_plans.devices.ur_loopback import LoopbackController\n"
        "print(LoopbackController.start()._process.process.pid, flush=True)\n"
        "os.kill(os.getpid(), 9)\n"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).stdout
    pids = [int(word) for word in said.split()]
    assert len(pids) == 1
    end = time.monotonic() + 30.0
    while any(_runs(pid) for pid in pids):
        assert time.monotonic() < end, "a loopback controller outlives its parent"
        time.sleep(0.02)


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


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False
