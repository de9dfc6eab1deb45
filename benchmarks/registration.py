"""Benchmark of registration: the pose of every object in every view, in a simulated lab.

    uv run python benchmarks/registration.py [--quick] [--json FILE] [--seed 100] [--part NAME]

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
Shares are 0 to 1. Eight scenes from the seed on; seeds from 100 are those of the published figures,
use lower ones while developing.
"""

import argparse
from pathlib import Path

import blas_threads  # noqa: F401
import numpy as np
from figures import Figure, Found, run
from registration_figures import GOALS, Row, figures_of, per_part
from registration_jobs import jobs_of, results

from realsim.app.console import Console

PACKAGES = ("numpy", "scipy", "numba", "open3d-cpu", "opencv-python-headless", "pybullet")
PARTS = ("rough", "cold", "unknown", "piles", "refined", "biased", "rival", "flags", "cost", "real")
QUICK_PARTS = ("cold", "refined", "rival")
SCENES, MANY_SCENES = 8, 4
"""Scenes; those of 256 views are the first seeds."""
HEADER = ["part", "seed", "objects", "right", "median mm", "p90 mm", "not right"]


def measure(given: argparse.Namespace) -> Found:
    """Measure all parts: a scene is made once for those that look at it."""
    console, found, rows = Console(), Found(), list[Row]()
    samples: dict[str, list[float]] = {}
    complete: dict[str, float] = {}
    if given.quick:
        given.parts = [part for part in QUICK_PARTS if part in given.parts] or given.parts
    seeds = range(given.seed, given.seed + (1 if given.quick else given.scenes))
    jobs = jobs_of(seeds, given.parts, given.many, given.keep, given.quick)
    with console.stage("scenes", f"{len(jobs)} jobs") as tick:
        # Each process compiles: one does for a quick run.
        for count, (_, every) in enumerate(results(jobs, 1 if given.quick else given.jobs), 1):
            for done in every:
                rows += done.rows
                complete |= dict(done.figures)
                found.notes += done.notes
                for key, values in done.samples.items():
                    samples.setdefault(key, []).extend(values)
            tick(count, len(jobs))
    order = list(dict.fromkeys(r.part for r in rows))
    rows.sort(key=lambda r: (order.index(r.part), r.seed))
    console.table(
        "Scenes: what is not right (! = flagged), in brackets right but not accepted",
        HEADER, per_part(rows),
    )  # fmt: skip
    found.notes += dict.fromkeys(f"{r.part}, seed {r.seed}: {r.failure}" for r in rows if r.failure)
    figures, found.over = figures_of(rows, samples)
    figures |= {k: float(np.mean(v)) for k, v in samples.items() if k.startswith("cpu_s_")}
    found.figures = {k: v for k, v in (figures | complete).items() if np.isfinite(v)}
    found.cases["rows"] = [r.plain() for r in rows]
    return found


def options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--scenes", type=int, default=SCENES, help="scenes (quick: 1)")
    parser.add_argument("--many", type=int, default=MANY_SCENES, help="scenes of 256 views")
    parser.add_argument("--jobs", type=int, default=2, help="processes (quick: 1)")
    parser.add_argument("--keep", type=Path, help="folder of images and fields, kept between runs")


if __name__ == "__main__":
    figures = {key: Figure(unit="", goal=goal) for key, goal in GOALS.items()}
    parts = dict.fromkeys(PARTS, measure)
    run(
        "registration", __doc__ or "", PACKAGES, figures, parts,
        seed=100, options=options,
    )  # fmt: skip
