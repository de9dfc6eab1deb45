"""The command line: quick to answer, and clear about what it cannot use."""

import subprocess
import sys
from pathlib import Path

import pytest

HEAVY = "numpy open3d pybullet gtsam cv2 viser trimesh scipy numba matplotlib".split()


def realsim(*args: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    code = "from realsim.app.cli import main; main()"
    return subprocess.run(
        [sys.executable, "-c", code, *args], capture_output=True, text=True, timeout=120, cwd=cwd
    )


def test_help_imports_nothing_heavy_and_costs_little() -> None:
    code = (
        "import sys, time, click\n"
        "from realsim.app import cli\n"
        "try: cli.commands(['--help'], standalone_mode=False)\n"
        "except SystemExit: pass\n"
        f"heavy = [m for m in {HEAVY!r} if m in sys.modules]\n"
        "print('HEAVY', heavy, 'CPU', time.process_time())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert "HEAVY []" in done.stdout, done.stdout + done.stderr
    # CPU seconds of the process, not the clock: a busy machine must not fail the test.
    assert float(done.stdout.rsplit("CPU", 1)[1]) < 1.0


def test_help_names_every_job() -> None:
    text = realsim("--help").stdout
    for command in ("demo", "upgrade", "calibrate", "register", "school", "annotate", "review"):
        assert command in text


@pytest.mark.parametrize("command", ["calibrate", "register", "school", "annotate", "report"])
def test_a_folder_that_is_no_session_is_named(command: str, tmp_path: Path) -> None:
    done = realsim(command, str(tmp_path))
    assert done.returncode == 2
    assert str(tmp_path) in done.stderr and "session.json" in done.stderr
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    done = realsim("register", str(tmp_path / "nowhere"))
    assert done.returncode == 2 and "nowhere" in done.stderr and "Traceback" not in done.stderr


def test_demo_takes_nobodys_folder(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    done = realsim("demo", "--out", str(tmp_path))
    assert done.returncode == 2 and "not empty" in done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


def test_demo_of_another_setup_is_not_mixed(tmp_path: Path) -> None:
    (tmp_path / "demo.json").write_text('{"views": 7, "objects": 2, "seed": 1}')
    done = realsim("demo", "--out", str(tmp_path), "--views", "8")
    assert done.returncode == 2 and "views=7" in done.stderr


def test_demo_output_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    done = realsim("demo", "--out", str(tmp_path / "file"))
    assert done.returncode == 2 and "is a file" in done.stderr


def test_unwritable_output_is_one_paragraph() -> None:
    # /proc refuses new folders for everybody, root included.
    done = realsim("demo", "--out", "/proc/realsim-demo")
    assert done.returncode == 2 and "Traceback" not in done.stderr and "/proc" in done.stderr


def test_upgrade_names_a_folder_without_scenes(tmp_path: Path) -> None:
    done = realsim("upgrade", str(tmp_path), "--out", str(tmp_path / "out"))
    assert done.returncode == 2 and "scene" in done.stderr and "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()


def test_scene_numbers_must_be_numbers(tmp_path: Path) -> None:
    done = realsim("upgrade", str(tmp_path), "--out", str(tmp_path / "o"), "--scenes", "fifty")
    assert done.returncode == 2 and "fifty" in done.stderr
