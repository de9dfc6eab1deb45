"""The whole loop in the simulated lab: a kill costs nothing."""

import hashlib
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

SMALL = ["--views", "6", "--objects", "2", "--grasps", "8", "--quiet"]


def start_demo(out: Path) -> subprocess.Popen[str]:
    code = "from realsim.app.cli import main; main()"
    return subprocess.Popen(
        [sys.executable, "-c", code, "demo", "--out", str(out), *SMALL],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def kill_when(out: Path, reached: Callable[[Path], bool]) -> bool:
    """Start a demo and SIGKILL it as soon as `reached`; return whether it was caught alive."""
    process = start_demo(out)
    deadline = time.monotonic() + 900
    while process.poll() is None and time.monotonic() < deadline:
        if reached(out / "session"):
            process.send_signal(signal.SIGKILL)
            process.communicate()
            return True
        time.sleep(0.005)
    process.kill()
    process.communicate()
    return False


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.slow
def test_a_demo_killed_in_two_stages_ends_like_one_left_alone(
    tmp_path: Path, demo_session: Path
) -> None:
    def lines(path: Path) -> int:
        return path.read_text().count("\n") if path.is_file() else 0

    killed = tmp_path / "killed"
    moments: dict[str, Callable[[Path], bool]] = {
        "capture": lambda s: lines(s / "robot.jsonl") == 3,
        "school": lambda s: any((s / "grasps/cache").glob("*")),
    }
    caught = {name: kill_when(killed, moment) for name, moment in moments.items()}
    assert caught == {"capture": True, "school": True}
    finished = start_demo(killed)
    _, err = finished.communicate(timeout=900)
    assert finished.returncode == 0, err
    for pattern in ("rgb/*.png", "depth/*.png", "mask_visib/*.png"):
        a = {p.name: digest(p) for p in (killed / "session").glob(pattern)}
        b = {p.name: digest(p) for p in demo_session.glob(pattern)}
        assert a == b and a, pattern
    for name in ("scene_gt.json", "registration/scene.json"):
        left = json.loads((killed / "session" / name).read_text())
        assert left == json.loads((demo_session / name).read_text()), name
