"""Nothing in the product runs what a file or a user says: no pickle, eval, shell or unsafe YAML."""

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PRODUCT = ("realsim", "calibration", "capture_plans", "sim_bridge")


def broken_rules(*paths: Path | str) -> set[tuple[str, str]]:
    """Return (rule, file) of what pyproject.toml's S rules find, told off in a comment or not."""
    how = ["--config", "pyproject.toml", "--ignore-noqa", "--no-cache", "--output-format", "json"]
    command = [sys.executable, "-m", "ruff", "check", *how, *paths]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode in (0, 1), done.stderr
    found = json.loads(done.stdout)
    return {(f["code"], f["filename"]) for f in found if str(f["code"]).startswith("S")}


def allowing_pickles(path: Path) -> bool:
    """Return whether a file lets numpy unpickle, or leaves it to a variable."""
    if "allow_pickle" not in (text := path.read_text()):
        return False
    words = [k for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Call)
             for k in n.keywords if k.arg == "allow_pickle"]  # fmt: skip
    return any(not isinstance(k.value, ast.Constant) or k.value.value for k in words)


def test_the_product_runs_nothing_that_a_file_brings() -> None:
    assert not broken_rules(*PRODUCT)
    files = [p for room in PRODUCT for p in (ROOT / room).rglob("*.py")]
    assert len(files) > 500 and not [p for p in files if allowing_pickles(p)]


@pytest.mark.parametrize(
    "line",
    ["import pickle; pickle.loads(b'')", "eval(input())", "exec('1')",
     "import os; os.system(input())", "import subprocess as s; s.run(input(), shell=True)",
     "import yaml; yaml.load('', yaml.Loader)"],
)  # fmt: skip
def test_each_rule_is_alive(line: str, tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text(line + "  # noqa\n")
    assert broken_rules(tmp_path)


def test_a_pickled_array_is_seen(tmp_path: Path) -> None:
    path = tmp_path / "a.py"
    for value, expected in (("True", True), ("False", False), ("given", True)):
        path.write_text(f"np.load(path, allow_pickle={value})")
        assert allowing_pickles(path) == expected
