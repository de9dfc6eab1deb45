"""Benchmark results compared: worse is told, noise is not, and the page is the one on disk."""

import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
COMPARE = ROOT / "benchmarks" / "compare.py"
BEFORE = {
    "benchmark": "b", "seed": 0,
    "goals": {"error_mm": "<= 0.5", "found": ">= 0.9", "odd": "1 to 2"},
    "figures": {"error_mm": 0.2, "found": 0.99, "odd": 1.5, "free": 7.0, "cpu_s": 10.0},
}  # fmt: skip


def compared(tmp_path: Path, **figures: float | None) -> tuple[int, str]:
    after = BEFORE | {"figures": {**BEFORE["figures"], **figures}}
    (tmp_path / "before.json").write_text(json.dumps(BEFORE))
    (tmp_path / "after.json").write_text(json.dumps(after))
    done = subprocess.run(
        [sys.executable, COMPARE, tmp_path / "before.json", tmp_path / "after.json"],
        capture_output=True, text=True,
    )  # fmt: skip
    return done.returncode, done.stdout


@pytest.mark.parametrize(
    ("figures", "code", "told"),
    [
        ({}, 0, "0 moved"),
        ({"error_mm": 0.21, "cpu_s": 12.0}, 0, "0 moved"),  # within the noise
        ({"error_mm": 0.3}, 1, "WORSE"),
        ({"error_mm": 0.1}, 0, "better"),
        ({"found": 0.5}, 1, "WORSE"),
        ({"odd": 3.0}, 1, "WORSE"),
        ({"free": 70.0}, 0, "moved"),
        ({"found": None}, 1, "missing"),
    ],
)
def test_what_moved_is_told(
    tmp_path: Path, figures: dict[str, float | None], code: int, told: str
) -> None:
    found, text = compared(tmp_path, **figures)
    assert (found, told in text) == (code, True), text


def test_runs_kept_together_know_their_noise(tmp_path: Path) -> None:
    for seed, error in enumerate((0.1, 0.2, 0.4)):
        run = BEFORE | {"seed": seed, "figures": {"error_mm": error}}
        (tmp_path / f"{seed}.json").write_text(json.dumps(run))
    runs = [tmp_path / f"{seed}.json" for seed in range(3)]
    subprocess.run([sys.executable, COMPARE, "--keep", tmp_path / "kept", *runs], check=True)
    kept = json.loads((tmp_path / "kept").read_text())
    assert kept["figures"] == {"error_mm": 0.2} and kept["seeds"] == [0, 1, 2]
    assert kept["noise"]["error_mm"] == pytest.approx(0.3)
    none = [sys.executable, COMPARE, "--keep", tmp_path / "none"]
    assert "the runs to merge" in subprocess.run(none, capture_output=True, text=True).stderr


def test_the_page_of_what_was_measured_is_made_of_the_kept_runs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(COMPARE.parent)
    compare = importlib.import_module("compare")
    assert compare.PAGE.read_text() == compare.page_of(compare.load(compare.MEASURED))
