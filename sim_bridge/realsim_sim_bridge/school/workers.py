"""Processes that work for the school and end with it."""

import os
import signal
import threading
from collections.abc import Callable, Generator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from typing import Any

ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""The processes share the cores; threads of their libraries would fight over them."""


class _InThisProcess(Executor):
    """An executor that does the job at once."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Do it and return the finished future; what it raises is raised by `result()`."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@contextmanager
def executor(workers: int) -> Generator[Executor]:
    """Yield an executor of that many fresh processes; of this one where 1 or fewer are wanted."""
    if workers <= 1:
        yield _InThisProcess()
        return
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    # The libraries read this when they load: it has to stand before the processes start.
    os.environ.update(ONE_THREAD)
    try:
        with ProcessPoolExecutor(
            max_workers=workers, mp_context=get_context("spawn"), initializer=_end_with_parent
        ) as pool:
            try:
                yield pool
            except BaseException:
                # A job may take half a minute, and an interrupted user does not wait for it.
                for process in list(pool._processes.values()):  # pyright: ignore[reportPrivateUsage]
                    process.terminate()
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    finally:
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
