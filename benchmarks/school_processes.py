"""Fresh processes for the parts of the school's benchmark, and what work costs.

Fresh ones, because the engines' and Open3D's threads do not survive a fork.
"""

import multiprocessing
import os
import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import TypeVar

from registration_jobs import die_with_parent

PROCESSES = 2
"""Of this benchmark, whatever the machine has."""
Job = TypeVar("Job")
Result = TypeVar("Result")


@dataclass(eq=False, kw_only=True, slots=True)
class Spent:
    """What something cost."""

    cpu_s: float = 0.0
    """Of this process and of its children that ended within [s]."""
    wall_s: float = 0.0


@contextmanager
def spent() -> Generator[Spent]:
    """Measure what is done within."""
    cost = Spent()
    cpu, wall = _cpu_seconds(), time.perf_counter()
    try:
        yield cost
    finally:
        cost.cpu_s, cost.wall_s = _cpu_seconds() - cpu, time.perf_counter() - wall


def _cpu_seconds() -> float:
    """Return the CPU time of this process and of its ended children [s]."""
    t = os.times()
    return t.user + t.system + t.children_user + t.children_system


def in_processes(work: Callable[[Job], Result], jobs: Sequence[Job]) -> list[Result]:
    """Return what the work makes of each job, in their order; the first failure is raised.

    The two processes stay for the next call, with all that they have loaded.

    Args:
        work: a function of a module.
        jobs: the dearest first.
    """
    pool = _pool()
    try:
        return list(pool.map(work, jobs))
    except KeyboardInterrupt:
        for process in multiprocessing.active_children():
            process.terminate()
        pool.shutdown(wait=False, cancel_futures=True)
        raise


@cache
def _pool() -> ProcessPoolExecutor:
    """Return this process's pool."""
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(PROCESSES, mp_context=context, initializer=die_with_parent)


def in_fresh_process(work: Callable[[Job], Result], job: Job) -> Result:
    """Return what the work makes of a job in a process that has done nothing else."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context, initializer=die_with_parent) as pool:
        return pool.submit(work, job).result()
