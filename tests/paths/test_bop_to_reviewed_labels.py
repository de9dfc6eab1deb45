"""From a BOP folder to reviewed, exported labels with three commands: upgrade, review, export.

The review is a person's: a real Chromium opens the page that the command names, presses its keys.
"""

import contextlib
import os
import re
import subprocess
from collections.abc import Generator
from pathlib import Path

import numpy as np
import pytest

from documents import as_arguments, documented
from realsim.formats.bop.scene import find_scenes, read_scene
from realsim.geometry import se3
from realsim.records import Scene
from realsim.review import journal, reviewed_scene
from realsim.store import SessionStore, load_scene
from review_browser import ReviewPage, needs_chromium, review_browser
from upgradable_datasets import bop_dataset

pytestmark = pytest.mark.slow
README = "README.md"
UPGRADE = documented(README, "realsim", "upgrade", "DATASET", "--out")
REVIEW = documented(README, "realsim", "review", "upgraded/test/000050")
EXPORT = documented(README, "realsim", "export", "SESSION", "--to", "bop")
REAL = Path(os.environ.get("REALSIM_DATA", "nowhere")) / "scenes/ycbv_mini"
PATIENCE_S = 180.0
"""The browser draws without a graphics card."""


def run(line: str, here: Path, *more: str, **replaced: str) -> str:
    done = subprocess.run(
        [*as_arguments(line, **replaced), *more], cwd=here, text=True, timeout=1500,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    return done.stdout


@contextlib.contextmanager
def page_of(session: Path) -> Generator[ReviewPage]:
    """Serve the review as the README says and open it in a browser."""
    words = as_arguments(REVIEW.replace("upgraded/test/000050", str(session)))
    server = subprocess.Popen(
        [*words, "--port", "0", "--no-browser", "--reviewer", "ada"], text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    try:
        assert server.stdout is not None
        said = ""
        while not (found := re.search(r"http://\S+", said)):
            line = server.stdout.readline()
            assert line, said
            said += line
        with review_browser() as browser, browser.page(found.group()) as page:
            yield page
        server.terminate()
        said, _ = server.communicate(timeout=60)
        assert server.returncode == 0 and "decisions in this run" in said
    finally:
        server.kill()
        server.wait()


def moved_by_key(page: ReviewPage) -> bool:
    """Press the key that moves the object; keys count once the scene stands before the camera."""
    page.key("l")
    return "Nothing is written yet" in page.text()


def review(session: Path) -> Scene:
    """Move and accept one object, reject the next; return the scene as the reviewer left it."""
    store = SessionStore.open(session)
    path = store.path(journal.JOURNAL_FILE)
    objects = len(load_scene(store).objects)
    with page_of(session) as page:
        page.wait_for("objects judged", "computed:", seconds=PATIENCE_S)
        page.tab("Correct")
        page.wait_until(lambda: moved_by_key(page), "a move by key", PATIENCE_S)
        page.key("v")
        page.wait_message("Recorded")
        page.tab("Object")
        page.press("Accept")
        page.wait_for(f"1 of {objects} objects judged", "accepted by ada")
        page.key("n")
        page.wait_gone("accepted by ada")
        page.press("Reject")
        page.wait_for(f"2 of {objects} objects judged", "rejected by ada")
    entries = journal.read(path).entries
    assert [e.action for e in entries] == ["move", "accept", "reject"]
    assert {e.reviewer for e in entries} == {"ada"}
    assert entries[0].instance == entries[1].instance != entries[2].instance
    before, after = load_scene(store), reviewed_scene(load_scene(store), journal.replay(entries))
    moved, rejected = entries[0].instance, entries[2].instance
    assert moved is not None and rejected is not None
    T = se3.invert(before.object(moved).T_world_obj) @ after.object(moved).T_world_obj
    assert np.linalg.norm(T[:3, 3]) > 1e-3
    assert after.object(moved).verdict == "accepted"
    assert after.object(rejected).verdict == "rejected"
    return after


def carries(out: Path, session: Path, scene: Scene) -> None:
    """Compare what was exported, frame by frame, with the scene that the reviewer left."""
    (ref,) = find_scenes(out)
    exported = read_scene(ref)
    kept = [o for o in scene.objects if o.verdict != "rejected"]
    store = SessionStore.open(session)
    assert exported.ground_truth
    for index, labels in exported.ground_truth.items():
        T_world_cam = store.session.view(index).T_world_cam
        assert T_world_cam is not None
        assert sorted(a.obj_id for a in labels) == sorted(o.obj_id for o in kept)
        for label in labels:
            expected = [
                se3.invert(T_world_cam) @ o.T_world_obj for o in kept if o.obj_id == label.obj_id
            ]
            off = min(float(np.abs(label.T_cam_obj - T).max()) for T in expected)
            assert off < 1e-6
    masks = list(ref.folder.glob("mask_visib/*.png"))
    assert len(masks) == sum(len(labels) for labels in exported.ground_truth.values())


def only_adds(session: Path, folder: Path) -> bool:
    """Review a session and check its labels; return whether what was registered stays as it was."""
    registered = (session / "registration/scene.json").read_bytes()
    scene = review(session)
    run(EXPORT, folder, "--quiet", SESSION=str(session), FOLDER="labels")
    carries(folder / "labels", session, scene)
    return (session / "registration/scene.json").read_bytes() == registered


@needs_chromium
def test_what_the_reviewer_said_is_in_the_labels(tmp_path: Path) -> None:
    bop_dataset(tmp_path / "there", 1, views=2, off_m=0.004)
    run(UPGRADE, tmp_path, "--grasps", "2", "--workers", "1", "--quiet", DATASET="there")
    session = tmp_path / "upgraded/test/000001"
    assert only_adds(session, tmp_path)


@pytest.mark.real
@needs_chromium
@pytest.mark.skipif(not REAL.is_dir(), reason="REALSIM_DATA is not set")
def test_the_same_on_real_photographs(tmp_path: Path) -> None:
    few = ("--only-scenes", "50", "--views", "2", "--grasps", "2")
    run(UPGRADE, tmp_path, *few, "--quiet", DATASET=str(REAL))
    session = tmp_path / "upgraded/test/000050"
    assert only_adds(session, tmp_path)
