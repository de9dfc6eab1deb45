"""Compare benchmark results, keep them, and write them down as a page.

    uv run python benchmarks/compare.py BEFORE AFTER        # files, or folders of NAME.json
    uv run python benchmarks/compare.py --keep NAME.json RUN.json [RUN.json ...]
    uv run python benchmarks/compare.py --page              # docs/measured.md from measured/

The first prints every figure that moved by more than its noise and exits with 1 if one is worse or
missing. A figure's noise is the spread over the runs that were kept together (other seeds, other
moments); of a single run it is a share: times and rates on a shared machine 25 %, others 10 %.
Which way is worse, the figure's goal says; a figure without a goal only moves.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

HERE = Path(__file__).resolve().parent
MEASURED = HERE / "measured"
PAGE = HERE.parent / "docs" / "measured.md"
TIME_NOISE, NOISE = 0.25, 0.10
TIMED = ("cpu_s", "_ms", "per_s", "_mb", "_over_", "ratio", "wall")
"""Parts of the names of figures that a busy machine moves."""
TOOLS = ("_closed_", "open3d", "rival", "poisson", "default_world")
"""Parts of the names of figures that other tools reach."""
Document = dict[str, Any]


def load(path: Path) -> dict[str, Document]:
    """Return the documents of a file, or of a folder's files, by the benchmark's name.

    Raises:
        SystemExit: nothing is there, or it is no benchmark's result.
    """
    files = sorted(path.glob("*.json")) if path.is_dir() else [path]
    found: dict[str, Document] = {}
    for file in files:
        if not file.is_file():
            sys.exit(f"'{file}' is not there: name a benchmark's JSON or a folder of them.")
        document = json.loads(file.read_text())
        if not isinstance(document, dict) or "figures" not in document:
            sys.exit(f"'{file}' is no benchmark's result: it has no 'figures'.")
        found[document.get("benchmark", file.stem)] = document
    if not found:
        sys.exit(f"'{path}' holds no results: *.json is looked for.")
    return found


def merge(documents: Sequence[Document]) -> Document:
    """Return one document of several runs: median figures, and their spread as noise."""
    runs = [d["figures"] for d in documents]
    keys = list(dict.fromkeys(key for run in runs for key in run))
    values = {k: [r[k] for r in runs if r.get(k) is not None] for k in keys}
    same = ("benchmark", "machine", "versions", "quick", "goals")
    kept: Document = {key: documents[-1].get(key) for key in same}
    kept["over"] = {key: what for d in documents for key, what in (d.get("over") or {}).items()}
    kept["seeds"] = list(dict.fromkeys(d.get("seed") for d in documents))  # parts share theirs
    kept["figures"] = {k: median(v) if v else None for k, v in values.items()}
    kept["noise"] = {k: max(v) - min(v) for k, v in values.items() if len(v) > 1}
    return kept


def noise_of(key: str, before: Document) -> float:
    """Return by how much a figure may move without a cause."""
    value = abs(before["figures"][key])
    share = TIME_NOISE if any(part in key for part in TIMED) else NOISE
    return max(before.get("noise", {}).get(key, 0.0), share * value, 1e-12)


def is_worse(goal: str, before: float, after: float) -> bool | None:
    """Return whether a figure moved away from its goal; None if nobody said which way that is."""
    if goal.startswith("<="):
        return after > before
    if goal.startswith(">="):
        return after < before
    if not goal or "inf" in goal:
        return None
    low, _, high = goal.partition(" to ")
    return not float(low) <= after <= float(high or low)


def compare(before: dict[str, Document], after: dict[str, Document]) -> tuple[list[list[str]], int]:
    """Return a row for each figure that moved, and how many are worse or missing."""
    rows: list[list[str]] = []
    worse = 0
    for name, old in before.items():
        figures = after.get(name, {"figures": {}})["figures"]
        for key, value in old["figures"].items():
            now = figures.get(key)
            if value is None or (now is not None and abs(now - value) <= noise_of(key, old)):
                continue
            goal = (old.get("goals") or {}).get(key, "")
            bad = True if now is None else is_worse(goal, value, now)
            worse += bool(bad)
            word = {True: "WORSE", False: "better", None: "moved"}[bad]
            shown = "missing" if now is None else f"{now:.4g}"
            rows.append([name, key, f"{value:.4g}", shown, word])
    return rows, worse


def page_of(documents: dict[str, Document]) -> str:
    """Return the page of what was measured last: figures with a goal as tables, others as lists."""
    lines = [
        "# Measured", "",
        "Written by `benchmarks/compare.py --page` from `benchmarks/measured/`; do not edit it.",
        "Runs are full and have 2 cores unless it is said. Goals are those of full runs; quick "
        "ones take fewer samples. A value behind +- is the spread over runs.", "",
    ]  # fmt: skip
    for name, document in documents.items():
        machine, goals = document.get("machine") or {}, document.get("goals") or {}
        seeds = ", ".join(map(str, document.get("seeds") or [document.get("seed")]))
        unusual = ", quick" * bool(document.get("quick"))
        unusual += f", {machine.get('cores', '?')} cores" * (machine.get("cores") != 2)
        lines += [f"## {name}", "", f"seeds {seeds}{unusual}", ""]
        figures, noise = document["figures"].items(), document.get("noise", {}).items()
        said = {k: "not measured" if v is None else f"{v:.4g}" for k, v in figures}
        said |= {k: f"{said[k]} +- {v:.2g}" for k, v in noise}
        asked = [key for key in said if "inf" not in goals.get(key, "inf")]
        lines += ["figure | measured | goal", "---|---|---"]
        rows = [f"{key} | {said[key]} | {goals[key]}" for key in asked]
        lines += [r.replace(">= ", "\u2265").replace("<= ", "\u2264") for r in rows]
        tools = ", ".join(f"{k} {said[k]}" for k in said if any(word in k for word in TOOLS))
        lines += ["", f"Other tools: {tools}." if tools else "", ""]
    return "\n".join(lines)


def main() -> None:
    """Compare, keep, or write the page."""
    parser = argparse.ArgumentParser(description="Compare and keep benchmark results.")
    parser.add_argument("results", nargs="*", type=Path, help="BEFORE AFTER, or runs to keep")
    parser.add_argument("--keep", type=Path, help="merge runs into this file")
    parser.add_argument("--page", action="store_true", help="write docs/measured.md")
    given = parser.parse_args()
    if given.page:
        PAGE.write_text(page_of(load(MEASURED)))
    elif given.keep and given.results:
        merged = merge([d for path in given.results for d in load(path).values()])
        given.keep.write_text(json.dumps(merged, indent=1) + "\n")
    elif len(given.results) == 2:
        rows, worse = compare(*(load(path) for path in given.results))
        for row in [["benchmark", "figure", "before", "after", ""], *rows]:
            print("{:24} {:36} {:>12} {:>12} {}".format(*row))
        print(f"{len(rows)} moved by more than their noise, {worse} are worse or missing")
        sys.exit(1 if worse else 0)
    else:
        parser.error("give BEFORE and AFTER, or --keep FILE and the runs to merge, or --page")


if __name__ == "__main__":
    main()
