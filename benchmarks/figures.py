"""What all benchmarks have in common: the command line, parts, goals, the table and the JSON.

A benchmark is a docstring, its figures with their goals, and parts that measure them:

    FIGURES = {"error_mm": Figure(unit="mm", goal=Goal(high=0.5))}
    PARTS = {"exact": "labels_exact:exactness"}    # imported when it runs; or a function
    if __name__ == "__main__":
        run("labels", __doc__, ("numpy", "realsim"), FIGURES, PARTS)

A part takes the command line (`seed`, `quick`, `parts`, and what the benchmark added) and returns
what it found. A figure that could not be measured is missing there; its key is null in the JSON.
"""

import argparse
import json
import os
import platform
import resource
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from realsim.app.console import Console

# Where Python may not keep what it has compiled, each process that is measured compiles its
# libraries anew, for 4 CPU s: nobody's machine is like that.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
DATA = Path(os.environ.get("REALSIM_DATA", Path(__file__).resolve().parents[2] / "shared/data"))
"""Folder of the real data."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Goal:
    """What a figure should be."""

    low: float = -np.inf
    high: float = np.inf

    def __str__(self) -> str:
        if np.isfinite(self.low) and np.isfinite(self.high):
            return f"{self.low:g}" if self.low == self.high else f"{self.low:g} to {self.high:g}"
        return f">= {self.low:g}" if np.isfinite(self.low) else f"<= {self.high:g}"

    def met(self, value: float) -> bool:
        """Return whether a figure is as good as it should be."""
        return bool(self.low <= value <= self.high)


@dataclass(frozen=True, kw_only=True, slots=True)
class Figure:
    """A figure and what it should be."""

    unit: str
    goal: Goal = field(default_factory=Goal)
    rival: str = ""
    """A published value."""


@dataclass(eq=False, kw_only=True, slots=True)
class Found:
    """What a part measured."""

    figures: dict[str, float] = field(default_factory=dict[str, float])
    over: dict[str, str] = field(default_factory=dict[str, str])
    """What a figure was taken over, and its interval."""
    rivals: dict[str, str] = field(default_factory=dict[str, str])
    """What another way gave in the same run, by the figure's key."""
    notes: list[str] = field(default_factory=list[str])
    """Sentences for a person."""
    cases: dict[str, object] = field(default_factory=dict[str, object])
    """What is kept in the JSON besides: plain values."""

    def real_data(self, part: str, under: str) -> Path | None:
        """Return a folder of the real data, or None with a note that the part is not run."""
        if (DATA / under).is_dir():
            return DATA / under
        self.notes.append(f"{part}: not run; set REALSIM_DATA to the folder that holds {under}")
        return None

    def add(self, key: str, value: float, over: str = "") -> None:
        """Note a figure."""
        self.figures[key] = value
        if over:
            self.over[key] = over

    def take(self, other: "Found") -> None:
        """Put what another part measured to it."""
        self.figures |= other.figures
        self.over |= other.over
        self.rivals |= other.rivals
        self.notes += other.notes
        self.cases |= other.cases


def print_table(console: Console, title: str, figures: Mapping[str, Figure], found: Found) -> None:
    """Print every figure beside its goal and its rival, then what else is to be said."""
    rows: list[list[str]] = []
    for key in _keys(figures, found):
        if key not in found.figures:
            continue
        figure, value = figures.get(key), found.figures[key]
        bounded = figure is not None and "inf" not in str(figure.goal)
        verdict = ""
        if figure is not None and bounded:
            verdict = "ok" if figure.goal.met(value) else "FELL SHORT"
        rivals = [figure.rival if figure else "", found.rivals.get(key, "")]
        rows.append([
            key, f"{value:.4g}", figure.unit if figure else "",
            str(figure.goal) if figure and bounded else "", verdict,
            "; ".join(r for r in rivals if r),
        ])  # fmt: skip
    console.table(title, ["figure", "value", "unit", "goal", "", "rival"], rows)
    for key, words in found.over.items():
        console.say(f"{key}: {words}")
    for note in found.notes:
        console.say(note)


def document_of(
    name: str,
    packages: Sequence[str],
    figures: Mapping[str, Figure],
    arguments: argparse.Namespace,
    found: Found,
) -> dict[str, Any]:
    """Return what is written as JSON; a figure that was not measured is null.

    Args:
        name: of the benchmark.
        packages: whose versions are written.
        figures: all keys; in every run they are in the JSON.
        arguments: with `seed`, `parts` and `quick`.
        found: what was measured.
    """
    values = {k: found.figures.get(k, float("nan")) for k in _keys(figures, found)}
    return {
        "benchmark": name,
        "machine": {
            "cpu": platform.machine(), "cores": len(os.sched_getaffinity(0)),
            "load": os.getloadavg()[0],
        },
        "versions": {package: _version(package) for package in packages}, "seed": arguments.seed,
        "parts": arguments.parts, "quick": arguments.quick,
        "figures": {k: float(v) if np.isfinite(v) else None for k, v in values.items()},
        "goals": {k: str(f.goal) for k, f in figures.items()}, "over": found.over,
        "rivals": found.rivals, "notes": found.notes, "cases": found.cases,
    }  # fmt: skip


def children_cpu_s() -> float:
    """Return the CPU time of this process's children that have ended [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def median_of(values: Sequence[float]) -> float:
    """Return the median; NaN of nothing."""
    return float(np.median(values)) if len(values) else float("nan")


def share_of(hits: Sequence[bool]) -> float:
    """Return the share that is true; NaN of nothing."""
    return float(np.mean(hits)) if len(hits) else float("nan")


def _keys(figures: Mapping[str, Figure], found: Found) -> list[str]:
    return [*figures, *(k for k in found.figures if k not in figures)]


def _version(name: str) -> str | None:
    """Return a package's version; None = it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def run(
    name: str,
    text: str,
    packages: Sequence[str],
    figures: Mapping[str, Figure],
    parts: Mapping[str, "str | Callable[[argparse.Namespace], Found]"],
    *,
    seed: int = 0,
    options: Callable[[argparse.ArgumentParser], object] | None = None,
    end: Callable[[Found], object] | None = None,
) -> None:
    """Run a benchmark from its command line: parts, table, JSON; exit with 1 if a part failed.

    Args:
        name: of the benchmark, in the JSON.
        text: its docstring, which is the help; the first line is the table's title.
        packages: whose versions are written.
        figures: what it measures; all of these keys are in the JSON of every run.
        parts: what measures them: a function of the command line, or "module:function". One that
            stands for several parts is called once for all of them.
        seed: used where the command line gives none.
        options: adds options of its own to the command line.
        end: adds what follows from all parts.
    """
    arguments = _arguments_of(text, parts, seed, options)
    console, begin, found = Console(), time.perf_counter(), Found()
    failures: dict[str, str] = {}
    for what in dict.fromkeys(parts[part] for part in arguments.parts):
        part = ", ".join(p for p in arguments.parts if parts[p] == what)
        start = time.perf_counter()
        try:
            found.take(_part(what)(arguments))
        except KeyboardInterrupt:
            sys.exit(130)
        except Exception as error:
            failures[part] = f"{type(error).__name__}: {error}"
            print(f"\n{part}:\n{traceback.format_exc()}", file=sys.stderr)
        console.warn(f"{part}: {time.perf_counter() - start:.0f} s")
    if end is not None:
        end(found)
    seconds = time.perf_counter() - begin
    print_table(console, text.splitlines()[0].rstrip("."), figures, found)
    for part, why in failures.items():
        console.warn(f"the part {part} failed: {why}")
    console.say(f"{seconds:.0f} s, load {os.getloadavg()[0]:.1f}")
    if arguments.json:
        document = document_of(name, packages, figures, arguments, found)
        document |= {"wall_s": round(seconds, 1), "failures": failures}
        arguments.json.write_text(json.dumps(document, indent=1, default=str))
    if failures:
        sys.exit(1)


def _arguments_of(
    text: str,
    parts: Mapping[str, Any],
    seed: int,
    options: Callable[[argparse.ArgumentParser], object] | None,
) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=text, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--quick", action="store_true", help="every figure from fewer samples")
    parser.add_argument("--seed", type=int, default=seed, help=f"of what is random ({seed})")
    parser.add_argument(
        "--part", action="append", dest="parts", choices=list(parts), help="run this one alone"
    )
    if options is not None:
        options(parser)
    arguments = parser.parse_args()
    arguments.parts = arguments.parts or list(parts)
    return arguments


def _part(what: "str | Callable[[argparse.Namespace], Found]") -> Callable[..., Found]:
    if callable(what):
        return what
    module, function = what.split(":")
    return getattr(import_module(module), function)
