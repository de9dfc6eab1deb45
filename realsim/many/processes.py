"""A pool on this machine: this process, or processes beside it.

Every process has its own pool of one, so that one which dies takes down its own job alone, and it
is known which job that was; a pool of many breaks as a whole.
"""

import os
import signal
import sys
import threading
from collections.abc import Callable, Generator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from multiprocessing import current_process, get_context, parent_process
from multiprocessing.process import BaseProcess
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any

from threadpoolctl import threadpool_limits

from realsim.interop import cores
from realsim.many.carried import called, here
from realsim.many.pool import Pool, WorkerDiedError

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
        before = {name: os.environ.get(name) for name in ONE_THREAD}
        script = sys.modules["__main__"]
        os.environ.update(ONE_THREAD)
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = script
            for name, value in before.items():
                if value is None:
                    os.environ.pop(name, None)
                else:
                    os.environ[name] = value


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
