"""What other stages make of a registration: which views count, interrupted ones, notes, colour."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from realsim.app.annotate.current import annotate_session
from realsim.app.console import Console
from realsim.app.register.colour import colour_remark
from realsim.app.register.files import documents, write_result
from realsim.app.register.results import NEXT_FILE, SCENE_FILE, cameras_now
from realsim.app.report.session import write_report
from realsim.app.stages import judged_scene, registered_views
from realsim.records import CaptureSession, View
from realsim.store import SessionStore, atomic
from registered_sessions import CAMERA, models_of, registered_by_hand, table_renderer, true_cameras
from shared_sessions import copy_of

MODELS = models_of()
VIEWS = 5
QUIET = Console(quiet=True)


@pytest.fixture
def store(few_views: Path, tmp_path: Path) -> SessionStore:
    return SessionStore.open(copy_of(few_views, tmp_path / "s"))


def test_views_that_were_left_out_get_no_labels_and_are_named(store: SessionStore) -> None:
    write_result(store, registered_by_hand(store), MODELS, {})
    assert registered_views(store) == [0, 1, 2, 3]
    whole = annotate_session(store, QUIET)
    assert whole.views == 4 and whole.views_left_out == () and "not registered" not in str(whole)
    # One view less than before: its labels of the earlier run go, too.
    write_result(store, registered_by_hand(store, left_out=2), MODELS, {})
    summary = annotate_session(SessionStore.open(store.folder), QUIET)
    assert (summary.views, summary.views_left_out) == (3, (2,))
    assert "1 not registered (2)" in str(summary)
    assert set(store.read_json("scene_gt.json")) == {"0", "1", "3"}
    assert not store.has("annotations/000002.json") and store.has("annotations/000003.json")
    assert not store.has("mask_visib/000002_000000.png")
    page = write_report(store, None)
    shown = {p.name for p in page.parent.glob("overlay_*.png")}
    assert shown == {f"overlay_{k:06d}.png" for k in (0, 1, 3)}


def test_an_interrupted_registration_is_finished_by_whoever_comes_next(store: SessionStore) -> None:
    result = registered_by_hand(store, left_out=1)
    before = {str(k): T.tolist() for k, T in cameras_now(store).items()}
    files = documents(result, store, MODELS)
    store.write_bytes(NEXT_FILE, atomic.json_bytes({"before": before, "files": files}))
    assert not store.has(SCENE_FILE)
    scene = judged_scene(store)
    assert [o.instance for o in scene.objects] == [0, 1] and not store.has(NEXT_FILE)
    np.testing.assert_allclose(cameras_now(store)[0], result.cameras.refined[0], atol=1e-15)


# --- depth against colour ---------------------------------------------------------------------


def coloured(folder: Path, shift_px: int, *, blank: bool = False) -> SessionStore:
    """Return a session whose colour lies `shift_px` to the right of its depth."""
    camera = replace(CAMERA, width=640, height=480, fx=600.0, fy=600.0, cx=320.0, cy=240.0)
    session = CaptureSession(name="colour", intrinsics=camera, views=(), depth_unit_m=1e-4)
    store = SessionStore.create(folder, session)
    renderer = table_renderer()
    for k, T in enumerate(true_cameras(VIEWS)):
        labels = renderer.render(camera, T)
        grey = np.where(labels.ids >= 0, 200, 90).astype(np.uint8)
        grey = np.zeros_like(grey) if blank else np.roll(grey, shift_px, axis=1)
        rgb = np.repeat(grey[..., None], 3, axis=2)
        store.add_view(View(index=k, T_world_cam=T), rgb, labels.depth_m)
    return store


def test_depth_that_does_not_lie_on_colour_is_said_in_pixels(tmp_path: Path) -> None:
    remark = colour_remark(coloured(tmp_path / "off", 15), range(VIEWS))
    assert remark is not None and remark.kind == "not_aligned" and remark.view is None
    assert "15 px to the left of" in remark.words and f"of {VIEWS} views" in remark.words


# --- odometry ---------------------------------------------------------------------------------
