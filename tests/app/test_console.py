"""The console: colours and progress only where a terminal wants them, one document for programs.

A command on several sessions: each by a process, failures named, the rest done.
"""

import json
import os
import pty
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from file_trees import bytes_of
from realsim.app import console as module
from realsim.app.console import Console, duration
from realsim.json_values import json_document
from synthetic_scenes import captured_session
from typed_commands import finished, invoked, refused

HEADER = ["object", "tried", "reach of the arm [mm]", "place [m]", "sentence"]
ROWS = [["a mug of twenty words", 123456.789, 98765.4321, "0.123 0.456", "half of it is hidden"]]
SCRIPT = f"""
import time
from realsim.app.console import Console
console = Console()
console.table("Objects", {HEADER!r}, {ROWS!r})
console.warn("look here")
with console.stage("capture", "many views") as tick:
    for k in range(5):
        tick(k + 1, 5)
        time.sleep(0.03)
"""
PLAIN_ENVIRONMENT = {
    k: v for k, v in os.environ.items() if k not in ("NO_COLOR", "FORCE_COLOR", "TERM", "COLUMNS")
}


def on_a_terminal(columns: int = 100, **environment: str) -> str:
    """Return what the script writes to a terminal."""
    parent, child = pty.openpty()
    env = PLAIN_ENVIRONMENT | {"TERM": "xterm-256color", "COLUMNS": str(columns)} | environment
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT], stdout=child, stderr=child, stdin=child, env=env
    )
    os.close(child)
    said = b""
    while True:
        try:
            part = os.read(parent, 65536)
        except OSError:
            break
        if not part:
            break
        said += part
    os.close(parent)
    assert process.wait() == 0
    return said.decode()


def piped(**environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True,
        env=PLAIN_ENVIRONMENT | {"TERM": "xterm-256color"} | environment,
    )  # fmt: skip


COLOUR = re.compile(r"\x1b\[[0-9;]*3[0-9]")
"""An escape sequence that sets a colour."""


def test_a_terminal_gets_colours_and_a_bar_with_the_time_that_is_left() -> None:
    said = on_a_terminal()
    assert COLOUR.search(said) and "5/5" in said and "left" in said


def test_a_pipe_gets_no_escape_sequence_and_no_bar() -> None:
    done = piped()
    assert "\x1b" not in done.stdout + done.stderr and "\r" not in done.stdout + done.stderr
    assert "Objects" in done.stdout and "note: look here" in done.stderr
    assert "5/5" not in done.stderr


def test_no_number_is_cut_in_two_and_no_line_is_too_wide() -> None:
    columns = 40
    said = re.sub(r"\x1b\[[0-9;]*m", "", on_a_terminal(columns))
    table = said.partition("note:")[0]
    for word in ("123456.789", "98765.4321", "0.123", "0.456", "hidden", "twenty"):
        assert word in table, word
    assert all(len(line) <= columns for line in table.replace("\r", "").splitlines())


def test_a_log_gets_a_line_at_most_every_ten_seconds(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = iter(float(s) for s in range(10_000))
    monkeypatch.setattr(module.time, "monotonic", lambda: next(clock))
    console = Console()
    for name in ("first", "second"):
        with console.stage(name) as tick:
            for k in range(50):
                tick(k + 1, 50)
    lines = capsys.readouterr().err.splitlines()
    assert 8 <= len(lines) <= 10  # a second each tick, a hundred ticks
    assert re.fullmatch(r"first: 16 % \(8 of 50\), \d+ s left", lines[0]) or "left" in lines[0]
    shares = [int(re.findall(r"(\d+) %", line)[0]) for line in lines]
    assert shares[:4] == sorted(shares[:4])
    with console.stage("long") as tick:
        for _ in range(300):
            tick(0, 5)
    assert len(capsys.readouterr().err.splitlines()) == 3  # nothing moved: every two minutes


def test_json_has_stdout_for_itself(capsys: pytest.CaptureFixture[str]) -> None:
    console = Console(as_json=True)
    console.table("Objects", HEADER, ROWS)
    console.say("written")
    console.warn("look here")
    console.result({"a": 1})
    told = capsys.readouterr()
    assert json.loads(told.out) == {"a": 1}
    assert "written" in told.err and "look here" in told.err


@dataclass(frozen=True)
class Record:
    folder: Path
    values: np.ndarray
    share: float


def test_json_has_records_arrays_paths_and_no_nan() -> None:
    record = Record(Path("a/b"), np.array([[1.5, np.nan], [np.inf, 0.1]]), float("nan"))
    told = json.loads(json_document({"r": record, "n": np.int64(3), "k": {2: (1, None, True)}}))
    assert told == {
        "r": {"folder": "a/b", "values": [[1.5, None], [None, 0.1]], "share": None},
        "n": 3,
        "k": {"2": [1, None, True]},
    }


@pytest.mark.parametrize(
    ("seconds", "text"), [(89, "89 s"), (90, "2 min"), (5399, "1 h 30 min")]
)  # fmt: skip
def test_a_time_is_said_as_people_say_it(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_a_reader_that_has_gone_is_not_a_check_that_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A table into a closed pipe is told as what it is: exit code 141, not 1."""
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as gone:
        monkeypatch.setattr(sys, "stdout", gone)
        console = Console()
        with pytest.raises(BrokenPipeError):
            console.say("words")
            gone.flush()
        monkeypatch.undo()
        os.dup2(os.open(os.devnull, os.O_WRONLY), gone.fileno())


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    folder = tmp_path_factory.mktemp("many")
    first = captured_session(folder / "a", 2).folder
    shutil.copytree(first, folder / "b")
    (folder / "c").mkdir()
    return [first, folder / "b", folder / "c"]


def labels(session):
    return bytes_of(session, "mask/*.png", "annotations/*.json")


def test_each_session_is_done_and_the_one_that_fails_is_named(sessions, tmp_path):
    alone = tmp_path / "alone"
    shutil.copytree(sessions[0], alone)
    finished("annotate", alone, "--maps", "none", "--workers", "1", "--quiet")
    done = invoked("annotate", *sessions, "--maps", "none", "--workers", "2", "--json", "--quiet")
    assert done.exit_code == 1, done.output
    document = json.loads(done.stdout)
    assert document["done"] == {str(s): 0 for s in sessions[:2]}
    assert list(document["failed"]) == [str(sessions[2])]
    assert "session.json" in document["failed"][str(sessions[2])]
    assert labels(sessions[0]) == labels(sessions[1]) == labels(alone) and labels(alone)


@pytest.mark.slow
def test_sessions_that_travel_to_a_cluster_come_back_as_if_they_had_stayed(sessions, tmp_path):
    pytest.importorskip("ray")
    before = {p for p in sessions[0].rglob("*") if p.is_file()}
    places = [tmp_path / name for name in ("here", "a", "b")]
    for place in places:
        shutil.copytree(sessions[0], place)
    words = ("--library", sessions[0] / "models", "--views", "2", "--quiet")
    objects = ("--object", "1", "--object", "7")
    here = invoked("register", places[0], *objects, *words)
    ray = ("--address", "local", "--workers", "1", "--json")
    done = invoked("register", *places[1:], *objects, *words, *ray)
    assert here.exception is None or isinstance(here.exception, SystemExit), here.exception
    code = here.exit_code
    assert done.exit_code == code and code in (0, 1), done.output
    assert json.loads(done.stdout)["done"] == {str(p): code for p in places[1:]}
    scenes = [json.loads((p / "registration/scene.json").read_text()) for p in places]
    poses = [[o["T_world_obj"] for o in s["objects"]] for s in scenes]
    assert poses[0] and poses[1] == poses[2] == poses[0]
    # A process that has a model's distance field in memory keeps none in the cache.
    files = [
        {p.relative_to(place) for p in place.rglob("*") if p.is_file() and p.parent.name != "cache"}
        for place in places
    ]
    assert files[1] == files[2] == files[0] and len(files[0]) > len(before)


def test_what_cannot_be_for_several_is_refused(sessions):
    for words, told in (
        (("annotate", sessions[0], sessions[0]), "given twice"),
        (("render", *sessions[:2], "--out", sessions[0].parent / "out"), "is one place"),
        (("school", *sessions[:2], "--json-file", sessions[0].parent / "x.json"), "--json-file"),
    ):
        assert told in refused(*words, "--quiet")
