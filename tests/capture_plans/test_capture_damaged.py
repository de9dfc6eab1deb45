"""A capture does not go on in silence in a session that is not what was written."""

from functools import lru_cache
from pathlib import Path
from typing import Any

import pytest

from begun_sessions import begun
from given_plans import QUICK
from realsim.store import SessionStore
from realsim.store.opening import BEGUN_FILE
from realsim.store.session_repair import repair_session
from realsim_capture_plans.capturing.capture import CaptureJob, capture
from realsim_capture_plans.capturing.run import CaptureSummary
from realsim_capture_plans.lab import LabConfig, SimulatedLab
from realsim_capture_plans.plan_files.plan_json import resolve_plan
from realsim_capture_plans.planning.record import CapturePlan
from refusals import refused

LAB = {"seed": 3, "objects": 2}


@lru_cache(maxsize=1)
def plan() -> CapturePlan:
    return resolve_plan("shipped:ur5_d405_hemisphere_256")


def lab() -> SimulatedLab:
    """A lab as it is at the beginning of every run: its camera counts the time from 0."""
    made = SimulatedLab(LabConfig(seed=3, n_objects=2, width=160, height=90))
    made.place_objects()
    return made


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    camera = lab().camera
    extra = {"plan_hash": plan().content_hash, "camera": camera.name, "arm": "UR5", "lab": LAB}
    begun(tmp_path / "s", camera.intrinsics, extra, unit_m=camera.depth_unit_m)
    run(tmp_path / "s", views=(0, 1, 2, 3))
    return tmp_path / "s"


def run(folder: Path, **job: Any) -> CaptureSummary:
    here, store = lab(), SessionStore.open(folder)
    return capture(plan(), here.arm, here.camera, store, config=QUICK, job=CaptureJob(**job))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-30])


def test_stored_images_that_changed_are_named_and_not_counted(folder: Path) -> None:
    cut(folder / "rgb/000001.png")
    (folder / "depth/000003.png").unlink()
    log = (folder / "capture_log.jsonl").read_bytes()
    for _ in range(2):  # opening it again does not make it sound
        refused(r"rgb/000001\.png: .*depth/000003.*s --repair", run, folder, views=(0, 1, 2, 3, 4))
    assert (folder / "capture_log.jsonl").read_bytes() == log
    repair_session(folder)
    summary = run(folder, views=(0, 1, 2, 3, 4))
    assert summary.complete and (summary.skipped, summary.captured) == (2, 3)
    store = SessionStore.open(folder)
    assert store.verify() == [] and store.check().sound


def test_a_session_without_its_manifest_is_not_gone_on_with(folder: Path) -> None:
    (folder / "manifest.jsonl").unlink()
    cut(folder / "rgb/000002.png")
    refused(r"manifest\.jsonl is lost.*--repair", run, folder, views=(0, 1, 2, 3, 4))
    assert not (folder / "manifest.jsonl").exists()
    assert repair_session(folder).dropped_views == (2,)
    assert run(folder, views=(0, 1, 2, 3, 4)).captured == 2


def test_a_session_whose_beginning_is_lost_gets_no_more_views(folder: Path) -> None:
    (folder / BEGUN_FILE).unlink()
    (folder / "session.json").write_text('{"broken')
    repair_session(folder)
    refused(r"made anew by a repair.*arm_description.*new folder", run, folder, views=(4,))
    store = SessionStore.open(folder)
    assert store.completed == {0, 1, 2, 3} and store.check().sound
    # The way that the message tells.
    header = (folder / "session.json").read_text()
    assert '"recovered": true,' in header
    (folder / "session.json").write_text(header.replace('"recovered": true,', ""))
    repair_session(folder)
    assert run(folder, views=(4,)).complete
