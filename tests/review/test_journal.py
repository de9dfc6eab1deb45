"""The journal is a monoid action on the state, loses nothing, and undo is an inverse."""

import json
import multiprocessing
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from realsim import ObjectModel, ObjectPose, Scene
from realsim.geometry import se3
from realsim.geometry.parts import part
from realsim.review import journal, reviewed_scene
from realsim.review.corrections import (
    SAME_PLACE_M,
    check_is_current,
    corrected_scene,
    decision_on,
    marked_models,
    pending,
    symmetry_of,
)
from refusals import refused


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "journal.jsonl"


def placed(instance: int = 0, x: float = 0.0) -> ObjectPose:
    return ObjectPose(obj_id=3, instance=instance, T_world_obj=se3.from_translation([x, 0, 0]))


def random_journal(rng: np.random.Generator, n: int) -> list[journal.Entry]:
    """Return n lines with decisions, comments, and undos of random earlier lines."""
    lines: list[journal.Entry] = []
    for _ in range(n):
        kind = rng.integers(4)
        obj = placed(int(rng.integers(3)))
        if kind == 3 and lines:
            target = lines[int(rng.integers(len(lines)))]
            obj = placed(target.instance or 0)
            lines.append(journal.new_entry("undo", obj, "ada", undoes=target.id))
        elif kind == 2:
            lines.append(journal.new_entry("comment", obj, "ada", comment="look here"))
        else:
            lines.append(journal.new_entry("accept" if kind else "reject", obj, "ada"))
    return lines


def test_replay_of_concatenated_journals_is_replay_after_replay() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        a, b = random_journal(rng, 12), random_journal(rng, 9)
        b += [journal.new_entry("undo", placed(a[0].instance or 0), "bob", undoes=a[0].id)]
        assert journal.replay(b, journal.replay(a)) == journal.replay(a + b)
        assert journal.replay(b, journal.replay(a)).standing == journal.replay(a + b).standing


def test_undo_is_the_inverse_and_undo_of_undo_the_identity() -> None:
    rng = np.random.default_rng(3)
    for _ in range(15):
        before = journal.replay(random_journal(rng, 8))
        line = journal.new_entry("accept", placed(1), "ada")
        undo = journal.new_entry("undo", placed(1), "ada", undoes=line.id)
        redo = journal.new_entry("undo", placed(1), "ada", undoes=undo.id)
        assert journal.replay([line, undo], before).standing == before.standing
        assert journal.replay([line, undo, redo], before).standing == (*before.standing, line)


def test_the_last_standing_decision_counts() -> None:
    yes, no = (journal.new_entry(a, placed(), "ada") for a in ("accept", "reject"))
    assert journal.replay([yes, no]).standing[-1] == no
    assert journal.replay([no, yes]).standing[-1] == yes
    undo = journal.new_entry("undo", placed(), "ada", undoes=no.id)
    assert journal.replay([yes, no, undo]).standing[-1] == yes


def test_file_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "review" / "journal.jsonl"
    assert journal.read(path).entries == ()
    lines = random_journal(np.random.default_rng(4), 25)
    lines.append(journal.new_entry("comment", placed(), "Żółw", comment='naïve\n"quoted" 物'))
    for line in lines:
        journal.append(path, line)
    assert journal.read(path) == journal.JournalContent(entries=tuple(lines), damaged=())


def test_a_torn_line_spoils_no_other(path: Path) -> None:
    first, second = random_journal(np.random.default_rng(6), 2)
    journal.append(path, first)
    with path.open("ab") as file:
        file.write(b'{"format": 1, "id": "abc", "ti')  # a process was killed here
    assert journal.read(path) == journal.JournalContent(entries=(first,), damaged=(2,))
    journal.append(path, second)
    assert journal.read(path) == journal.JournalContent(entries=(first, second), damaged=(2,))


def test_reading_on_is_reading_whole_whatever_was_done_to_the_file(path: Path) -> None:
    rng = np.random.default_rng(8)
    followed = journal.Journal(path)
    for line in random_journal(rng, 200):
        journal.append(path, line)
        done, data = rng.integers(12), path.read_bytes()
        torn, again = b'\n{"format": 1, "id": "abc", "ti', b" \n" + data[: data.index(b"\n")]
        edited = data.replace(b'"accept"', b'"reject"', 1)  # in place, no byte more or less
        if done < 4:
            path.write_bytes((data + torn, data + again, edited, b"\n" + data)[done])
        if done < 6:
            now = journal.JournalContent(entries=followed.read().entries, damaged=followed.damaged)
            assert now == journal.read(path)


def test_what_was_read_is_not_read_again_and_held_once(path: Path) -> None:
    followed = journal.Journal(path)
    for _ in range(9):
        before, line = followed.read().entries, journal.new_entry("accept", placed(), "ada")
        journal.append(path, line, check=lambda _: None, journal=followed)
        *same, last = followed.read().entries
        assert all(a is b for a, b in zip(before, same, strict=True))
        assert all(e.T_world_obj is last.T_world_obj and e.subject is last.subject for e in before)


def test_foreign_lines_are_refused_with_their_number(path: Path) -> None:
    for line, words in (({"format": 99}, "line 1.*format 1"), ({"format": 1, "mood": 2}, "mood")):
        path.write_text(json.dumps(line) + "\n")
        refused(words, journal.read, path)


def _write_many(path: Path, reviewer: str, n: int) -> None:
    for k in range(n):
        journal.append(path, journal.new_entry("comment", placed(k), reviewer, comment="x" * 300))


def test_two_processes_lose_no_line(path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    writers = [context.Process(target=_write_many, args=(path, w, 40)) for w in ("ada", "bob")]
    for w in writers:
        w.start()
    for w in writers:
        w.join(60)
        assert w.exitcode == 0
    content = journal.read(path)
    assert content.damaged == ()
    for name in ("ada", "bob"):
        assert [e.instance for e in content.entries if e.reviewer == name] == list(range(40))


# --- Corrections form a chain from the registered pose, undo takes them back, nothing is lost.

RNG = np.random.default_rng(0)


def scene(*objects: ObjectPose) -> Scene:
    return Scene(name="s", objects=objects or (placed(), placed(1, 0.2)))


def after(start: Scene, entries: list[journal.Entry]) -> ObjectPose:
    return corrected_scene(start, journal.replay(entries)).object(0)


def moves(n: int, first: ObjectPose) -> list[journal.Entry]:
    """Return n moves, each of the pose that the one before has made."""
    lines: list[journal.Entry] = []
    here = first
    for _ in range(n):
        T = se3.random_transform(RNG)
        lines.append(journal.new_entry("move", here, "ada", pose=T, how="gizmo"))
        here = after(scene(first), lines)
        np.testing.assert_allclose(here.T_world_obj, T, atol=1e-12)
    return lines


def test_moves_form_a_chain_and_undo_goes_back_one_link() -> None:
    first = placed()
    lines = moves(4, first)
    for n in range(4, 0, -1):
        lines.append(journal.new_entry("undo", first, "ada", undoes=lines[n - 1].id))
        expected = first.T_world_obj if n == 1 else lines[n - 2].pose
        assert expected is not None
        np.testing.assert_allclose(after(scene(first), lines).T_world_obj, expected, atol=1e-12)


def test_a_moved_object_keeps_nothing_that_was_computed_of_the_old_pose() -> None:
    sure = ObjectPose(
        obj_id=3, instance=0, T_world_obj=np.eye(4), covariance=np.eye(6) * 1e-6,
        checks={"agree": 0.9}, verdict="accepted",
    )  # fmt: skip
    line = journal.new_entry(
        "move", sure, "ada", pose=se3.from_translation([0.003, 0, 0]), how="icp",
        checks={"agree": 1},
    )  # fmt: skip
    now = after(scene(sure), [line])
    assert (now.covariance, now.verdict, now.checks) == (None, "unchecked", {"agree": 1})
    assert now.reasons == ("moved by ada (icp): 3 mm, 0 deg from where it was registered",)


def test_a_decision_is_about_the_pose_and_the_object_that_it_was_made_of() -> None:
    first = placed()
    move = journal.new_entry("move", first, "ada", pose=se3.from_translation([0.01, 0, 0]))
    now = after(scene(first), [move])
    before = journal.new_entry("accept", first, "ada")
    verdicts = [
        reviewed_scene(scene(first), journal.replay(lines)).object(0).verdict
        for lines in ([before], [before, move], [move, journal.new_entry("accept", now, "ada")])
    ]
    assert verdicts == ["accepted", "unchecked", "accepted"]
    swap = journal.new_entry("swap", first, "ada", pose=first.T_world_obj, obj_id=9)
    swapped = reviewed_scene(scene(first), journal.replay([before, swap])).object(0)
    assert (swapped.obj_id, swapped.verdict) == (9, "unchecked")
    assert "object 3 was said to be object 9" in swapped.reasons[0]


@pytest.mark.parametrize(("factor", "holds"), [(0.9, True), (1.1, False)])
def test_a_decision_holds_where_the_object_is_registered_to_the_same_place(
    factor: float, holds: bool
) -> None:
    state = journal.replay([journal.new_entry("accept", placed(), "ada")])
    assert (decision_on(placed(x=factor * SAME_PLACE_M), state) is not None) == holds


def test_a_later_registration_takes_no_correction_twice() -> None:
    first = placed()
    lines = moves(2, first)
    registered_anew = placed(x=0.5)
    assert after(scene(registered_anew), lines) is registered_anew
    assert pending(scene(registered_anew), journal.replay(lines)) == ()
    assert len(pending(scene(first), journal.replay(lines))) == 2


def test_pending_names_rejections_views_and_marks_but_not_accepts() -> None:
    start = scene()
    lines = [
        journal.new_entry("accept", start.objects[0], "ada"),
        journal.new_entry("reject", start.objects[1], "ada"),
        journal.new_entry("exclude", None, "ada", view=4),
        journal.new_entry("exclude", None, "ada", view=5),
        journal.new_entry("include", None, "bob", view=5),
        journal.new_entry("symmetric", None, "ada", obj_id=3, symmetry="z"),
    ]  # fmt: skip
    state = journal.replay(lines)
    assert {e.id for e in pending(start, state)} == {lines[k].id for k in (1, 2, 5)}
    assert list(state.excluded_views()) == [4]


def test_the_second_of_two_movers_is_told_and_nothing_is_written(path: Path) -> None:
    start = scene()
    seen = start.objects[0]
    T = se3.from_translation([0.01, 0, 0])
    move = journal.new_entry("move", seen, "ada", pose=T)
    journal.append(path, move, check=check_is_current(start, seen))
    before = path.read_bytes()
    late = journal.new_entry("move", seen, "bob", pose=se3.from_translation([0, 0.01, 0]))
    refused("ada", journal.append, path, late, check=check_is_current(start, seen))
    assert path.read_bytes() == before


def test_lines_of_the_first_format_are_read(path: Path) -> None:
    entry = journal.new_entry("accept", placed(), "ada")
    keys = ("id", "time", "reviewer", "action", "instance", "subject", "comment", "undoes")
    old = {"format": 1} | {k: getattr(entry, k) for k in keys}
    path.write_text(json.dumps(old) + "\n")
    state = journal.replay(journal.read(path).entries)
    assert reviewed_scene(scene(), state).object(0).verdict == "accepted"


@pytest.mark.parametrize(
    "said",
    [
        {"id": ["x"]}, {"reviewer": 7}, {"comment": ["a"]}, {"comment": "x" * 5000}, {"time": 5},
        {"instance": "0"}, {"instance": 0.5}, {"instance": True}, {"instance": -1},
        {"instance": 10**30}, {"instance": [0]}, {"checks": [1]}, {"checks": {"a": "b"}},
        {"undoes": ["x"]}, {"T_world_obj": [[1, 2], [3]]}, {"T_world_obj": "x"}, {"id": ""},
        {"T_world_obj": [[float("nan")] * 4] * 4}, {"symmetry": {}}, {"action": "undo"},
        {"action": "undo", "undoes": "1"}, {"surprise": 1},
    ],
)  # fmt: skip
def test_fields_of_another_kind_are_refused_with_the_line(said: dict[str, Any], path: Path) -> None:
    whole = {"format": 2, "id": "1", "time": "t", "reviewer": "ada", "action": "accept",
             "instance": 0, "subject": "s"}  # fmt: skip
    path.write_text(json.dumps(whole | said) + "\n")
    refused(r"journal\.jsonl, line 1", journal.read, path)


@pytest.mark.parametrize("line", [b"[" * 5000, b"1" * 6000, b"\x00\xff", b'{"a":'])
def test_what_is_no_json_is_damage_and_spoils_no_other_line(line: bytes, path: Path) -> None:
    journal.append(path, journal.new_entry("accept", placed(), "ada"))
    path.write_bytes(line + b"\n" + path.read_bytes())
    found = journal.read(path)
    assert (found.damaged, len(found.entries)) == ((1,), 1)


def test_one_id_with_two_meanings_is_refused() -> None:
    yes = journal.new_entry("accept", placed(), "ada")
    refused("say different things", journal.replay, [yes, replace(yes, action="reject")])


def test_a_full_disk_leaves_the_journal_as_it_was(path: Path) -> None:
    journal.append(path, journal.new_entry("accept", placed(), "ada"))
    before = path.read_bytes()
    program = (
        "import resource, signal, sys; from pathlib import Path; "
        "from realsim.review import journal; from realsim import ObjectPose; import numpy as np; "
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); "
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({len(before) + 20},) * 2); "
        "o = ObjectPose(obj_id=3, instance=0, T_world_obj=np.eye(4)); "
        "journal.append(Path(sys.argv[1]), journal.new_entry('accept', o, 'ada'))"
    )
    ended = subprocess.run([sys.executable, "-c", program, path], capture_output=True, text=True)
    assert "File too large" in ended.stderr
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("text", "size", "axes"),
    [("none", 1, 0), ("z", 1, 1), ("x:2", 2, 0), ("z:4 x:2", 8, 0), ("y:3 y", 3, 1)],
)
def test_marks_make_groups_about_the_middle_of_the_mesh(text: str, size: int, axes: int) -> None:
    mesh = part("wedge").mesh
    symmetries, found = symmetry_of(text, mesh)
    assert (len(symmetries), len(found)) == (size, axes)
    middle = mesh.bounds.mean(0)
    for S in symmetries:
        np.testing.assert_allclose(se3.transform(S, middle)[0], middle, atol=1e-12)
        products = [np.abs(symmetries - S @ other).max((1, 2)).min() for other in symmetries]
        assert max(products) < 1e-9


@pytest.mark.parametrize("text", ["", "w", "z:1", "z:99", "none z", "z:"])
def test_what_is_no_symmetry_is_refused_with_what_would_be(text: str) -> None:
    refused("accepted", symmetry_of, text, part("box").mesh)


def test_the_last_mark_of_a_model_counts_and_others_keep_theirs() -> None:
    models = {k: ObjectModel(obj_id=k, name=str(k), mesh=part("box").mesh) for k in (3, 4)}
    lines = [
        journal.new_entry("symmetric", None, "ada", obj_id=k, symmetry=text)
        for k, text in ((3, "z"), (3, "z:2"), (77, "z"))
    ]
    marked = marked_models(models, journal.replay(lines))
    assert (len(marked[3].symmetries), marked[3].symmetry_axes) == (2, ())
    assert marked[4] is models[4]
    undo = journal.new_entry("undo", None, "ada", undoes=lines[1].id)
    assert len(marked_models(models, journal.replay([*lines, undo]))[3].symmetry_axes) == 1
