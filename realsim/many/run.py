"""Many tasks on a pool, opened here: failures listed, lost ones tried again, told in sentences.

A pool on this machine: this process, or processes beside it.

Every process has its own pool of one, so that one which dies takes down its own job alone, and it
is known which job that was; a pool of many breaks as a whole.
"""

import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import current_process, get_context, parent_process
from multiprocessing.process import BaseProcess
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any

from threadpoolctl import threadpool_limits

from realsim.errors import RealsimError
from realsim.interop import cores
from realsim.many.carried import called, here
from realsim.many.pool import (
    ClusterLostError,
    ForeignNodeError,
    Pool,
    PoolConfig,
    WorkerDiedError,
    Workers,
)
from realsim.many.ray_pool import ray_pool
from realsim.store.atomic import FULL, StorageError

ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""The processes share the cores; threads of their libraries would fight over them, and sums split
over threads differ in their last bits."""
_starting = threading.Lock()
"""Held while a process starts."""


@contextmanager
def local_pool(count: int | None = None) -> Generator[Pool]:
    """Yield that many fresh processes (None = one a core), or this process where it is one."""
    count = cores() if count is None else count
    with TemporaryDirectory(prefix="realsim_many_") as kept:
        if count <= 1 or current_process().daemon:  # a worker of the user's own may have none
            yield _ThisProcess(Path(kept))
            return
        processes = _Processes(count, Path(kept))
        try:
            yield processes
        except BaseException:
            # A job may take half a minute, and an interrupted user does not wait for it.
            processes.end(at_once=True)
            raise
        processes.end(at_once=False)


class _ThisProcess:
    """Does the job at once."""

    shares_files = True

    def __init__(self, kept: Path) -> None:
        self._kept = kept

    def capacity(self) -> int:
        """Return 1."""
        return 1

    def submit(self, fn: Callable[..., Any], /, *args: Any) -> Future[Any]:
        """Do it and return the finished future; what it raises is raised by `result()`."""
        future: Future[Any] = Future()
        try:
            with threadpool_limits(1):
                future.set_result(fn(*here(args, self._kept, apart=False)))
        except Exception as error:
            future.set_exception(error)
        return future


class _Processes:
    """One pool of one process for each job that may be under way."""

    shares_files = True

    def __init__(self, count: int, kept: Path) -> None:
        self._kept = kept
        self._pools: list[ProcessPoolExecutor | None] = [None] * count
        self._idle = list(range(count))

    def capacity(self) -> int:
        """Return the number of processes."""
        return len(self._pools)

    def submit(self, fn: Callable[..., Any], /, *args: Any) -> Future[Any]:
        """Give the job to an idle process; a new one takes the place of one that died."""
        args = here(args, self._kept, apart=True)
        place = self._idle.pop()
        try:
            pool, inner = self._start(place, fn, args)
        except BrokenProcessPool:  # it was killed while it had nothing to do
            self._pools[place] = None
            pool, inner = self._start(place, fn, args)
        # The pool knows why its process ended; it tells nobody.
        process = next(iter(pool._processes.values()), None)  # pyright: ignore[reportPrivateUsage]
        outer: Future[Any] = Future()
        inner.add_done_callback(partial(self._settle, place, process, outer))
        return outer

    def _start(
        self, place: int, fn: Callable[..., Any], args: tuple[Any, ...]
    ) -> tuple[ProcessPoolExecutor, Future[Any]]:
        """Submit to the process of a place, which is started if there is none."""
        pool = self._pools[place]
        if pool is None:
            pool = self._pools[place] = ProcessPoolExecutor(
                max_workers=1, mp_context=get_context("spawn"), initializer=_end_with_parent
            )
        with _fresh():
            return pool, pool.submit(called, fn, args)

    def _settle(
        self, place: int, process: BaseProcess | None, outer: Future[Any], inner: Future[Any]
    ) -> None:
        """Pass on what became of a job, and free its place first: the next may come at once."""
        if inner.cancelled():
            outer.cancel()
            return
        error = inner.exception()
        if isinstance(error, BrokenProcessPool):
            self._pools[place] = None
            error = WorkerDiedError(_end_of(process))
        self._idle.append(place)
        if error is None:
            outer.set_result(inner.result())
        else:
            outer.set_exception(error)

    def end(self, *, at_once: bool) -> None:
        """End the processes; at once means in the middle of their jobs."""
        for pool in self._pools:
            if pool is None:
                continue
            if at_once:
                for process in list(pool._processes.values()):  # pyright: ignore[reportPrivateUsage]
                    process.terminate()
            pool.shutdown(wait=not at_once, cancel_futures=at_once)


def _end_of(process: BaseProcess | None) -> str:
    """Return in words how a process ended."""
    if process is not None:
        process.join(timeout=5.0)
    code = None if process is None else process.exitcode
    if code is None:
        return "its process ended without a word"
    if code == -signal.SIGKILL:
        return "its process was killed (signal SIGKILL), as the system does when memory runs out"
    if code < 0:
        return f"its process ended by signal {signal.Signals(-code).name}"
    return f"its process ended with exit code {code}"


@contextmanager
def _fresh() -> Generator[None]:
    """Let a process that starts within have one thread, and not run the user's script again.

    Libraries read the environment when they load: it has to stand before the process starts.
    """
    with _starting:
        before = {name: os.environ[name] for name in ONE_THREAD if name in os.environ}
        script = sys.modules["__main__"]
        os.environ.update(ONE_THREAD)
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = script
            for name in ONE_THREAD:
                del os.environ[name]
            os.environ.update(before)


def _end_with_parent() -> None:
    """End this process when its parent is gone: a killed parent cannot tell its pool to stop.

    Ctrl-C reaches every process of the terminal; the parent alone answers it.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is None:
        return

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


MOST_DEATHS = 3
"""A task that ended so many workers is not given to another: it is the task, not the machine."""
LOOK_UP_S = 1.0
"""How often the one who waits looks whether there are more workers, and tells how it goes [s]."""
AHEAD = 2
"""Tasks that are begun before an earlier one's result is there, in units of the pool's capacity,
where results are wanted in order."""
ENDS_ALL = (StorageError, ClusterLostError, ForeignNodeError)
"""What would befall every other task as well."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Task:
    """Something to be done by a pure function: its result depends on the arguments alone."""

    name: str
    """In words, for messages and progress; the caller tells tasks apart by it."""
    fn: Callable[..., Any]
    """Function of a module, so that another process finds it; its result can be pickled."""
    args: tuple[Any, ...] = ()
    """What can be pickled; files go as `Sent`, and a folder that is changed as `Worked`."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Outcome:
    """What became of a task."""

    task: Task
    value: Any = None
    """What the function returned."""
    error: Exception | None = None
    """Why it returned nothing."""
    deaths: int = 0
    """Workers that were lost in the middle of it."""

    def found(self) -> Any:
        """Return the value, or raise why there is none."""
        if self.error is not None:
            raise self.error
        return self.value

    @property
    def why(self) -> str:
        """Why there is no value, in a sentence."""
        if self.error is None or isinstance(self.error, RealsimError | OSError):
            return str(self.error or "")
        return f"the program failed: {type(self.error).__name__}: {self.error}"


Done = Callable[[Outcome], Iterable[Task] | None]
"""Called with each outcome, in the process that asked, which alone keeps results; it may return
tasks that come out of it."""


@dataclass(eq=False, kw_only=True, slots=True)
class Summary:
    """How a run of many went."""

    done: int = 0
    failed: list[Outcome] = field(default_factory=list[Outcome])
    """In the order in which they failed."""
    lost: int = 0
    """Workers that were lost."""

    def __str__(self) -> str:
        """Return it in words."""
        failed = f", {len(self.failed)} failed" if self.failed else ""
        done = "1 task is" if self.done == 1 else f"{self.done} tasks are"
        return f"{done} done{failed}"


@dataclass(eq=False, slots=True)
class _Begun:
    """A task on its way."""

    task: Task
    place: int
    """In the order of the tasks."""
    deaths: int = 0


def run_many(
    tasks: Iterable[Task],
    pool: Pool,
    done: Done,
    *,
    in_order: bool = False,
    tick: Callable[[Sequence[str]], None] | None = None,
) -> Summary:
    """Do tasks, as many at a time as the pool has room for; return when all have ended.

    A task that fails is handed to `done` with its error, and the others go on. One whose worker is
    lost (killed, out of memory, its machine gone or full) is begun again, three times at most.

    Args:
        tasks: taken one by one when there is room; leave out those whose result is there.
        pool: who does them.
        done: takes what becomes of each; what it raises ends the run.
        in_order: whether `done` gets the outcomes in the order of the tasks.
        tick: called with the names of the tasks under way, after every change and each second.

    Raises:
        StorageError: no more can be written; what `done` has kept is kept.
        ClusterLostError: the cluster's head is gone, likewise.
        ForeignNodeError: a machine has another version.
        KeyboardInterrupt: with a sentence that says how far it came.
    """
    run = _Run(iter(tasks), pool, done, in_order)
    try:
        run.all(tick or _silent)
    except ClusterLostError as error:
        raise ClusterLostError(
            f"{error} Until then {run.summary}, and what they brought is kept. Start the cluster "
            "again, or leave out --address; the same command goes on from here."
        ) from None
    except KeyboardInterrupt as stop:
        raise type(stop)(str(stop) or f"interrupted: {run.summary}") from None
    return run.summary


def _silent(names: Sequence[str]) -> None:
    """Tell nobody."""


class _Run:
    """The tasks that wait, those under way, and those whose turn has not come."""

    def __init__(self, tasks: Iterator[Task], pool: Pool, done: Done, in_order: bool) -> None:
        self.summary = Summary()
        self._sources = deque([tasks])
        self._pool, self._done, self._in_order = pool, done, in_order
        self._waiting: deque[_Begun] = deque()
        self._under_way: dict[Future[Any], _Begun] = {}
        self._held: dict[int, Outcome] = {}
        self._begun, self._told = 0, 0

    def all(self, tick: Callable[[Sequence[str]], None]) -> None:
        """Work until everything has ended."""
        while True:
            while len(self._under_way) < self._pool.capacity():
                begun = self._next()
                if begun is None:
                    break
                self._under_way[self._pool.submit(begun.task.fn, *begun.task.args)] = begun
            if not self._under_way:
                if not self._sources and not self._waiting:
                    return
                time.sleep(LOOK_UP_S)  # no machine has room now
                continue
            tick([begun.task.name for begun in self._under_way.values()])
            for future in wait(self._under_way, LOOK_UP_S, FIRST_COMPLETED).done:
                self._take(self._under_way.pop(future), future)

    def _next(self) -> _Begun | None:
        """Return the task that is begun next; None = none now."""
        if self._waiting:
            return self._waiting.popleft()
        far = self._begun - self._told >= AHEAD * max(self._pool.capacity(), 1)
        while self._sources and not (self._in_order and far):
            task = next(self._sources[0], None)
            if task is not None:
                self._begun += 1
                return _Begun(task, self._begun - 1)
            self._sources.popleft()
        return None

    def _take(self, begun: _Begun, future: Future[Any]) -> None:
        """Take what a task came to."""
        value, error = None, None
        try:
            value = future.result()
        except ENDS_ALL:
            raise
        except WorkerDiedError as died:
            begun.deaths += 1
            self.summary.lost += 1
            if begun.deaths < MOST_DEATHS:
                self._waiting.appendleft(begun)
                return
            error = WorkerDiedError(
                f"{MOST_DEATHS} workers ended in the middle of it; of the last: {died}"
            )
        except Exception as raised:
            if isinstance(raised, OSError) and raised.errno in FULL:
                raise StorageError(
                    f"the disk is full: {raised}. What was stored before is intact. Make room; the "
                    "same command goes on from here."
                ) from raised
            error = raised
        self._tell(begun.place, Outcome(task=begun.task, value=value, error=error,
                                        deaths=begun.deaths))  # fmt: skip

    def _tell(self, place: int, outcome: Outcome) -> None:
        """Hand an outcome on, or keep it until its turn."""
        self._held[place] = outcome
        due = self._told if self._in_order else place
        while due in self._held:
            now = self._held.pop(due)
            due, self._told = due + 1, self._told + 1
            if now.error is not None:
                self.summary.failed.append(now)
            more = self._done(now)
            self.summary.done += now.error is None
            if more is not None:
                self._sources.append(iter(more))


@contextmanager
def open_pool(where: Workers = None) -> Generator[Pool]:
    """Yield who does the work; leaving ends it, in the middle of jobs where an error leaves.

    Args:
        where: a number = so many processes, 1 = this one; None = one a core.

    Raises:
        InputError: the cluster is not there, lets in anyone, or Ray is not installed.
    """
    config = where if isinstance(where, PoolConfig) else PoolConfig(workers=where)
    if config.address:
        with ray_pool(config) as pool:
            yield pool
        return
    with local_pool(config.workers) as pool:
        yield pool
