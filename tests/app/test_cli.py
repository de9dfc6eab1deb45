"""The command line: quick to answer, and clear about what it cannot use."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from stored_sessions import flip, make_whole
from typed_commands import complained, realsim, started

HEAVY = "numpy open3d pybullet gtsam cv2 viser trimesh scipy numba matplotlib".split()


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys, click\n"
        "from realsim.app import cli\n"
        "try: cli.commands(['--help'], standalone_mode=False)\n"
        "except SystemExit: pass\n"
        f"heavy = [m for m in {HEAVY!r} if m in sys.modules]\n"
        "print('HEAVY', heavy)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert "HEAVY []" in done.stdout, done.stdout + done.stderr


def test_a_folder_that_is_no_session_is_named(tmp_path: Path) -> None:
    for command in ("calibrate", "register", "school", "annotate", "report"):
        said = complained(command, tmp_path)
        assert str(tmp_path) in said and "session.json" in said
        assert list(tmp_path.iterdir()) == []


# --- exit codes ---------------------------------------------------------------------------------


def test_0_is_done(tmp_path: Path) -> None:
    assert realsim("board", "tag:7,size=80mm", "--out", tmp_path / "b").returncode == 0


def test_1_is_done_but_a_check_failed(tmp_path: Path) -> None:
    make_whole(tmp_path / "s")
    assert realsim("check", str(tmp_path / "s")).returncode == 0
    flip(next((tmp_path / "s/rgb").iterdir()), 100)
    done = realsim("check", str(tmp_path / "s"), "--json")
    assert done.returncode == 1 and json.loads(done.stdout)


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["schol"], "Did you mean 'school'?"),
        (["school", "run"], "Missing argument"),
        (["scan", "lst"], "Did you mean 'list'?"),
        (["register", "s", "--view", "3"], "Did you mean"),
        (["demo", "--views", "3"], "4<=x<=1024"),
        (["demo", "--views", "abc"], "'abc' is not a whole number"),
        (["export", "s", "--to", "bob", "--out", "o"], "bop"),
        ([], "Prepare:"),
    ],
)
def test_2_is_bad_input(
    args: list[str], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = realsim(*args)
    assert done.returncode == 2 and says in done.stderr + done.stdout
    assert "Traceback" not in done.stderr and list(tmp_path.iterdir()) == []


def test_130_is_interrupted(tmp_path: Path) -> None:
    words = ("demo", "--out", tmp_path / "d", "--workers", "1")
    with started(*words, stderr=subprocess.PIPE) as process:
        until = time.monotonic() + 100
        while not (tmp_path / "d/demo.json").is_file() and time.monotonic() < until:
            time.sleep(0.1)
        # A compiler that calls back into Python swallows what is raised there: asked until it ends.
        for _ in range(5):
            process.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=30)
                break
        _, said = process.communicate(timeout=10)
    assert process.returncode == 130 and "interrupted" in said and "Traceback" not in said


def test_a_reader_that_goes_away_is_no_error() -> None:
    code = "from realsim.app.cli import main; main()"
    script = f"{sys.executable} -c '{code}' config template | head -1; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, timeout=100)
    assert done.returncode in (0, 141) and done.stderr == ""
    assert done.stdout.startswith("# Settings")


@pytest.mark.parametrize("place", [0, 1, 2])
def test_no_color_may_stand_anywhere(place: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_COLOR", "")  # restored in the end, whatever the command sets
    words = ["config", "template"]
    words.insert(place, "--no-color")
    assert realsim(*words).returncode == 0 and os.environ["NO_COLOR"] == "1"


def test_demo_takes_nobodys_folder(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    assert "not empty" in complained("demo", "--out", tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


def test_unwritable_output_is_one_paragraph() -> None:
    # /proc refuses new folders for everybody, root included.
    assert "/proc" in complained("demo", "--out", "/proc/realsim-demo")


def test_upgrade_names_a_folder_without_scenes(tmp_path: Path) -> None:
    assert "scene" in complained("upgrade", tmp_path, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()
