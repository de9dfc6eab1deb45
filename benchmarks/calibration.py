"""Benchmark of the calibration stage: real sets held out, simulation, faults, corners.

    uv run python benchmarks/calibration.py [--quick] [--json FILE] [--data DIR] [--part PART ...]

Parts: time (the solve; the whole command on 20 images and on 20 pose pairs), real (5-fold held-out
reprojection on three open sets, against OpenCV's seven closed forms with the best of five lenses,
and the same with two poses swapped; a pose-only set, left out one by one), halves (sigma against
disjoint halves of the four sets; the command on the whole sets), crb and coverage (simulation with
truth), faults, corners. --quick takes few trials.
"""

import argparse
import multiprocessing
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar

import blas_threads  # noqa: F401
import numpy as np
from calibration_faults import faults_named_share, layouts_that_are_read
from calibration_halves import Command, Halves, halves_apart, run_command
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
from calibration_simulated import coverage_trial, efficiency_trial, solve_cpu_s
from corner_accuracy import KINDS as TARGETS
from corner_accuracy import measure, opencv
from figures import DATA, Figure, Found, Goal, run

A = TypeVar("A")
B = TypeVar("B")
PACKAGES = ("realsim", "numpy", "scipy", "gtsam", "numba", "opencv-python-headless")
COVERAGE_VIEWS, DENSE_VIEWS, COMMAND_VIEWS = 40, 256, 20
COVERED = Goal(low=0.93, high=0.97)
ALL = Goal(low=1.0, high=1.0)
FIGURES = {
    "heldout_ratio_geomean": Figure(unit="", goal=Goal(low=5.0)),
    "heldout_ratio_min": Figure(unit="", goal=Goal(low=3.0)),
    "x_alone_ratio_min": Figure(unit="", goal=Goal(low=1.0)),
    **{f"x_alone_ratio_{name}": Figure(unit="") for name in (*SOURCES, "koch")},
    "sigma_ratio_min": Figure(unit="", goal=Goal(low=0.7)),
    "sigma_ratio_max": Figure(unit="", goal=Goal(high=2.0)),
    **{f"this_arm_ratio_{name}": Figure(unit="") for name in (*SOURCES, "koch")},
    **{f"this_arm_ratio_deg_{name}": Figure(unit="") for name in (*SOURCES, "koch")},
    "good_sets_exit_zero": Figure(unit="", goal=Goal(low=4.0, high=4.0)),
    "rtde_px": Figure(unit="px", goal=Goal(high=0.40)),
    "rosi_px": Figure(unit="px", goal=Goal(high=1.25)),
    "muligheder_px": Figure(unit="px", goal=Goal(high=1.25)),
    "swapped_px_ratio": Figure(unit="", goal=Goal(high=1.25)),
    "swapped_named_share": Figure(unit="", goal=ALL),
    "koch_mm": Figure(unit="mm", goal=Goal(high=1.65)),
    "koch_median_mm": Figure(unit="mm", goal=Goal(high=1.1)),
    "solve_cpu_s": Figure(unit="s", goal=Goal(high=1.2)),
    "joint_solve_cpu_s": Figure(unit="s"),
    "command_cpu_s_20_views": Figure(unit="s", goal=Goal(high=9.0)),
    "command_cpu_s_20_pairs": Figure(unit="s"),
    "crb_ratio": Figure(unit="", goal=Goal(high=1.2)),
    "crb_ratio_median": Figure(unit=""),
    "coverage95": Figure(unit="", goal=COVERED),
    **{f"coverage95_{kind}": Figure(unit="", goal=COVERED) for kind in ROBOTS},
    **{f"coverage95_{kind}_alone": Figure(unit="") for kind in ROBOTS},
    **{f"x_mm_{kind}": Figure(unit="mm") for kind in ROBOTS},
    "faults_named_share": Figure(unit="", goal=ALL),
    "layouts_read": Figure(unit="", goal=Goal(low=16)),
    "corner_rms_px": Figure(unit="px", goal=Goal(high=0.10)),
    "corner_rms_strong_px": Figure(unit="px", goal=Goal(high=0.22)),
    "corner_found_share": Figure(unit=""),
    "rtde_joints_px": Figure(unit="px"),
    "swapped_both_named_share": Figure(unit=""),
    **{f"swapped_px_ratio_{name}": Figure(unit="") for name in SOURCES},
    **{f"{name}_closed_px": Figure(unit="px") for name in SOURCES},
    "koch_closed_mm": Figure(unit="mm"),
    "koch_no_joints_mm": Figure(unit="mm"),
    "koch_no_joints_median_mm": Figure(unit="mm"),
}


@cache
def pool(workers: int) -> ProcessPoolExecutor:
    """Return the processes of all parts: what they import costs more than many a task."""
    # Fresh processes: OpenCV's threads do not survive a fork.
    return ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))


def each(a: argparse.Namespace, function: Callable[[A], B], tasks: Iterable[A]) -> list[B]:
    """Return the results of all tasks, run side by side."""
    return list(pool(a.workers).map(function, tasks))


def rms(values: Sequence[float]) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def measure_time(a: argparse.Namespace) -> Found:
    """Measure CPU seconds of a calibration of many views, and of the whole command on 20."""
    found = Found()
    whole, alone, corners = solve_cpu_s(DENSE_VIEWS, 1 if a.quick else 3)
    found.add("solve_cpu_s", whole, f"{DENSE_VIEWS} views, {corners} corners")
    found.add("joint_solve_cpu_s", alone, "joint fit, maps, covariance")
    if not (a.data / "handeye").is_dir():
        found.notes.append(
            f"{a.data} has no folder handeye: the command is not timed. Give --data."
        )
        return found
    for key, name, over in (
        ("command_cpu_s_20_views", "rtde", "realsim calibrate: 20 images of 1920x1080, a page"),
        ("command_cpu_s_20_pairs", "koch", "realsim calibrate: 20 pose pairs, a page"),
    ):
        code, cpu_s = run_command(Command(data=a.data, name=name, views=COMMAND_VIEWS))
        found.add(key, cpu_s if code == 0 else float("nan"), over)
    return found


@cache
def real_sets(data: Path, workers: int, quick: bool) -> tuple[tuple[ImageSet, ...], PoseSet] | None:
    """Return the open sets with their corners, None where they are not there."""
    if not (data / "handeye").is_dir():
        return None
    tasks = {name: image_tasks(data, name) for name in SOURCES}
    steps = {name: max(1, len(part) // 12) if quick else 1 for name, part in tasks.items()}
    tasks = {name: part[:: steps[name]] for name, part in tasks.items()}
    seen = list(pool(workers).map(detect, [t for part in tasks.values() for t in part]))
    sets: list[ImageSet] = []
    for name, part in tasks.items():
        sets.append(image_set(data, name, seen[: len(part)], steps[name]))
        seen = seen[len(part) :]
    return tuple(sets), read_koch(data)


def measure_real(a: argparse.Namespace) -> Found:
    """Measure the held-out errors of the open sets, with a referee's closed forms beside them."""
    found, seeds = Found(), range(1 if a.quick else 4)
    given = real_sets(a.data, a.workers, a.quick)
    if given is None:
        found.notes.append(f"{a.data} has no folder handeye: real sets are not run. Give --data.")
        return found
    sets, poses = given
    number = 1 if a.quick else FOLDS
    referee = Referee.start(sets, poses, seeds)
    clean = folds(a, found, sets, seeds, "clean", number)
    for s in sets:
        px = px_by_seed(clean, s.name)
        found.cases[f"{s.name}_px by seed"] = px
        found.cases[f"{s.name}_alone_px by seed"] = px_by_seed(clean, s.name, alone=True)
        found.add(f"{s.name}_px", float(np.mean(px)), f"{len(px)} seeds x {len(s.Ts)} views")
    joints = folds(a, found, sets, seeds, "with joints", number, joints=True)
    for key in {r.set_name for r in joints}:
        px = px_by_seed(joints, key)
        found.add(f"{key}_joints_px", float(np.mean(px)), f"{len(px)} seeds")
    swapped = folds(a, found, sets, seeds, "poses swapped", number, swap=True)
    put_swapped(found, sets, [r for r in clean if r.number < number], swapped)
    put_koch(a, found, poses)
    put_referee(found, referee)
    return found


def folds(
    a: argparse.Namespace, found: Found, sets: Sequence[ImageSet], seeds: range, name: str,
    number: int, *, joints: bool = False, swap: bool = False,
) -> list[FoldResult]:  # fmt: skip
    """Return the results of some folds of the sets."""
    tasks = [
        Fold(data=s, seed=seed, number=k, joints=joints, swap=swap)
        for s in sets
        for seed in seeds
        for k in range(number)
        if s.joints is not None or not joints
    ]
    results = each(a, run_fold, tasks)
    found.cases[name] = [
        {"set": r.set_name, "seed": r.seed, "fold": r.number, "px": rms(r.px), "map": r.map_name,
         "rejected": r.rejected, "swapped": r.swapped, "said": r.said}
        for r in results
    ]  # fmt: skip
    return results


def put_swapped(
    found: Found, sets: Sequence[ImageSet], clean: Sequence[FoldResult],
    results: Sequence[FoldResult],
) -> None:  # fmt: skip
    """Note what two swapped poses do, the worst set, and whether exactly they were named."""
    ratios: list[float] = []
    for s in sets:
        px, clean_px = (float(np.mean(px_by_seed(part, s.name))) for part in (results, clean))
        ratios.append(px / clean_px)
        found.add(f"swapped_px_ratio_{s.name}", ratios[-1])
    found.add("swapped_px_ratio", max(ratios), "worst set")
    exact = [r.swapped is not None and set(r.rejected) == set(r.swapped) for r in results]
    both = [r.swapped is not None and set(r.rejected) >= set(r.swapped) for r in results]
    found.add("swapped_named_share", float(np.mean(exact)), f"{len(exact)} folds")
    found.add("swapped_both_named_share", float(np.mean(both)), "others may be named too")


def put_koch(a: argparse.Namespace, found: Found, poses: PoseSet) -> None:
    """Note the pose-only set, left out one by one, with and without the joints."""
    n = len(poses.A)
    views, plain = (range(0, n, 10), range(0, n, 20)) if a.quick else (range(n), range(min(n, 20)))
    tasks = [(poses, k, True) for k in views] + [(poses, k, False) for k in plain]
    mm = each(a, left_out_mm, tasks)
    for name, part in (("koch", mm[: len(views)]), ("koch_no_joints", mm[len(views) :])):
        found.add(f"{name}_mm", rms([p[0] for p in part]), f"{len(part)} views")
        found.add(f"{name}_median_mm", float(np.median([p[0] for p in part])), f"{len(part)} views")
    found.cases["koch_alone_mm"] = {
        "views": list(plain), "mm": [p[1] for p in mm[len(views) :]]
    }  # fmt: skip


def put_referee(found: Found, referee: Referee) -> None:
    """Note the ratio to the best closed form, chosen afterwards for every set and seed."""
    theirs, reason = referee.result()
    if theirs is None:
        found.notes.append(f"the referee (OpenCV 4) could not run: {reason}")
        return
    found.cases["closed forms"] = theirs
    ratios: list[float] = []
    for name, methods in theirs["px"].items():
        best = np.min(list(methods.values()), axis=0)
        ratios += (best / np.array(found.cases[f"{name}_px by seed"])).tolist()
        alone = float(np.min(best / np.array(found.cases[f"{name}_alone_px by seed"])))
        found.add(f"x_alone_ratio_{name}", alone, "worst seed; without the robot's map")
        over = f"best of 7 with the best of 5 lenses, {theirs['opencv']}"
        found.add(f"{name}_closed_px", float(np.mean(best)), over)
    if ratios:
        geometric_mean = float(np.exp(np.mean(np.log(ratios))))
        found.add("heldout_ratio_geomean", geometric_mean, f"{len(ratios)} sets x seeds")
        found.add("heldout_ratio_min", min(ratios))
    if theirs["poses_mm"]:
        best_mm = min(rms(mm) for mm in theirs["poses_mm"].values())
        found.add("koch_closed_mm", best_mm, "best of 7")
        ours: Any = found.cases["koch_alone_mm"]
        same = min(rms([mm[k] for k in ours["views"]]) for mm in theirs["poses_mm"].values())
        found.add("x_alone_ratio_koch", same / rms(ours["mm"]), f"{len(ours['mm'])} views")
    alone_ratios = [v for k, v in found.figures.items() if k.startswith("x_alone_ratio_")]
    if alone_ratios:
        found.add("x_alone_ratio_min", min(alone_ratios), f"{len(alone_ratios)} sets, worst seed")


def measure_halves(a: argparse.Namespace) -> Found:
    """Measure sigma against disjoint halves of the open sets, and run the command on all four."""
    found = Found()
    given = real_sets(a.data, a.workers, a.quick)
    if given is None:
        found.notes.append(f"{a.data} has no folder handeye: real sets are not run. Give --data.")
        return found
    sets = (*given[0], given[1])
    cuts = range(a.seed, a.seed + (1 if a.quick else 12))
    results = each(a, halves_apart, [Halves(data=s, seed=k) for s in sets for k in cuts])
    ratios: list[float] = []
    for name in (*SOURCES, "koch"):
        part = [r for r in results if r.name == name and not r.said]
        over = f"{len(part)} of {len(cuts)} cuts"
        if not part:
            continue
        ratios.append(rms([r.stated_mm for r in part]) / rms([r.mm for r in part]))
        turn = rms([r.stated_deg for r in part]) / rms([r.deg for r in part])
        found.add(f"this_arm_ratio_{name}", ratios[-1], over)
        found.add(f"this_arm_ratio_deg_{name}", turn, over)
    found.cases["halves"] = [
        {"set": r.name, "mm": r.mm, "stated": r.stated_mm, "said": r.said} for r in results
    ]
    if ratios:
        found.add("sigma_ratio_min", min(ratios), "stated sigma over spread, least set")
        found.add("sigma_ratio_max", max(ratios), "stated sigma over spread, largest set")
    commands = [Command(data=a.data, name=name) for name in (*SOURCES, "koch")]
    codes = [code for code, _ in each(a, run_command, commands)]
    found.cases["exit codes"] = dict(zip((*SOURCES, "koch"), codes, strict=True))
    found.add("good_sets_exit_zero", float(codes.count(0)), "realsim calibrate on whole sets")
    return found


def measure_crb(a: argparse.Namespace) -> Found:
    """Measure the error of X against the Cramer-Rao bound, white robot noise."""
    found = Found()
    e2 = each(a, efficiency_trial, [(DENSE_VIEWS, a.seed + s) for s in range(1 if a.quick else 40)])
    found.cases["crb chi2"] = e2
    over = f"{len(e2)} trials of {DENSE_VIEWS} views"
    found.add("crb_ratio", float(np.sqrt(np.mean(e2) / 6)), over)
    found.add("crb_ratio_median", float(np.sqrt(np.median(e2) / 5.348)), "median over chi2's")
    return found


def measure_coverage(a: argparse.Namespace) -> Found:
    """Measure how often the 95 % region of X holds the truth."""
    found, count = Found(), 3 if a.quick else 200
    tasks = [(kind, COVERAGE_VIEWS, a.seed + s) for kind in ROBOTS for s in range(count)]
    trials = each(a, coverage_trial, tasks)
    for kind in ROBOTS:
        part = [t for t in trials if t.kind == kind]
        over = f"{len(part)} trials of {COVERAGE_VIEWS} views"
        found.add(f"coverage95_{kind}", float(np.mean([t.covered for t in part])), over)
        alone = float(np.mean([t.covered_alone for t in part]))
        found.add(f"coverage95_{kind}_alone", alone, "X fitted without a map")
        found.add(f"x_mm_{kind}", rms([t.mm for t in part]), "RMS error of X")
        names = [t.map_name or f"refused: {t.said[:80]}" for t in part]
        found.cases[f"maps, {kind}"] = {n: names.count(n) for n in sorted(set(names))}
    shares = [found.figures[f"coverage95_{kind}"] for kind in ROBOTS]
    spread = float(np.sqrt(0.95 * 0.05 / count))
    worst = max(shares, key=lambda share: abs(share - 0.95))
    found.add("coverage95", worst, f"worst of three; +-{spread:.3f} by chance")
    return found


def measure_faults(a: argparse.Namespace) -> Found:
    """Measure how often the fault put into a session is named, clean sessions included."""
    found = Found()
    trials = each(a, partial(faults_named_share, 1), range(a.seed, a.seed + (1 if a.quick else 10)))
    share = float(np.mean([share for share, _ in trials]))
    found.add("faults_named_share", share, f"{len(trials)} x {len(trials[0][1])} sessions")
    layouts = layouts_that_are_read()
    read = sum(not problem for problem in layouts.values())
    found.add("layouts_read", read, f"of {len(layouts)}: " + ", ".join(layouts))
    found.cases["faults missed"] = [
        {"seed": seed, "fault": row[0], "said": row[3]}
        for seed, (_, table) in enumerate(trials)
        for row in table
        if row[2]
    ]
    return found


def _corners(task: tuple[str, str, int]) -> tuple[float, float, float]:
    kind, level, views = task
    seen, theirs = measure(kind, level, range(views)), measure(kind, level, range(views), opencv)
    return seen.rms_px, seen.found_share, theirs.rms_px


def measure_corners(a: argparse.Namespace) -> Found:
    """Measure the points found on rendered targets, the worst kind; OpenCV's beside it."""
    found, views = Found(), 1 if a.quick else 6
    levels = {"moderate": "corner_rms_px", "strong": "corner_rms_strong_px"}
    tasks = [(kind, level, views) for level in levels for kind in TARGETS]
    results = dict(zip(tasks, each(a, _corners, tasks), strict=True))
    for level, key in levels.items():
        px = {kind: (r[0], r[2]) for (kind, at, _), r in results.items() if at == level}
        worst = max(px, key=lambda kind: px[kind][0] if np.isfinite(px[kind][0]) else np.inf)
        found.add(key, px[worst][0], f"{len(px)} kinds x {views}; worst: {worst}")
        found.rivals[key] = f"OpenCV {px[worst][1]:.3g} px"
        found.cases[key] = px
    found.add("corner_found_share", min(r[1] for r in results.values()), "least of all")
    return found


def options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the real sets")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes")


if __name__ == "__main__":
    parts = {
        "time": measure_time, "real": measure_real, "halves": measure_halves, "crb": measure_crb,
        "coverage": measure_coverage, "faults": measure_faults, "corners": measure_corners,
    }  # fmt: skip
    run("calibration", __doc__ or "", PACKAGES, FIGURES, parts, options=options)
