"""The work of the registration benchmark: one scene at a time, in processes of their own.

Imported by `registration.py`. What raises, or takes its process down, is named, and all of its
objects count as lost.
"""

import ctypes
import multiprocessing
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from registration_cases import OBJECTS, SceneKey
from registration_figures import Done

PR_SET_PDEATHSIG = 1
"""Option of Linux's prctl: the signal that a process gets when its parent ends."""
WARM_UP = SceneKey(seed=0, views=6, objects=3)
"""The scene on which everything is compiled, so that no other pays for it."""
COUNTED = ("rough", "cold", "unknown", "piles", "refined", "biased")
"""Parts whose objects are lost if they fail."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Job:
    """What one process does at a time."""

    parts: tuple[str, ...]
    """Parts of one scene; or one of 'cost', 'real'."""
    key: SceneKey
    keep: Path | None
    quick: bool = False

    def __str__(self) -> str:
        return f"{'+'.join(self.parts)} seed {self.key.seed}"


def _methods() -> dict[str, Callable[..., Done]]:
    """Return the parts of a scene."""
    import registration_methods as methods
    from registration_provoked import provoked
    from registration_rivals import rivals

    return {
        "rough": methods.rough, "cold": methods.cold, "piles": methods.cold,
        "unknown": methods.unknown, "absent": methods.absent, "refined": methods.refined,
        "biased": methods.refined, "rival": rivals, "provoked": provoked,
    }  # fmt: skip


def _failed(job: Job, part: str, failure: str) -> Done:
    """Return the rows of a part that failed."""
    from registration_methods import lost_rows

    count = job.key.objects if part in COUNTED else 1
    return Done(rows=lost_rows([part], job.key.seed, count, failure))


def _tried(job: Job, part: str, work: Callable[[], Done]) -> Done:
    """Return what the work gives; the failure, named, if it raises."""
    try:
        return work()
    except Exception as error:
        print(f"\n{job}, {part}:\n{traceback.format_exc()}", file=sys.stderr)
        return _failed(job, part, f"{type(error).__name__}: {error}")


@cache
def warm_up(keep: Path | None) -> None:
    """Compile what numba compiles."""
    from registration_methods import cold, given, rough

    job = Job(parts=("warm-up",), key=WARM_UP, keep=keep)
    for method in (rough, cold):
        _tried(job, "warm-up", lambda method=method: method(given(WARM_UP, keep)))


def run_job(job: Job) -> list[Done]:
    """Do a job in a process of its own."""
    if "cost" in job.parts:
        from registration_cost import cost

        return [_tried(job, "cost", lambda: cost(job.keep, job.quick))]
    if "real" in job.parts:
        from registration_real import real

        return [_tried(job, "real", lambda: real(job.keep))]
    from registration_methods import given

    warm_up(job.keep)
    try:
        g = given(job.key, job.keep)
    except Exception as error:
        print(f"\n{job}:\n{traceback.format_exc()}", file=sys.stderr)
        return [_failed(job, p, f"the scene: {type(error).__name__}: {error}") for p in job.parts]
    methods = _methods()
    return [_tried(job, p, lambda p=p: methods[p](g)) for p in job.parts]


def die_with_parent() -> None:
    """End this process when its parent ends, whatever ends it; Ctrl-C ends it as well."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def results(jobs: Sequence[Job], processes: int) -> Iterator[tuple[Job, list[Done]]]:
    """Yield what comes of the jobs; one that takes its process down is repeated alone, then named.

    Fresh processes: OpenCV's and Open3D's threads do not survive a fork.
    """
    context = multiprocessing.get_context("spawn")
    lost: list[Job] = []
    with ProcessPoolExecutor(processes, mp_context=context, initializer=die_with_parent) as pool:
        waiting = {pool.submit(run_job, job): job for job in jobs}
        try:
            for future in as_completed(waiting):
                try:
                    yield waiting[future], future.result()
                except BrokenProcessPool:
                    lost.append(waiting[future])
        except BaseException:
            _stop(pool, list(waiting))
            raise
    for job in lost:
        with ProcessPoolExecutor(1, mp_context=context, initializer=die_with_parent) as pool:
            alone = pool.submit(run_job, job)
            try:
                yield job, alone.result()
            except BrokenProcessPool:
                yield job, [_failed(job, part, "the process died") for part in job.parts]
            except BaseException:
                _stop(pool, [alone])
                raise


def _stop(pool: ProcessPoolExecutor, waiting: Sequence[Future[list[Done]]]) -> None:
    """End the processes at once."""
    for future in waiting:
        future.cancel()
    for process in multiprocessing.active_children():
        process.terminate()
    pool.shutdown(wait=False, cancel_futures=True)


def jobs_of(
    seeds: Sequence[int], parts: Sequence[str], many_scenes: int, keep: Path | None, quick: bool
) -> list[Job]:
    """Return what is to be done, the longest first.

    Args:
        seeds: of the scenes.
        parts: of the command line.
        many_scenes: scenes of 256 views.
        keep: see `Job`.
        quick: few objects and views.
    """
    objects, few, many = (4, 8, 16) if quick else (OBJECTS, 32, 256)
    jobs: list[Job] = []

    def add(names: Sequence[str], key: SceneKey) -> None:
        if names:
            jobs.append(Job(parts=tuple(names), key=key, keep=keep, quick=quick))

    for name in ("cost", "real"):
        if name in parts:
            add([name], SceneKey(seed=seeds[0], views=0))
    for seed in seeds[:many_scenes]:
        large = SceneKey(seed=seed, views=many, objects=objects)
        add([p for p in ("refined", "rival") if p in parts], large)
        if "biased" in parts:
            biased = SceneKey(seed=seed, views=many, objects=objects, bias_px=0.02)
            add(["biased"], biased)
    flags = ["absent", "provoked"] if "flags" in parts else []
    for seed in seeds:
        mine = [p for p in ("rough", "cold", "unknown") if p in parts]
        add([*mine, *flags], SceneKey(seed=seed, views=few, objects=objects))
        if "piles" in parts:
            pile = SceneKey(seed=seed, views=few, pile=True, objects=objects - 1)
            add(["piles", *flags[1:]], pile)
    return jobs
