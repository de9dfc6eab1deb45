"""The commands of one scene, each in a process of its own; and what is known of earlier runs."""

import ctypes
import hashlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from tempfile import TemporaryFile
from typing import BinaryIO

from realsim.app.check.checksums import listed_sums
from realsim.app.pipeline.campaign import Step
from realsim.app.reproduce.run import AGAIN
from realsim.errors import InputError
from realsim.formats.export_folder import FINISHED, SUMS_FILE
from realsim.store import provenance
from realsim.untrusted.own_json import read_own

PROGRAM = (sys.executable, "-c", "from realsim.app.pipeline.chain import child; child()")
PR_SET_PDEATHSIG = 1
"""Option of Linux's prctl: the signal that a process gets when its parent ends."""
DONE, LOOK = 0, 1
"""Exit codes of a command that did its work; 1: one of its checks failed."""
WORDS, TAIL_BYTES = 600, 20_000
"""Characters of a command's last words that are kept, and where they are looked for."""
RESTART = "--restart"
OWN_FILES = (SUMS_FILE, FINISHED, provenance.FOLDER_FILE, "provenance.run.json")
"""Files of an export that its list of checksums does not name."""
NOTE, MOST_NOTES = "note: ", 8
SCENE = "SCENE"
"""Word of a command that stands for the scene's folder, wherever that is."""
ENVIRONMENT = {"REALSIM_CONFIG": "", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
"""The campaign's file alone says how commands run; scenes share the cores."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Command:
    """A command of a stage."""

    stage: str
    words: tuple[str, ...]
    """As they are typed behind `realsim`."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Ended:
    """How a command ended."""

    stage: str
    words: tuple[str, ...]
    """The command."""
    code: int
    """Exit code; negative: the signal that ended it."""
    wall_s: float
    cpu_s: float
    """User and system time of the command with its processes [s]."""
    peak_mb: float
    """Largest memory of one process [MB]."""
    told: str
    """Why it failed, in its own words."""
    result: str = ""
    """What the stage left in the scene, see `result_of`; empty = it leaves no record."""
    notes: tuple[str, ...] = ()
    """What a command that did its work had to say."""

    @property
    def is_done(self) -> bool:
        """Return whether it did its work."""
        return self.code in (DONE, LOOK)


def run_chain(
    commands: Sequence[Command], scene: Path, folder: Path, log: Path
) -> tuple[Ended, ...]:
    """Run commands on a scene, one after the other until one fails; return how they ended.

    A command that was killed is begun once more: it goes on where it stopped.

    Args:
        commands: in their order.
        scene: stands for `SCENE` in them.
        folder: in which they run; on another machine, where it is not, the scene's.
        log: file that their output is added to, if its folder is there.
    """
    ends: list[Ended] = []
    for command in commands:
        end = run_command(command, scene, folder, log)
        if end.code < 0:
            end = run_command(command, scene, folder, log)
        ends.append(end)
        if not end.is_done:
            break
    # At the end: a later stage may renew what an earlier one recorded.
    return tuple(replace(e, result=result_of(scene, e.stage) if e.is_done else "") for e in ends)


def result_of(scene: Path, stage: str) -> str:
    """Return the sha256 of a stage's record, and of names and sizes of the files of its result.

    Empty: there is no record.
    """
    record = scene / provenance.file_of(stage)
    if not record.is_file():
        return ""
    _, patterns = AGAIN.get(stage, (None, ()))
    paths = {p for pattern in patterns for p in scene.glob(pattern)}
    paths |= {p for folder in paths if folder.is_dir() for p in folder.rglob("*")}
    sizes = [
        f"{p.relative_to(scene).as_posix()} {p.stat().st_size}\n"
        for p in sorted(paths)
        if p.is_file() and p.parent.name != record.parent.name
    ]
    left = hashlib.sha256("".join(sizes).encode()).hexdigest()
    return f"{provenance.sha256_of(record)} {left}"


def run_command(command: Command, scene: Path, folder: Path, log: Path) -> Ended:
    """Run one command and return how it ended; arguments as of `run_chain`."""
    words = [str(scene) if word == SCENE else word for word in command.words]
    with ExitStack() as opened:
        out = opened.enter_context(log.open("ab") if log.parent.is_dir() else TemporaryFile())
        out.write(f"$ realsim {' '.join(words)}\n".encode())
        out.flush()
        start, begun = out.tell(), time.monotonic()
        process = subprocess.Popen(
            [*PROGRAM, *words], cwd=folder if folder.is_dir() else scene.parent,
            stdin=subprocess.DEVNULL, stdout=out, stderr=out, env=os.environ | ENVIRONMENT,
        )  # fmt: skip
        try:
            _, status, used = os.wait4(process.pid, 0)
        except BaseException:
            process.terminate()
            process.wait()
            raise
        process.returncode = code = os.waitstatus_to_exitcode(status)
        with Path(f"/proc/self/fd/{out.fileno()}").open("rb") as written:
            is_done = code in (DONE, LOOK)
            told = "" if is_done else _last_words(written, start, code)
            notes = _notes(written, start) if is_done else ()
    return Ended(
        stage=command.stage,
        words=command.words,
        code=code,
        wall_s=time.monotonic() - begun,
        cpu_s=used.ru_utime + used.ru_stime,
        peak_mb=used.ru_maxrss / 1024,
        told=told,
        notes=notes,
    )


def child() -> None:
    """Run a command as a child that ends with its parent: two runs never meet in a folder."""
    from realsim.app.cli import main

    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a pool's process ignores it
    main()


def _tail(written: BinaryIO, start: int) -> str:
    written.seek(max(start, written.seek(0, os.SEEK_END) - TAIL_BYTES))
    return written.read().decode("utf-8", "replace")


def _notes(written: BinaryIO, start: int) -> tuple[str, ...]:
    """Return the first notes of a command, of each that is said of several scenes one."""
    lines = _tail(written, start).splitlines()
    notes = [x[len(NOTE) : WORDS] for x in lines if x.startswith(NOTE)]
    return tuple({n.partition(": ")[2]: n for n in reversed(notes)}.values())[::-1][:MOST_NOTES]


def _last_words(written: BinaryIO, start: int, code: int) -> str:
    """Return why a command failed, in its own words."""
    lines = _tail(written, start).strip().splitlines()
    errors = [k for k, line in enumerate(lines) if line.lower().startswith("error: ")]
    told = " ".join(lines[errors[-1] if errors else -1 :])
    told = told[len("error: ") :] if errors else told
    if code < 0:
        told = f"ended by signal {-code}, as when memory runs out{f'; {told}' if told else ''}"
    return told[:WORDS] or f"exit code {code}"


# --- what earlier runs did -----------------------------------------------------------------------


def ends_of(record: Path) -> tuple[Ended, ...]:
    """Return what a record holds; a damaged one holds nothing: the commands find out themselves."""
    try:
        return tuple(read_own(record, list[Ended])) if record.is_file() else ()
    except InputError:
        return ()


def are_same(commands: Sequence[Command], ends: Sequence[Ended]) -> list[bool]:
    """Return which commands were run as they are asked for now."""
    return [_plain(c.words) == _plain(e.words) for c, e in zip(commands, ends, strict=False)]


def begun_anew(
    commands: Sequence[Command], steps: Sequence[Step], ends: Sequence[Ended]
) -> list[Command]:
    """Return commands that begin anew what was done with other options, or of other results."""
    same = are_same(commands, ends)
    return [
        replace(c, words=(*c.words, RESTART))
        if step.has_restart and RESTART not in c.words and False in same[: k + 1] and k < len(same)
        else c
        for k, (c, step) in enumerate(zip(commands, steps, strict=True))
    ]


def _plain(words: Sequence[str]) -> list[str]:
    """Return a command without what changes no result: its processes, and that it begins anew."""
    at = words.index("--workers") if "--workers" in words else len(words)
    return [word for word in (*words[:at], *words[at + 2 :]) if word != RESTART]


def take_away(before: Path, new: Path) -> Path | None:
    """Remove what an earlier run wrote into a folder; return where the rest stays, if there is any.

    Args:
        before: the folder, moved aside.
        new: the same as it was made anew.
    """
    sums = before / SUMS_FILE
    written = dict(listed_sums(sums, before.resolve())) if sums.is_file() else {}
    for path in [p for p in before.rglob("*") if p.is_file()]:
        name = path.relative_to(before).as_posix()
        if name in written:
            is_own = written[name] == provenance.sha256_of(path)
        else:
            is_own = name in OWN_FILES or (not written and (new / name).is_file())
        if is_own:
            path.unlink()
    for folder in sorted((p for p in before.rglob("*") if p.is_dir()), reverse=True):
        with suppress(OSError):  # not empty
            folder.rmdir()
    if not any(before.iterdir()):
        before.rmdir()
        return None
    names = (f"{new.name}.kept{f'_{k}' if k > 1 else ''}" for k in count(1))
    kept = next(p for p in map(new.with_name, names) if not p.exists())
    before.rename(kept)
    return kept
