"""`realsim review` as it is typed: what it opens, how it ends, what a script reads of it."""

import json
import os
import signal
import subprocess
from pathlib import Path

import pytest

import refusals
from realsim.app.review.run import ReviewRequest, open_all, write_page
from realsim.review.reviewed_session import ReviewedSession
from realsim.review.server import counted
from realsim.store import SessionStore
from reviewed_boxes import boxes_session
from typed_commands import refused, started


def test_sessions_that_cannot_be_reviewed_are_told_and_the_others_opened(tmp_path: Path) -> None:
    boxes_session(tmp_path / "root/a").close()
    boxes_session(tmp_path / "root/b").remove("registration/scene.json")
    cut = boxes_session(tmp_path / "root/c").path("registration/scene.json")
    cut.write_text(cut.read_text()[:99])
    stores, remarks = open_all((tmp_path / "root",))
    assert [s.folder.name for s in stores] == ["a"] and len(remarks) == 2
    assert "b is left out" in remarks[0] and "realsim register" in remarks[0]
    assert "c is left out" in remarks[1] and "not valid JSON" in remarks[1]
    refusals.refused("not registered yet", open_all, (tmp_path / "root/b",))


def test_ctrl_c_ends_with_a_summary_and_exit_code_0(tmp_path: Path) -> None:
    folder = boxes_session(tmp_path / "boxes").folder
    (folder / "review").mkdir()
    (folder / "review/journal.jsonl").write_text('{"format": 2, "id\n')
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    at_once = {"env": os.environ | {"PYTHONUNBUFFERED": "1"}}
    process = started("review", folder, "--port=0", "--no-browser", "--json", **pipes, **at_once)
    assert process.stderr is not None
    assert "line 1 of" in process.stderr.readline()
    assert "http://127.0.0.1:" in process.stderr.readline()
    session = ReviewedSession(SessionStore.open(folder))
    session.decide("reject", session.standing.scene.object(3), "ada", comment="floats")
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    said = json.loads(out)
    assert (said["judged"], said["objects"]) == (1, 2)
    assert [(d["action"], d["reviewer"]) for d in said["decisions"]] == [("reject", "ada")]
    assert said["to_register"] == [str(folder)]
    assert "1 reject" in err and "--from-review" in err


def test_a_static_page_is_of_one_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What is torn of its journal is told."""
    from realsim.app.console import Console

    torn = boxes_session(tmp_path / "root/a").folder / "review/journal.jsonl"
    torn.parent.mkdir()
    torn.write_text('{"format": 2, "id\n')
    boxes_session(tmp_path / "root/b").close()
    both, one = (ReviewRequest(folders=(tmp_path / name,)) for name in ("root", "root/a"))
    to = tmp_path / "page.html", Console(quiet=True, as_json=True)
    refusals.refused("writes one scene, and there are 2", write_page, both, *to)
    write_page(one, *to)
    assert (tmp_path / "page.html").read_bytes().lstrip()[:15].lower() == b"<!doctype html>"
    assert "line 1 of" in capsys.readouterr().err


def test_where_the_static_page_cannot_be_is_told_before_anything_is_read(tmp_path: Path) -> None:
    for path, words in (
        (tmp_path, f"{tmp_path}' is a folder"),
        (tmp_path / "no/page.html", f"{tmp_path / 'no'}) for --static is not there"),
    ):
        assert words in refused("review", tmp_path / "no session", "--static", path)


def test_a_session_that_was_moved_is_told_at_the_end_and_its_decisions_counted(
    tmp_path: Path,
) -> None:
    folder = boxes_session(tmp_path / "boxes").folder
    session = ReviewedSession(SessionStore.open(folder))
    session.decide("reject", session.standing.scene.object(3), "ada", comment="floats")
    folder.rename(tmp_path / "elsewhere")
    assert [e.action for e in session.entries_seen()] == ["reject"]
    assert counted([session]) == (1, 2) and session.has_pending
    assert "is gone" in session.trouble() and str(folder) in session.trouble()
