"""The work of the scale benchmark: one object at a time, in processes of their own.

Imported by `scale.py`. The images of a case are rendered where they are used, once for all methods.
What raises, or takes its process down, is named and counts as an error beyond every limit.
"""

import importlib
import multiprocessing
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scale_cases import Case, make_case
from scale_figures import FAILED_PCT, KINDS, Kind, Row
from scale_rivals import rival_errors

WARM_UP_WIDTH = 320
"""Images of the fit that only makes numba compile [px]."""
OTHERS = {"tsdf": ("scale_fusion", "tsdf_median_mm"), "sfm": ("scale_sfm", "sfm_scale_pct")}
"""Benchmarks that are called for their figures: module, and the key that must come back."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Job:
    """What one process does at a time."""

    name: str
    """An object, or one of `OTHERS`."""
    seed: int
    width: int
    keep: Path | None
    parts: tuple[str, ...]
    """Some of 'exact', 'distorted', 'cold', 'rival'; empty for the other benchmarks."""
    quick: bool


@dataclass(frozen=True, kw_only=True, slots=True)
class Done:
    """What came of a job."""

    rows: tuple[Row, ...] = ()
    figures: tuple[tuple[str, float], ...] = ()


def fit_row(case: Case, kind: Kind) -> Row:
    """Return one fit, or its failure."""
    from realsim.scanning.scale.fit import fit_scale

    mesh = case.given_exact if kind == "exact" else case.given_distorted
    start = {"exact": case.start_exact, "distorted": case.start_distorted, "cold": None}[kind]
    began = time.process_time()
    fit = fit_scale(mesh, case.views.intrinsics, case.views.frames, start=start)
    cpu_s = time.process_time() - began
    error = 100 * (fit.scale / case.true_scale - 1)
    return Row(
        name=case.name,
        seed=case.seed,
        kind=kind,
        error_pct=error if np.isfinite(error) else FAILED_PCT,
        sigma_pct=fit.sigma_percent,
        verdict=fit.verdict,
        cpu_s=cpu_s,
        said={
            "reasons": list(fit.reasons),
            "checks": {k: float(v) for k, v in fit.checks.items()},
            "limits": {limit.name: limit.percent for limit in fit.limits},
            "notes": list(fit.notes),
            "candidates": [
                [float(c.scale / case.true_scale), float(c.score), c.source]
                for c in fit.candidates[:5]
            ],
        },
    )


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


def _failed(name: str, seed: int, kind: str, failure: str) -> list[Row]:
    """Return the rows of a part that failed."""
    kinds = [f"open3d {v}_{k}" for v in ("fused", "topdown") for k in KINDS[:2]]
    return [Row(name=name, seed=seed, kind=k, failure=failure)
            for k in (kinds if kind == "rival" else [kind])]  # fmt: skip


def _tried(name: str, seed: int, part: str, work: Callable[[], list[Row]]) -> list[Row]:
    """Return what the work gives; the failure, named, if it raises."""
    try:
        return work()
    except Exception as error:
        print(f"\n{name} {seed} {part}:\n{traceback.format_exc()}", file=sys.stderr)
        return _failed(name, seed, part, f"{type(error).__name__}: {error}")


@cache
def warm_up() -> None:
    """Compile what numba compiles, so that no object pays for it."""
    case = make_case("cube", 0, WARM_UP_WIDTH)
    for kind in ("exact", "cold"):
        _tried(case.name, case.seed, f"warm-up, {kind}", lambda kind=kind: [fit_row(case, kind)])


def run_job(job: Job) -> Done:
    """Do a job in a process of its own."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if job.name in OTHERS:
        return _other(job)
    if set(job.parts) & set(KINDS):
        warm_up()
    try:
        case = make_case(job.name, job.seed, job.width, job.keep)
    except Exception as error:
        print(f"\n{job.name} {job.seed}:\n{traceback.format_exc()}", file=sys.stderr)
        text = f"the case: {type(error).__name__}: {error}"
        return Done(rows=tuple(r for p in job.parts for r in _failed(job.name, job.seed, p, text)))
    rows: list[Row] = []
    for kind in KINDS:
        if kind in job.parts:
            rows += _tried(job.name, job.seed, kind, lambda kind=kind: [fit_row(case, kind)])
    if "rival" in job.parts:
        rows += _tried(job.name, job.seed, "rival", lambda: rival_rows(case))
    return Done(rows=tuple(rows))


def _other(job: Job) -> Done:
    """Return the figures of another benchmark; its key at `FAILED_PCT` if it fails."""
    module, key = OTHERS[job.name]
    try:
        found: dict[str, Any] = importlib.import_module(module).run(job.quick)
    except Exception as error:
        print(f"\n{module}:\n{traceback.format_exc()}", file=sys.stderr)
        row = Row(name=job.name, seed=0, kind=key, failure=f"{type(error).__name__}: {error}")
        return Done(rows=(row,), figures=((key, FAILED_PCT),))
    numbers = {k: float(v) for k, v in found.items() if isinstance(v, int | float)}
    return Done(figures=tuple(({key: FAILED_PCT} | numbers).items()))


def results(jobs: Sequence[Job], processes: int) -> Iterator[Done]:
    """Yield what comes of the jobs; one that takes its process down is repeated alone, then named.

    Fresh processes: OpenCV's and Open3D's threads do not survive a fork.
    """
    context = multiprocessing.get_context("spawn")
    lost: list[Job] = []
    with ProcessPoolExecutor(processes, mp_context=context) as pool:
        waiting = {pool.submit(run_job, job): job for job in jobs}
        try:
            for future in as_completed(waiting):
                try:
                    yield future.result()
                except BrokenProcessPool:
                    lost.append(waiting[future])
        except BaseException:
            _stop(pool, list(waiting))
            raise
    for job in lost:
        with ProcessPoolExecutor(1, mp_context=context) as pool:
            alone = pool.submit(run_job, job)
            try:
                yield alone.result()
            except BrokenProcessPool:
                text = "the process died"
                parts = job.parts or (OTHERS[job.name][1],)
                rows = [r for p in parts for r in _failed(job.name, job.seed, p, text)]
                figures = () if job.parts else ((OTHERS[job.name][1], FAILED_PCT),)
                yield Done(rows=tuple(rows), figures=figures)
            except BaseException:
                _stop(pool, [alone])
                raise


def _stop(pool: ProcessPoolExecutor, waiting: Sequence[Future[Done]]) -> None:
    """End the processes at once."""
    for future in waiting:
        future.cancel()
    for process in multiprocessing.active_children():
        process.terminate()
    pool.shutdown(wait=False, cancel_futures=True)
