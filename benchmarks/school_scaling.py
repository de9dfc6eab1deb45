"""What a second process and a second machine bring, and how long the paper's data set would take.

The same school is run by one worker and by two: processes of this machine, then nodes of a Ray
cluster on loopback, one core each. How long each run takes is counted in CPU seconds along its
longest way, the process that asked and its busiest worker, so that others on the machine do not
change it:

    scaling = (asking + only worker) with one worker / (asking + busiest worker) with two

It sees uneven work, what is done while workers wait, and caches that are shared; the clock's own
ratio stands beside it. Workers are warm: each has tried one small object before.
"""

import os
import time
from collections.abc import Callable, Generator
from concurrent.futures import Future, wait
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from figures import Found
from school_cases import (
    PAPER_GRASPS_PER_S,
    SchoolCase,
    candidate_config,
    in_fresh_process,
    school_case,
    slip_config,
    tasks_of,
)

from realsim.many import Pool, PoolConfig, open_pool
from realsim_sim_bridge.school.config import SchoolConfig
from realsim_sim_bridge.school.day import Day, Pupil

FULL, QUICK = 80, 3
"""Candidates per object."""
SHARD_GRASPS, SHARD_GRASPS_QUICK = 24, 8
"""Grasps per job: few, so that the last job does not decide."""
SCENES, CANDIDATES = 1035, 2198
"""Size of the paper's data set; candidates per scene."""
CLUSTERS = (1, 4, 16)
"""Machines like this one that the data set is worked out for."""
TOKEN_BYTES = 32


@dataclass(frozen=True, kw_only=True, slots=True)
class Told:
    """A job's result, who did it, and what it cost."""

    value: Any
    worker: str
    cpu_s: float


def told(fn: Callable[..., Any], *args: Any) -> Told:
    """Do a job where it was sent to."""
    begin = time.process_time()
    value = fn(*args)
    return Told(value=value, worker=_place(), cpu_s=time.process_time() - begin)


def _place() -> str:
    """Return the Ray node that this process belongs to, or the process itself."""
    import sys

    ray: Any = sys.modules.get("ray")
    if ray is not None and ray.is_initialized():
        return str(ray.get_runtime_context().get_node_id())
    return str(os.getpid())


@dataclass(eq=False, slots=True)
class CountedWorkers:
    """Workers whose CPU seconds are counted one by one."""

    workers: Pool
    shares_files: bool = False
    busy: dict[str, float] = field(default_factory=dict[str, float])

    def capacity(self) -> int:
        """Return how many jobs may be under way."""
        return self.workers.capacity()

    def submit(self, fn: Callable[..., Any], /, *args: Any) -> Future[Any]:
        """Hand the job on, and take the cost out of what comes back."""
        outer: Future[Any] = Future()

        def settle(inner: Future[Told]) -> None:
            error = inner.exception()
            if error is not None:
                outer.set_exception(error)
                return
            found = inner.result()
            self.busy[found.worker] = self.busy.get(found.worker, 0.0) + found.cpu_s
            outer.set_result(found.value)

        self.workers.submit(told, fn, *args).add_done_callback(settle)
        return outer


@dataclass(frozen=True, kw_only=True, slots=True)
class Run:
    """What a school cost with so many workers."""

    asking_s: float
    """CPU of the process that asked [s]."""
    busy_s: tuple[float, ...]
    """CPU of each worker in its jobs [s]."""
    wall_s: float
    candidates: int

    @property
    def longest_s(self) -> float:
        """CPU seconds along the longest way."""
        return self.asking_s + max(self.busy_s)


def day(staff: AbstractContextManager[Pool], case: SchoolCase, config: SchoolConfig,
        shard_grasps: int, places: int) -> Run:  # fmt: skip
    """Run the school and return what it cost.

    Args:
        staff: the workers.
        case: the scene.
        config: the school's.
        shard_grasps: of a job.
        places: processes or nodes, each of which is warmed up.
    """
    with staff as workers:
        few = replace(config, max_candidates=2)
        first = tasks_of(case, few)[0]
        wait([workers.submit(_warmed, first) for _ in range(places)])
        counted = CountedWorkers(workers)
        begin, wall = time.process_time(), time.perf_counter()
        tasks = tasks_of(case, config)
        pupils = [Pupil(task=task, folder=None, shard_grasps=shard_grasps) for task in tasks]
        Day(counted, pupils, None).run()
        cost = time.process_time() - begin, time.perf_counter() - wall
    own_jobs_s = counted.busy.get(str(os.getpid()), 0.0)  # a single worker is this process
    return Run(
        asking_s=cost[0] - own_jobs_s,
        busy_s=tuple(counted.busy.values()),
        wall_s=cost[1],
        candidates=sum(len(p.result.grasp_set) for p in pupils if p.result is not None),
    )


def _warmed(task: Any) -> None:
    """Try an object with two candidates, so that everything is loaded."""
    from realsim_sim_bridge.school.object_task import prepare, trial_of
    from realsim_sim_bridge.school.shards import run_shard

    prepared = prepare(task)
    rows = prepared.tested
    if len(rows):
        run_shard(trial_of(task, prepared, rows), rows, task.config)


# --- processes and nodes -----------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, slots=True)
class ScalingJob:
    """Which runs a fresh process does."""

    kind: str
    """'processes' or 'nodes'."""
    seed: int
    keep: Path
    quick: bool


def runs(job: ScalingJob) -> tuple[Run, Run]:
    """Return the run with one worker and the run with two."""
    case = school_case(job.seed, job.keep, job.quick)
    config = SchoolConfig(
        seed=job.seed,
        max_candidates=QUICK if job.quick else FULL,
        candidates=candidate_config(job.quick),
        slip=slip_config("mujoco", "plain", 1.0),
    )
    size = SHARD_GRASPS_QUICK if job.quick else SHARD_GRASPS
    if job.kind == "processes":
        one, two = (day(open_pool(n), case, config, size, n) for n in (1, 2))
        return one, two
    return _on_nodes(case, config, size)


def _on_nodes(case: SchoolCase, config: SchoolConfig, size: int) -> tuple[Run, Run]:
    """Return the runs on one and on two Ray nodes, every port of which is on loopback."""
    found: list[Run] = []
    with ray_nodes() as (address, add):
        for count in (1, 2):
            if count == 2:
                add()
            staff = open_pool(PoolConfig(address=address))
            found.append(day(staff, case, config, size, count))
    return found[0], found[1]


@contextmanager
def ray_nodes() -> Generator[tuple[str, Callable[[], Any]]]:
    """Yield the address of a cluster of one node on loopback, and what adds another."""
    import secrets

    os.environ.update(
        RAY_AUTH_MODE="token",
        RAY_AUTH_TOKEN=secrets.token_hex(TOKEN_BYTES),
        RAY_USAGE_STATS_ENABLED="0",
        RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER="0",
        RAY_ENABLE_UV_RUN_RUNTIME_ENV="0",
    )
    from ray.cluster_utils import Cluster

    node = {"num_cpus": 1, "object_store_memory": 80_000_000}
    cluster: Any = Cluster(
        initialize_head=True, head_node_args={**node, "include_dashboard": False}
    )
    try:
        yield cluster.address, lambda: cluster.add_node(**node)
    finally:
        cluster.shutdown()


# --- figures -----------------------------------------------------------------------------------


def scaling(seed: int, keep: Path, quick: bool) -> Found:
    """Return both scalings."""
    found = Found()
    for kind, key in (("processes", "workers_scaling"), ("nodes", "ray_nodes_scaling")):
        job = ScalingJob(kind=kind, seed=seed, keep=keep, quick=quick)
        try:
            one, two = in_fresh_process(runs, job)
        except ImportError as error:
            found.notes.append(f"scaling: {kind} not run: {error}")
            continue
        shares = ", ".join(f"{s:.1f}" for s in two.busy_s)
        found.add(
            key,
            one.longest_s / two.longest_s,
            f"{one.longest_s:.1f} CPU s with one, of two: asking {two.asking_s:.1f}, {kind} "
            f"{shares}; by the clock {one.wall_s / two.wall_s:.2f}; {one.candidates} candidates",
        )
    return found


def extrapolation(figures: dict[str, float]) -> list[str]:
    """Return in words how long the paper's 1,035 scenes would take, from the rates measured."""
    said: list[str] = []
    total = SCENES * CANDIDATES
    paper = total / PAPER_GRASPS_PER_S / 86400
    for engine in ("bullet", "mujoco"):
        rate = figures.get(f"{engine}_candidates_judged_per_s")
        if rate is None:
            continue
        here = total / rate / 86400
        words = f"{SCENES} scenes of {CANDIDATES} candidates, {engine}: {here:.2f} days here"
        scale = figures.get("ray_nodes_scaling")
        if scale is not None:
            # With n nodes each has the share that it had of two: a fixed part f does not divide.
            fixed = max(2.0 / scale - 1.0, 0.0)
            spread = [f"{here * (fixed + (1 - fixed) / n):.2f} on {n}" for n in CLUSTERS[1:]]
            words += (
                f", {', '.join(spread)} machines like this one if {100 * fixed:.0f} % of the work "
                "does not divide, as measured with two nodes"
            )
        said.append(f"{words}; at the paper's rate {paper:.0f} days")
    return said
