"""Benchmark of metric scale: 30 objects of unknown scale from 24 depth views of a simulated lab.

    uv run python benchmarks/scale.py [--quick] [--json FILE] [--seeds 0,1,2] [--only NAMES]

The lab's hand-eye is off by 0.5 mm and 0.1 deg, every robot pose by 0.2 mm and 0.03 deg; the mesh
is in unknown units (factor 0.3 to 3) and other axes. Figures (keys of the JSON's "figures"):
  scale_median_pct_exact, within1pct_exact, within2pct_exact, worst_pct_exact
                      from a rough start (10 mm, 10 deg, x0.87 or x1.15), the exact mesh
  scale_median_pct_distorted, within2pct_distorted, worst_pct
                      the same with a mesh that has a shape error of 2 % of its size
  cold_median_pct, cold_within2pct
                      from no start at all, distorted
  cold_flagged_share  of the cold results wrong by more than 5 %: those not 'accepted'
  false_alarm_share   of the cold results right within 5 %: those not 'accepted'
  cpu_s_per_object    median of one fit from a rough start, preparation of the mesh included
  interval_coverage   share of 95 % intervals that hold the truth: exact, distorted, accepted cold
  open3d_fused_median_pct, open3d_topdown_median_pct
                      Open3D's ICP with scaling, exact mesh, same start and images
  sfm_scale_pct, tsdf_median_mm
                      of `scale_sfm.py` and `scale_fusion.py`
Shares are 0 to 1. What crashes counts as an error of 1000 % and is named.
"""

import os

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import argparse
import json
import platform
import sys
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from scale_cases import FULL_WIDTH
from scale_figures import GOALS, KINDS, Row, figures_of, per_object
from scale_jobs import OTHERS, Job, results
from scale_shapes import SHAPES

from realsim.app.console import Console

PACKAGES = ("numpy", "scipy", "numba", "open3d-cpu", "opencv-python-headless", "pycolmap")
QUICK_NAMES = ("bunny", "disc")
QUICK_WIDTH = 640
"""Images of a quick run [px]: a quarter of the pixels, twice the depth noise."""


def print_tables(
    console: Console, rows: Sequence[Row], figures: dict[str, float], over: dict[str, str]
) -> None:
    """Print the objects, the failures, and every figure beside its goal."""
    names = [n for n in SHAPES if any(r.name == n for r in rows)]
    header = ["object", *KINDS, "Open3D fused", "Open3D top", "CPU-s"]
    title = "Scale error [%] ± 1-sigma of every seed; ! = not accepted"
    console.table(title, header, per_object(rows, names))
    for row in rows:
        if row.failure:
            console.warn(f"{row.name}, seed {row.seed}, {row.kind} failed: {row.failure}")
    order = [k for k in GOALS if k in figures] + [k for k in figures if k not in GOALS]
    table: list[list[str]] = []
    for key in order:
        goal = GOALS.get(key)
        verdict = "" if goal is None else "ok" if goal.met(figures[key]) else "FELL SHORT"
        if not np.isfinite(figures[key]):
            verdict = "not run"
        table.append([key, f"{figures[key]:.4g}", str(goal or ""), verdict, over.get(key, "")])
    console.table("Metric scale", ["figure", "value", "goal", "", "over"], table)


def document_of(
    arguments: argparse.Namespace, rows: Sequence[Row], figures: dict[str, float], seconds: float
) -> dict[str, Any]:
    """Return what is written; a figure that is not finite is null."""
    return {
        "benchmark": "scale",
        "machine": {"cpu": platform.machine(), "cores": os.cpu_count()},
        "versions": {name: version(name) for name in PACKAGES},
        "seed": arguments.seeds,
        "quick": arguments.quick,
        "width_px": arguments.width,
        "wall_s": round(seconds, 1),
        "figures": {k: v if np.isfinite(v) else None for k, v in figures.items()},
        "goals": {k: str(goal) for k, goal in GOALS.items()},
        "cases": [r.plain() for r in rows],
    }


def arguments_of() -> argparse.Namespace:
    """Return the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    numbers: Callable[[str], list[int]] = lambda text: [int(v) for v in text.split(",")]  # noqa: E731
    words: Callable[[str], list[str]] = lambda text: text.split(",")  # noqa: E731
    parts = ",".join([*KINDS, "rival", *OTHERS])
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--quick", action="store_true", help="few objects, one seed, small images")
    parser.add_argument("--seeds", type=numbers, help="0,1,2 (quick: 0)")
    parser.add_argument("--only", type=words, help=f"objects: {', '.join(SHAPES)}")
    parser.add_argument("--parts", type=words, default=words(parts), help=f"of {parts}")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--width", type=int, help=f"of the images [px] ({FULL_WIDTH})")
    parser.add_argument("--keep", type=Path, help="folder where rendered images are kept and found")
    arguments = parser.parse_args()
    arguments.seeds = arguments.seeds or ([0] if arguments.quick else [0, 1, 2])
    arguments.width = arguments.width or (QUICK_WIDTH if arguments.quick else FULL_WIDTH)
    arguments.only = arguments.only or list(QUICK_NAMES if arguments.quick else SHAPES)
    for given, known in ((arguments.only, list(SHAPES)), (arguments.parts, parts.split(","))):
        unknown = [n for n in given if n not in known]
        if unknown:
            parser.error(f"there is no {', '.join(unknown)}; there are: {', '.join(known)}")
    return arguments


def jobs_of(arguments: argparse.Namespace) -> list[Job]:
    """Return what is to be done, the longest first."""
    parts = tuple(p for p in arguments.parts if p not in OTHERS)
    others = [p for p in OTHERS if p in arguments.parts]
    settings: dict[str, Any] = {
        "width": arguments.width, "keep": arguments.keep, "quick": arguments.quick
    }  # fmt: skip
    cases = [Job(name=n, seed=s, parts=parts, **settings)
             for s in arguments.seeds for n in arguments.only]  # fmt: skip
    return [Job(name=n, seed=0, parts=(), **settings) for n in others] + (cases if parts else [])


def main() -> None:
    """Run the jobs, print the tables, write the JSON."""
    arguments = arguments_of()
    console = Console()
    begin = time.perf_counter()
    rows: list[Row] = []
    others: dict[str, float] = {}
    jobs = jobs_of(arguments)
    try:
        with console.stage("objects", f"{len(jobs)} jobs") as tick:
            for count, done in enumerate(results(jobs, arguments.jobs), 1):
                rows += done.rows
                others |= dict(done.figures)
                tick(count, len(jobs))
    except KeyboardInterrupt:
        sys.exit(130)
    order = list(SHAPES)
    rows.sort(key=lambda r: (order.index(r.name) if r.name in order else -1, r.seed))
    figures, over = figures_of(rows)
    figures |= others
    seconds = time.perf_counter() - begin
    print_tables(console, rows, figures, over)
    console.say(f"{seconds:.0f} s")
    if arguments.json:
        text = json.dumps(document_of(arguments, rows, figures, seconds), indent=1, default=str)
        arguments.json.write_text(text)


if __name__ == "__main__":
    main()
