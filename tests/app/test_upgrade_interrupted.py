"""An upgrade whose worker is killed loses a stage of a scene, and goes on from there."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from realsim.store import SessionStore
from upgradable_datasets import bop_dataset

pytestmark = pytest.mark.slow
PROGRAM = "from realsim.app.upgrade.cli import upgrade_command as c; c()"
LIMIT_S = 300.0


def start(dataset: Path, out: Path) -> "subprocess.Popen[str]":
    arguments = [str(dataset), "--out", str(out), "--quiet", "--grasps", "12"]
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *arguments, "--workers", "2"],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
    )  # fmt: skip


def wait_for(condition: Callable[[], bool], run: "subprocess.Popen[str]") -> None:
    end = time.monotonic() + LIMIT_S
    while not condition():
        assert run.poll() is None, run.communicate()[0]
        assert time.monotonic() < end
        time.sleep(0.05)


def worker_in(run: "subprocess.Popen[str]", folder: Path) -> int | None:
    """Return the process that holds the lock of a scene's folder."""
    for entry in Path("/proc").iterdir():
        if not entry.name.isdecimal():
            continue
        try:
            parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
            if parent != run.pid:
                continue
            for handle in (entry / "fd").iterdir():
                if os.readlink(handle) == str(folder):
                    return int(entry.name)
        except OSError:
            continue
    return None


def both_are_whole(out: Path) -> None:
    told = json.loads((out / "upgrade.json").read_text())
    assert [s["place"] for s in told["scenes"]] == ["test/000001", "test/000002"]
    for scene in told["scenes"]:
        assert SessionStore.open(out / scene["place"]).verify() == []
        assert all(o["grasps"]["tried"] > 0 for o in scene["objects"])


def test_a_killed_worker_loses_its_stage_and_nothing_else(tmp_path: Path) -> None:
    dataset, out = bop_dataset(tmp_path / "dataset", 2), tmp_path / "out"
    run = start(dataset, out)
    scene = out / "test/000001"
    wait_for(lambda: (scene / "stages/register.json").is_file(), run)
    registered = (scene / "registration/scene.json").stat().st_mtime_ns
    worker = worker_in(run, scene)
    assert worker is not None
    os.kill(worker, signal.SIGKILL)
    text = run.communicate(timeout=LIMIT_S)[0]
    assert run.returncode == 0, text
    both_are_whole(out)
    assert (scene / "registration/scene.json").stat().st_mtime_ns == registered
