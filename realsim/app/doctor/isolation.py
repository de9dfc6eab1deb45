"""Probes in processes of their own: what crashes there is a finding, not an end."""

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from threading import Timer
from typing import Any

TIMEOUT_S = 60.0
"""For one probe [s]: the slowest takes two, on a laden machine ten times as long."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Outcome:
    """What came of a probe."""

    ok: bool
    told: Any
    """What it found, or why it could not."""


def isolated(
    names: Sequence[str], tick: Callable[[int, int], None], *, timeout_s: float = TIMEOUT_S
) -> dict[str, Outcome]:
    """Run probes one after the other in one process, and in another one after each crash.

    What crashes is tried once more alone: two libraries may not get on with one another.

    Args:
        names: of the probes, see `probe`.
        tick: called with (done, total).
        timeout_s: for one probe; one that takes longer is ended.
    """
    found: dict[str, Outcome] = {}
    left = list(dict.fromkeys(names))
    total = len(left)
    while left:
        crashed = _one_process(left, found, timeout_s, lambda: tick(len(found), total))
        if crashed and len(left) < total:
            _one_process([crashed], found, timeout_s, lambda: tick(len(found), total))
        left = [name for name in left if name not in found]
    return found


def _one_process(
    names: Sequence[str], found: dict[str, Outcome], timeout_s: float, told: Callable[[], None]
) -> str:
    """Add the outcomes up to and with the first probe that took its process along; return it."""
    command = [sys.executable, "-m", "realsim.app.doctor.probe", *names]
    answered: set[str] = set()
    late = False

    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        assert process.stdout is not None

        def end() -> None:
            nonlocal late
            late = True
            process.kill()

        timer = Timer(timeout_s, end)
        timer.start()
        for line in process.stdout:
            timer.cancel()
            timer = Timer(timeout_s, end)
            timer.start()
            try:
                answer = json.loads(line)
            except ValueError:
                continue  # a line that a crash cut
            found[answer["probe"]] = Outcome(ok=answer["ok"], told=answer["told"])
            answered.add(answer["probe"])
            told()
        timer.cancel()
        code = process.wait()
    unanswered = [name for name in names if name not in answered]
    if not unanswered:
        return ""
    words = f"did not end within {timeout_s:g} s" if late else _words(code)
    found[unanswered[0]] = Outcome(ok=False, told=words)
    return unanswered[0]


def _words(code: int) -> str:
    """Return how a process ended."""
    if code >= 0:
        return f"ended its process with exit code {code}"
    try:
        return f"crashed ({signal.Signals(-code).name})"
    except ValueError:
        return f"crashed (signal {-code})"
