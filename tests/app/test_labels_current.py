"""Labels follow the reviewed scene: an export never hands out those of before the review."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from realsim.app.annotate import current
from realsim.app.annotate.current import annotate_session, refresh_labels, what_is_stale
from realsim.app.console import Console
from realsim.app.export.request import ExportRequest
from realsim.app.export.run import run_export
from realsim.formats.bop.scene import find_scenes, read_scene
from realsim.geometry import se3
from realsim.records import ObjectPose, Scene, SupportPlane
from realsim.review import journal
from realsim.store import SessionStore, load_scene, provenance, save_scene
from refusals import refused
from registered_sessions import true_poses
from shared_sessions import copy_of

QUIET = Console(quiet=True)


@pytest.fixture(scope="module")
def labelled(few_views: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    store = SessionStore.open(copy_of(few_views, tmp_path_factory.mktemp("labelled") / "s"))
    plane = SupportPlane(T_world_table=np.eye(4))
    save_scene(store, Scene(name="s", objects=tuple(true_poses()), plane=plane))
    annotate_session(store, QUIET, maps="instance")
    return store.folder


@pytest.fixture
def session(labelled: Path, tmp_path: Path) -> SessionStore:
    return SessionStore.open(copy_of(labelled, tmp_path / "s"))


def say(store: SessionStore, action: journal.Action, placed: ObjectPose | None, **said: object):
    entry = journal.new_entry(action, placed, "ada", **said)  # type: ignore[arg-type]
    journal.append(store.path(journal.JOURNAL_FILE), entry)


def test_what_nobody_touched_is_current_and_not_computed_again(session: SessionStore) -> None:
    assert what_is_stale(session) == ""
    assert not refresh_labels(session, QUIET)


def test_frames_are_said_to_show_other_grasps_where_they_do(session: SessionStore) -> None:
    assert current.other_grasps_shown(session) == ""
    session.write_bytes("grasps/000000_obj000001.npz", b"first")
    assert current.other_grasps_shown(session) == "show no grasps yet"
    now = provenance.inputs_of(session, current.GRASPS)
    record, run = provenance.read(session.folder, "annotate")
    provenance.write(session, replace(record, inputs=now), run)
    assert current.other_grasps_shown(session) == ""
    session.write_bytes("grasps/000000_obj000001.npz", b"anew")
    assert current.other_grasps_shown(session) == "still show the grasps of before"


def test_every_decision_that_changes_labels_is_noticed(session: SessionStore) -> None:
    first, second = load_scene(session).objects[:2]
    T = first.T_world_obj @ se3.from_translation([0.004, 0, 0])
    decisions: list[tuple[journal.Action, ObjectPose | None, dict[str, object], str]] = [
        ("reject", first, {}, "is rejected"),
        ("swap", first, {"pose": first.T_world_obj, "obj_id": second.obj_id}, "is object"),
        ("exclude", None, {"view": 2}, "view 2"),
        ("move", first, {"pose": T}, "was moved"),
    ]
    for action, placed, said, words in decisions:
        session.path(journal.JOURNAL_FILE).unlink(missing_ok=True)
        say(session, action, placed, **said)
        assert words in what_is_stale(session)
    say(session, "comment", second, comment="nothing changes by this")
    assert refresh_labels(session, QUIET)
    again = SessionStore.open(session.folder)
    assert what_is_stale(again) == ""
    assert not refresh_labels(again, QUIET)


def test_cameras_that_changed_a_little_at_a_time_make_labels_stale(session: SessionStore) -> None:
    lens, cameras = session.session.intrinsics, session.session.Ts_world_cam
    for _ in range(2):
        cameras[1] = cameras[1] @ se3.from_translation([2e-4, 0, 0])
        session.set_cameras(lens, cameras)
        assert what_is_stale(session) == "view 1 was labelled with its camera elsewhere"
    assert refresh_labels(session, QUIET) and not refresh_labels(session, QUIET)
    session.set_cameras(replace(lens, fx=1.001 * lens.fx), cameras)
    assert what_is_stale(session) == "view 0 was labelled with another lens"


def test_an_export_carries_the_reviewed_poses_and_leaves_out_what_was_rejected(
    session: SessionStore, tmp_path: Path
) -> None:
    first, second = load_scene(session).objects[:2]
    T = first.T_world_obj @ se3.exp([0, 0, 0.1, 0.004, 0, 0])
    say(session, "move", first, pose=T)
    say(session, "reject", second)
    request = ExportRequest(sources=(session.folder,), target="bop")
    run_export(request, tmp_path / "out", QUIET)
    (ref,) = find_scenes(tmp_path / "out")
    scene = read_scene(ref)
    view = session.session.view(0)
    assert view.T_world_cam is not None
    expected = se3.invert(view.T_world_cam) @ T
    labels = {a.obj_id: a.T_cam_obj for a in scene.ground_truth[0]}
    np.testing.assert_allclose(labels[first.obj_id], expected, atol=1e-6)
    assert second.obj_id not in labels


def test_only_what_a_review_changes_makes_it_another_export(
    session: SessionStore, tmp_path: Path
) -> None:
    request = ExportRequest(sources=(session.folder,), target="bop")
    run_export(request, tmp_path / "out", QUIET)
    for name in ("reports/a.html", "review/thumbnails/000000.jpg"):
        path = session.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x")
    assert run_export(request, tmp_path / "out", QUIET).was_finished
    say(session, "reject", load_scene(session).objects[0])
    refused("finished export.*delete that one first", run_export, request, tmp_path / "out", QUIET)
