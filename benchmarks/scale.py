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
Shares are 0 to 1. What raises counts as an error of 1000 % and is named.
"""

import argparse
import multiprocessing
import sys
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache

import blas_threads  # noqa: F401
from figures import Found, run
from scale_cases import FULL_WIDTH, Case, make_case
from scale_figures import FIGURES, KINDS, Kind, Row, figures_of, told
from scale_rivals import rival_errors
from scale_shapes import SHAPES

PACKAGES = ("numpy", "scipy", "numba", "open3d-cpu", "opencv-python-headless", "pycolmap")
QUICK_NAMES = ("bunny", "disc")
QUICK_WIDTH = 640
"""Images of a quick run [px]: a quarter of the pixels, twice the depth noise."""
WARM_UP_WIDTH = 320
"""Images of the fit that only makes numba compile [px]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Job:
    """One object, one seed."""

    name: str
    seed: int
    width: int


def fit_row(case: Case, kind: Kind) -> Row:
    """Return one fit."""
    from realsim.scanning.scale.fit import fit_scale

    mesh = case.given_exact if kind == "exact" else case.given_distorted
    start = {"exact": case.start_exact, "distorted": case.start_distorted, "cold": None}[kind]
    began = time.process_time()
    fit = fit_scale(mesh, case.views.intrinsics, case.views.frames, start=start)
    return Row(
        name=case.name, seed=case.seed, kind=kind,
        error_pct=100 * (fit.scale / case.true_scale - 1), sigma_pct=fit.sigma_percent,
        verdict=fit.verdict, cpu_s=time.process_time() - began,
        said={"reasons": list(fit.reasons), "notes": list(fit.notes),
              "limits": {limit.name: limit.percent for limit in fit.limits}},
    )  # fmt: skip


def rival_rows(case: Case) -> list[Row]:
    """Return the rival's results on a case."""
    began = time.process_time()
    errors = rival_errors(case)
    each = (time.process_time() - began) / len(errors)
    return [
        Row(name=case.name, seed=case.seed, kind=f"open3d {key}", error_pct=error, cpu_s=each,
            verdict="none")
        for key, error in errors.items()
    ]  # fmt: skip


def _tried(job: Job, kinds: list[str], work: Callable[[], list[Row]]) -> list[Row]:
    """Return what the work gives; the failure of all these kinds, named, if it raises."""
    try:
        return work()
    except Exception as error:
        print(f"\n{job.name} {job.seed} {kinds}:\n{traceback.format_exc()}", file=sys.stderr)
        text = f"{type(error).__name__}: {error}"
        return [Row(name=job.name, seed=job.seed, kind=kind, failure=text) for kind in kinds]


@cache
def warm_up() -> None:
    """Load what numba compiles, so that no object pays for it."""
    case = make_case("cube", 0, WARM_UP_WIDTH)
    for kind in ("exact", "cold"):
        fit_row(case, kind)


def run_job(job: Job) -> list[Row]:
    """Do a job in a process of its own."""
    warm_up()
    rivals = [f"open3d {v}_{k}" for v in ("fused", "topdown") for k in KINDS[:2]]
    made: list[Case] = []

    def case() -> Case:
        if not made:
            made.append(make_case(job.name, job.seed, job.width))
        return made[0]

    rows: list[Row] = []
    for kind in KINDS:
        rows += _tried(job, [kind], lambda kind=kind: [fit_row(case(), kind)])
    return rows + _tried(job, rivals, lambda: rival_rows(case()))


def fits(arguments: argparse.Namespace) -> Found:
    """Return the figures of all objects; fresh processes: OpenCV's threads survive no fork."""
    names = arguments.only or list(QUICK_NAMES if arguments.quick else SHAPES)
    seeds = arguments.seeds or ([0] if arguments.quick else [0, 1, 2])
    width = arguments.width or (QUICK_WIDTH if arguments.quick else FULL_WIDTH)
    jobs = [Job(name=n, seed=s, width=width) for s in seeds for n in names]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(arguments.jobs, mp_context=context) as pool:
        rows = [row for rows in pool.map(run_job, jobs) for row in rows]
    figures, over = figures_of(rows)
    return Found(
        figures=figures, over=over, notes=told(rows), cases={"rows": [r.plain() for r in rows]}
    )


def options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    names = ", ".join(SHAPES)
    numbers: Callable[[str], list[int]] = lambda text: [int(v) for v in text.split(",")]  # noqa: E731
    parser.add_argument("--seeds", type=numbers, help="0,1,2 (quick: 0)")
    parser.add_argument("--only", type=lambda text: text.split(","), help=f"objects: {names}")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--width", type=int, help=f"of the images [px] ({FULL_WIDTH})")


PARTS = {"fits": fits, "tsdf": "scale_fusion:measured", "sfm": "scale_sfm:measured"}

if __name__ == "__main__":
    run("scale", __doc__, PACKAGES, FIGURES, PARTS, options=options)
