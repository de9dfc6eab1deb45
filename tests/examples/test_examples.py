"""Examples stay short and run as they stand: the quick ones here, .ci/run runs all of them."""

import runpy
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("[0-9]*.py"))
QUICK = ("01_frames_and_cameras", "10_data_sets_in_and_out", "11_review_journal")


def test_examples_are_short() -> None:
    assert EXAMPLES and all(p.read_text().count("\n") <= 60 for p in EXAMPLES)


@pytest.mark.parametrize("path", [p for p in EXAMPLES if p.stem in QUICK], ids=lambda p: p.stem)
def test_example_runs(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(path), run_name="__main__")
    assert capsys.readouterr().out.strip()
