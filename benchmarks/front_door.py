"""Benchmark of the front door: what a newcomer installs, waits for, learns and reads.

    uv run --group dev python benchmarks/front_door.py [--quick] [--json FILE] [--part PART]

The install is that of `uv sync` in a fresh clone: install_mb is `du` of its site-packages, without
compiled Python files. demo_cpu_s is `realsim demo` there, its processes included, with the inner
loops that this user's runs have compiled. The other times are the least of five.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

from figures import Figure, Found, Goal, children_cpu_s, run

ROOT = Path(__file__).resolve().parents[1]
FIGURES = {
    "install_mb": Figure(unit="MiB", goal=Goal(high=2200)),
    "install_packages": Figure(unit=""),
    "demo_cpu_s": Figure(unit="s", goal=Goal(high=90)),
    "help_cpu_s": Figure(unit="s", goal=Goal(high=0.15)),
    "import_realsim_cpu_s": Figure(unit="s", goal=Goal(high=0.05)),
    "options_with_two_meanings": Figure(unit="", goal=Goal(high=0)),
    "readme_lines": Figure(unit="", goal=Goal(high=120)),
    "docs_words": Figure(unit="", goal=Goal(high=30_000)),
    "code_lines": Figure(unit="", goal=Goal(high=98_000)),
}
CLONE = tempfile.TemporaryDirectory(prefix="front_door_")


@cache
def installed() -> Path:
    """Return the site-packages of `uv sync` in a fresh clone."""
    subprocess.run(["git", "clone", "-q", ROOT, CLONE.name], check=True)
    subprocess.run(["uv", "sync", "-q"], cwd=CLONE.name, env=bare(), check=True)
    return next(Path(CLONE.name).glob(".venv/lib/python3*/site-packages"))


def bare() -> dict[str, str]:
    """Return an environment without this run's Python."""
    return {k: v for k, v in os.environ.items() if k != "VIRTUAL_ENV"}


def cpu_s(*command: str | Path) -> float:
    """Run a command and return what it and its processes cost [s]."""
    before = children_cpu_s()
    subprocess.run(command, cwd=CLONE.name, env=bare(), check=True, stdout=subprocess.DEVNULL)
    return children_cpu_s() - before


def install(_: argparse.Namespace) -> Found:
    """Measure what is installed."""
    packages, found = installed(), Found()
    size = subprocess.run(
        ["du", "-sm", "--exclude=*.pyc", packages], check=True, capture_output=True, text=True
    )
    found.add("install_mb", int(size.stdout.split()[0]))
    found.add("install_packages", len(list(packages.glob("*.dist-info"))) - 1)
    return found


def times(given: argparse.Namespace) -> Found:
    """Measure what is waited for."""
    programs, found = installed().parents[2] / "bin", Found()
    small = ["--views", "4", "--objects", "1", "--grasps", "2"] if given.quick else []
    found.add("demo_cpu_s", cpu_s(programs / "realsim", "demo", "--quiet", *small))
    found.add("help_cpu_s", min(cpu_s(programs / "realsim", "--help") for _ in range(5)))
    with_it, without = (
        min(cpu_s(programs / "python", "-c", code) for _ in range(5))
        for code in ("import realsim", "")
    )
    found.add("import_realsim_cpu_s", with_it - without)
    return found


def words(_: argparse.Namespace) -> Found:
    """Count what is learned and read."""
    from realsim.app.cli import commands
    from realsim.app.command import walk
    from realsim.app.options import two_meanings

    sys.path.insert(0, str(ROOT / ".ci"))
    from check_size import figures_of, tracked

    found, readme = Found(), ROOT / "README.md"
    found.add("options_with_two_meanings", len(two_meanings(walk(commands))))
    found.add("readme_lines", len(readme.read_text().splitlines()))
    pages = [readme, *(ROOT / "docs").rglob("*.md")]
    found.add("docs_words", sum(len(page.read_text().split()) for page in pages))
    found.add("code_lines", figures_of(tracked())["product_code_lines"])
    return found


if __name__ == "__main__":
    parts = {"install": install, "times": times, "words": words}
    run("front_door", __doc__ or "", ("realsim", "open3d-cpu", "pybullet"), FIGURES, parts)
