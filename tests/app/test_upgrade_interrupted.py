"""An upgrade that is killed or interrupted loses a stage of a scene, and goes on from there."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from realsim.store import SessionStore
from upgradable_datasets import bop_dataset

pytestmark = pytest.mark.slow
PROGRAM = "from realsim.app.upgrade.cli import upgrade_command as c; c()"
LIMIT_S = 300.0


def start(dataset: Path, out: Path) -> "subprocess.Popen[str]":
    arguments = [str(dataset), "--out", str(out), "--quiet", "--grasps", "30"]
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *arguments, "--scene-workers", "2"],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
        # Whoever runs the tests in the background hands on that interrupts are ignored.
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
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


def test_ctrl_c_leaves_what_the_same_command_goes_on_with(tmp_path: Path) -> None:
    dataset, out = bop_dataset(tmp_path / "dataset", 2), tmp_path / "out"
    run = start(dataset, out)
    wait_for(lambda: any(out.glob("test/*/stages/register.json")), run)
    done = next(iter(out.glob("test/*/stages/register.json"))).parents[1]
    registered = (done / "registration/scene.json").stat().st_mtime_ns
    os.killpg(run.pid, signal.SIGINT)
    try:
        run.communicate(timeout=10)
    except subprocess.TimeoutExpired:  # Python drops an interrupt that comes within a finalizer
        os.killpg(run.pid, signal.SIGINT)
        run.communicate(timeout=60)
    assert run.returncode != 0
    again = start(dataset, out)
    text = again.communicate(timeout=LIMIT_S)[0]
    assert again.returncode == 0, text
    both_are_whole(out)
    assert (done / "registration/scene.json").stat().st_mtime_ns == registered


def test_a_killed_run_goes_on_where_it_was(tmp_path: Path) -> None:
    dataset, out = bop_dataset(tmp_path / "dataset", 2), tmp_path / "out"
    run = start(dataset, out)
    wait_for(lambda: any(out.glob("test/*/scene_camera.json")), run)
    os.kill(run.pid, signal.SIGKILL)
    run.communicate(timeout=60)
    # The workers end with their parent; until they have, the scenes are locked.
    end = time.monotonic() + 30
    while time.monotonic() < end:
        again = start(dataset, out)
        text = again.communicate(timeout=LIMIT_S)[0]
        if again.returncode == 0:
            break
        time.sleep(0.5)
    assert again.returncode == 0, text
    both_are_whole(out)
