"""The operator's view in a real pseudo-terminal: keys in, effects on disk, terminal given back.

Run as a script, this file captures with a terminal view until it is told to stop.
"""

import fcntl
import os
import pty
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from begun_sessions import begun
from given_plans import TURNED_HOME, plan_through
from realsim.records import CameraIntrinsics
from realsim.store import SessionStore
from realsim_capture_plans.capturing.capture import CaptureJob, capture
from realsim_capture_plans.capturing.log import LOG_FILE, CaptureLog
from realsim_capture_plans.capturing.operator import TerminalOperator
from realsim_capture_plans.devices.interfaces import Frame
from realsim_capture_plans.lab.lab import SimulatedArm
from realsim_capture_plans.planning.record import CapturePlan, PlanConfig

VIEWS = 40
CAMERA = CameraIntrinsics(width=64, height=48, fx=60.0, fy=60.0, cx=31.5, cy=23.5)


def plan() -> CapturePlan:
    """The wrist turns a little from view to view, above the middle of the table."""
    joints = TURNED_HOME + 0.02 * np.arange(1, VIEWS + 1)[:, None] * np.eye(6)[5]
    center = np.array([0.45, 0.0, 0.0])
    cell = PlanConfig().work_cell(center, "calibration")
    return plan_through(joints, TURNED_HOME, center, "imported", cell=cell)


class SlowCamera:
    """Gives a new image every tenth of a second."""

    name = "camera of the test"
    intrinsics = CAMERA
    depth_unit_m = 1e-4

    def __init__(self) -> None:
        self.frames = 0
        self.description: dict[str, Any] = {}

    def grab(self) -> Frame:
        time.sleep(0.1)
        self.frames += 1
        rgb = np.random.default_rng(self.frames).integers(80, 120, (48, 64, 3)).astype(np.uint8)
        return Frame(rgb=rgb, depth_m=np.full((48, 64), 0.3, np.float32), time_s=time.time())

    def recover(self) -> None:
        pass


def captured_by_a_person(folder: Path) -> None:
    store = begun(folder, CAMERA, {"plan_hash": plan().content_hash})
    with TerminalOperator("test") as operator:
        capture(plan(), SimulatedArm(), SlowCamera(), store, job=CaptureJob(operator=operator))


class Terminal:
    """A pseudo-terminal with a capture in it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.ours, self.theirs = pty.openpty()
        fcntl.ioctl(self.theirs, termios.TIOCSWINSZ, b"\x28\x00\x78\x00\0\0\0\0")  # 40 x 120
        self.before = termios.tcgetattr(self.theirs)
        self.output = b""

        def take_the_terminal() -> None:
            os.setsid()
            # Whoever runs the tests in the background hands on that interrupts are ignored.
            signal.signal(signal.SIGINT, signal.SIG_DFL)
            fcntl.ioctl(self.theirs, termios.TIOCSCTTY, 0)

        self.child = subprocess.Popen(
            [sys.executable, __file__, str(folder)],
            stdin=self.theirs, stdout=self.theirs, stderr=self.theirs,
            preexec_fn=take_the_terminal,
            env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1] / "support")},
        )  # fmt: skip
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        while True:
            try:
                self.output += os.read(self.ours, 65536)
            except OSError:
                return

    def type(self, keys: str) -> None:
        os.write(self.ours, keys.encode())

    @property
    def stored(self) -> int:
        path = self.folder / "robot.jsonl"
        return path.read_bytes().count(b"\n") if path.is_file() else 0

    def wait(self, condition: Callable[[], bool], what: str) -> None:
        end = time.monotonic() + 60.0
        while not condition():
            assert time.monotonic() < end, f"{what} did not happen:\n{self.output.decode()[-3000:]}"
            time.sleep(0.02)

    def ended(self) -> int:
        return self.child.wait(timeout=60.0)


@contextmanager
def terminal(folder: Path) -> Generator[Terminal]:
    t = Terminal(folder)
    try:
        yield t
    finally:
        t.child.kill()
        t.child.wait()
        os.close(t.theirs)
        os.close(t.ours)


def log_has(folder: Path, event: str) -> bool:
    path = folder / LOG_FILE
    return path.is_file() and f'"event": "{event}"' in path.read_text()


def test_pause_redo_skip_stop(tmp_path: Path) -> None:
    folder = tmp_path / "s"
    with terminal(folder) as t:
        t.wait(lambda: t.stored >= 2, "the first views")
        assert termios.tcgetattr(t.theirs)[3] & termios.ICANON == 0
        assert b"\a" not in t.output
        t.type("p")
        t.wait(lambda: b"nothing moves" in t.output, "the pause")
        t.wait(lambda: b"\a" in t.output, "the beep")
        stored = t.stored
        time.sleep(0.6)
        assert t.stored == stored
        t.type("x ")  # an unknown key is no answer, space is
        t.wait(lambda: t.stored > stored, "going on")
        t.type("r")
        t.wait(lambda: bool(list(folder.glob("retaken/*_1.json"))), "the view taken again")
        t.type("S")
        t.wait(lambda: log_has(folder, "skipped"), "the skipped view")
        t.type("q")
        assert t.ended() == 0
        assert termios.tcgetattr(t.theirs) == t.before
        text = t.output.decode()
        assert "depth 100 %" in text and "●" in text and "space go on" in text
    store = SessionStore.open(folder)
    assert store.verify() == [] and len(store.completed) < VIEWS
    views = CaptureLog(store).views()
    assert {k for k, e in views.items() if e["event"] == "stored"} == store.completed
    redone = [k for k, e in views.items() if "earlier" in e]
    assert len(redone) == 1 and store.has(f"retaken/{redone[0]:06d}_1_rgb.png")


def test_the_terminal_is_given_back_after_ctrl_c(tmp_path: Path) -> None:
    with terminal(tmp_path / "s") as t:
        t.wait(lambda: t.stored >= 2, "the first views")
        t.type("\x03")
        assert t.ended() in (-signal.SIGINT, 130, 1)
        assert termios.tcgetattr(t.theirs) == t.before
    assert SessionStore.open(tmp_path / "s").verify() == []


if __name__ == "__main__":
    captured_by_a_person(Path(sys.argv[1]))
