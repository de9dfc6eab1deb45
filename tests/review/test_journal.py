"""The journal is a monoid action on the state, loses nothing, and undo is an inverse."""

import json
import multiprocessing
from pathlib import Path

import numpy as np

from realsim import ObjectPose
from realsim.geometry import se3
from realsim.review import journal
from refusals import refused


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


def test_a_torn_line_spoils_no_other(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    first, second = random_journal(np.random.default_rng(6), 2)
    journal.append(path, first)
    with path.open("ab") as file:
        file.write(b'{"format": 1, "id": "abc", "ti')  # a process was killed here
    assert journal.read(path) == journal.JournalContent(entries=(first,), damaged=(2,))
    journal.append(path, second)
    assert journal.read(path) == journal.JournalContent(entries=(first, second), damaged=(2,))


def test_reading_on_is_reading_whole_whatever_was_done_to_the_file(tmp_path: Path) -> None:
    path, rng = tmp_path / "journal.jsonl", np.random.default_rng(8)
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


def test_what_was_read_is_not_read_again_and_held_once(tmp_path: Path) -> None:
    followed = journal.Journal(path := tmp_path / "journal.jsonl")
    for _ in range(9):
        before, line = followed.read().entries, journal.new_entry("accept", placed(), "ada")
        journal.append(path, line, check=lambda _: None, journal=followed)
        *same, last = followed.read().entries
        assert all(a is b for a, b in zip(before, same, strict=True))
        assert all(e.T_world_obj is last.T_world_obj and e.subject is last.subject for e in before)


def test_foreign_lines_are_refused_with_their_number(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    for line, words in (({"format": 99}, "line 1.*format 1"), ({"format": 1, "mood": 2}, "mood")):
        path.write_text(json.dumps(line) + "\n")
        refused(words, journal.read, path)


def _write_many(path: Path, reviewer: str, n: int) -> None:
    for k in range(n):
        journal.append(path, journal.new_entry("comment", placed(k), reviewer, comment="x" * 300))


def test_two_processes_lose_no_line(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
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
