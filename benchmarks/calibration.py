"""Benchmark of the calibration stage: real sets held out, simulation, faults, corners.

    uv run python benchmarks/calibration.py [--quick] [--json FILE] [--data DIR] [--only PART ...]

Parts: real (5-fold held-out reprojection on three open sets, against OpenCV's seven closed forms,
and the same with two poses swapped), koch (a pose-only set, left out one by one), time, crb and
coverage (simulation with truth), faults, corners. Every figure stands beside its goal; the number
of trials behind it is printed, and --quick takes few.
"""

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import argparse
import json
import multiprocessing
import platform
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from calibration_faults import faults_named_share
from calibration_goals import FULL, GOALS, QUICK, Size
from calibration_real import (
    FOLDS,
    SOURCES,
    Fold,
    FoldResult,
    ImageSet,
    PoseSet,
    Referee,
    detect,
    image_set,
    image_tasks,
    left_out_mm,
    px_by_seed,
    read_koch,
    run_fold,
)
from calibration_simulated import KINDS as ROBOTS
from calibration_simulated import Kind as Robot
from calibration_simulated import coverage_trial, efficiency_trial, solve_cpu_s
from corner_accuracy import KINDS as TARGETS
from corner_accuracy import Found, measure

from realsim.app.console import Console

A = TypeVar("A")
B = TypeVar("B")
PACKAGES = ("realsim", "numpy", "scipy", "gtsam", "numba", "opencv-python-headless")
PARTS = ("time", "real", "koch", "crb", "coverage", "faults", "corners")
COVERAGE_VIEWS, DENSE_VIEWS = 40, 256


@dataclass(eq=False, kw_only=True, slots=True)
class Run:
    """One run: what it may use, and what it found."""

    pool: Executor
    size: Size
    data: Path
    console: Console
    figures: dict[str, float] = field(default_factory=dict[str, float])
    counts: dict[str, str] = field(default_factory=dict[str, str])
    """What a figure was taken over."""
    details: dict[str, Any] = field(default_factory=dict[str, Any])

    started: dict[str, Iterator[Any]] = field(default_factory=dict[str, Iterator[Any]])
    """Work handed to the processes ahead of its turn, by name."""

    def put(self, key: str, value: float, over: str) -> None:
        """Note a figure."""
        self.figures[key], self.counts[key] = float(value), over

    def each(self, name: str, function: Callable[[A], B], tasks: Iterable[A]) -> list[B]:
        """Return the results of all tasks, run side by side."""
        tasks = list(tasks)
        found: list[B] = []
        with self.console.stage(name, f"{len(tasks)} runs") as tick:
            results = self.started.pop(name, None) or self.pool.map(function, tasks)
            for result in results:
                found.append(result)
                tick(len(found), len(tasks))
        return found


def geometric_mean(values: Sequence[float]) -> float:
    """Return the geometric mean."""
    return float(np.exp(np.mean(np.log(values))))


def rms(values: Sequence[float]) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def read_sets(run: Run) -> list[ImageSet]:
    """Return the open sets with the target found in every image."""
    tasks = {name: image_tasks(run.data, name) for name in SOURCES}
    found = run.each("find the targets", detect, [t for part in tasks.values() for t in part])
    sets: list[ImageSet] = []
    for name, part in tasks.items():
        sets.append(image_set(run.data, name, found[: len(part)]))
        found = found[len(part) :]
    return sets


def run_real(run: Run, sets: Sequence[ImageSet]) -> None:
    """Measure the held-out reprojection of the open sets, clean, with joints, and swapped."""
    seeds = range(run.size.seeds)
    clean: list[FoldResult] = []
    for name, options in (
        ("clean", {}),
        ("with joints", {"joints": True}),
        ("poses swapped", {"swap": True}),
    ):
        folds = [
            Fold(data=s, seed=seed, number=k, **options)
            for s in sets
            for seed in seeds
            for k in range(run.size.swapped_folds if options.get("swap") else FOLDS)
            if s.joints is not None or not options.get("joints")
        ]
        results = run.each(f"folds, {name}", run_fold, folds)
        run.details[name] = [
            {"set": r.set_name, "seed": r.seed, "fold": r.number, "px": rms(r.px),
             "map": r.map_name, "rejected": r.rejected, "swapped": r.swapped, "said": r.said}
            for r in results
        ]  # fmt: skip
        if name == "clean":
            clean = results
            put_clean(run, sets, results)
        elif name == "with joints":
            for key in {r.set_name for r in results}:
                px = px_by_seed(results, key)
                run.put(f"{key}_joints_px", float(np.mean(px)), f"{len(px)} seeds")
        else:
            put_swapped(run, sets, clean, results)


def put_clean(run: Run, sets: Sequence[ImageSet], results: Sequence[FoldResult]) -> None:
    """Note the held-out errors."""
    for s in sets:
        px = px_by_seed(results, s.name)
        run.details[f"{s.name}_px by seed"] = px
        run.put(f"{s.name}_px", float(np.mean(px)), f"{len(px)} seeds x {len(s.Ts)} views")


def put_swapped(
    run: Run, sets: Sequence[ImageSet], clean: Sequence[FoldResult], results: Sequence[FoldResult]
) -> None:
    """Note what two swapped poses do, the worst set, and whether exactly they were named."""
    ratios: list[float] = []
    for s in sets:
        same = [r for r in clean if r.number < run.size.swapped_folds]
        px, clean_px = (float(np.mean(px_by_seed(part, s.name))) for part in (results, same))
        ratios.append(px / clean_px)
        run.put(f"swapped_px_ratio_{s.name}", ratios[-1], "")
    run.put("swapped_px_ratio", max(ratios), "worst set")
    exact = [r.swapped is not None and set(r.rejected) == set(r.swapped) for r in results]
    both = [r.swapped is not None and set(r.rejected) >= set(r.swapped) for r in results]
    run.put("swapped_named_share", float(np.mean(exact)), f"{len(exact)} folds")
    run.put("swapped_both_named_share", float(np.mean(both)), "others may be named too")


def put_referee(run: Run, referee: Referee) -> None:
    """Note the ratio to the best closed form, chosen afterwards for every set and seed."""
    found, reason = referee.result()
    if found is None:
        run.console.warn(f"the referee (OpenCV 4) could not run, so there are no ratios: {reason}")
        return
    run.details["closed forms"] = found
    ratios: list[float] = []
    for name, methods in found["px"].items():
        best = np.min(list(methods.values()), axis=0)
        ratios += (best / run.details[f"{name}_px by seed"]).tolist()
        run.put(f"{name}_closed_px", float(np.mean(best)), f"best of 7, OpenCV {found['opencv']}")
    if ratios:
        over = f"{len(ratios)} sets x seeds"
        run.put("heldout_ratio_geomean", geometric_mean(ratios), over)
        run.put("heldout_ratio_min", min(ratios), over)
    if found["poses_mm"]:
        run.put("koch_closed_mm", min(rms(mm) for mm in found["poses_mm"].values()), "best of 7")


def run_koch(run: Run, poses: PoseSet) -> None:
    """Measure the pose-only set, left out one by one, with and without the joints."""
    n = len(poses.A)
    plain = min(n, run.size.koch_plain)
    tasks = [(poses, k, True) for k in range(n)] + [(poses, k, False) for k in range(plain)]
    mm = run.each("poses left out", left_out_mm, tasks)
    run.put("koch_mm", rms(mm[:n]), f"{n} views")
    run.put("koch_median_mm", float(np.median(mm[:n])), f"{n} views")
    if plain:
        run.put("koch_no_joints_mm", rms(mm[n:]), f"{plain} views")
        run.put("koch_no_joints_median_mm", float(np.median(mm[n:])), f"{plain} views")


def run_time(run: Run) -> None:
    """Measure CPU seconds, alone on the machine as far as this run is concerned."""
    with run.console.stage("time", f"{DENSE_VIEWS} views") as tick:
        whole, alone, corners = solve_cpu_s(DENSE_VIEWS, run.size.time_repeats)
        tick(1, 1)
    run.put("solve_cpu_s", whole, f"{DENSE_VIEWS} views, {corners} corners")
    run.put("joint_solve_cpu_s", alone, "joint fit, maps, covariance")


def run_crb(run: Run) -> None:
    """Measure the error of X against the Cramer-Rao bound, white robot noise."""
    tasks = [(DENSE_VIEWS, seed) for seed in range(run.size.crb_trials)]
    e2 = run.each("Cramer-Rao", efficiency_trial, tasks)
    run.details["crb chi2"] = e2
    over = f"{len(e2)} trials of {DENSE_VIEWS} views"
    run.put("crb_ratio", float(np.sqrt(np.mean(e2) / 6)), over)
    run.put("crb_ratio_median", float(np.sqrt(np.median(e2) / 5.348)), "median over chi2's")


def run_coverage(run: Run) -> None:
    """Measure how often the 95 % region of X holds the truth."""
    tasks: list[tuple[Robot, int, int]] = [
        (kind, COVERAGE_VIEWS, s) for kind in ROBOTS for s in range(run.size.trials)
    ]
    trials = run.each("coverage", coverage_trial, tasks)
    for kind in ROBOTS:
        part = [t for t in trials if t.kind == kind]
        over = f"{len(part)} trials of {COVERAGE_VIEWS} views"
        run.put(f"coverage95_{kind}", float(np.mean([t.covered for t in part])), over)
        alone = float(np.mean([t.covered_alone for t in part]))
        run.put(f"coverage95_{kind}_alone", alone, "X fitted without a map")
        run.put(f"x_mm_{kind}", rms([t.mm for t in part]), "RMS error of X")
        names = [t.map_name or f"refused: {t.said[:80]}" for t in part]
        run.details[f"maps, {kind}"] = {n: names.count(n) for n in sorted(set(names))}
    shares = [run.figures[f"coverage95_{kind}"] for kind in ROBOTS]
    worst = max(shares, key=lambda share: abs(share - 0.95))
    spread = float(np.sqrt(0.95 * 0.05 / run.size.trials))
    run.put("coverage95", worst, f"worst of three; +-{spread:.3f} by chance")


def _faults(seed: int) -> tuple[float, list[tuple[str, int, int, dict[str, int]]]]:
    return faults_named_share(1, seed)


def run_faults(run: Run) -> None:
    """Measure how often the fault put into a session is named, clean sessions included."""
    found = run.each("faults", _faults, range(run.size.fault_trials))
    over = f"{len(found)} x {len(found[0][1])} sessions"
    run.put("faults_named_share", float(np.mean([share for share, _ in found])), over)
    run.details["faults missed"] = [
        {"seed": seed, "fault": row[0], "said": row[3]}
        for seed, (_, table) in enumerate(found)
        for row in table
        if row[2]
    ]


def _corners(task: tuple[str, str, int]) -> Found:
    kind, level, views = task
    return measure(kind, level, range(views))


def run_corners(run: Run) -> None:
    """Measure the points found on rendered targets, the worst kind."""
    levels = {"moderate": "corner_rms_px", "strong": "corner_rms_strong_px"}
    tasks = [(kind, level, run.size.corner_views) for level in levels for kind in TARGETS]
    found = dict(zip(tasks, run.each("corners", _corners, tasks), strict=True))
    for level, key in levels.items():
        px = {kind: f.rms_px for (kind, at, _), f in found.items() if at == level}
        worst = max(px, key=lambda kind: px[kind] if np.isfinite(px[kind]) else np.inf)
        run.put(key, px[worst], f"{len(px)} kinds x {run.size.corner_views}; worst: {worst}")
        run.details[key] = px
    shares = [f.row["found"] for f in found.values()]
    run.put("corner_found_share", min(shares), "least of all kinds and levels")


def run_parts(run: Run, parts: Sequence[str]) -> None:
    """Run the parts asked for."""
    if "time" in parts:
        run_time(run)
    if "faults" in parts:
        # Long single tasks first, so that no process waits for them at the end.
        run.started["faults"] = run.pool.map(_faults, range(run.size.fault_trials))
    sets = read_sets(run) if "real" in parts else []
    poses = read_koch(run.data) if "koch" in parts else None
    referee = None
    if sets or poses is not None:
        referee = Referee.start(sets, poses, range(run.size.seeds))
    if sets:
        run_real(run, sets)
    if poses is not None:
        run_koch(run, poses)
    simple = {
        "crb": run_crb, "coverage": run_coverage, "faults": run_faults, "corners": run_corners
    }  # fmt: skip
    for name, part in simple.items():
        if name in parts:
            part(run)
    if referee is not None:
        put_referee(run, referee)


def print_table(run: Run) -> None:
    """Print every figure beside its goal, those with a goal first."""
    order = [k for k in GOALS if k in run.figures]
    order += [k for k in run.figures if k not in GOALS]
    rows: list[list[str]] = []
    for key in order:
        value, goal = run.figures[key], GOALS.get(key)
        verdict = "" if goal is None else "met" if goal.met(value) else "SHORT"
        rows.append([key, f"{value:.4g}", str(goal or ""), verdict, run.counts[key]])
    header = ["figure", "value", "goal", "", "over"]
    run.console.table("Camera and hand-eye calibration", header, rows)


def document_of(run: Run, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return what is written; a figure that is not finite is null."""
    return {
        "benchmark": "calibration",
        "machine": {"cpu": platform.machine(), "cores": os.cpu_count()},
        "versions": {name: version(name) for name in PACKAGES},
        "quick": arguments.quick,
        "parts": arguments.only,
        "size": {name: getattr(run.size, name) for name in Size.__slots__},
        "figures": {k: v if np.isfinite(v) else None for k, v in run.figures.items()},
        "goals": {k: str(goal) for k, goal in GOALS.items()},
        "over": run.counts,
        "details": run.details,
    }


def arguments_of() -> argparse.Namespace:
    """Return the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    data = Path(os.environ.get("REALSIM_DATA", "../shared/data"))
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--quick", action="store_true", help="few trials, under 50 s")
    parser.add_argument("--data", type=Path, default=data, help="folder of the real sets")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS), metavar="PART",
                        help=f"parts to run: {', '.join(PARTS)}")  # fmt: skip
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes")
    for name in Size.__slots__:
        at = getattr(FULL, name)
        option = "--" + name.replace("_", "-")
        parser.add_argument(
            option, type=int, help=f"instead of {at} (quick: {getattr(QUICK, name)})"
        )
    return parser.parse_args()


def main() -> None:
    """Run the parts, print the table, write the JSON."""
    arguments = arguments_of()
    usual = QUICK if arguments.quick else FULL
    given = {name: getattr(arguments, name) for name in Size.__slots__}
    size = Size(**{k: getattr(usual, k) if v is None else v for k, v in given.items()})
    console = Console()
    if not (arguments.data / "handeye").is_dir() and {"real", "koch"} & set(arguments.only):
        missing = {"real", "koch"}
        arguments.only = [part for part in arguments.only if part not in missing]
        console.warn(f"{arguments.data} has no folder handeye: real sets are not run. Give --data.")
    begin = time.perf_counter()
    # Fresh processes: OpenCV's threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(arguments.workers, mp_context=context) as pool:
        run = Run(pool=pool, size=size, data=arguments.data, console=console)
        run_parts(run, arguments.only)
    print_table(run)
    console.say(f"{time.perf_counter() - begin:.0f} s")
    if arguments.json:
        arguments.json.write_text(json.dumps(document_of(run, arguments), indent=1, default=str))


if __name__ == "__main__":
    main()
