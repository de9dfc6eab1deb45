"""Processor, memory, disks, clock: what the machine gives.

Probes in processes of their own: what crashes there is a finding, not an end.

What was found out about this machine, one line each.
"""

import ctypes
import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Timer
from typing import Any, Literal

from realsim.interop import cores

Kind = Literal["ok", "note", "problem"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Finding:
    """One line of the doctor's tables."""

    group: str
    """Title of its table."""
    name: str
    kind: Kind
    """`problem`: something that every user needs does not work; `note`: some will miss it."""
    found: str
    todo: str = ""
    """What to do about it; empty where nothing is to be done."""


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


GROUP = "Machine"
GB = 1e9
INSTRUCTIONS = ("avx2", "fma")
"""Instructions of the processor; without them the wheels' inner loops are slower, or do not
start."""
LEAST_MEMORY_GB = 2.0
"""A demo takes less; below, large scenes are killed by the system."""
LITTLE_DISK_GB, LEAST_DISK_GB = 5.0, 0.5
"""A session of 256 views takes 0.15 to 0.4 GB; a data set of many scenes a multiple."""
NETWORK_FILESYSTEMS = ("nfs", "nfs4", "cifs", "smb3", "fuse.sshfs", "9p")
SOURCE_DATE = 1_735_689_600
"""2025-01-01 [s]: a clock before is wrong."""
STA_UNSYNC = 0x40
"""Bit of the kernel's clock status: nobody disciplines the clock (adjtimex(2))."""
STATUS_OFFSET = 40
"""Byte of `status` in struct timex on 64-bit Linux."""


def machine_findings(session: Path | None, numba: Outcome) -> list[Finding]:
    """Return what the machine has, and what may run short."""
    folder = session or Path()
    places = [("disk of the session" if session else "disk of this folder", folder)]
    places.append(("disk for temporary files", Path(tempfile.gettempdir())))
    return [
        _processor(),
        _memory(),
        *(_disk(name, place) for name, place in places),
        _filesystem(folder),
        _numba(numba),
        _clock(),
    ]


def _processor() -> Finding:
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        text = ""
    flags = next((set(x.split()) for x in text.splitlines() if x.startswith("flags")), set[str]())
    missing = [f for f in INSTRUCTIONS if f not in flags] if flags else []
    there = [f for f in INSTRUCTIONS if f in flags]
    return Finding(
        group=GROUP, name="processor", kind="note" if missing else "ok",
        found=f"{cores()} cores{''.join(f', {f}' for f in there)}",
        todo=f"no {' and '.join(missing)}: some packages are slow or do not start"
        if missing else "",
    )  # fmt: skip


def _memory() -> Finding:
    rows = Path("/proc/meminfo").read_text(encoding="utf-8").splitlines()
    kb = {row.split(":")[0]: float(row.split()[1]) for row in rows if ":" in row}
    total, free = 1024 * kb["MemTotal"] / GB, 1024 * kb.get("MemAvailable", 0.0) / GB
    short = free < LEAST_MEMORY_GB
    return Finding(
        group=GROUP, name="memory", kind="note" if short else "ok",
        found=f"{free:.1f} of {total:.1f} GB free",
        todo="fewer --workers take less" if short else "",
    )  # fmt: skip


def _disk(name: str, place: Path) -> Finding:
    free = shutil.disk_usage(place).free / GB
    kind: Kind = "problem" if free < LEAST_DISK_GB else "note" if free < LITTLE_DISK_GB else "ok"
    todo = "" if kind == "ok" else "make room: a session of 256 views takes up to 0.4 GB"
    if not os.access(place, os.W_OK):
        kind, todo = "problem", f"{place} may not be written; change its permissions"
    return Finding(group=GROUP, name=name, kind=kind, found=f"{free:.1f} GB free", todo=todo)


def _filesystem(folder: Path) -> Finding:
    """Try locks and atomic renames in a folder of its own, which is taken away again."""
    name, kind = "locks and atomic writing", filesystem_of(folder)
    try:
        with tempfile.TemporaryDirectory(prefix=".realsim-doctor-", dir=folder) as text:
            try_store(Path(text))
    except OSError as error:
        return Finding(
            group=GROUP, name=name, kind="problem",
            found=f"not in {folder} ({kind or 'filesystem not known'}): {error.strerror or error}",
            todo="keep sessions on a local disk that you may write",
        )  # fmt: skip
    if kind in NETWORK_FILESYSTEMS:
        return Finding(
            group=GROUP, name=name, kind="note", found=f"work, over the network ({kind})",
            todo="locks of other machines may not be seen: one machine at a time in a session",
        )  # fmt: skip
    return Finding(group=GROUP, name=name, kind="ok", found=f"work ({kind or 'not known'})")


def try_store(folder: Path) -> None:
    """Do what the store does: lock a folder, write a file, put it in the place of another.

    Raises:
        OSError: the filesystem cannot, or a second lock was given.
    """
    first = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    second = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(first, fcntl.LOCK_EX | fcntl.LOCK_NB)
        try:
            fcntl.flock(second, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            pass  # as it should be
        else:
            raise OSError("two locks are given on one folder")
    finally:
        os.close(second)
        os.close(first)
    old, new = folder / "old", folder / "new"
    for path in (old, new):
        with path.open("wb") as file:
            file.write(path.name.encode())
            file.flush()
            os.fsync(file.fileno())
    new.replace(old)
    if old.read_bytes() != b"new" or new.exists():
        raise OSError("a file was not put in the place of another")


def filesystem_of(folder: Path) -> str:
    """Return the kind of the filesystem that a folder lies on, "" where it is not known."""
    try:
        rows = Path("/proc/self/mountinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return ""
    place, best, kind = folder.resolve(), "", ""
    for row in rows:
        mounted, _, rest = row.partition(" - ")
        point = mounted.split()[4].replace("\\040", " ")
        if place.is_relative_to(point) and len(point) >= len(best):
            best, kind = point, rest.split()[0]
    return kind


def _numba(outcome: Outcome) -> Finding:
    name = "numba's cache"
    if outcome.ok:
        return Finding(group=GROUP, name=name, kind="ok", found=f"is written to {outcome.told}")
    return Finding(
        group=GROUP, name=name, kind="problem", found=f"cannot be written: {outcome.told}",
        todo="name a folder that may be written, or every run compiles anew: `export "
        "NUMBA_CACHE_DIR=FOLDER`",
    )  # fmt: skip


def _clock() -> Finding:
    now = time.time()
    said = time.strftime("%Y-%m-%d %H:%M:%S %Z")
    if now < SOURCE_DATE:
        return Finding(
            group=GROUP, name="clock", kind="problem", found=f"{said} is in the past",
            todo="set it: `sudo timedatectl set-ntp true`",
        )  # fmt: skip
    if clock_status() & STA_UNSYNC:
        return Finding(
            group=GROUP, name="clock", kind="note", found=f"{said}, not synchronised",
            todo="time stamps of several machines will differ: `sudo timedatectl set-ntp true`",
        )  # fmt: skip
    return Finding(group=GROUP, name="clock", kind="ok", found=said)


def clock_status() -> int:
    """Return the kernel's clock status bits (adjtimex(2) with nothing to change), 0 = not known."""
    buffer = ctypes.create_string_buffer(512)
    try:
        if ctypes.CDLL(None).adjtimex(buffer) < 0:
            return 0
    except (OSError, AttributeError):
        return 0
    return int.from_bytes(buffer.raw[STATUS_OFFSET : STATUS_OFFSET + 4], "little")
