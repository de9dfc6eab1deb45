"""Benchmark of the Robot School: speed, physics that can be believed, labels that agree.

    uv run python benchmarks/school.py [--quick] [--json FILE] [--seed N] [--part NAME]

Scenes of ten generated objects of 16 to 32 convex parts (six with --quick); seeds from 100 on are
those of the published figures, use lower ones while developing. Parts and the figures they give
(keys of the JSON's "figures"):
  speed       bullet_grasps_per_s, mujoco_grasps_per_s
                      candidates, the arm's reach and four stages, per second of two processes on
                      two cores, counted in CPU seconds
              mujoco_marginal_grasps_per_s, marginal_speed_dropped_share
                      the same at 500 kg/m^3, friction 0.3 and twelve weights carried
  steps       plans_per_s, candidates_per_s, candidates_above_table_per_s
                      of one core: collision-free trajectories; turned hands, those not in the table
  validation  coulomb_worst_pct, torque_worst_pct, box_score, box_slip_mm, box_slip_deg,
              light_convergence_share, suite_checks_failed
                      the worst of both engines; `realsim school validate` tells the rest
  agreement   fast_agree_share
                      held labels at fast and at reference settings, the worst of both engines and
                      both conditions
              engines_agree_share, engines_agree_marginal_share, marginal_dropped_share
                      held labels of PyBullet and MuJoCo
  margins     rank_margin_score, rank_margin_closure, rank_score_closure
                      Spearman's rank correlation of margin, score and Ferrari-Canny quality
  acronym     acronym_balacc
                      our held labels against ACRONYM's (REALSIM_DATA); reported, no goal
  scaling     workers_scaling, ray_nodes_scaling
                      two processes, two Ray nodes, over one; and days for the paper's data set
Shares are 0 to 1. Convex parts are cut once and kept in the folder --keep.
"""

import os

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import argparse
import json
import sys
import time
import traceback
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from figures import Found, document_of, print_table
from school_acronym import acronym
from school_agreement import agreement
from school_cases import KEEP, cut_shapes, library
from school_figures import FIGURES
from school_margins import margins
from school_scaling import extrapolation, scaling
from school_speed import speed
from school_steps import first_steps
from school_validation import validation

from realsim.app.console import Console

PACKAGES = ("realsim", "numpy", "scipy", "numba", "pybullet", "mujoco", "coacd", "ray")
PARTS: dict[str, Callable[[int, Path, bool], Found]] = {
    "speed": speed,
    "steps": first_steps,
    "validation": validation,
    "agreement": agreement,
    "margins": margins,
    "acronym": acronym,
    "scaling": scaling,
}
SEED = 100


def say_objects(console: Console, keep: Path, quick: bool) -> None:
    """Cut the objects, once for all runs, and print into how many convex parts."""
    start = time.perf_counter()
    cut_shapes(keep, quick)
    solids = {m.name: s.parts for m, s in library(keep, quick).values()}
    words = [f"{n} {len(p.parts)} ({p.volume_ratio:.2f})" for n, p in solids.items()]
    console.say(
        f"convex parts (volume over the mesh's): {', '.join(words)}; "
        f"{time.perf_counter() - start:.0f} s"
    )


def arguments_of() -> argparse.Namespace:
    """Return the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--quick", action="store_true", help="every figure from fewer samples")
    parser.add_argument("--seed", type=int, default=SEED, help=f"of scenes and grasps ({SEED})")
    parser.add_argument(
        "--part", action="append", dest="parts", choices=list(PARTS), help="run this one alone"
    )
    parser.add_argument("--keep", type=Path, default=KEEP, help="folder of convex parts")
    arguments = parser.parse_args()
    arguments.parts = arguments.parts or list(PARTS)
    return arguments


def main() -> None:
    """Run the parts, print the table, write the JSON."""
    arguments = arguments_of()
    console = Console()
    begin = time.perf_counter()
    found = Found()
    failures: dict[str, str] = {}
    arguments.keep.mkdir(parents=True, exist_ok=True)
    say_objects(console, arguments.keep, arguments.quick)
    # Scaling counts its own CPU seconds and waits for Ray much of the time: in the short run it
    # goes on beside the parts that measure no speed.
    beside = arguments.quick and len(arguments.parts) > 1
    later: dict[str, Future[Found]] = {}
    with ThreadPoolExecutor(1) as thread:
        for name in arguments.parts:
            start = time.perf_counter()
            if beside and name == "validation" and "scaling" in arguments.parts:
                later["scaling"] = thread.submit(
                    scaling, arguments.seed, arguments.keep, arguments.quick
                )
            try:
                if name in later:
                    found.take(later[name].result())
                else:
                    found.take(PARTS[name](arguments.seed, arguments.keep, arguments.quick))
            except KeyboardInterrupt:
                sys.exit(130)
            except Exception as error:
                failures[name] = f"{type(error).__name__}: {error}"
                print(f"\n{name}:\n{traceback.format_exc()}", file=sys.stderr)
            console.warn(f"{name}: {time.perf_counter() - start:.0f} s")
    found.notes += extrapolation(found.figures)
    seconds = time.perf_counter() - begin
    print_table(console, "Robot School", FIGURES, found)
    for name, why in failures.items():
        console.warn(f"the part {name} failed: {why}")
    console.say(f"{seconds:.0f} s, load {os.getloadavg()[0]:.1f}")
    if arguments.json:
        document = document_of("school", PACKAGES, FIGURES, arguments, found)
        document |= {"wall_s": round(seconds, 1), "failures": failures}
        arguments.json.write_text(json.dumps(document, indent=1, default=str))
    if failures:
        sys.exit(1)


if __name__ == "__main__":
    main()
