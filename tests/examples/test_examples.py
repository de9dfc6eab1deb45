"""Examples stay short and run as they stand: the quick ones here, .ci/run runs all of them."""

import ast
import json
import runpy
from pathlib import Path
from typing import Any

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


@pytest.mark.slow
def test_the_cells_of_the_notebook_run_in_order_and_draw(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    cells = json.loads((EXAMPLES[0].parent / "tour.ipynb").read_text())["cells"]
    texts = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    names: dict[str, Any] = {}
    verbs: list[str] = []
    for text in texts:
        *lines, last = ast.parse(text).body
        assert isinstance(last, ast.Expr)
        target = ast.Name("shown", ast.Store())
        tree = ast.Module([*lines, ast.Assign([target], last.value)], [])
        exec(compile(ast.fix_missing_locations(tree), "cell", "exec"), names)  # noqa: S102 - the book
        shown = names["shown"]
        assert shown.passed and f"<b>{shown.verb} " in shown._repr_html_()
        verbs.append(shown.verb)
    assert len(set(verbs)) == 11 and (tmp_path / "scene.html").is_file()
