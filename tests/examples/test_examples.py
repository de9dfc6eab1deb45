"""Every example runs as it stands and stays short."""

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("[0-9]*.py"))
LONG = {"03_capture_and_resume", "04_register_objects", "07_scan_scale", "08_register_from_nothing"}
"""These capture or register for ten seconds and more."""


def test_there_are_examples() -> None:
    assert EXAMPLES


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(p, marks=pytest.mark.slow if p.stem in LONG else (), id=p.stem)
        for p in EXAMPLES
    ],
)
def test_example_runs(path: Path, tmp_path: Path) -> None:
    assert path.read_text().count("\n") <= 60
    done = subprocess.run(
        [sys.executable, str(path)], capture_output=True, text=True, timeout=200, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()
