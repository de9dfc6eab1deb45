"""What reviewers said is where `realsim register --from-review` starts from; labels follow it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import refusals
from realsim.app import stages
from realsim.app.annotate import current
from realsim.app.annotate.current import annotate_session, refresh_labels, what_is_stale
from realsim.app.console import Console
from realsim.app.export.run import run_export
from realsim.app.export.target import ExportRequest
from realsim.app.register.from_review import moved_since_accepted, review_starts, stayed
from realsim.app.register.results import load_registered, with_objects
from realsim.formats.bop.scene import find_scenes, read_scene
from realsim.geometry import se3
from realsim.records import ObjectPose, Scene, SupportPlane
from realsim.review import journal
from realsim.review.corrections import decision_on
from realsim.store import SessionStore, load_scene, provenance, save_scene
from registered_sessions import true_poses
from shared_sessions import copy_of
from typed_commands import finished, invoked, refused

OFF = se3.exp(np.array([0.05, -0.05, 0.1, 0.004, -0.003, 0.005]))


@pytest.fixture
def session(registered_session: Path, tmp_path: Path) -> SessionStore:
    """A registered session that nobody has reviewed."""
    return SessionStore.open(copy_of(registered_session, tmp_path / "s"))


def say(store: SessionStore, action: journal.Action, placed: ObjectPose | None, **said: object):
    entry = journal.new_entry(action, placed, "ada", **said)  # type: ignore[arg-type]
    journal.append(store.path(journal.JOURNAL_FILE), entry)
    return entry


def test_without_a_review_the_command_says_how_to_get_one(session: SessionStore) -> None:
    said = refused("register", session.folder, "--from-review")
    assert "journal is empty" in said and "realsim review" in said
    words = ("register", session.folder, "--from-review", "--object", "1")
    assert "leave --object" in refused(*words)


def test_moved_rejected_and_excluded_are_what_comes_out(session: SessionStore) -> None:
    before = load_scene(session)
    first, second = before.objects[:2]
    data = session.path("registration/scene.json").read_bytes()
    move = say(session, "move", first, pose=first.T_world_obj @ OFF, how="gizmo")
    reject = say(session, "reject", second, comment="it is gone")
    exclude = say(session, "exclude", None, view=2, comment="blurred")
    result = finished("register", session.folder, "--from-review", "--json", "--quiet")
    said = json.loads(result.stdout[result.stdout.index("{") :])
    left = {o.instance for o in before.objects} - {second.instance}
    assert {o["instance"] for o in said["objects"]} == left
    assert said["views"] == [0, 1, 3, 4, 5, 6, 7]
    assert any("excluded by ada: blurred" in f["words"] for f in said["findings"])
    words = " ".join(f["words"] for f in said["findings"])
    assert f"instance {second.instance}" in words and "rejected by ada: it is gone" in words
    assert f"instance {first.instance}" in words and "starts from where it was put" in words
    # The depth pulls what a person moved back to where it stands.
    now = load_scene(str(session.folder)).object(first.instance)
    assert 1e3 * np.linalg.norm(now.T_world_obj[:3, 3] - first.T_world_obj[:3, 3]) < 0.5
    # Nothing is lost: the earlier scene, the journal, and what was taken in.
    assert session.path("registration/earlier/scene_001.json").read_bytes() == data
    kept = session.read_json("registration/review.json")
    assert set(kept["applied"]) == {move.id, reject.id, exclude.id}
    assert SessionStore.open(session.folder).verify() == []
    scene = session.path("registration/scene.json").read_bytes()
    finished("register", session.folder, "--from-review", "--quiet")
    assert session.path("registration/scene.json").read_bytes() == scene
    assert len(list(session.path("registration/earlier").iterdir())) == 1
    # What is taken back afterwards is told, and no longer told as done.
    state = journal.replay(journal.read(session.path(journal.JOURNAL_FILE)).entries)
    assert state.entries[1] == reject
    say(session, "undo", second, undoes=reject.id)
    again = finished("register", session.folder, "--from-review", "--json", "--quiet").stdout
    assert f"the reject of instance {second.instance} by ada was taken back" in again
    assert "It is left out" not in again
    assert stages.registered_views(session) == [0, 1, 3, 4, 5, 6, 7]


def test_the_scene_that_other_commands_use_is_the_reviewed_one(session: SessionStore) -> None:
    first, second = load_scene(session).objects[:2]
    T = first.T_world_obj @ OFF
    say(session, "move", first, pose=T, how="keyboard")
    say(session, "exclude", None, view=0)
    say(session, "symmetric", None, obj_id=second.obj_id, symmetry="z:3")
    judged = stages.judged_scene(session)
    np.testing.assert_allclose(judged.object(first.instance).T_world_obj, T, atol=1e-9)
    assert judged.object(first.instance).verdict == "unchecked"
    assert stages.registered_views(session) == list(range(1, 8))
    assert len(stages.session_models(session)[second.obj_id].symmetries) == 3


@pytest.mark.parametrize("upgraded", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_accepted_objects_stay_and_in_an_upgraded_scene_all_that_nobody_moved(
    session: SessionStore, upgraded: bool
) -> None:
    beside = se3.from_translation([0.002, 0.0, 0.0])
    scene = load_scene(session)
    first, second = (replace(o, T_world_obj=beside @ o.T_world_obj) for o in scene.objects)
    save_scene(session, replace(scene, objects=(first, second)))
    say(session, "accept", first)
    if upgraded:
        session.write_json("stages/upgrade.json", {})
    said = invoked("register", session.folder, "--from-review", "--json", "--quiet").stdout
    assert f"instance {first.instance} stays where ada accepted it; the fit would put it" in said
    now = {o.instance: o.T_world_obj for o in load_scene(session).objects}
    np.testing.assert_array_equal(now[first.instance], first.T_world_obj)
    assert np.array_equal(now[second.instance], second.T_world_obj) == upgraded
    assert (f"instance {second.instance} stays where it stood" in said) == upgraded


def test_an_accepted_object_seen_by_other_cameras_is_where_it_is_found(
    session: SessionStore,
) -> None:
    result = load_registered(session)
    say(session, "accept", result.scene.objects[0])
    starts, beside = review_starts(session, None), se3.from_translation([0.003, 0.0, 0.0])
    objects = [replace(o, T_world_obj=beside @ o.T_world_obj) for o in result.scene.objects]
    refined = {k: beside @ T for k, T in result.cameras.refined.items()}
    for cameras, stays in (result.cameras.refined, True), (refined, False):
        seen = replace(result, cameras=replace(result.cameras, refined=cameras))
        kept = stayed(session, starts, with_objects(seen, objects))[0].scene.objects[0]
        assert np.array_equal(kept.T_world_obj, objects[0].T_world_obj) != stays


@pytest.mark.slow
def test_an_acceptance_outlives_a_registration_also_that_of_a_moved_object(
    session: SessionStore,
) -> None:
    first, second = load_scene(session).objects[:2]
    say(session, "accept", first)
    far = replace(second, T_world_obj=second.T_world_obj @ OFF)
    say(session, "move", second, pose=far.T_world_obj, how="gizmo")
    say(session, "accept", far)
    say(session, "exclude", None, view=99)
    say(session, "symmetric", None, obj_id=9999, symmetry="z")
    say(session, "reject", ObjectPose(obj_id=1, instance=77, T_world_obj=np.eye(4)))
    with session.path(journal.JOURNAL_FILE).open("ab") as file:
        file.write(b'{"torn\n')
    result = invoked("register", session.folder, "--from-review", "--json", "--quiet")
    words = [f["words"] for f in json.loads(result.stdout[result.stdout.index("{") :])["findings"]]
    said = f"instance {second.instance} stays where ada accepted it; the fit would put it"
    assert any(said in w for w in words)
    # Lines about what is not there and damaged ones are told.
    for part in ("no view 99", "no model 9999", "no instance 77", "line 7 of", "not whole"):
        assert part in " ".join(words), part
    state = journal.replay(journal.read(session.path(journal.JOURNAL_FILE)).entries)
    now = load_scene(session).objects
    assert all(decision_on(o, state) is not None for o in now)
    assert not list(moved_since_accepted(now, state))
    beside = se3.from_translation([0.003, 0.0, 0.0])
    elsewhere = [replace(o, T_world_obj=beside @ o.T_world_obj) for o in now]
    assert [found[1].action for found in moved_since_accepted(elsewhere, state)] == ["accept"] * 2


def test_a_swap_to_an_object_without_a_model_is_refused_before_anything_is_written(
    session: SessionStore,
) -> None:
    first = load_scene(session).objects[0]
    before = session.path("registration/scene.json").read_bytes()
    say(session, "swap", first, pose=first.T_world_obj, obj_id=999)
    assert "999" in refused("register", session.folder, "--from-review")
    assert session.path("registration/scene.json").read_bytes() == before
    assert not session.path("registration/earlier").exists()


def test_a_journal_of_damage_alone_is_not_taken_for_none(session: SessionStore) -> None:
    session.path("review").mkdir()
    session.path(journal.JOURNAL_FILE).write_bytes(b"\x00\xff\n\x01\n")
    said = refused("register", session.folder, "--from-review")
    assert "line 1, 2 of" in said and "empty" not in said


# --- Labels follow the reviewed scene: no export hands out those of before the review -----------

QUIET = Console(quiet=True)


@pytest.fixture(scope="module")
def labelled(few_views: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    store = SessionStore.open(copy_of(few_views, tmp_path_factory.mktemp("labelled") / "s"))
    plane = SupportPlane(T_world_table=np.eye(4))
    save_scene(store, Scene(name="s", objects=tuple(true_poses()), plane=plane))
    annotate_session(store, QUIET, maps="instance")
    return store.folder


@pytest.fixture
def annotated(labelled: Path, tmp_path: Path) -> SessionStore:
    return SessionStore.open(copy_of(labelled, tmp_path / "s"))


def test_what_nobody_touched_is_current_and_not_computed_again(annotated: SessionStore) -> None:
    assert what_is_stale(annotated) == ""
    assert not refresh_labels(annotated, QUIET)


def test_frames_are_said_to_show_other_grasps_where_they_do(annotated: SessionStore) -> None:
    assert current.other_grasps_shown(annotated) == ""
    annotated.write_bytes("grasps/000000_obj000001.npz", b"first")
    assert current.other_grasps_shown(annotated) == "show no grasps yet"
    now = provenance.inputs_of(annotated, current.GRASPS)
    record, run = provenance.read(annotated.folder, "annotate")
    provenance.write(annotated, replace(record, inputs=now), run)
    assert current.other_grasps_shown(annotated) == ""
    annotated.write_bytes("grasps/000000_obj000001.npz", b"anew")
    assert current.other_grasps_shown(annotated) == "still show the grasps of before"


def test_every_decision_that_changes_labels_is_noticed(annotated: SessionStore) -> None:
    first, second = load_scene(annotated).objects[:2]
    T = first.T_world_obj @ se3.from_translation([0.004, 0, 0])
    decisions: list[tuple[journal.Action, ObjectPose | None, dict[str, object], str]] = [
        ("reject", first, {}, "is rejected"),
        ("swap", first, {"pose": first.T_world_obj, "obj_id": second.obj_id}, "is object"),
        ("exclude", None, {"view": 2}, "view 2"),
        ("move", first, {"pose": T}, "was moved"),
    ]
    for action, placed, said, words in decisions:
        annotated.path(journal.JOURNAL_FILE).unlink(missing_ok=True)
        say(annotated, action, placed, **said)
        assert words in what_is_stale(annotated)
    say(annotated, "comment", second, comment="nothing changes by this")
    assert refresh_labels(annotated, QUIET)
    again = SessionStore.open(annotated.folder)
    assert what_is_stale(again) == ""
    assert not refresh_labels(again, QUIET)


def test_cameras_that_changed_a_little_at_a_time_make_labels_stale(annotated: SessionStore) -> None:
    lens, cameras = annotated.session.intrinsics, annotated.session.Ts_world_cam
    for _ in range(2):
        cameras[1] = cameras[1] @ se3.from_translation([2e-4, 0, 0])
        annotated.set_cameras(lens, cameras)
        assert what_is_stale(annotated) == "view 1 was labelled with its camera elsewhere"
    assert refresh_labels(annotated, QUIET) and not refresh_labels(annotated, QUIET)
    annotated.set_cameras(replace(lens, fx=1.001 * lens.fx), cameras)
    assert what_is_stale(annotated) == "view 0 was labelled with another lens"


def test_an_export_carries_the_reviewed_poses_and_leaves_out_what_was_rejected(
    annotated: SessionStore, tmp_path: Path
) -> None:
    first, second = load_scene(annotated).objects[:2]
    T = first.T_world_obj @ se3.exp([0, 0, 0.1, 0.004, 0, 0])
    say(annotated, "move", first, pose=T)
    say(annotated, "reject", second)
    request = ExportRequest(sources=(annotated.folder,), target="bop")
    run_export(request, tmp_path / "out", QUIET)
    (ref,) = find_scenes(tmp_path / "out")
    labels = {a.obj_id: a.T_cam_obj for a in read_scene(ref).ground_truth[0]}
    expected = se3.invert(annotated.session.Ts_world_cam[0]) @ T
    np.testing.assert_allclose(labels[first.obj_id], expected, atol=1e-6)
    assert second.obj_id not in labels


def test_only_what_a_review_changes_makes_it_another_export(
    annotated: SessionStore, tmp_path: Path
) -> None:
    request = ExportRequest(sources=(annotated.folder,), target="bop")
    run_export(request, tmp_path / "out", QUIET)
    for name in ("reports/a.html", "review/thumbnails/000000.jpg"):
        path = annotated.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x")
    assert run_export(request, tmp_path / "out", QUIET).was_finished
    say(annotated, "reject", load_scene(annotated).objects[0])
    why = "finished export.*delete that one first"
    refusals.refused(why, run_export, request, tmp_path / "out", QUIET)
