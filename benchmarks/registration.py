"""Benchmark of registration: the pose of every object in every view, in a simulated lab.

    uv run python benchmarks/registration.py [--quick] [--json FILE] [--seeds 100,101] [--parts ...]

14 of 30 objects in clutter; hand-eye off by 0.5 mm / 0.1 deg, every robot pose by 0.2 mm / 0.03
deg. Errors are MSSD over all symmetries, continuous ones aligned exactly; medians over objects.
Parts and the figures they give (keys of the JSON's "figures"):
  rough, cold, unknown, piles (32 views)
      rough_share_under_3mm   from starts off by 30 mm and 20 deg
      cold_share_under_3mm    from nothing, ids given
      unknown_share_under_3mm, false_object_share
                              from nothing, all 30 models compete; found where it is not / found
      pile_share_under_3mm    from nothing, ids given, a heap dropped by a physics engine
  refined, biased (256 views, from nothing)
      mssd_mm_256, mssd_p90_mm_256, camera_mm_after, camera_deg_after
      reproj_px_before/_after, reproj_p90_px_after
                              model points in the image, claimed cameras and the search's poses /
                              after; in pixels of a 1280 px wide image
      biased_mssd_mm, biased_reproj_px
                              with a disparity bias of 0.02 px that nobody calibrated
  rival
      ratio_mssd_vs_topdown, ratio_adds_vs_topdown
                              best variant of ICP in one top-down view (from 5 mm / 5 deg; with
                              '_rough' from the rough starts) / ours at 256 views
  flags
      wrong_flagged_share     wrong poses, registered or provoked, that are not 'accepted'
      false_alarm_share       right ones that are not 'accepted'
  cost
      total_cpu_s, peak_mb    15 objects, 256 views of 1280x720 read from PNG, from nothing to the
                              verdict, in a fresh process, numba compiled before
      mesh_cache_cpu_s        of each mesh, once
  real
      real_*                  YCB-Video frames: see `registration_real.py`
      apc_step_mm, apc_step_deg
                              a robot's scan of a shelf without any model: ICP between neighbouring
                              views after refinement
Shares are 0 to 1. Seeds from 100 on are those of the published figures; use lower ones while
developing.
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
from registration_figures import GOALS, Row, figures_of, per_part
from registration_jobs import jobs_of, results

from realsim.app.console import Console

PACKAGES = ("numpy", "scipy", "numba", "open3d-cpu", "opencv-python-headless", "pybullet")
PARTS = ("rough", "cold", "unknown", "piles", "refined", "biased", "rival", "flags", "cost", "real")
SEEDS = tuple(range(100, 108))
MANY_SCENES = 4
"""Scenes of 256 views: the first seeds."""


def print_tables(
    console: Console, rows: Sequence[Row], figures: dict[str, float], over: dict[str, str]
) -> None:
    """Print the scenes, the failures, and every figure beside its goal."""
    header = ["part", "seed", "objects", "right", "median mm", "p90 mm", "not right"]
    console.table(
        "Scenes: what is not right (! = flagged), in brackets right but not accepted",
        header,
        per_part(rows),
    )
    for failure in dict.fromkeys(
        f"{r.part}, seed {r.seed}: {r.failure}" for r in rows if r.failure
    ):
        console.warn(failure)
    order = [k for k in GOALS if k in figures] + [k for k in figures if k not in GOALS]
    table: list[list[str]] = []
    for key in order:
        goal = GOALS.get(key)
        value = figures[key]
        bounded = goal is not None and str(goal) != ">= -inf" and "inf" not in str(goal)
        verdict = "" if not bounded or goal is None else "ok" if goal.met(value) else "FELL SHORT"
        if not np.isfinite(value):
            if goal is None:
                continue
            verdict = "not run"
        wish = str(goal) if bounded else ""
        table.append([key, f"{value:.4g}", wish, verdict, over.get(key, "")])
    console.table("Registration", ["figure", "value", "goal", "", "over"], table)


def document_of(
    arguments: argparse.Namespace,
    rows: Sequence[Row],
    figures: dict[str, float],
    notes: Sequence[str],
    seconds: float,
) -> dict[str, Any]:
    """Return what is written; a figure that is not finite is null."""
    return {
        "benchmark": "registration",
        "machine": {"cpu": platform.machine(), "cores": os.cpu_count()},
        "versions": {name: version(name) for name in PACKAGES},
        "seeds": arguments.seeds,
        "many_scenes": arguments.many,
        "parts": arguments.parts,
        "quick": arguments.quick,
        "wall_s": round(seconds, 1),
        "figures": {k: v if np.isfinite(v) else None for k, v in figures.items()},
        "goals": {k: str(goal) for k, goal in GOALS.items()},
        "notes": list(notes),
        "cases": [r.plain() for r in rows],
    }


def arguments_of() -> argparse.Namespace:
    """Return the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    numbers: Callable[[str], list[int]] = lambda text: [int(v) for v in text.split(",")]  # noqa: E731
    words: Callable[[str], list[str]] = lambda text: text.split(",")  # noqa: E731
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--quick", action="store_true", help="one scene, few objects and views")
    parser.add_argument("--seeds", type=numbers, help="100,...,107 (quick: 1)")
    parser.add_argument("--many", type=int, default=MANY_SCENES, help="scenes of 256 views")
    parser.add_argument("--parts", type=words, help=f"of {','.join(PARTS)}")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--keep", type=Path, help="folder of images and fields, kept between runs")
    arguments = parser.parse_args()
    arguments.seeds = arguments.seeds or ([1] if arguments.quick else list(SEEDS))
    arguments.parts = arguments.parts or (
        ["cold", "refined", "rival"] if arguments.quick else list(PARTS)
    )
    unknown = [n for n in arguments.parts if n not in PARTS]
    if unknown:
        parser.error(f"there is no {', '.join(unknown)}; there are: {', '.join(PARTS)}")
    return arguments


def main() -> None:
    """Run the jobs, print the tables, write the JSON."""
    arguments = arguments_of()
    console = Console()
    begin = time.perf_counter()
    rows: list[Row] = []
    samples: dict[str, list[float]] = {}
    complete: dict[str, float] = {}
    notes: list[str] = []
    jobs = jobs_of(
        arguments.seeds, arguments.parts, arguments.many, arguments.keep, arguments.quick
    )
    try:
        with console.stage("scenes", f"{len(jobs)} jobs") as tick:
            for count, (_, every) in enumerate(results(jobs, arguments.jobs), 1):
                for done in every:
                    rows += done.rows
                    complete |= dict(done.figures)
                    notes += done.notes
                    for key, values in done.samples.items():
                        samples.setdefault(key, []).extend(values)
                tick(count, len(jobs))
    except KeyboardInterrupt:
        sys.exit(130)
    order = list(dict.fromkeys(r.part for r in rows))
    rows.sort(key=lambda r: (order.index(r.part), r.seed))
    figures, over = figures_of(rows, samples)
    figures |= {k: float(np.mean(v)) for k, v in samples.items() if k.startswith("cpu_s_")}
    figures |= complete
    seconds = time.perf_counter() - begin
    print_tables(console, rows, figures, over)
    for note in notes:
        console.say(note)
    console.say(f"{seconds:.0f} s")
    if arguments.json:
        document = document_of(arguments, rows, figures, notes, seconds)
        arguments.json.write_text(json.dumps(document, indent=1, default=str))


if __name__ == "__main__":
    main()
