"""`realsim upgrade --address`: scenes travel to the nodes, sessions come back."""

import json

import pytest

from typed_commands import finished
from upgradable_datasets import bop_dataset

DATED = ("session.json", "session.begun.json", "manifest.jsonl", "scene_gt_coco.json")
"""Files that say when they were made."""


def upgraded(dataset, out, *options):
    few = ("--grasps", "2", "--workers", "1")
    return finished("upgrade", dataset, "--out", out, *few, "--json", *options)


def content(out):
    return {
        p.relative_to(out).as_posix(): p.read_bytes()
        for p in sorted(out.glob("*/*/**/*"))
        if p.is_file() and p.name not in DATED and "report" not in p.name
        and not p.name.endswith(".run.json") and p.parent.name != "cache"
    }  # fmt: skip


@pytest.mark.slow
def test_scenes_upgraded_on_a_cluster_are_those_upgraded_here(tmp_path):
    pytest.importorskip("ray")
    dataset = bop_dataset(tmp_path / "dataset", 2)
    here = upgraded(dataset, tmp_path / "here")
    there = upgraded(dataset, tmp_path / "there", "--address", "local")
    scenes = json.loads(here.stdout)["scenes"]
    assert json.loads(there.stdout)["scenes"] == scenes and len(scenes) == 2
    mine, theirs = content(tmp_path / "here"), content(tmp_path / "there")
    assert len(mine) > 100
    assert [k for k in mine.keys() | theirs.keys() if mine.get(k) != theirs.get(k)] == []
    again = upgraded(dataset, tmp_path / "there")
    assert json.loads(again.stdout)["skipped"] == 2
