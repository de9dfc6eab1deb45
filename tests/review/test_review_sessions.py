"""The list of scenes, and decisions on one session: nothing is lost, the slower one is told."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from file_trees import bytes_of
from realsim import ObjectPose
from realsim.geometry import se3
from realsim.review import journal, scene_list
from realsim.review.refusals import SessionGone
from realsim.review.reviewed_session import ReviewedSession
from realsim.review.scene_list import ObjectRow
from realsim.store import SessionStore
from refusals import refused
from review_browser import SMALL
from reviewed_boxes import boxes_session

TALL, FLAT, SPARE = 1, 7, 9


@pytest.fixture
def session(tmp_path: Path) -> ReviewedSession:
    return ReviewedSession(boxes_session(tmp_path / "boxes"), config=SMALL)


def seen(session: ReviewedSession, instance: int) -> ObjectPose:
    return session.standing.scene.object(instance)


def row(key: int, verdict: str, agree: float, *, decided: bool = False) -> ObjectRow:
    return ObjectRow(
        session=key // 10, instance=key % 10, name="x", verdict=verdict,
        agree=agree, is_decided=decided,
    )  # fmt: skip


# --- the list ---------------------------------------------------------------------------------


def test_worst_comes_first_whatever_the_order() -> None:
    rows = [
        row(1, "accepted", 0.1), row(2, "rejected", 0.9), row(13, "doubtful", 0.5),
        row(4, "doubtful", 0.4), row(25, "unchecked", 0.0),
    ]  # fmt: skip
    expected = [(0, 2), (0, 4), (1, 3), (2, 5), (0, 1)]
    rng = np.random.default_rng(0)
    for _ in range(10):
        shuffled = [rows[k] for k in rng.permutation(len(rows))]
        assert [r.key for r in scene_list.worst_first(shuffled)] == expected


def test_what_waits_for_a_person_stands_before_what_is_judged() -> None:
    rows = [row(0, "rejected", 0.1, decided=True), row(1, "accepted", 0.99)]
    assert [r.instance for r in scene_list.worst_first(rows)] == [1, 0]


def test_stepping_through_the_undecided_meets_each_once_and_comes_round() -> None:
    rows = [row(k, "doubtful", 0.1 * k, decided=k in (2, 5)) for k in range(7)]
    for step, order in ((1, [0, 1, 3, 4, 6]), (-1, [6, 4, 3, 1, 0])):
        now, met = None, []
        for _ in range(5):
            found = scene_list.next_undecided(rows, now, step)  # type: ignore[arg-type]
            assert found is not None
            met.append(found.instance)
            now = found.key
        assert met == order
        again = scene_list.next_undecided(rows, now, step)  # type: ignore[arg-type]
        assert again is not None and again.instance == order[0]
    done = [row(k, "doubtful", 0.1, decided=True) for k in range(3)]
    assert scene_list.next_undecided(done, (0, 1), 1) is None
    assert scene_list.next_undecided([], None, 1) is None
    last = [*done, row(3, "doubtful", 0.1)]
    assert scene_list.next_undecided(last, (0, 3), 1) == last[3]


def test_sessions_are_found_below_a_folder_and_once(tmp_path: Path) -> None:
    for name in ("root/test/000002", "root/test/000001", "root/other"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "session.json").write_text("{}")
    inner = tmp_path / "root/other/calibration/capture"
    inner.mkdir(parents=True)
    (inner / "session.json").write_text("{}")
    root = tmp_path / "root"
    found = [root / "other", root / "test/000001", root / "test/000002"]
    assert scene_list.sessions_under([root]) == found
    alike = [root / "train/000002", root / "test/000002", root / "test/000001"]
    assert scene_list.names_of(alike) == ["train/000002", "test/000002", "000001"]
    assert scene_list.sessions_under([found[2], root, root / "test"]) == [found[2], *found[:2]]
    refused("not a folder", scene_list.sessions_under, [tmp_path / "nothing"])
    (tmp_path / "empty").mkdir()
    refused("nothing to review", scene_list.sessions_under, [tmp_path / "empty"])


# --- decisions --------------------------------------------------------------------------------


def test_decisions_change_the_journal_and_no_other_file(session: ReviewedSession) -> None:
    before = bytes_of(session.store.folder)
    session.decide("reject", seen(session, 3), "ada", comment="it floats")
    assert seen(session, 3).verdict == "rejected" and seen(session, 0).verdict == "accepted"
    assert [r.is_decided for r in session.rows()] == [False, True]
    session.undo(seen(session, 3), session.standing.state.of(3)[-1], "ada")
    assert seen(session, 3).verdict == "doubtful"
    T = se3.from_translation([0.5, 0.1, 0.015])
    session.decide("move", seen(session, 3), "bob", pose=T, how="steps")
    session.decide("swap", seen(session, 3), "bob", pose=T, obj_id=SPARE)
    session.set_view(1, True, "ada", "blurred")
    session.mark_symmetric(TALL, "z:4", "ada")
    actions = [e.action for e in session.standing.state.entries]
    assert actions == ["reject", "undo", "move", "swap", "exclude", "symmetric"]
    after = bytes_of(session.store.folder)
    assert {name: after[name] for name in before} == before
    moved = session.rows()[1]
    assert moved.is_changed and moved.name == "spare" and moved.verdict == "unchecked"
    assert len(session.model(TALL).symmetries) == 4
    assert ReviewedSession(session.store, config=SMALL).standing.state == session.standing.state


def test_the_slower_of_two_movers_is_told_and_nothing_is_lost(session: ReviewedSession) -> None:
    """Two servers on one session: whoever saves second decided about another pose."""
    other = ReviewedSession(SessionStore.open(session.store.folder), config=SMALL)
    mine, theirs = seen(session, 3), seen(other, 3)
    session.decide("move", mine, "ada", pose=se3.from_translation([0.5, 0.1, 0.015]))
    for action, said in (
        ("move", {"pose": se3.from_translation([0.4, 0, 0.015])}), ("accept", {}), ("reject", {}),
        ("swap", {"pose": mine.T_world_obj, "obj_id": SPARE}),
    ):  # fmt: skip
        refused("changed by ada", other.decide, action, theirs, "bob", **said)
    other.decide("comment", theirs, "bob", comment="I saw it elsewhere")  # a remark fits any pose
    np.testing.assert_allclose(seen(other, 3).T_world_obj[:3, 3], [0.5, 0.1, 0.015])
    other.decide("accept", seen(other, 3), "bob")
    assert seen(session, 3).verdict == "accepted"


def test_undo_takes_back_only_what_was_seen(session: ReviewedSession) -> None:
    refused("nothing to undo", session.undo, seen(session, 3), None, "ada")
    mine = session.decide("accept", seen(session, 3), "ada")
    session.decide("reject", seen(session, 3), "bob")
    refused("bob was faster", session.undo, seen(session, 3), mine, "ada")
    assert seen(session, 3).verdict == "rejected"


def test_views_are_left_out_once(session: ReviewedSession) -> None:
    session.set_view(1, True, "ada")
    refused("left out already, by ada", session.set_view, 1, True, "bob")
    session.set_view(1, False, "bob")
    refused("is in already", session.set_view, 1, False, "ada")
    assert session.standing.state.excluded_views() == {}


def test_unsigned_and_senseless_decisions_are_refused(session: ReviewedSession) -> None:
    refused("name is empty", session.decide, "accept", seen(session, 0), "  ")
    refused("comment is empty", session.decide, "comment", seen(session, 0), "ada")
    refused("is no symmetry", session.mark_symmetric, TALL, "round", "ada")
    refused("no model of object 55", session.model, 55)
    assert session.standing.state.entries == ()


def test_the_journal_is_read_again_only_when_it_changed(session: ReviewedSession) -> None:
    first = session.standing
    assert session.standing is first
    line = journal.new_entry("accept", seen(session, 0), "somebody else")
    journal.append(session.journal_path, line)
    assert session.standing is not first
    assert session.standing.state.entries[-1].reviewer == "somebody else"


# --- what keeps a line out ----------------------------------------------------------------------


def test_a_journal_that_is_gone_is_not_begun_anew(session: ReviewedSession) -> None:
    session.decide("accept", seen(session, 0), "ada")
    session.decide("reject", seen(session, 3), "ada")
    looked_at = seen(session, 3)
    kept = session.journal_path.read_bytes()
    session.journal_path.unlink()
    first_line = kept.split(b"\n")[0] + b"\n"
    for left in (None, b"", first_line):
        if left is not None:
            session.journal_path.write_bytes(left)
        with pytest.raises(SessionGone, match="journal that was read is gone"):
            _ = session.standing
        refused("Put the file back", session.decide, "accept", looked_at, "bob", error=SessionGone)
        again = ReviewedSession(session.store, config=SMALL, before=session)
        with pytest.raises(SessionGone):
            _ = again.standing
        assert (session.journal_path.read_bytes() if left is not None else None) == left
    assert not session.journal_path.with_suffix(".tmp").exists()
    session.journal_path.write_bytes(kept)
    session.decide("accept", looked_at, "bob")
    assert [e.reviewer for e in session.standing.state.entries] == ["ada", "ada", "bob"]


def test_a_folder_that_is_gone_is_not_made_anew(session: ReviewedSession) -> None:
    looked_at = seen(session, 3)
    folder = session.store.folder
    folder.rename(folder.with_name("elsewhere"))
    why = "folder of the session is gone"
    refused(why, session.decide, "accept", looked_at, "ada", error=SessionGone)
    assert not folder.exists()
    folder.with_name("elsewhere").rename(folder)
    session.decide("accept", looked_at, "ada")


@pytest.mark.parametrize(
    ("number", "words"),
    [(errno.ENOSPC, "the disk is full"), (errno.EACCES, "this user may not")],
)  # fmt: skip
def test_a_disk_that_takes_nothing_is_told_in_plain_words(
    session: ReviewedSession, monkeypatch: pytest.MonkeyPatch, number: int, words: str
) -> None:
    looked_at = seen(session, 3)

    def failing(*_: object) -> int:
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patched:
        patched.setattr(os, "write", failing)
        refused(f"Not recorded: .*{words}", session.decide, "accept", looked_at, "ada")
    assert session.standing.state.entries == () and session.entries_seen() == []


def test_too_long_names_and_comments_are_refused(session: ReviewedSession) -> None:
    for said in ({"comment": "x" * 2001}, {"reviewer": "x" * 81}):
        refused("at most", session.decide, "reject", seen(session, 3), **{"reviewer": "ada"} | said)
    session.decide("reject", seen(session, 3), "x" * 80, comment="x" * 2000)
    assert len(session.standing.state.entries) == 1


def test_a_swap_to_a_missing_model_is_shown_and_can_be_undone(session: ReviewedSession) -> None:
    """The line may have been written where the model was."""
    placed = seen(session, 3)
    session.decide("swap", placed, "ada", pose=placed.T_world_obj, obj_id=99)
    swapped = seen(session, 3)
    assert [r.name for r in session.rows()] == ["tall", "object 99 (no model)"]
    assert not session.has_model(99) and session.has_model(SPARE)
    model = session.shown_model(swapped)
    assert "object 99 (its model is missing)" == model.name
    np.testing.assert_array_equal(model.mesh.vertices, session.model(FLAT).mesh.vertices)
    refused(r"obj_000099\.ply", session.model, 99)
    objects = session.standing.scene.objects
    assert [o.instance for o in session.with_models(objects)] == [0]
    assert len(session.residuals_m(objects)) == len(session.content().cloud)
    assert [o.instance for o in session.snapper().scene.objects] == [0]
    session.undo(swapped, session.standing.state.of(3)[-1], "ada")
    assert seen(session, 3).obj_id == FLAT


# --- colours and words ------------------------------------------------------------------------
