"""A session that is not as it was captured is refused; damaged notes and caches are redone."""

import json
import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from realsim.app import stages
from realsim.app.annotate.current import annotate_session
from realsim.app.console import Console
from realsim.app.register.run import register_session
from realsim.errors import InputError, UnitError
from realsim.geometry import se3
from realsim.records import ObjectPose
from realsim.store import SessionStore, load_scene
from realsim.store.arrays_on_disk import is_whole, write_arrays
from realsim.store.atomic import only_run_in
from refusals import refused
from registered_sessions import true_poses
from shared_sessions import copy_of

QUIET = Console(quiet=True)


@pytest.fixture(scope="module")
def pristine(few_views: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of four views of which one object is sought, from its start."""
    folder = copy_of(few_views, tmp_path_factory.mktemp("damaged") / "s")
    stages.save_starts(SessionStore.open(folder), true_poses()[:1], "test")
    return folder


@pytest.fixture
def store(pristine: Path, tmp_path: Path) -> SessionStore:
    return SessionStore.open(copy_of(pristine, tmp_path / "s"))


@pytest.fixture(scope="module")
def registered(pristine: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = copy_of(pristine, tmp_path_factory.mktemp("registered") / "s")
    register_session(SessionStore.open(folder), QUIET)
    return folder


def start_of(store: SessionStore) -> ObjectPose:
    (row,) = store.read_json("registration/starts.json")["starts"]
    return ObjectPose(**row)


@pytest.mark.parametrize("spoil", ["zero depth", "cut list", "lost photograph"])
def test_a_changed_capture_is_refused_even_after_it_was_registered(
    registered: Path, tmp_path: Path, spoil: str
) -> None:
    store = SessionStore.open(copy_of(registered, tmp_path / "s"))
    if spoil == "zero depth":
        store.path("depth/000002.png").unlink()  # it is linked to that of the other tests
        store.path("depth/000002.png").write_bytes(store.path("depth/000001.png").read_bytes())
    elif spoil == "cut list":
        path = store.path("robot.jsonl")
        path.write_bytes(path.read_bytes()[: path.stat().st_size * 55 // 100])
    else:
        store.path("rgb/000003.png").unlink()
    again = SessionStore.open(store.folder)
    for stage in (register_session, annotate_session):
        refused("not as it was captured", stage, again, QUIET)


def test_a_damaged_note_is_no_note(registered: Path, tmp_path: Path) -> None:
    store = SessionStore.open(copy_of(registered, tmp_path / "s"))
    store.path("stages/register.json").write_text('{"key": "abc')
    assert register_session(store, QUIET).objects[0].verdict == "accepted"
    assert "key" in json.loads(store.path("stages/register.json").read_text())


def test_an_object_out_of_every_view_is_not_placed_and_all_files_are_written(
    store: SessionStore,
) -> None:
    start = start_of(store)
    away = se3.from_translation([2.0, 0.0, 0.0]) @ start.T_world_obj
    others = replace(start, instance=1, T_world_obj=away), replace(start, instance=9)
    stages.save_starts(store, [start, *others], "test")
    scene = register_session(store, QUIET)
    assert [o.verdict for o in scene.objects] == ["accepted"]
    report = store.read_json("registration/report.json")
    # One thing named twice is counted once.
    left = {n["instance"] for n in report["not_placed"]} | {scene.objects[0].instance}
    assert left == {0, 1, 9} and len(report["not_placed"]) == 2
    assert all(len(n["reason"]) > 20 for n in report["not_placed"])
    assert [o.verdict for o in load_scene(store).objects] == ["accepted"]


def test_starts_in_millimetres_are_found_out(store: SessionStore) -> None:
    start = start_of(store)
    T = start.T_world_obj.copy()
    T[:3, 3] = [300.0, 20.0, 52.0]
    stages.save_starts(store, [replace(start, T_world_obj=T)], "test")
    refused("millimetres", register_session, store, QUIET, error=UnitError)


def test_two_runs_do_not_share_a_folder(tmp_path: Path) -> None:
    with only_run_in(tmp_path):
        with pytest.raises(InputError, match="another run"), only_run_in(tmp_path):
            pass
        if (child := os.fork()) == 0:  # it has the handle, and outlives the run
            time.sleep(60.0)
    try:
        with only_run_in(tmp_path):
            pass
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_cache_file_is_thrown_away(tmp_path: Path) -> None:
    path = tmp_path / "kept.npz"
    write_arrays(path, {"a": np.arange(1000.0)}, {"n": 1})
    assert is_whole(path)
    path.write_bytes(path.read_bytes()[:500])
    assert not is_whole(path)
    assert not path.exists()
