"""Upgrades by workers: one that is killed loses a stage of a scene, a cluster gives the same."""

import json
import os
import signal
import subprocess
from pathlib import Path

import pytest
from click.testing import Result

from file_trees import bytes_of
from realsim.store import SessionStore
from typed_commands import finished, started, wait_until
from upgradable_datasets import bop_dataset

pytestmark = pytest.mark.slow
DATED = ("session.json", "session.begun.json", "manifest.jsonl", "scene_gt_coco.json")
"""Files that say when they were made."""


def worker_in(parent: int, folder: Path) -> int | None:
    """Return the process that holds the lock of a scene's folder."""
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1]) == parent:
                if str(folder) in map(os.readlink, (entry / "fd").iterdir()):
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
    words = ("upgrade", dataset, "--out", out, "--quiet", "--grasps", 12, "--workers", 2)
    run = started(*words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True)
    scene = out / "test/000001"
    wait_until((scene / "stages/register.json").is_file, run)
    registered = (scene / "registration/scene.json").stat().st_mtime_ns
    worker = worker_in(run.pid, scene)
    assert worker is not None
    os.kill(worker, signal.SIGKILL)
    text = run.communicate(timeout=300.0)[0]
    assert run.returncode == 0, text
    both_are_whole(out)
    assert (scene / "registration/scene.json").stat().st_mtime_ns == registered


def upgraded(dataset: Path, out: Path, *options: str) -> Result:
    few = ("--grasps", "2", "--workers", "1")
    return finished("upgrade", dataset, "--out", out, *few, "--json", *options)


def content(out: Path) -> dict[str, bytes]:
    """Return what two upgrades have in common."""
    return {
        k: v for k, v in bytes_of(out, "*/*/**/*").items()
        if (p := Path(k)).name not in DATED and "report" not in p.name
        and not k.endswith(".run.json") and p.parent.name != "cache"
    }  # fmt: skip


def test_scenes_upgraded_on_a_cluster_are_those_upgraded_here(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    dataset = bop_dataset(tmp_path / "dataset", 2)
    here = upgraded(dataset, tmp_path / "here")
    there = upgraded(dataset, tmp_path / "there", "--address", "local")
    scenes = json.loads(here.stdout)["scenes"]
    assert json.loads(there.stdout)["scenes"] == scenes and len(scenes) == 2
    mine, theirs = content(tmp_path / "here"), content(tmp_path / "there")
    assert len(mine) > 100
    assert [k for k in mine.keys() | theirs.keys() if mine.get(k) != theirs.get(k)] == []
    assert json.loads(upgraded(dataset, tmp_path / "there").stdout)["skipped"] == 2
