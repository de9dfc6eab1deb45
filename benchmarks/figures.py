"""Figures of a benchmark: what they should be, what was measured, the table and the JSON.

Imported by the benchmarks. A figure that could not be measured is missing from what its part found;
its key is null in the JSON.
"""

import argparse
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
from calibration_goals import Goal

from realsim.app.console import Console


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
            "cpu": platform.machine(),
            "cores": len(os.sched_getaffinity(0)),
            "load": os.getloadavg()[0],
        },
        "versions": {package: _version(package) for package in packages},
        "seed": arguments.seed,
        "parts": arguments.parts,
        "quick": arguments.quick,
        "figures": {k: float(v) if np.isfinite(v) else None for k, v in values.items()},
        "goals": {k: str(f.goal) for k, f in figures.items()},
        "over": found.over,
        "rivals": found.rivals,
        "notes": found.notes,
        "cases": found.cases,
    }


def _keys(figures: Mapping[str, Figure], found: Found) -> list[str]:
    return [*figures, *(k for k in found.figures if k not in figures)]


def _version(name: str) -> str | None:
    """Return a package's version; None = it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None
