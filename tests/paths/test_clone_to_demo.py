"""From a clone to a finished demo with the two commands of the README, in a fresh environment."""

import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from documented_commands import ROOT, documented

pytestmark = pytest.mark.slow
README = "README.md"
SMALL = "--views 12 --objects 2 --grasps 10"
"""The README's demo with fewer of everything: it is the same loop."""
LIMIT_S = 2700.0
GOAL = re.compile(r"([\d.]+)(?: mm| deg)?[\s│|]+(<=|>=) ([\d.]+)")
"""A measured figure beside its goal, as the demo prints them."""


@pytest.fixture(scope="module")
def clone(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Return a fresh copy of what is committed, and nothing else."""
    if not (ROOT / ".git").exists():
        pytest.skip("not a git checkout: there is nothing to clone")
    folder = tmp_path_factory.mktemp("clone") / "realsim"
    subprocess.run(
        ["git", "clone", "--quiet", "--no-hardlinks", str(ROOT), str(folder)], check=True
    )
    yield folder
    shutil.rmtree(folder)  # its environment alone has two gigabytes


def typed(line: str, here: Path) -> str:
    """Return what a person sees who types this line there, in a shell without any environment."""
    ours = ("VIRTUAL_ENV", "PYTHONPATH", "UV_PROJECT_ENVIRONMENT", "NUMBA_CACHE_DIR")
    environment = {k: v for k, v in os.environ.items() if k not in ours}
    done = subprocess.run(
        ["bash", "-c", line], cwd=here, env={**environment, "COLUMNS": "160"}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=LIMIT_S,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    return done.stdout


def goals(text: str) -> list[tuple[float, str, float]]:
    return [(float(a), how, float(b)) for a, how, b in GOAL.findall(text)]


def test_two_commands_give_a_demo_within_its_goals(clone: Path) -> None:
    getting_uv, demo = documented(README, "realsim", "demo", "&&").split("&&")
    assert getting_uv.split() == ["pip", "install", "uv"]
    if shutil.which("uv") is None:
        typed(getting_uv, clone)
    said = typed(f"{demo} {SMALL}", clone)
    figures = goals(said)
    promised = goals((ROOT / README).read_text())
    assert [f[1:] for f in figures] == [f[1:] for f in promised] != []
    for measured, how, goal in figures:
        assert measured <= goal if how == "<=" else measured >= goal, said
    for told in re.findall(r"^(?:report|picture)\s+(\S+)$", said, flags=re.MULTILINE):
        assert (clone / told).stat().st_size > 1000
    assert (clone / "demo/session/reports/report.html").is_file()


def test_the_tests_of_the_readme_run_there_too(clone: Path) -> None:
    tests = documented(README, "pytest")
    assert re.search(r"\d+ passed", typed(f"{tests} -q tests/laws", clone))
