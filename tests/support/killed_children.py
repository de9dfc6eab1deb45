"""Work in children that are killed in the middle of it, as a power cut would end it."""

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path


def _child(work: Callable[[], object]) -> int:
    """Do something in a child of this process; return its number."""
    child = os.fork()
    if child == 0:
        try:
            work()
            os._exit(0)
        finally:
            os._exit(1)
    return child


def ended_well(*children: int) -> bool:
    """Wait for children; return whether none was killed. One that failed is an error here."""
    codes = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
    assert set(codes) <= {0, -signal.SIGKILL}, codes
    return not any(codes)


def in_children(*works: Callable[[], object]) -> bool:
    """Do several things at once, each in a child; return whether none was killed."""
    return ended_well(*[_child(work) for work in works])


def killed_at(step: int, work: Callable[[], object]) -> bool:
    """Work in a child that is killed before its `step`-th rename, from 0; return whether it was."""
    replaced, count = os.replace, 0

    def dying(a: object, b: object) -> None:
        nonlocal count
        if count == step:
            os.kill(os.getpid(), signal.SIGKILL)
        count += 1
        replaced(a, b)  # pyright: ignore[reportArgumentType]

    def doomed() -> None:
        os.replace = dying  # pyright: ignore[reportAttributeAccessIssue]
        work()

    return not in_children(doomed)


def killed_growing(work: Callable[[], object], path: Path, lines: int, wait_s: float) -> None:
    """Work in a child that is killed a little after a file of its has so many lines more."""

    def count() -> int:
        return path.read_bytes().count(b"\n") if path.exists() else 0

    goal, end = count() + lines, time.monotonic() + 30
    child = _child(work)
    while count() < goal:
        assert time.monotonic() < end, f"{path} does not grow"
        time.sleep(0.001)
    time.sleep(wait_s)
    os.kill(child, signal.SIGKILL)
    assert not ended_well(child)
