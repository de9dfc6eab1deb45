"""Hold that work stays in a bounded memory."""

import multiprocessing
import re
import tracemalloc
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def below(most_bytes: float) -> Generator[None, None, None]:
    """Hold that what Python takes in the block is no more at any time."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < most_bytes
    finally:
        tracemalloc.stop()


def alone(work: Callable[..., object], *arguments: object) -> None:
    """Work in a process of its own: its peak of memory is then not that of other tests."""
    child = multiprocessing.get_context("spawn").Process(target=work, args=arguments)
    child.start()
    child.join()
    assert child.exitcode == 0, "the work failed; its traceback is in the captured stderr"


def own_kb(key: str) -> int:
    """Return what the system says that this process has: VmRSS now, VmHWM at most [kB].

    Not ru_maxrss: that one survives exec, so it would hold what the test's own process had.
    """
    status = Path("/proc/self/status").read_text()
    return int(re.findall(rf"{key}:\s+(\d+) kB", status)[0])
