"""Many tasks on a pool, opened here: failures listed, lost ones tried again, told in sentences."""

import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from realsim.errors import RealsimError
from realsim.many.pool import (
    ClusterLostError,
    ForeignNodeError,
    Pool,
    PoolConfig,
    WorkerDiedError,
    Workers,
)
from realsim.many.processes import local_pool
from realsim.many.ray_pool import ray_pool
from realsim.store.atomic import FULL, StorageError

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
